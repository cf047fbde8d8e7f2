"""Adapters of diffusion depth priors, one a file, and how a prior is found by name.

Hop: name or folder -> pipeline -> ``DepthPrior``.
Paper: S4 (any diffusion-based depth model with iterative updates).

A new prior is a new file and one line in ``PRIORS``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from diffusers import DiffusionPipeline
from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError, RepositoryNotFoundError

from geodiff_plugin._checks import bad_type, bad_value
from geodiff_plugin.priors.base import DepthPrior, OwnPipelinePrior
from geodiff_plugin.priors.geowizard import GeoWizardPrior
from geodiff_plugin.priors.marigold import MarigoldPrior
from geodiff_plugin.priors.ppd import PPDPrior
from geodiff_plugin.priors.transformers_depth import TransformersDepthPrior

__all__ = ["PRIORS", "DepthPrior", "find_adapter", "load_prior"]

PRIORS: dict[str, type[DepthPrior]] = {
    "geowizard": GeoWizardPrior,
    "marigold": MarigoldPrior,
    "ppd": PPDPrior,
    "transformers": TransformersDepthPrior,
}

BUNDLED_FOLDER = Path(__file__).resolve().parents[1] / "bundled" / "prior"


def find_adapter(pipe: Any) -> type[DepthPrior]:
    """The class in ``PRIORS`` that understands a live pipeline.

    A ``DepthDiffusionPipeline`` that is not in the table says of itself what guidance must know.

    Raises:
        TypeError: none does.
    """
    for adapter in (*PRIORS.values(), OwnPipelinePrior):
        if adapter.matches(pipe):
            return adapter
    bad_type(
        "pipe",
        f"a pipeline with an adapter ({', '.join(PRIORS)})",
        pipe,
        "docs/extending.md shows how to write one.",
    )


def load_prior(
    name: str | Path,
    device: str | torch.device | None = None,
    dtype: torch.dtype = torch.float32,
    **kwargs: Any,
) -> DiffusionPipeline:
    """Load a pipeline that can be guided.

    Args:
        name: ``"bundled"``, a folder in diffusers' layout, or a hub id (``prs-eth/marigold-depth-v1-1``).
        device: where to, CPU for ``None``.
        dtype: of U-Net and VAE.
        **kwargs: for ``from_pretrained`` (``revision``, ``variant``, ``token``, ``local_files_only``, ...).

    Raises:
        ValueError: it does not exist, or is neither cached nor can be fetched.
        TypeError: it loads, but has no adapter.
    """
    source = str(BUNDLED_FOLDER) if str(name) == "bundled" else str(name)
    if Path(source).is_dir():
        if not (Path(source) / "model_index.json").is_file():
            cure = "Name the folder that save_pretrained wrote, or use the bundled prior: --prior bundled."
            bad_value("prior", "a folder in diffusers' layout", f"{source} without model_index.json", cure)
        kwargs["local_files_only"] = True
    elif source.count("/") > 1 or source.startswith((".", "/", "~")):
        bad_value("prior", "'bundled', a folder that is there, or a hub id", repr(source), "Check the path.")
    try:
        pipe = DiffusionPipeline.from_pretrained(source, dtype=dtype, **kwargs)
    except (
        LocalEntryNotFoundError,
        RepositoryNotFoundError,
        HFValidationError,
        OSError,
        ConnectionError,
    ) as error:
        cure = "Fetch it once with `hf download ID` while online, give a folder, or use --prior bundled."
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(
            "prior must be 'bundled', a folder or a hub id that is cached or can be reached; "
            f"got {str(name)!r} ({reason}). {cure}"
        ) from error
    find_adapter(pipe)
    return pipe.to(device) if device is not None else pipe
