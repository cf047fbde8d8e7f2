"""Options of the experiments, declared like the options of ``geodiff eval``; does not import torch."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field
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
from geodiff_plugin.options import SPACES
from geodiff_plugin.settings import setting


class Strength(NamedTuple):
    """Error of an emulated prior: mean absolute error of log depth, blur, exponent of the map."""

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
STRENGTH_METHODS = ("prior-aligned", "prior-fit", "guided", "search-only", "guided:guidance_steps=5")


class MapError(NamedTuple):
    """Error of a depth map that is otherwise the ground truth."""

    far: float = 1.0  # factor on depth beyond the median
    smooth: float = 0.0  # standard deviation of a smooth field, log depth
    patches: float = 0.0  # standard deviation of the patches over 30 % of the image, log depth


MAP_ERRORS = {
    "far": MapError(far=0.9),
    "smooth1": MapError(smooth=0.01),
    "smooth5": MapError(smooth=0.05),
    "smooth10": MapError(smooth=0.1),
    "smooth15": MapError(smooth=0.15),
    "patches": MapError(patches=0.4),
}
#: Ways to process a sequence, and the titles of their rows.
WAYS = {
    "alone": "independent",
    "temporal_smoothing": "smoothed over three before and after",
}


@dataclass(frozen=True, kw_only=True)
class StrengthOptions(OutOptions):
    """Options of ``strength``: the effect of prior quality."""

    data: tuple[Path, ...] = folder_of(
        "Folder of datasets, or the name of a known dataset; repeatable.", default=()
    )
    limit: int | None = count_of(None, "Maximum number of pairs, taken from the start of each --data.")
    strengths: tuple[str, ...] = some_of(STRENGTHS)
    space: str = setting(
        "disparity",
        "Quantity that the prior predicts up to scale and shift: disparity, depth or log.",
        choices=SPACES[:3],
    )
    follow: float = setting(
        0.3, "How much the prior's later predictions follow their input, 0 to 1.", low=0.0, high=1.0
    )
    methods: tuple[str, ...] = listed(
        STRENGTH_METHODS, "Methods that use a prior; geodiff eval list shows them."
    )
    steps: int | None = count_of(4, "Number of denoising steps.", high=1000)
    resolution: int = count_of(384, "Longer side of the prior's input in pixels.", 64, 8192)


@dataclass(frozen=True, kw_only=True)
class PriorMapsOptions(EvalOptions):
    """Options of ``prior-maps``: guided calls with depth maps that have errors."""

    data: tuple[Path, ...] = folder_of(
        "Folder of datasets, or the name of a known dataset; repeatable.", default=()
    )
    scenes: tuple[str, ...] = listed(
        (), "Only pairs whose names contain one of these words, separated by commas."
    )
    limit: int | None = count_of(None, "Maximum number of pairs, taken from the start of each --data.")
    errors: tuple[str, ...] = some_of(MAP_ERRORS)
    maps: tuple[str, ...] = listed(
        (), "Folders of further maps, DIR or KIND:DIR as in the method prior-map, separated by commas."
    )
    out: Path = out_folder("geodiff-prior-maps")


@dataclass(frozen=True, kw_only=True)
class SequenceOptions(EvalOptions):
    """Options of ``sequence``: flicker between frames of a moving rig."""

    scenes: int = count_of(4, "Number of sequences, with seeds from 0.", high=10_000)
    frames: int = count_of(6, "Number of frames per sequence.", 2, 10_000)
    size: tuple[int, int] = field(default=(192, 256))
    ways: tuple[str, ...] = some_of(WAYS)
    steps: int | None = count_of(4, "Number of denoising steps per frame.", high=1000)


@dataclass(frozen=True, kw_only=True)
class SurfacesOptions:
    """Options of ``surfaces``: planarity and smoothness after every stage of a call."""

    data: tuple[str, ...] = setting(
        MISSING, "Folder with planes.json, data sets or synthetic-plain:N; repeatable."
    )
    prior: str = setting("bundled", "Prior to guide.")
    seed: int = setting(0, "Seed for the random noise.")
    out: Path | None = setting(None, "Folder for one figure per pair.")
    without: str | None = setting(None, "Stage to omit: median or planar.", choices=("median", "planar"))


@dataclass(frozen=True, kw_only=True)
class TrustOptions(EvalOptions):
    """Options of ``trust``: wrong calibrations of real and rendered pairs."""

    data: Path | None = folder_of("Folder of real pairs (default: none).")
    limit: int | None = count_of(None, "Maximum number of real pairs, from the first.")
    rendered: int = count_of(0, "Number of rendered pairs.", 0, 10**6)
    width: int = count_of(512, "Width of the rendered pairs in pixels.", 64, 8192)
    kinds: tuple[str, ...] = listed(
        (), 'Kinds of errors, separated by commas (default: all); "right" for none.'
    )
    out: Path = out_folder("geodiff-trust")
