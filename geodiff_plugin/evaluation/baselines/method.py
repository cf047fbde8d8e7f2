"""What a method of the evaluation is, what it is given and what it returns."""

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
from geodiff_plugin.jobs.journal import fingerprint
from geodiff_plugin.priors import load_prior
from geodiff_plugin.priors.loading import no_bars
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance


def folder_fingerprint(folder: Path) -> str:
    """Digits that change with any file of the folder; empty where there is none."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    states = [(str(path.relative_to(folder)), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    return fingerprint(states) if states else ""


class NotApplicable(Exception):
    """A method cannot work on a sample; the message is the reason that the tables show."""


@dataclass(frozen=True)
class Settings:
    """What the user chose for a run, the same for every method; ``None`` is the pipeline's own."""

    prior: str = "bundled"
    ensemble: int = 1
    seed: int = 0
    steps: int | None = None  # of denoising
    resolution: int | None = None  # longer side of the image for the prior, pixels
    device: str = "cpu"
    dtype: str = "float32"
    space: str | None = None  # what the prior's map is affine in
    views: int = 2  # of a sample that has more, with the left one
    graphs: bool = False  # networks as CUDA graphs
    no_kernels: bool = False  # every stage in plain torch


@dataclass(frozen=True, eq=False)
class Prediction:
    """One method's answer at the left image's resolution: metres, or ``relative``, affine in ``space``.

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
    """Short hash of a prior's configuration and of samples of its weights."""
    digest = hashlib.sha256()
    # The pipeline's own options are the space of its map, its size, how images are prepared.
    for name, module in [("", pipe), *sorted(pipe.components.items())]:
        config = getattr(module, "config", None)
        config = config if isinstance(config, Mapping) else {}
        # Names that start with an underscore say where it was loaded from and by which version.
        values = {k: v for k, v in config.items() if k[0] != "_"}
        digest.update(json.dumps([name, values], default=str, sort_keys=True).encode())
        if isinstance(module, torch.nn.Module):
            for label, tensor in module.state_dict().items():
                some = tensor.detach().flatten()[:4].double().cpu().numpy()
                digest.update(label.encode() + str(tuple(tensor.shape)).encode() + some.tobytes())
    return digest.hexdigest()[:16]


class PriorCache:
    """Loads a prior once per run, ready to be guided; ``evidence`` is that of the last pairs."""

    def __init__(self) -> None:
        self.evidence, self._pipes = EvidenceStore(), dict[tuple[str | bool | None, ...], Any]()

    def get(self, settings: Settings) -> Any:
        """The pipeline of ``settings.prior`` with geometry guidance enabled; errors as ``load_prior``."""
        speed = {"graphs": settings.graphs, "kernels": not settings.no_kernels}
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
        """What changes with the prior of the settings, also where it was trained further under its name."""
        return _fingerprint(self.get(settings))


@dataclass(frozen=True)
class Method:
    """One entry of ``METHODS``: its key, the heading of its column, and what it does, one sentence.

    ``run`` raises ``NotApplicable`` with a reason; ``configuration`` are the JSON values that change its
    result, beside the prior. ``prior`` and ``seed`` are what it is bound to, whatever the settings say.
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
        """The name without the prior and the seed that the method is bound to."""
        name = self.name if self.seed is None else self.name.removesuffix(f"#{self.seed}")
        return name if self.prior is None else name.removesuffix(f"@{self.prior}")

    def adapted(self, settings: Settings) -> Settings:
        """The settings with the prior and the seed that the method is bound to, if it is."""
        prior = settings.prior if self.prior is None else self.prior
        return replace(settings, prior=prior, seed=settings.seed if self.seed is None else self.seed)
