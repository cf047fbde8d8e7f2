"""Adapts depth priors, one adapter per file; ``PRIORS`` lists them, ``find_prior`` finds one (paper S4).

To add a prior, add a file with a ``DepthPrior`` and a row of ``PRIORS``; tests/contracts/test_priors.py picks
it up (docs/how-to/extending.md). diffusers is imported from this layer on.
Layer 7: imports ``evidence`` and below; imported by ``runtime``, ``bundled`` and ``jobs``. Priors have no
access to cameras.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from diffusers import DiffusionPipeline

from geodiff_plugin._internal.checks import bad_type, bad_value, check_choice
from geodiff_plugin.priors.depthfm import DepthFMPipeline
from geodiff_plugin.priors.depthmaster import DepthMasterPipeline
from geodiff_plugin.priors.geowizard import GeoWizardPipeline
from geodiff_plugin.priors.loading import BUNDLED_FOLDER, Layout, check_supported, fetch, no_bars, reading
from geodiff_plugin.priors.lotus import LotusPipeline
from geodiff_plugin.priors.map import MAP_LAYOUT, DepthMapPipeline
from geodiff_plugin.priors.marigold import E2EFTPrior, MarigoldPrior
from geodiff_plugin.priors.marigold_v2 import MarigoldV2Pipeline
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline, DepthPrior
from geodiff_plugin.priors.ppd import PPDPipeline
from geodiff_plugin.priors.transformers_depth import TransformersDepthPipeline
from geodiff_plugin.scale.space import SPACES

__all__ = ["BUNDLED_FOLDER", "PRIORS", "DepthPrior", "PriorSource", "find_prior", "load_prior", "prior_of"]

#: Adapters by key. The first one that recognises a folder loads it, so specific adapters precede general
#: ones.
PRIORS: dict[str, type[DepthPrior]] = {
    "marigold-v2": MarigoldV2Pipeline,
    "geowizard": GeoWizardPipeline,
    "lotus": LotusPipeline,
    "depthmaster": DepthMasterPipeline,
    "depthfm": DepthFMPipeline,
    "ppd": PPDPipeline,
    "transformers": TransformersDepthPipeline,
    "map": DepthMapPipeline,
    "e2e-ft": E2EFTPrior,
    "marigold": MarigoldPrior,
}


def prior_of(pipe: Any) -> DepthPrior:
    """Return the ``DepthPrior`` of a live pipeline: itself or its adapter; ``TypeError`` without one."""
    if isinstance(pipe, DepthDiffusionPipeline):
        return pipe
    for adapter in PRIORS.values():
        if isinstance(pipe, getattr(adapter, "pipeline_class", ())):
            return adapter(pipe)  # type: ignore[call-arg]
    expected = f"a pipeline with an adapter ({', '.join(PRIORS)})"
    loaded = "Load a Hugging Face model ID or a folder with load_prior(name)."
    written = "docs/how-to/extending.md shows how to write one."
    bad_type("pipe", expected, pipe, loaded if isinstance(pipe, str) else written)


@dataclass(frozen=True)
class PriorSource:
    """A prior's folder and the ``key`` of its adapter in ``PRIORS``; ``load`` reads the weights."""

    key: str
    layout: Layout

    @property
    def licence(self) -> str:
        """Licence of the weights, from the model card; for a map, the licence of its model."""
        return "licence of the model that made the map" if self.key == "map" else self.layout.licence

    def load(
        self,
        device: str | torch.device | None = None,
        dtype: torch.dtype = torch.float32,
        space: str | None = None,
    ) -> DiffusionPipeline:
        """Load the pipeline; arguments and errors as in ``load_prior``."""
        if space is not None:
            check_choice(space, "space", SPACES)
        if not isinstance(dtype, torch.dtype) or not dtype.is_floating_point:
            bad_value("dtype", "torch.float32, torch.float16 or torch.bfloat16", repr(dtype))
        if device is not None:
            expected = "a PyTorch device of this machine"
            with reading("device", expected, repr(str(device)), "Try 'cpu'."):
                torch.empty(1, device=device)
        with no_bars() if self.layout.folder == BUNDLED_FOLDER else nullcontext():  # it is small
            pipe = PRIORS[self.key].load(self.layout, dtype, space)
        pipe.register_to_config(_name_or_path=self.layout.name)
        return pipe.to(device) if device is not None else pipe


def find_prior(name: str | Path, variant: str | None = None, **hub: Any) -> PriorSource:
    """Find a prior as in ``load_prior``; ``KEY:NAME`` with a key of ``PRIORS`` selects the adapter."""
    typed = str(name)
    if typed == MAP_LAYOUT.name:
        return PriorSource("map", MAP_LAYOUT)
    key, _, rest = typed.partition(":")
    if rest and key in PRIORS:
        typed = rest
    else:
        check_supported(typed)
        key = _recognise(Layout(fetch(typed, hub), typed))
    return PriorSource(key, Layout(fetch(typed, hub, weights=True, variant=variant), typed, variant))


def _recognise(layout: Layout) -> str:
    """Return the key of the first adapter that recognises the folder."""
    for key, adapter in PRIORS.items():
        if adapter.recognises(layout):
            return key
    hint = f"Supported: {', '.join(PRIORS)} (docs/reference/priors.md); --prior bundled always works."
    if any(layout.folder.glob("*.ckpt")) or any(layout.folder.glob("*.pth")):
        hint = "Convert a checkpoint to such a folder with `geodiff convert SRC DST`."
    got = ", of unknown type" if layout.index else " without model_index.json"
    expected = "a folder in diffusers' layout, or with a transformers depth model"
    bad_value("prior", expected, f"{layout.folder}{got}", hint)


def load_prior(
    name: str | Path,
    device: str | torch.device | None = None,
    dtype: torch.dtype = torch.float32,
    space: str | None = None,
    **kwargs: Any,
) -> DiffusionPipeline:
    """Load a pipeline that can be guided.

    Args:
        name: ``"bundled"``, a folder, or a Hugging Face model ID (``prs-eth/marigold-depth-v1-1``); or
            ``"map"``, whose call takes the ``depth_map`` of another model.
        device: device of the networks, CPU for ``None``.
        dtype: dtype of the networks.
        space: space in which the prior's map is affine, key of ``SPACES``; by default from the folder, or
            depth.
        **kwargs: ``variant`` of the weight files (``"fp16"``), and for the download ``revision``, ``token``,
            ``cache_dir``, ``local_files_only``.

    Raises:
        ValueError: the prior does not exist, is neither cached nor reachable, or is unsupported or unknown;
            its weights do not match; its space is unknown.
    """
    return find_prior(name, **kwargs).load(device, dtype, space)
