"""Options of the laboratories, declared as those of ``geodiff eval``; nothing here imports torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from geodiff_plugin.evaluation.options import (
    EvalOptions,
    OutOptions,
    count_of,
    folder_of,
    listed,
    out_folder,
    some_of,
)
from geodiff_plugin.options import SPACES, declare


class Strength(NamedTuple):
    """How an emulated prior errs: mean absolute error of log depth, a blurred map, exponent of the map."""

    error: float
    blurred: bool = False
    gamma: float = 1.0


STRENGTHS = {
    "exact": Strength(0.0),
    "2%": Strength(0.02),
    "5%": Strength(0.05),
    "10%": Strength(0.1),
    "20%": Strength(0.2),
    "blur": Strength(0.01, blurred=True),
    "gamma": Strength(0.0, gamma=1.6),
}
STRENGTH_METHODS = ("prior-aligned", "prior-fit", "guided", "search-only", "guided:inner_steps=5")
#: How depth of a sequence is made, by the title of its row.
WAYS = {
    "alone": "each frame alone",
    "steady": "averaged with three before and after",
}


@dataclass(frozen=True, kw_only=True)
class StrengthOptions(OutOptions):
    """Priors from exact to weak."""

    data: tuple[Path, ...] = folder_of(
        "Folder of data sets, or a registered set; may be repeated.", default=()
    )
    limit: int | None = count_of(None, "The first N pairs alone, of each --data.")
    strengths: tuple[str, ...] = some_of(STRENGTHS)
    space: str = declare("disparity", "Affine in disparity, depth or log.", choices=SPACES[:3])
    follow: float = declare(0.3, "How far the prior's later answers follow their input.", low=0.0, high=1.0)
    methods: tuple[str, ...] = listed(STRENGTH_METHODS, "Methods that use a prior, see geodiff eval list.")
    steps: int | None = count_of(4, "Denoising steps.", high=1000)
    resolution: int = count_of(384, "Longer side for the prior, pixels.", 64, 8192)


@dataclass(frozen=True, kw_only=True)
class SequenceOptions(EvalOptions):
    """Sequences of a moving rig."""

    scenes: int = count_of(4, "Sequences, of the seeds from 0 on.", high=10_000)
    frames: int = count_of(6, "Frames of each.", 2, 10_000)
    size: tuple[int, int] = field(default=(192, 256))
    ways: tuple[str, ...] = some_of(WAYS)
    steps: int | None = count_of(4, "Denoising steps of a frame alone.", high=1000)


@dataclass(frozen=True, kw_only=True)
class TrustOptions(EvalOptions):
    """Wrong calibrations, of real pairs and of rendered ones."""

    data: Path | None = folder_of("Folder of real pairs; none by default.")
    limit: int | None = count_of(None, "The first N real pairs alone.")
    rendered: int = count_of(0, "Rendered pairs.", 0, 10**6)
    width: int = count_of(512, "Width of the rendered pairs, pixels.", 64, 8192)
    kinds: tuple[str, ...] = listed(
        (), 'Comma-separated kinds; all wrong ones by default, "right" for no wrong one.'
    )
    out: Path = out_folder("geodiff-trust")
