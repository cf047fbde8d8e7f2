"""Options of every command of ``geodiff eval``, and the table of the commands; nothing here imports torch."""

from __future__ import annotations

import shlex
from collections.abc import Collection
from dataclasses import MISSING, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geodiff_plugin.options import (
    DTYPES,
    OUTPUT,
    SPACES,
    Command,
    PriorOptions,
    check_options,
    declare,
    flag_of,
    imported,
)

if TYPE_CHECKING:
    from geodiff_plugin.evaluation.baselines import Settings

PEERS = ("prior-aligned", "search-only", "paper", "guided", "sgbm")
STRENGTH_METHODS = ("prior-aligned", "prior-fit", "guided", "search-only", "guided:inner_steps=5")
FIGURES = ("gs-sweep", "inner-steps", "ablation", "qualitative")
#: Emulated priors: mean absolute error of log depth, whether the map is blurred, its exponent, 1 for none.
STRENGTHS = {f"{percent}%": (percent / 100, False, 1.0) for percent in (2, 5, 10, 20)}
STRENGTHS = {"exact": (0.0, False, 1.0), **STRENGTHS, "blur": (0.01, True, 1.0), "gamma": (0.0, False, 1.6)}
#: How depth of a sequence is made, by the title of its row.
WAYS = {
    "alone": "each frame alone",
    "steady": "averaged with three before and after",
}
#: Title, poses of the capture, knob ``pose`` of every call.
CAPTURE_ROWS = {
    "given": ("poses as given", "given", "given"),
    "pairs": ("refined by pairs", "given", "refine"),
    "capture": ("solved over the capture", "refined", "given"),
}


def _out(folder: str) -> Any:
    return declare(Path(folder), "Records and results; resumed where it exists.", "--out", "-o", panel=OUTPUT)


def _list(default: tuple[Any, ...], help_text: str, **rules: Any) -> Any:
    """A tuple that is typed with commas."""
    return declare(default, help_text, split=True, **rules)


def _some(names: Collection[str]) -> Any:
    return _list(tuple(names), f"Comma-separated: {', '.join(names)}.", choices=names)


def _count(default: int | None, help_text: str, low: int = 1, high: int = 10**9) -> Any:
    return declare(default, help_text, low=low, high=high)


def _dir(help_text: str, *flags: str, default: Any = None) -> Any:
    return declare(default, help_text, *flags, metavar="DIR")


@dataclass(frozen=True, kw_only=True)
class OutOptions:
    """What every command is told."""

    seed: int = declare(0, "Seed of the noise.")
    steps: int | None = _count(None, "Denoising steps; each method's own by default.", high=1000)
    out: Path = _out("geodiff-eval")
    results: Path | None = declare(None, "Write the Markdown page here as well.", panel=OUTPUT)
    quiet: bool = declare(False, "No bar and nothing on the screen.", "--quiet", "-q", panel=OUTPUT)

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def settings(self) -> Settings:
        """What methods are given; imports torch."""
        from geodiff_plugin.evaluation.baselines import Settings
        from geodiff_plugin.runtime.machine import pick_device

        given: dict[str, Any] = {f.name: getattr(self, f.name, f.default) for f in fields(Settings)}
        return Settings(**given | {"device": str(pick_device(given["device"]))})


@dataclass(frozen=True, kw_only=True)
class EvalOptions(OutOptions, PriorOptions):
    """What every command that runs a prior is told."""

    dtype: str = declare("float32", f"{', '.join(DTYPES)}.", choices=DTYPES)


@dataclass(frozen=True, kw_only=True)
class SampleOptions(EvalOptions):
    """Which samples, of what data."""

    data: Path | None = _dir("Folder with data sets, or the name of a registered set.")
    methods: tuple[str, ...] = _list((), "Comma-separated, see geodiff eval list; beside the built-in rows.")
    datasets: tuple[str, ...] = _list((), "Comma-separated; all that the folder has by default.")
    scenes: tuple[str, ...] = _list((), "Comma-separated parts of sample names to keep.")
    limit: int | None = _count(None, "The first N samples alone; in a table of the paper, of each set.")
    ensemble: int = _count(1, "Ensemble members.", high=1000)
    resolution: int | None = _count(None, "Longer side for the prior, pixels.", 0, 8192)
    views: int = _count(2, "Views that methods take of a group that has more than two.", 2, 100)
    perturb: str | None = declare(None, "Wrong poses: turn, shift / baseline.", metavar="DEGREES,SHARE")


@dataclass(frozen=True, kw_only=True)
class PairsOptions(SampleOptions):
    """``geodiff eval pairs``, and without a few the tables of the paper, of parts, flatness and cost."""

    sample: int | None = _count(None, "Draw this many samples at random, by --seed.")
    pairs: str = declare("default", "Of posed views: default (two) or all.", choices=("default", "all"))
    pixel_centre: float | None = declare(None, "First pixel's centre in posed cameras, 0.5 for COLMAP's.")
    skip_broken: bool = declare(False, "Go on after a broken sample and count it.", panel=OUTPUT)
    save_depth: bool = declare(False, "Write every depth map as .npy.", panel=OUTPUT)


@dataclass(frozen=True, kw_only=True)
class DirOptions(PairsOptions):
    """``geodiff eval pairs DIR``."""

    data: Path | None = _dir("Folder of data sets, or the name of a registered set.", "", default=MISSING)
    methods: tuple[str, ...] = _list(PEERS, "Comma-separated, see geodiff eval list.")


@dataclass(frozen=True, kw_only=True)
class FigureOptions(SampleOptions):
    """``geodiff eval figure NAME``."""

    name: str = declare(MISSING, f"{', '.join(FIGURES)}.", "", metavar="NAME")
    max: float = declare(80.0, "gs-sweep: the last g_s, metres.", low=1.01, high=1e6)
    updates: tuple[int, ...] = _list((1, 2, 5, 10, 20, 40), "inner-steps: updates a step.", low=1, high=10**4)
    results: Path | None = field(default=None)
    clouds: bool = declare(False, "qualitative, ablation: point clouds from another view too.")


@dataclass(frozen=True, kw_only=True)
class StrengthOptions(OutOptions):
    """``geodiff eval strength``."""

    data: tuple[Path, ...] = _dir("Folder of data sets, or a registered set; may be repeated.", default=())
    limit: int | None = _count(None, "The first N pairs alone, of each --data.")
    strengths: tuple[str, ...] = _some(STRENGTHS)
    space: str = declare("disparity", "Affine in disparity, depth or log.", choices=SPACES[:3])
    follow: float = declare(0.3, "How far the prior's later answers follow their input.", low=0.0, high=1.0)
    methods: tuple[str, ...] = _list(STRENGTH_METHODS, "Methods that use a prior, see geodiff eval list.")
    steps: int | None = _count(4, "Denoising steps.", high=1000)
    resolution: int = _count(384, "Longer side for the prior, pixels.", 64, 8192)


@dataclass(frozen=True, kw_only=True)
class SequenceOptions(EvalOptions):
    """``geodiff eval sequence``."""

    scenes: int = _count(4, "Sequences, of the seeds from 0 on.", high=10_000)
    frames: int = _count(6, "Frames of each.", 2, 10_000)
    size: tuple[int, int] = field(default=(192, 256))
    ways: tuple[str, ...] = _some(WAYS)
    steps: int | None = _count(4, "Denoising steps of a frame alone.", high=1000)


@dataclass(frozen=True, kw_only=True)
class RealOptions(EvalOptions):
    """Real pairs beside rendered ones."""

    data: Path | None = _dir("Folder of real pairs; none by default.")
    limit: int | None = _count(None, "The first N real pairs alone.")
    rendered: int = _count(0, "Pairs of the registered set 'synthetic'.", 0, 10**6)
    width: int = _count(512, "Width of the rendered pairs, pixels.", 64, 8192)


@dataclass(frozen=True, kw_only=True)
class TrustOptions(RealOptions):
    """``geodiff eval trust``."""

    kinds: tuple[str, ...] = _list((), "Comma-separated kinds of wrong calibration; all by default.")
    out: Path = _out("geodiff-trust")


@dataclass(frozen=True, kw_only=True)
class PosesOptions(RealOptions):
    """``geodiff eval poses``."""

    perturb: str = declare("1.5,0.1", "Rendered: turn, shift / baseline.", metavar="DEGREES,SHARE")
    drift: str = declare("0.3,1.5", "Rectified: turn and shift of the right image.", metavar="DEGREES,PIXELS")
    resolution: int | None = _count(None, "Longer side for the prior, pixels.", 0, 8192)
    out: Path = _out("geodiff-poses")


@dataclass(frozen=True, kw_only=True)
class CaptureEvalOptions(EvalOptions):
    """``geodiff eval capture DIR ...``."""

    data: tuple[Path, ...] = _dir("Captures that name depth maps of their frames.", "", default=MISSING)
    frames: str | None = declare(None, "NAME,NAME or FIRST:LAST:STEP; all by default.")
    count: int | None = _count(None, "So many frames of each, evenly spread, in place of --frames.", 2)
    neighbours: tuple[int, ...] = _list((2, 3, 5), "Comma-separated numbers of right views.", low=1, high=32)
    rows: tuple[str, ...] = _some(CAPTURE_ROWS)


def _run(name: str, where: str, options: OutOptions) -> Any:
    """The page, the path of a figure, or ``None`` in a process that writes nothing."""
    return imported(f"evaluation.{where}")(name, options)


_PAPER, _CHANGES = "paper.run_paper_table", "pairs.run_changes"
_TABLE: dict[str, tuple[type[OutOptions], str, str]] = {
    "pairs": (DirOptions, "pairs.run_pairs", "Methods side by side on every metric pair below DIR."),
    "table1": (PairsOptions, _PAPER, "Table 1: KITTI, Booster and Middlebury, in metres and aligned."),
    "table2": (PairsOptions, _PAPER, "Table 2: Booster, beside stereo."),
    "table3": (PairsOptions, _PAPER, "Table 3: two posed views, Tanks and Temples."),
    "ablation": (PairsOptions, _PAPER, "Table 4, and one change at a time: gradients, rules, terms."),
    "parts": (PairsOptions, _CHANGES, "The default with one of its parts left out at a time."),
    "flatness": (PairsOptions, _CHANGES, "Every number of the default, at half and at twice."),
    "cost": (PairsOptions, "pairs.run_cost", "Seconds and peak memory, plain against guided."),
    "strength": (StrengthOptions, "strength.run_strength", "Emulated priors from exact to weak."),
    "sequence": (SequenceOptions, "frames.run_sequence", "Frames of a moving rig; error, flicker."),
    "figure": (FigureOptions, "figures.run_figure", "Draw one figure as PNG, its numbers as JSON."),
    "trust": (TrustOptions, "calibrations.run_trust", "How many wrong calibrations are detected."),
    "poses": (PosesOptions, "calibrations.run_poses", "Poses given, perturbed, refined, estimated."),
    "capture": (CaptureEvalOptions, "frames.run_capture_eval", "Depth of a capture (extra capture)."),
}
#: Every command but ``list``, by name.
COMMANDS = {
    name: Command(kind, partial(_run, name, where), about) for name, (kind, where, about) in _TABLE.items()
}


def command_line(name: str, options: Any) -> str:
    """The command line that gives these options, defaults and what changes no number left out."""
    words, without = ["geodiff", "eval", name], ("out", "results", "quiet", "skip_broken", "save_depth")
    for each in fields(options):
        value, rules = getattr(options, each.name), each.metadata
        if not rules or each.name in without or value == each.default:
            continue
        flag = [flag_of(each)] if rules["flags"] != ("",) else []
        entries = value if isinstance(value, tuple) and not rules["split"] else (value,)
        for entry in entries:
            text = ",".join(map(str, entry)) if isinstance(entry, tuple) else str(entry)
            words += flag + ([] if entry is True else [text])
    return shlex.join(words)
