"""Options of every command of ``geodiff eval``, one dataclass each, and the table of the commands.

Nothing here imports torch: the command line is built from these, and ``--help`` answers at once.
"""

from __future__ import annotations

import importlib
import random
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from geodiff_plugin._checks import bad_value
from geodiff_plugin.options import OUTPUT, SPACES, check_options, declare, flag_of

if TYPE_CHECKING:
    from geodiff_plugin.evaluation.baselines import Settings
    from geodiff_plugin.evaluation.datasets import SampleRef

CROPS = ("none", "garg", "eigen", "benchmark")
POSES = ("refine", "given", "estimated")
"""Where ``guided`` has poses from: refined, as given, or withheld but for the baseline's length."""
CAPTURE_ROWS = ("given", "pairs", "capture")
"""Poses of a capture: as given, refined pair by pair, solved together."""
STRENGTHS = ("exact", "2%", "5%", "10%", "20%", "blur", "gamma")
DTYPES = ("float32", "float16", "bfloat16")
FIGURES = ("gs-sweep", "inner-steps", "ablation", "exposure", "qualitative")
WAYS = ("alone", "alone-half", "scale", "warm", "warm-50", "warm-75")
#: Fields that are those of ``Settings``.
SETTINGS = ("ensemble", "seed", "steps", "resolution", "dtype", "space", "views")
#: What a repeated run need not be told.
_NOT_REPEATED = ("out", "results", "quiet", "skip_broken", "save_depth")
_GIVEN = (
    "Give a folder of data sets, or the name of a registered set (docs/how-to/extending.md); "
    "geodiff eval list says how to obtain the public ones."
)


def _out(folder: str) -> Any:
    return declare(Path(folder), "Records and results; resumed where it exists.", "--out", "-o", panel=OUTPUT)


def _list(default: tuple[Any, ...], help_text: str, **rules: Any) -> Any:
    """A tuple that is typed with commas."""
    return declare(default, help_text, split=True, **rules)


def _count(default: int | None, help_text: str, low: int = 1, high: int = 10**9) -> Any:
    return declare(default, help_text, low=low, high=high)


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


@dataclass(frozen=True, kw_only=True)
class EvalOptions(OutOptions):
    """What every command that runs a prior is told."""

    prior: tuple[str, ...] = declare(
        ("bundled",), "'bundled', a hub id or a folder; repeat it for further rows."
    )
    space: str | None = declare(
        None, "What the prior's map is affine in, if its folder does not say.", choices=SPACES
    )
    dtype: str = declare("float32", f"{', '.join(DTYPES)}.", choices=DTYPES)
    device: str = declare("auto", "auto, cpu, cuda, cuda:N or mps.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.prior) != 1 and not isinstance(self, PairsOptions):
            bad_value("--prior", "given once", " ".join(self.prior) or "nothing")

    @property
    def settings(self) -> Settings:
        """What methods are given; imports torch."""
        from geodiff_plugin.evaluation.baselines import Settings
        from geodiff_plugin.runtime.machine import pick_device

        given = {name: getattr(self, name) for name in SETTINGS if hasattr(self, name)}
        return Settings(self.prior[0], device=str(pick_device(self.device)), **given)


@dataclass(frozen=True, kw_only=True)
class _SampleOptions(EvalOptions):
    """Which samples, of what data."""

    data: Path | None = declare(
        None, "Folder with data sets, or the name of a registered set.", metavar="DIR"
    )
    methods: tuple[str, ...] = _list((), "Comma-separated, see geodiff eval list; beside the built-in rows.")
    datasets: tuple[str, ...] = _list((), "Comma-separated; all that the folder has by default.")
    scenes: tuple[str, ...] = _list((), "Comma-separated parts of sample names to keep.")
    limit: int | None = _count(None, "The first N samples alone; in a table of the paper, of each set.")
    ensemble: int = _count(1, "Ensemble members.", high=1000)
    resolution: int | None = _count(None, "Longer side for the prior, pixels.", 0, 8192)
    views: int = _count(2, "Views that methods take of a group that has more than two.", 2, 100)
    perturb: str | None = declare(
        None, "Poses given wrongly: turn, and shift / baseline.", metavar="DEGREES,SHARE"
    )

    def changed(self, refs: Sequence[SampleRef]) -> list[SampleRef]:
        """The references, with the poses given wrongly where ``perturb`` says so."""
        from geodiff_plugin.evaluation.datasets.changed import changed_ref, perturbation

        if self.perturb is None:
            return list(refs)
        return [changed_ref(ref, "perturbed", perturbation(self.perturb)) for ref in refs]


@dataclass(frozen=True, kw_only=True)
class PairsOptions(_SampleOptions):
    """``geodiff eval pairs``, and without a few the tables of the paper, of parts, flatness and cost."""

    sample: int | None = _count(None, "Draw this many samples at random, by --seed.")
    pairs: str = declare(
        "default", "Of posed views: default (the first two) or all.", choices=("default", "all")
    )
    pixel_centre: float | None = declare(None, "First pixel's centre in posed cameras, 0.5 for COLMAP's.")
    crop: str = declare("none", "Region that is scored: none, garg, eigen, benchmark (KITTI).", choices=CROPS)
    seeds: int = _count(
        1, "Seeds, from --seed on, of methods with a prior; a table has their spread.", high=1000
    )
    pose: tuple[str, ...] = _list(
        (), "Rows of 'guided': refine, given, estimated (poses withheld).", choices=POSES
    )
    skip_broken: bool = declare(False, "Go on after a broken sample and count it.", panel=OUTPUT)
    save_depth: bool = declare(False, "Write every depth map as .npy.", panel=OUTPUT)


@dataclass(frozen=True, kw_only=True)
class DirOptions(PairsOptions):
    """``geodiff eval pairs DIR``."""

    data: Path | None = declare(
        MISSING, "Folder of data sets, or the name of a registered set.", "", metavar="DIR"
    )
    methods: tuple[str, ...] = _list(
        ("prior-aligned", "search-only", "paper", "guided", "sgbm"), "Comma-separated, see geodiff eval list."
    )


@dataclass(frozen=True, kw_only=True)
class FigureOptions(_SampleOptions):
    """``geodiff eval figure NAME``."""

    name: str = declare(MISSING, f"{', '.join(FIGURES)}.", "", metavar="NAME")
    max: float = declare(80.0, "gs-sweep: the last g_s, metres.", low=1.01, high=1e6)
    updates: tuple[int, ...] = _list(
        (1, 2, 5, 10, 20, 40), "inner-steps: updates per step, comma-separated.", low=1, high=10_000
    )
    results: Path | None = field(default=None)
    clouds: bool = declare(False, "qualitative, ablation: point clouds from another view too.")


@dataclass(frozen=True, kw_only=True)
class StrengthOptions(OutOptions):
    """``geodiff eval strength``."""

    data: tuple[Path, ...] = declare(
        (), "Folder of data sets, or a registered set; may be repeated.", metavar="DIR"
    )
    limit: int | None = _count(None, "The first N pairs alone, of each --data.")
    strengths: tuple[str, ...] = _list(STRENGTHS, f"Some of {', '.join(STRENGTHS)}.", choices=STRENGTHS)
    space: str = declare(
        "disparity", "Affine in disparity, depth or log.", choices=("disparity", "depth", "log")
    )
    follow: float = declare(0.3, "How far the prior's later answers follow their input.", low=0.0, high=1.0)
    methods: tuple[str, ...] = _list(
        ("prior-aligned", "prior-fit", "guided", "search-only", "guided:inner_steps=5"),
        "Comma-separated methods that use a prior, see geodiff eval list.",
    )
    steps: int | None = _count(4, "Denoising steps.", high=1000)
    resolution: int = _count(384, "Longer side for the prior, pixels.", 64, 8192)
    figure: Path | None = declare(None, "PNG: error against the prior's error, lit surfaces.", panel=OUTPUT)


@dataclass(frozen=True, kw_only=True)
class SequenceOptions(EvalOptions):
    """``geodiff eval sequence``."""

    scenes: int = _count(4, "Sequences, of the seeds from 0 on.", high=10_000)
    frames: int = _count(6, "Frames of each.", 2, 10_000)
    size: tuple[int, int] = field(default=(192, 256))
    ways: tuple[str, ...] = _list(WAYS, f"Comma-separated: {', '.join(WAYS)}.", choices=WAYS)
    steps: int | None = _count(4, "Denoising steps of a frame alone.", high=1000)


@dataclass(frozen=True, kw_only=True)
class _RealOptions(EvalOptions):
    """Real pairs beside rendered ones."""

    data: Path | None = declare(None, "Folder of real pairs; none by default.", metavar="DIR")
    limit: int | None = _count(None, "The first N real pairs alone.")


@dataclass(frozen=True, kw_only=True)
class TrustOptions(_RealOptions):
    """``geodiff eval trust``."""

    rendered: int = _count(0, "Pairs of the registered set 'synthetic', every other one rectified.", 0, 10**6)
    width: int = _count(512, "Width of the rendered pairs, pixels.", 64, 8192)
    kinds: tuple[str, ...] = _list((), "Comma-separated kinds of wrong calibration; ten by default.")
    out: Path = _out("geodiff-trust")


@dataclass(frozen=True, kw_only=True)
class PosesOptions(_RealOptions):
    """``geodiff eval poses``."""

    rendered: int = _count(0, "Pairs of the registered set 'synthetic' in a general pose.", 0, 10**6)
    rendered_size: str | None = declare(None, "Of rendered pairs; smaller is faster.", metavar="WIDTHxHEIGHT")
    perturb: str = declare(
        "1.5,0.1", "Rendered: largest turn, and shift / baseline.", metavar="DEGREES,SHARE"
    )
    drift: str = declare("0.3,1.5", "Rectified: turn and shift of the right image.", metavar="DEGREES,PIXELS")
    resolution: int | None = _count(None, "Longer side for the prior, pixels.", 0, 8192)
    out: Path = _out("geodiff-poses")


@dataclass(frozen=True, kw_only=True)
class CaptureEvalOptions(EvalOptions):
    """``geodiff eval capture DIR ...``."""

    data: tuple[Path, ...] = declare((), "Captures that name depth maps of their frames.", "", metavar="DIR")
    frames: str | None = declare(None, "NAME,NAME or FIRST:LAST:STEP; all by default.")
    count: int | None = declare(
        None, "So many frames of each, evenly spread, in place of --frames.", low=2, high=10**6
    )
    neighbours: tuple[int, ...] = _list((2, 3, 5), "Comma-separated numbers of right views.", low=1, high=32)
    rows: tuple[str, ...] = _list(CAPTURE_ROWS, "Some of given, pairs, capture.", choices=CAPTURE_ROWS)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.data:
            bad_value("DIR", "at least one capture", "none")


class Command(NamedTuple):
    """A command of ``geodiff eval``: its options, what it does, and ``module:function`` in this package."""

    options: type[OutOptions]
    about: str
    run: str

    def __call__(self, name: str, options: Any) -> Any:
        """Run it: the page, the path of a figure, or ``None`` in a process that writes nothing."""
        module, _, function = self.run.partition(":")
        return getattr(importlib.import_module(f"geodiff_plugin.evaluation.{module}"), function)(
            name, options
        )


_PAPER, _CHANGES = "paper:run_paper_table", "changes:run_changes"
_ABLATION = "Table 4, and one change at a time: gradients, rules, terms, no diffusion."
_FLATNESS = "How flat the default lies: every number of it at half and at twice its value."
_STRENGTH = "Accuracy with emulated priors from exact to weak: aligned to the truth, fitted once, guided."
_SEQUENCE = "Depth of a moving rig: frames alone, or each from the one before; error, flicker, seconds."
_POSES = "Accuracy with poses as given, perturbed, refined and estimated, and of rigs that have drifted."
_CAPTURE = "Depth of a capture with poses as given, refined by pairs, and solved together (extra capture)."
_TRUST = "How many wrong calibrations are detected, and how many right ones are not trusted."
_TABLE1 = "Table 1: KITTI-Stereo, Booster and Middlebury, in metres and aligned."
COMMANDS: dict[str, Command] = {
    "pairs": Command(
        DirOptions, "Measure methods side by side on every metric pair below DIR.", "pairs:run_pairs"
    ),
    "table1": Command(PairsOptions, _TABLE1, _PAPER),
    "table2": Command(PairsOptions, "Table 2: Booster, beside stereo.", _PAPER),
    "table3": Command(PairsOptions, "Table 3: two posed views, Tanks and Temples.", _PAPER),
    "ablation": Command(PairsOptions, _ABLATION, _PAPER),
    "parts": Command(
        PairsOptions, "What each part of the default is worth: one left out at a time.", _CHANGES
    ),
    "flatness": Command(PairsOptions, _FLATNESS, _CHANGES),
    "cost": Command(
        PairsOptions, "Seconds and peak memory, plain against guided, as ratios.", "cost:run_cost"
    ),
    "strength": Command(StrengthOptions, _STRENGTH, "strength:run_strength"),
    "sequence": Command(SequenceOptions, _SEQUENCE, "sequence:run_sequence"),
    "figure": Command(
        FigureOptions, "Draw one figure as PNG, with its numbers as JSON.", "figures:run_figure"
    ),
    "trust": Command(TrustOptions, _TRUST, "trust:run_trust"),
    "poses": Command(PosesOptions, _POSES, "poses:run_poses"),
    "capture": Command(CaptureEvalOptions, _CAPTURE, "capture:run_capture_eval"),
}
"""Every command but ``list``, by name."""


def command_line(name: str, options: Any) -> str:
    """The command line that gives these options, defaults and what changes no number left out."""
    words = ["geodiff", "eval", name]
    for each in fields(options):
        value = getattr(options, each.name)
        if not each.metadata or each.name in _NOT_REPEATED or value == each.default:
            continue
        flag = [flag_of(each)] if each.metadata["flags"] != ("",) else []
        entries = value if isinstance(value, tuple) else (value,)
        if isinstance(value, tuple) and each.metadata["split"]:
            entries = (",".join(map(str, value)),)
        for entry in entries:
            words += flag + ([] if entry is True else [str(entry)])
    return shlex.join(words)


def data_of(options: Any) -> Path:
    """Where the samples are: what was given, or the pair that ships with the package."""
    from geodiff_plugin.bundled import PRIOR_FOLDER

    return options.data or PRIOR_FOLDER.parent / "pair"


def all_refs(options: PairsOptions | FigureOptions, datasets: Sequence[str] = ()) -> list[SampleRef]:
    """References to all samples of the data: of the named data sets, else of those that the options name."""
    from geodiff_plugin.evaluation.datasets import find_pairs

    given = {name: getattr(options, name, None) for name in ("pairs", "pixel_centre")}
    return find_pairs(data_of(options), datasets or options.datasets or None, **given)


def _check_names(refs: Sequence[SampleRef], data: Path) -> None:
    """Refuse samples of one name, as two resolutions of a set have: records could not tell them apart."""
    twice = [label for label, count in Counter(ref.label for ref in refs).items() if count > 1]
    if twice:
        cure = "Name the folder of one of them, for instance that of one resolution."
        bad_value("--data", "a folder with one sample of each name", f"{data} with several {twice[0]}", cure)


def real_and_rendered(
    options: TrustOptions | PosesOptions, text: str
) -> tuple[list[SampleRef], list[SampleRef]]:
    """The first pairs of ``--data``, if given, and ``--rendered`` ones of the registered set ``synthetic``.

    Args:
        options: of the command.
        text: what the set is asked for, as ``synthetic:{}@512x384``.

    Raises:
        ValueError: neither; a folder without pairs, or with two of one name; no such set is registered.
    """
    from geodiff_plugin.evaluation.datasets import DATASETS, find_pairs

    if options.data is None and not options.rendered:
        bad_value("--data", "given, or --rendered above 0", "neither")
    real, rendered = list[Any](), list[Any]()
    if options.data is not None:
        real = find_pairs(options.data)
        if not real:
            bad_value("--data", "a folder with pairs", str(options.data), _GIVEN)
        _check_names(real, options.data)
    if options.rendered:
        if "synthetic" not in DATASETS:
            cure = "A clone of the repository has it: python -m tests.scenes eval ..."
            bad_value("--rendered", "0 where no data set 'synthetic' is registered", options.rendered, cure)
        rendered = find_pairs(text.format(options.rendered), ["synthetic"])
    return real[: options.limit], rendered


def select(refs: Sequence[SampleRef], options: PairsOptions | FigureOptions) -> list[SampleRef]:
    """Keep the samples whose label contains one of ``scenes``, draw ``sample``, keep the first ``limit``.

    Raises:
        ValueError: nothing is left, two samples have one name, or more are to be drawn than there are.
    """
    scenes, data, count = options.scenes, data_of(options), getattr(options, "sample", None)
    kept = [ref for ref in refs if not scenes or any(scene in ref.label for scene in scenes)]
    if not kept:
        there = ", ".join(ref.label for ref in refs) or "no sample of any known data set"
        wanted = f" with {', '.join(scenes)} in its name" if scenes else ""
        bad_value("--data", f"a folder with a sample{wanted}", f"{data} with {there}", _GIVEN)
    _check_names(kept, data)
    if count is not None:
        if count > len(kept):
            bad_value("--sample", f"at most {len(kept)}, the number of samples found", count)
        drawn = random.Random(options.seed).sample(range(len(kept)), count)
        kept = [kept[i] for i in sorted(drawn)]
    return kept[: options.limit]
