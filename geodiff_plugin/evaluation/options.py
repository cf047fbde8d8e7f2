"""Options of a run: samples, methods, settings; and the command line that repeats it.

Data flow: ``PairsOptions`` -> references to samples; ``PairsOptions`` -> text of a command.
Paper: none.
"""

from __future__ import annotations

import random
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.evaluation.baselines import POSES, Settings
from geodiff_plugin.evaluation.crops import CROPS
from geodiff_plugin.evaluation.datasets import find_pairs
from geodiff_plugin.evaluation.datasets.sample import SampleRef

__all__ = [
    "PAIRS_METHODS",
    "PairsOptions",
    "all_refs",
    "command_line",
    "first_pairs",
    "select",
    "settings_words",
]

PAIRS_METHODS = ("prior-aligned", "search-only", "paper", "guided", "sgbm")


@dataclass(frozen=True)
class PairsOptions:
    """Options of ``geodiff eval pairs``; names as on the command line.

    Attributes:
        data: folder that holds data sets in their official layouts.
        methods: names that ``find_method`` knows.
        datasets: names in ``DATASETS``, empty for all.
        scenes: parts of sample names to keep, empty for all.
        limit: at most so many samples; ``None`` for all.
        sample: so many samples drawn at random with the settings' seed; ``None`` for all.
        pairs: which pairs of a group of posed views, ``"default"`` or ``"all"``.
        pixel_centre: coordinate of the first pixel's centre in posed cameras, 0.5 for COLMAP's; ``None`` for
            each data set's own.
        settings: what every method is given.
        out: folder of the records and tables.
        results: Markdown page to write beside; ``None`` for none.
        skip_broken: go on after a broken sample.
        save_depth: write depth maps.
        quiet: no bar, no table on the screen.
        crop: region that is scored, one of ``crops.CROPS``.
        priors: further priors beside the settings' own: methods that use one are run with each.
        seeds: how many seeds, from the settings' own on, methods that use a prior are run with.
        pose: where the poses come from: rows of ``guided`` that differ in it, see ``POSES``.
        perturb: largest turn in degrees and shift as a share of the baseline that poses are given wrong by.
    """

    data: Path
    methods: tuple[str, ...]
    datasets: tuple[str, ...]
    scenes: tuple[str, ...]
    limit: int | None
    sample: int | None
    pairs: str
    pixel_centre: float | None
    settings: Settings
    out: Path
    results: Path | None
    skip_broken: bool
    save_depth: bool
    quiet: bool
    crop: str = "none"
    priors: tuple[str, ...] = ()
    seeds: int = 1
    pose: tuple[str, ...] = ()
    perturb: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        check_choice(self.crop, "crop", CROPS)
        for pose in self.pose:
            check_choice(pose, "pose", POSES)


def all_refs(options: PairsOptions, datasets: Sequence[str] | None = None) -> list[SampleRef]:
    """References to all samples of the data: of the named data sets, else of those that the options name."""
    return find_pairs(
        options.data,
        datasets or options.datasets or None,
        pairs=options.pairs,
        pixel_centre=options.pixel_centre,
    )


def _check_count(name: str, count: int | None) -> None:
    if count is not None and count < 1:
        bad_value(name, "at least 1", count)


def _check_names(option: str, refs: Sequence[SampleRef], data: Path) -> None:
    """Refuse samples of one name, as two resolutions of a set have: records could not tell them apart."""
    twice = [label for label, count in Counter(ref.label for ref in refs).items() if count > 1]
    if twice:
        cure = "Name the folder of one of them, for instance that of one resolution."
        bad_value(option, "a folder with one sample of each name", f"{data} with several {twice[0]}", cure)


def first_pairs(data: Path | None, limit: int | None) -> list[SampleRef]:
    """The first pairs of a folder; none without a folder.

    Args:
        data: folder that holds data sets, or ``None``.
        limit: at most so many; ``None`` for all.

    Raises:
        ValueError: a folder without pairs, two of one name, or a limit below 1.
    """
    _check_count("limit", limit)
    if data is None:
        return []
    found = find_pairs(data)
    if not found:
        bad_value("--data", "a folder with pairs", str(data), "See: geodiff eval list.")
    _check_names("--data", found, data)
    return found[:limit]


def select(refs: Sequence[SampleRef], options: PairsOptions) -> list[SampleRef]:
    """Keep the samples whose label contains one of ``scenes``, draw ``sample``, keep the first ``limit``.

    Returns:
        References in the order of ``refs``.

    Raises:
        ValueError: nothing is left, two samples have one name, more are to be drawn than there are, or a
            number is below 1.
    """
    scenes, data = options.scenes, options.data
    for name in ("limit", "sample"):
        _check_count(name, getattr(options, name))
    kept = [ref for ref in refs if not scenes or any(scene in ref.label for scene in scenes)]
    if not kept:
        found = ", ".join(ref.label for ref in refs) or "no sample of any known data set"
        wanted = f" with {', '.join(scenes)} in its name" if scenes else ""
        bad_value("DIR", f"a folder with a sample{wanted}", f"{data} with {found}", "See: geodiff eval list.")
    _check_names("DIR", kept, data)
    if options.sample is not None:
        if options.sample > len(kept):
            bad_value("sample", f"at most {len(kept)}, the number of samples found", options.sample)
        drawn = random.Random(options.settings.seed).sample(range(len(kept)), options.sample)
        kept = [kept[i] for i in sorted(drawn)]
    return kept[: options.limit]


def settings_words(settings: Settings, without: Sequence[str] = ()) -> list[str]:
    """Words of a command line that give these settings, defaults and those in ``without`` left out."""
    words = []
    for field in fields(Settings):
        value: Any = getattr(settings, field.name)
        if field.name not in without and value != field.default:
            words += [f"--{field.name}", str(value)]
    return words


def command_line(
    options: PairsOptions, head: Sequence[str], default_methods: tuple[str, ...] = PAIRS_METHODS
) -> str:
    """The command line that gives these options, defaults left out.

    Args:
        options: what was given.
        head: subcommand and data, such as ``("eval", "pairs", "DIR")``.
        default_methods: methods of the subcommand when none are named.
    """
    words = ["geodiff", *head]
    if options.methods != default_methods:
        words += ["--methods", ",".join(options.methods)]
    for name in ("datasets", "scenes"):
        if getattr(options, name):
            words += [f"--{name}", ",".join(getattr(options, name))]
    defaults = {"limit": None, "sample": None, "pairs": "default", "pixel_centre": None, "crop": "none"}
    defaults["seeds"] = 1
    for name, default in defaults.items():
        if getattr(options, name) != default:
            words += [f"--{name.replace('_', '-')}", str(getattr(options, name))]
    if options.priors:
        words += ["--prior", options.settings.prior]
        words += [word for prior in options.priors for word in ("--prior", prior)]
    words += settings_words(options.settings, () if not options.priors else ("prior",))
    if options.pose:
        words += ["--pose", ",".join(options.pose)]
    if options.perturb is not None:
        words += ["--perturb", "{:g},{:g}".format(*options.perturb)]
    return shlex.join(words)
