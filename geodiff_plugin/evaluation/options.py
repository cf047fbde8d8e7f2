"""Define the commands of ``geodiff eval`` and their options, without importing torch."""

from __future__ import annotations

import shlex
from collections.abc import Collection
from dataclasses import MISSING, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from geodiff_plugin._internal.lazy import imported
from geodiff_plugin.options import (
    DTYPES,
    MACHINE_RULES,
    OUTPUT,
    PRIOR,
    SAMPLES,
    Command,
    MachineOptions,
    PriorOptions,
    SpeedOptions,
    check_rules,
)
from geodiff_plugin.settings import DEFAULT_SECTION, check_settings, setting, settings_of

if TYPE_CHECKING:
    from geodiff_plugin.evaluation.baselines import Settings

PEERS = ("prior-aligned", "search-only", "paper", "guided", "sgbm")
FIGURES = ("gs-sweep", "guidance-steps", "risk-coverage", "ablation", "qualitative")
#: Program name of these commands. A source checkout has further commands with another program name.
PROGRAM = "geodiff eval"


class CaptureRow(NamedTuple):
    """A row of ``geodiff eval capture``: poses of the capture, and the parameter ``pose`` of every call."""

    title: str
    poses: str
    pose: str


CAPTURE_ROWS = {
    "given": CaptureRow("given poses", poses="given", pose="given"),
    "pairs": CaptureRow("refined per pair", poses="given", pose="refine"),
    "capture": CaptureRow("refined over the capture", poses="refined", pose="given"),
}


def out_folder(folder: str) -> Any:
    """Create the option for the output folder of a run."""
    return setting(
        Path(folder), "Output folder; an earlier run in it is resumed.", "--out", "-o", section=OUTPUT
    )


def listed(default: tuple[Any, ...], help_text: str, **rules: Any) -> Any:
    """Create a comma-separated option."""
    return setting(default, help_text, comma_separated=True, **{"section": SAMPLES, **rules})


def some_of(names: Collection[str], help_text: str = "") -> Any:
    """Create a comma-separated option with some of these names (default: all)."""
    help_text = help_text or f"Rows, separated by commas: {', '.join(names)}."
    return listed(tuple(names), help_text, choices=names)


def count_of(
    default: int | None, help_text: str, low: int = 1, high: int = 10**9, section: str = SAMPLES
) -> Any:
    """Create an option for an integer in [low, high]."""
    return setting(default, help_text, low=low, high=high, section=section)


def folder_of(help_text: str, *flags: str, default: Any = None) -> Any:
    """Create an option for a folder or the name of a known dataset."""
    return setting(default, help_text, *flags, metavar="DIR", section=SAMPLES)


@dataclass(frozen=True, kw_only=True)
class OutOptions:
    """Options of every command."""

    seed: int = setting(0, "Seed for the random noise.", section=PRIOR)
    steps: int | None = count_of(
        None, "Number of denoising steps (default: each method's default).", high=1000, section=PRIOR
    )
    out: Path = out_folder("geodiff-eval")
    results: Path | None = setting(None, "Also write the results as Markdown to this file.", section=OUTPUT)
    quiet: bool = setting(False, "Hide the progress bar and the results.", "--quiet", "-q", section=OUTPUT)
    program: str = field(default=PROGRAM)

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def settings(self) -> Settings:
        """Return the settings of the methods; imports torch."""
        from geodiff_plugin.evaluation.baselines import Settings
        from geodiff_plugin.runtime.machine import pick_device

        given: dict[str, Any] = {f.name: getattr(self, f.name, f.default) for f in fields(Settings)}
        return Settings(**given | {"device": str(pick_device(given["device"]))})


@dataclass(frozen=True, kw_only=True)
class EvalOptions(SpeedOptions, OutOptions, PriorOptions):
    """Options of every command that runs a prior."""

    dtype: str = setting(
        "float32", f"Precision of the prior: {', '.join(DTYPES)}.", choices=DTYPES, section=PRIOR
    )


@dataclass(frozen=True, kw_only=True)
class SampleOptions(EvalOptions):
    """Options that select datasets and samples."""

    data: Path | None = folder_of(
        "Folder of datasets, or the name of a known dataset (see geodiff eval list)."
    )
    methods: tuple[str, ...] = listed(
        (), "Additional methods, separated by commas; geodiff eval list shows them."
    )
    datasets: tuple[str, ...] = listed((), "Datasets, separated by commas (default: all in the folder).")
    scenes: tuple[str, ...] = listed(
        (), "Only samples whose names contain one of these words, separated by commas."
    )
    limit: int | None = count_of(
        None,
        "Maximum number of samples, taken from the start of the list (table1, table2, table3, ablation: per "
        "dataset).",
    )
    ensemble: int = count_of(1, "Number of ensemble members.", high=1000, section=PRIOR)
    resolution: int | None = count_of(None, "Longer side of the prior's input in pixels.", 0, 8192, PRIOR)
    views: int = count_of(2, "Number of views to use in scenes that have more than two.", 2, 100)
    perturb: str | None = setting(
        None,
        "Perturb the poses by a rotation in degrees and a translation as a fraction of the baseline.",
        metavar="DEGREES,FRACTION",
        section=SAMPLES,
    )


@dataclass(frozen=True, kw_only=True)
class PairsOptions(SampleOptions):
    """Options of the tables over pairs: paper tables, parts, flatness and cost."""

    sample: int | None = count_of(None, "Number of random samples, drawn with --seed.")
    pairs: str = setting(
        "default",
        "Pairs of views in posed datasets: default (one pair per group or key view) or all (every listed "
        "pair).",
        choices=("default", "all"),
        section=SAMPLES,
    )
    pixel_centre: float | None = setting(
        None,
        "Coordinate of the centre of the first pixel in the cameras of posed datasets: 0, or 0.5 as in "
        "COLMAP.",
        section=SAMPLES,
    )
    stop_on_broken: bool = setting(
        False, "Stop at the first broken sample, instead of skipping and reporting it.", section=OUTPUT
    )
    save_depth: bool = setting(False, "Also write every depth map as .npy.", section=OUTPUT)


#: Number of ensemble members in the paper (S5.1).
PAPER_ENSEMBLE = 10


@dataclass(frozen=True, kw_only=True)
class PaperOptions(PairsOptions):
    """Options of the paper's tables, with the paper's defaults."""

    ensemble: int = count_of(
        PAPER_ENSEMBLE, "Number of ensemble members; the paper uses ten.", high=1000, section=PRIOR
    )


@dataclass(frozen=True, kw_only=True)
class DirOptions(MachineOptions, PairsOptions):
    """Options of ``geodiff eval pairs DIR``."""

    data: Path | None = folder_of(
        "Folder of datasets, or the name of a known dataset (see geodiff eval list).", "", default=MISSING
    )
    methods: tuple[str, ...] = listed(PEERS, "Methods, separated by commas; geodiff eval list shows them.")
    split: str = setting(
        "all",
        "Pairs to evaluate: all, tuned (used to tune the defaults) or unseen (held out).",
        choices=("all", "tuned", "unseen"),
        section=SAMPLES,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rules(self, MACHINE_RULES)


@dataclass(frozen=True, kw_only=True)
class FigureOptions(SampleOptions):
    """Options of ``geodiff eval figure NAME``."""

    name: str = setting(MISSING, f"Figure: {', '.join(FIGURES)}.", "", metavar="NAME")
    max: float = setting(80.0, "gs-sweep: largest g_s, in metres.", low=1.01, high=1e6)
    updates: tuple[int, ...] = listed(
        (1, 2, 5, 10, 20, 40),
        "guidance-steps: numbers of gradient updates per denoising step, separated by commas.",
        section=DEFAULT_SECTION,
        low=1,
        high=10**4,
    )
    results: Path | None = field(default=None)
    clouds: bool = setting(False, "qualitative, ablation: also draw point clouds from a different viewpoint.")


@dataclass(frozen=True, kw_only=True)
class PosesOptions(EvalOptions):
    """Options of ``geodiff eval poses``."""

    data: Path | None = folder_of(
        "Folder of pairs, or the name of a known dataset (see geodiff eval list; default: none)."
    )
    limit: int | None = count_of(None, "Maximum number of pairs, taken from the start of --data.")
    exact: Path | None = folder_of(
        "Folder, or name of a known dataset, whose pairs have exact poses. These poses are perturbed."
    )
    perturb: str = setting(
        "1.5,0.1",
        "Perturbation of the poses in --exact: a rotation in degrees and a translation as a fraction of the "
        "baseline.",
        metavar="DEGREES,FRACTION",
    )
    drift: str = setting(
        "0.3,1.5",
        "Perturbation of rectified pairs: rotation and shift of the right image.",
        metavar="DEGREES,PIXELS",
    )
    resolution: int | None = count_of(None, "Longer side of the prior's input in pixels.", 0, 8192, PRIOR)
    out: Path = out_folder("geodiff-poses")


@dataclass(frozen=True, kw_only=True)
class CaptureEvalOptions(EvalOptions):
    """Options of ``geodiff eval capture DIR ...``."""

    data: tuple[Path, ...] = folder_of("Captures with ground-truth depth maps.", "", default=MISSING)
    frames: str | None = setting(
        None, "Frames: NAME,NAME or FIRST:LAST:STEP, LAST included (default: all).", section=SAMPLES
    )
    count: int | None = count_of(
        None, "Number of evenly spaced frames of each capture, instead of --frames.", 2
    )
    neighbours: tuple[int, ...] = listed(
        (2, 3, 5),
        "Numbers of neighbouring frames to match each frame with, separated by commas.",
        low=1,
        high=32,
    )
    rows: tuple[str, ...] = some_of(
        CAPTURE_ROWS,
        "Poses to evaluate, separated by commas: given, pairs (refined per pair) or capture (refined "
        "jointly).",
    )


def _run(name: str, where: str, options: OutOptions) -> Any:
    """Run a command; returns the page, the path of a figure, or ``None`` in a process without output."""
    return imported(f"evaluation.{where}")(name, options)


class _Entry(NamedTuple):
    """A command: its options, its function as ``module.name`` in ``evaluation``, and its help."""

    options: type[OutOptions]
    where: str
    about: str


_PAPER = "paper.run_paper_table"
_CHANGES = "pairs.run_changes"
_TABLE = {
    "pairs": _Entry(
        DirOptions,
        "pairs.run_pairs",
        "Compare methods on all pairs in DIR with metric ground truth.",
    ),
    "table1": _Entry(
        PaperOptions,
        _PAPER,
        "Table 1 of the paper: KITTI, Booster and Middlebury, as metric depth and after alignment to ground "
        "truth.",
    ),
    "table2": _Entry(PaperOptions, _PAPER, "Table 2 of the paper: Booster, compared with stereo matching."),
    "table3": _Entry(PaperOptions, _PAPER, "Table 3 of the paper: two posed views of Tanks and Temples."),
    "ablation": _Entry(
        PaperOptions,
        _PAPER,
        "Table 4 of the paper, and variants with a single change: gradients, optimizers or loss terms.",
    ),
    "parts": _Entry(
        PairsOptions,
        _CHANGES,
        "Ablation: remove or change the components of the default preset, one at a time.",
    ),
    "flatness": _Entry(
        PairsOptions,
        _CHANGES,
        "Sensitivity: halve and double the main parameters of the default preset, one at a time.",
    ),
    "cost": _Entry(PairsOptions, "pairs.run_cost", "Run time and peak memory of plain and guided calls."),
    "figure": _Entry(FigureOptions, "figures.run_figure", "Draw a figure as PNG, with its numbers as JSON."),
    "baseline": _Entry(
        PairsOptions,
        "baseline_scale.run_baseline_scale",
        "Test whether the depth scales with the baseline when the baseline is halved or doubled, and whether "
        "it stays the same when the right image is resized (which changes its K).",
    ),
    "poses": _Entry(PosesOptions, "poses.run_poses", "Compare given, refined, estimated and wrong poses."),
    "capture": _Entry(
        CaptureEvalOptions, "captures.run_capture_eval", "Evaluate captures (needs the extra 'capture')."
    ),
}
#: All commands except ``list``, by name.
COMMANDS = {
    name: Command(entry.options, partial(_run, name, entry.where), entry.about)
    for name, entry in _TABLE.items()
}


#: Options that do not change the numbers of a page.
CHANGE_NO_NUMBER = frozenset(
    {"out", "results", "quiet", "stop_on_broken", "save_depth", "engine", "workers", "gpus"}
)


def command_line(command: str, options: Any) -> str:
    """Return the command line of these options, without defaults and ``CHANGE_NO_NUMBER``."""
    words = [*options.program.split(), command]
    for name, option in settings_of(type(options)).items():
        value = getattr(options, name)
        if name in CHANGE_NO_NUMBER or value == option.default:
            continue
        flag = [] if option.is_argument else [option.flag]
        entries = value if option.several and not option.comma_separated else (value,)
        for entry in entries:
            text = ",".join(map(str, entry)) if isinstance(entry, tuple) else str(entry)
            words += flag + ([] if entry is True else [text])
    return shlex.join(words)
