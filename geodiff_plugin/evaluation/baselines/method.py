"""Interface of a method of the evaluation: its inputs and outputs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evidence.store import EvidenceStore
from geodiff_plugin.jobs import fingerprint
from geodiff_plugin.priors import load_prior
from geodiff_plugin.priors.loading import no_bars
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance


def folder_fingerprint(folder: Path) -> str:
    """Return a digest of all files in the folder; empty if there is none."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    states = [(str(path.relative_to(folder)), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    return fingerprint(states) if states else ""


class NotApplicable(Exception):
    """Raised if a method cannot work on a sample; the message is the reason shown in the tables."""


@dataclass(frozen=True)
class Settings:
    """User settings of a run, common to all methods; ``None`` is the pipeline's default."""

    prior: str = "bundled"
    ensemble: int = 1
    seed: int = 0
    steps: int | None = None  # denoising steps
    resolution: int | None = None  # longer side of the image for the prior, pixels
    device: str = "cpu"
    dtype: str = "float32"
    space: str | None = None  # prediction space of the prior
    views: int = 2  # number of views of a sample that has more, including the left one
    cuda_graphs: bool = False  # run networks as CUDA graphs
    no_triton: bool = False  # use plain torch only


@dataclass(frozen=True, eq=False)
class Prediction:
    """A method's result at the left image's resolution: metres, or ``relative``, affine in ``space``.

    Holes are not finite; larger ``uncertainty`` is less certain; ``confidence`` is in [0, 1].
    """

    depth_m: np.ndarray | None
    relative: np.ndarray | None = None
    space: str = "depth"
    uncertainty: np.ndarray | None = None
    confidence: np.ndarray | None = None
    notes: Mapping[str, Any] = field(default_factory=dict)


@lru_cache(maxsize=8)
def _fingerprint(pipe: Any) -> str:
    """Return a short hash of a prior's configuration and of samples of its weights."""
    digest = hashlib.sha256()
    # The pipeline's options: prediction space, resolution, image preparation.
    for name, module in [("", pipe), *sorted(pipe.components.items())]:
        config = getattr(module, "config", None)
        config = config if isinstance(config, Mapping) else {}
        # Names with a leading underscore state the source and version.
        values = {k: v for k, v in config.items() if k[0] != "_"}
        digest.update(json.dumps([name, values], default=str, sort_keys=True).encode())
        if isinstance(module, torch.nn.Module):
            for label, tensor in module.state_dict().items():
                some = tensor.detach().flatten()[:4].double().cpu().numpy()
                digest.update(label.encode() + str(tuple(tensor.shape)).encode() + some.tobytes())
    return digest.hexdigest()[:16]


class PriorCache:
    """Loads a prior once per run, ready for guidance; ``evidence`` belongs to the most recent pairs."""

    def __init__(self) -> None:
        self.evidence = EvidenceStore()
        self._pipes = dict[tuple[str | bool | None, ...], Any]()

    def get(self, settings: Settings) -> Any:
        """Return the pipeline of ``settings.prior`` with guidance enabled; errors as in ``load_prior``."""
        speed = {"cuda_graphs": settings.cuda_graphs, "kernels": not settings.no_triton}
        key = (settings.prior, settings.device, settings.dtype, settings.space, *speed.values())
        if key not in self._pipes:
            options: dict[str, Any] = {"device": settings.device, "dtype": getattr(torch, settings.dtype)}
            options |= {} if settings.space is None else {"space": settings.space}
            with no_bars():
                pipe = load_prior(settings.prior, **options)
            pipe.set_progress_bar_config(disable=True)
            self._pipes[key] = enable_geometry_guidance(pipe, **speed)
        return self._pipes[key]

    def fingerprint(self, settings: Settings) -> str:
        """Return a value that changes with the prior, also if it was trained further under the same name."""
        return _fingerprint(self.get(settings))


@dataclass(frozen=True)
class Method:
    """One entry of ``METHODS``: its key, the heading of its column, and a one-sentence description.

    ``run`` raises ``NotApplicable`` with a reason; ``configuration`` returns the JSON values that affect its
    result, besides the prior. ``prior`` and ``seed`` override the settings.
    """

    name: str
    title: str
    summary: str
    run: Callable[[StereoSample, Settings, PriorCache], Prediction]
    configuration: Callable[[Settings], dict[str, Any]]
    uses_prior: bool
    prior: str | None = None
    seed: int | None = None

    @property
    def base_name(self) -> str:
        """Name without the bound prior and seed."""
        name = self.name if self.seed is None else self.name.removesuffix(f"#{self.seed}")
        return name if self.prior is None else name.removesuffix(f"@{self.prior}")

    def adapted(self, settings: Settings) -> Settings:
        """Return the settings with the method's bound prior and seed, if any."""
        prior = settings.prior if self.prior is None else self.prior
        return replace(settings, prior=prior, seed=settings.seed if self.seed is None else self.seed)
