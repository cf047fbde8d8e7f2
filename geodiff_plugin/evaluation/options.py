"""Options of every command of ``geodiff eval``, and the table of the commands; nothing here imports torch."""

from __future__ import annotations

import shlex
from collections.abc import Collection
from dataclasses import MISSING, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from geodiff_plugin._lazy import imported
from geodiff_plugin.options import (
    DTYPES,
    OTHERS,
    OUTPUT,
    PRIOR,
    SAMPLES,
    Command,
    PriorOptions,
    SpeedOptions,
    check_engine,
    check_options,
    declare,
    engine_option,
    flag_of,
    gpus_option,
    rules_of,
    workers_option,
)

if TYPE_CHECKING:
    from geodiff_plugin.evaluation.baselines import Settings

PEERS = ("prior-aligned", "search-only", "paper", "guided", "sgbm")
FIGURES = ("gs-sweep", "inner-steps", "ablation", "qualitative")
#: How the commands here are typed; a checkout has more of them, which are typed differently.
PROGRAM = "geodiff eval"


class CaptureRow(NamedTuple):
    """A row of ``geodiff eval capture``: the poses of the capture, and the knob ``pose`` of every call."""

    title: str
    poses: str
    pose: str


CAPTURE_ROWS = {
    "given": CaptureRow("poses as given", poses="given", pose="given"),
    "pairs": CaptureRow("refined by pairs", poses="given", pose="refine"),
    "capture": CaptureRow("solved over the capture", poses="refined", pose="given"),
}


def out_folder(folder: str) -> Any:
    """The folder of a run, by default this one."""
    return declare(
        Path(folder), "Folder of records and results; a run in it is resumed.", "--out", "-o", panel=OUTPUT
    )


def listed(default: tuple[Any, ...], help_text: str, **rules: Any) -> Any:
    """A tuple that is typed with commas."""
    return declare(default, help_text, split=True, **{"panel": SAMPLES, **rules})


def some_of(names: Collection[str]) -> Any:
    """Some of these names, by default all."""
    return listed(tuple(names), f"Which of {', '.join(names)}, separated by commas.", choices=names)


def count_of(
    default: int | None, help_text: str, low: int = 1, high: int = 10**9, panel: str = SAMPLES
) -> Any:
    """A whole number in [low, high]."""
    return declare(default, help_text, low=low, high=high, panel=panel)


def folder_of(help_text: str, *flags: str, default: Any = None) -> Any:
    """A folder, or a registered data set such as the renderer's."""
    return declare(default, help_text, *flags, metavar="DIR", panel=SAMPLES)


@dataclass(frozen=True, kw_only=True)
class OutOptions:
    """What every command is told."""

    seed: int = declare(0, "Seed of the noise.", panel=PRIOR)
    steps: int | None = count_of(
        None, "Denoising steps (default: each method's own).", high=1000, panel=PRIOR
    )
    out: Path = out_folder("geodiff-eval")
    results: Path | None = declare(None, "Also write the page as Markdown to this file.", panel=OUTPUT)
    quiet: bool = declare(False, "Show no progress bar and no result.", "--quiet", "-q", panel=OUTPUT)
    program: str = field(default=PROGRAM)

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
class EvalOptions(SpeedOptions, OutOptions, PriorOptions):
    """What every command that runs a prior is told."""

    dtype: str = declare(
        "float32", f"Number format of the prior: {', '.join(DTYPES)}.", choices=DTYPES, panel=PRIOR
    )


@dataclass(frozen=True, kw_only=True)
class SampleOptions(EvalOptions):
    """Which samples, of what data."""

    data: Path | None = folder_of("Folder with data sets, or the name of a registered set.")
    methods: tuple[str, ...] = listed(
        (), "Further methods, separated by commas; geodiff eval list names them."
    )
    datasets: tuple[str, ...] = listed((), "Data sets, separated by commas (default: all in the folder).")
    scenes: tuple[str, ...] = listed(
        (), "Keep samples whose names hold one of these words, separated by commas."
    )
    limit: int | None = count_of(
        None, "Number of samples taken, from the first; in a table of the paper, of each data set."
    )
    ensemble: int = count_of(1, "Members of the ensemble.", high=1000, panel=PRIOR)
    resolution: int | None = count_of(
        None, "Longer side of the image for the prior, in pixels.", 0, 8192, PRIOR
    )
    views: int = count_of(2, "Number of views taken of a scene that has more than two.", 2, 100)
    perturb: str | None = declare(
        None,
        "Make the poses wrong, by a turn in degrees and a shift as a share of the baseline.",
        metavar="DEGREES,SHARE",
        panel=SAMPLES,
    )


@dataclass(frozen=True, kw_only=True)
class PairsOptions(SampleOptions):
    """What the tables over pairs are told: the paper's, of parts, of flatness, of cost."""

    sample: int | None = count_of(None, "Number of samples drawn at random, by --seed.")
    pairs: str = declare(
        "default",
        "Pairs of posed views: default (two a scene) or all.",
        choices=("default", "all"),
        panel=SAMPLES,
    )
    pixel_centre: float | None = declare(
        None,
        "Coordinate of the first pixel's centre in posed cameras: 0, or 0.5 as COLMAP has it.",
        panel=SAMPLES,
    )
    stop_on_broken: bool = declare(
        False, "End at the first broken sample, instead of leaving it out and saying so.", panel=OUTPUT
    )
    skip_broken: bool = declare(
        False, "Deprecated and without effect: broken samples are left out by default.", panel=OUTPUT
    )
    save_depth: bool = declare(False, "Also write every depth map as .npy.", panel=OUTPUT)


#: Members of the ensemble whose numbers the paper prints (S5.1).
PAPER_ENSEMBLE = 10


@dataclass(frozen=True, kw_only=True)
class PaperOptions(PairsOptions):
    """The tables of the paper, as the paper made them."""

    ensemble: int = count_of(
        PAPER_ENSEMBLE, "Members of the ensemble; the paper has ten.", high=1000, panel=PRIOR
    )


@dataclass(frozen=True, kw_only=True)
class DirOptions(PairsOptions):
    """``geodiff eval pairs DIR``."""

    data: Path | None = folder_of(
        "Folder of data sets, or the name of a registered set.", "", default=MISSING
    )
    methods: tuple[str, ...] = listed(PEERS, "Methods, separated by commas; geodiff eval list names them.")
    engine: str = engine_option()
    workers: int | None = workers_option()
    gpus: float | None = gpus_option()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_engine(self)


@dataclass(frozen=True, kw_only=True)
class FigureOptions(SampleOptions):
    """``geodiff eval figure NAME``."""

    name: str = declare(MISSING, f"Which figure: {', '.join(FIGURES)}.", "", metavar="NAME")
    max: float = declare(80.0, "gs-sweep: the last g_s, in metres.", low=1.01, high=1e6)
    updates: tuple[int, ...] = listed(
        (1, 2, 5, 10, 20, 40),
        "inner-steps: numbers of updates per step, separated by commas.",
        panel=OTHERS,
        low=1,
        high=10**4,
    )
    results: Path | None = field(default=None)
    clouds: bool = declare(False, "qualitative, ablation: also draw point clouds from another view.")


@dataclass(frozen=True, kw_only=True)
class PosesOptions(EvalOptions):
    """``geodiff eval poses``."""

    data: Path | None = folder_of("Folder of pairs, or the name of a registered set (default: none).")
    limit: int | None = count_of(None, "Number of pairs of --data taken, from the first.")
    exact: Path | None = folder_of("The same, of pairs whose poses are exact and are made wrong here.")
    perturb: str = declare(
        "1.5,0.1",
        "How wrong, with --exact: a turn in degrees, a shift as a share of the baseline.",
        metavar="DEGREES,SHARE",
    )
    drift: str = declare(
        "0.3,1.5",
        "How wrong, of rectified pairs: turn and shift of the right image.",
        metavar="DEGREES,PIXELS",
    )
    resolution: int | None = count_of(
        None, "Longer side of the image for the prior, in pixels.", 0, 8192, PRIOR
    )
    out: Path = out_folder("geodiff-poses")


@dataclass(frozen=True, kw_only=True)
class CaptureEvalOptions(EvalOptions):
    """``geodiff eval capture DIR ...``."""

    data: tuple[Path, ...] = folder_of("Captures that name depth maps of their frames.", "", default=MISSING)
    frames: str | None = declare(None, "Frames, NAME,NAME or FIRST:LAST:STEP (default: all).", panel=SAMPLES)
    count: int | None = count_of(
        None, "Number of frames of each capture, evenly spread, instead of --frames.", 2
    )
    neighbours: tuple[int, ...] = listed(
        (2, 3, 5), "Numbers of right views, separated by commas.", low=1, high=32
    )
    rows: tuple[str, ...] = some_of(CAPTURE_ROWS)


def _run(name: str, where: str, options: OutOptions) -> Any:
    """The page, the path of a figure, or ``None`` in a process that writes nothing."""
    return imported(f"evaluation.{where}")(name, options)


class _Entry(NamedTuple):
    """A command: its options, its function as ``module.name`` of the evaluation, and its help."""

    options: type[OutOptions]
    where: str
    about: str


_PAPER = "paper.run_paper_table"
_CHANGES = "pairs.run_changes"
_TABLE = {
    "pairs": _Entry(
        DirOptions,
        "pairs.run_pairs",
        "Compare methods on every pair below DIR whose depth is known in metres.",
    ),
    "table1": _Entry(
        PaperOptions, _PAPER, "Table 1 of the paper: KITTI, Booster and Middlebury, in metres and aligned."
    ),
    "table2": _Entry(PaperOptions, _PAPER, "Table 2 of the paper: Booster, beside stereo matching."),
    "table3": _Entry(PaperOptions, _PAPER, "Table 3 of the paper: two posed views of Tanks and Temples."),
    "ablation": _Entry(
        PaperOptions, _PAPER, "Table 4 of the paper, and one change at a time: gradients, rules, terms."
    ),
    "parts": _Entry(PairsOptions, _CHANGES, "The default, with one part left out at a time."),
    "flatness": _Entry(PairsOptions, _CHANGES, "The default, with one number halved or doubled at a time."),
    "cost": _Entry(PairsOptions, "pairs.run_cost", "Seconds and peak memory, plain against guided."),
    "figure": _Entry(FigureOptions, "figures.run_figure", "Draw a figure as PNG, with its numbers as JSON."),
    "poses": _Entry(PosesOptions, "poses.run_poses", "Compare given, refined, estimated and wrong poses."),
    "capture": _Entry(
        CaptureEvalOptions, "captures.run_capture_eval", "Evaluate captures (needs the extra 'capture')."
    ),
}
#: Every command but ``list``, by name.
COMMANDS = {
    name: Command(entry.options, partial(_run, name, entry.where), entry.about)
    for name, entry in _TABLE.items()
}


#: Options that change no number of a page.
CHANGE_NO_NUMBER = frozenset(
    {"out", "results", "quiet", "skip_broken", "stop_on_broken", "save_depth", "engine", "workers", "gpus"}
)


def command_line(name: str, options: Any) -> str:
    """The command line that gives these options, defaults and what changes no number left out."""
    words = [*options.program.split(), name]
    for each in fields(options):
        value, rules = getattr(options, each.name), rules_of(each)
        if rules is None or each.name in CHANGE_NO_NUMBER or value == each.default:
            continue
        flag = [] if rules.is_argument else [flag_of(each)]
        entries = value if isinstance(value, tuple) and not rules.split else (value,)
        for entry in entries:
            text = ",".join(map(str, entry)) if isinstance(entry, tuple) else str(entry)
            words += flag + ([] if entry is True else [text])
    return shlex.join(words)
