"""What a method under test is given and what it returns (paper S5.1)."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin.bundled import no_bars
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.guidance.evidence import EvidenceStore
from geodiff_plugin.priors import load_prior
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance


def folder_fingerprint(folder: Path) -> str:
    """16 hexadecimal digits that change with any file of the folder; empty where there is no such folder."""
    if not os.path.isdir(folder):
        return ""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        status = path.stat()
        digest.update(f"{path.relative_to(folder)} {status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]


class NotApplicable(Exception):
    """A method cannot work on a sample; the message is the reason that the tables show."""


@dataclass(frozen=True)
class Settings:
    """What the user chose for a run, the same for every method.

    ``steps`` and ``resolution`` (longer side, pixels) are the pipeline's own where they are ``None``;
    ``space`` is for a prior that does not say; at most ``views`` views of a sample are taken.
    """

    prior: str = "bundled"
    ensemble: int = 1
    seed: int = 0
    steps: int | None = None
    resolution: int | None = None
    device: str = "cpu"
    dtype: str = "float32"
    space: str | None = None
    views: int = 2


@dataclass(frozen=True, eq=False)
class Prediction:
    """One method's answer for one sample, at the left image's resolution.

    All ``(H, W)``: ``depth_m`` metres, not finite in holes, or ``relative``, affine in ``space``, in which an
    oracle aligns it; perhaps ``uncertainty``, larger is less certain, and ``confidence`` in [0, 1]. ``notes``
    are JSON values.
    """

    depth_m: np.ndarray | None
    relative: np.ndarray | None = None
    space: str = "depth"
    uncertainty: np.ndarray | None = None
    confidence: np.ndarray | None = None
    notes: Mapping[str, Any] = field(default_factory=dict)


class PriorCache:
    """Loads a prior once per run, ready to be guided; ``evidence`` is that of the last pairs."""

    def __init__(self) -> None:
        self.evidence = EvidenceStore()
        self._pipes: dict[tuple[str | None, ...], Any] = {}
        self._fingerprints: dict[tuple[str | None, ...], str] = {}

    @staticmethod
    def _key(settings: Settings) -> tuple[str | None, ...]:
        return settings.prior, settings.device, settings.dtype, settings.space

    def get(self, settings: Settings) -> Any:
        """The pipeline of ``settings.prior`` with geometry guidance enabled; errors as ``load_prior``."""
        key = self._key(settings)
        if key not in self._pipes:
            options: dict[str, Any] = {"device": settings.device, "dtype": getattr(torch, settings.dtype)}
            options |= {} if settings.space is None else {"space": settings.space}
            with no_bars():
                pipe = load_prior(settings.prior, **options)
            pipe.set_progress_bar_config(disable=True)
            self._pipes[key] = enable_geometry_guidance(pipe)
        return self._pipes[key]

    def fingerprint(self, settings: Settings) -> str:
        """Short hash of the prior's configuration and of samples of its weights.

        A prior that was trained further under the same name has another one: its old results do not count.
        """
        key = self._key(settings)
        if key not in self._fingerprints:
            pipe, digest = self.get(settings), hashlib.sha256()
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
            self._fingerprints[key] = digest.hexdigest()[:16]
        return self._fingerprints[key]


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

    def own_settings(self, settings: Settings) -> Settings:
        """The settings with the prior and the seed that the method is bound to, if it is."""
        prior = settings.prior if self.prior is None else self.prior
        return replace(settings, prior=prior, seed=settings.seed if self.seed is None else self.seed)
