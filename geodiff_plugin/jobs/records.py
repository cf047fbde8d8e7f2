"""Records of a pair at each step from its files to its output folder."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from geodiff_plugin._internal.checks import captured_warnings
from geodiff_plugin.cameras import Camera
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.findings import Finding, dedupe
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.types import Rig


@dataclass
class JobLog:
    """Wall-clock seconds of the stages of a job, in order, and all findings that they reported."""

    seconds: dict[str, float] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block, and record its warnings."""
        started = time.perf_counter()
        with captured_warnings() as warned:
            yield
        self.seconds[name] = time.perf_counter() - started
        self.add(warned)

    def add(self, findings: Iterable[Finding]) -> None:
        """Add findings to the stages' findings, each message once."""
        self.findings = list(dedupe(self.findings, findings))


@dataclass(frozen=True, eq=False)
class PairInputs:
    """Inputs of a pair.

    Attributes:
        left: the left view ``(H, W, 3)`` in [0, 1], without lens distortion.
        rig: cameras of the left and right view.
        guidance: the guidance, with all other views.
        undistorted: whether lens distortion was removed from any view.
        prior_map: ``(h, w)``, NaN where unknown; ``None`` without ``--prior-map``.
        cameras: cameras of all views as taken, with their lenses, left one first.
        masks: valid pixels ``(H, W)`` bool of these views as taken; ``None`` for all.
    """

    left: np.ndarray
    rig: Rig
    guidance: GeometryGuidance
    undistorted: bool = False
    prior_map: np.ndarray | None = None
    cameras: tuple[Camera, ...] = ()
    masks: Sequence[Tensor | None] = ()


@dataclass(frozen=True)
class PairOrigin:
    """Identifies a pair of a run over many, with the SHA-256 of its files by path.

    ``frame`` is its number in a video or bag, ``None`` for images.
    """

    name: str
    frame: int | None
    sha256: dict[str, str]


@dataclass(frozen=True, eq=False)
class ReadPair:
    """A pair whose inputs were read; ``origin`` is ``None`` for a run over one pair."""

    options: DepthOptions
    inputs: PairInputs
    log: JobLog
    origin: PairOrigin | None = None


@dataclass(frozen=True, eq=False)
class PairRun:
    """A pair after the guided call.

    ``prior`` describes the prior: name and class of the pipeline, scheduler, device and dtype.
    """

    options: DepthOptions
    inputs: PairInputs
    output: MetricDepthOutput
    prior: dict[str, str]
    log: JobLog
    origin: PairOrigin | None = None


@dataclass(frozen=True, eq=False)
class PairResult:
    """A pair whose results are in ``folder``, with the content of its ``report.json``."""

    run: PairRun
    folder: Path
    report: dict[str, Any]
