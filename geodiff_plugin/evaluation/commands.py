"""What the ``geodiff eval`` commands do once their options are read.

Hop: options -> references -> records -> tables.
Paper: S5 (experiments).
"""

from __future__ import annotations

import random
import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.evaluation.baselines import (
    FAMILIES,
    METHODS,
    Settings,
    find_method,
    with_priors,
    with_seeds,
)
from geodiff_plugin.evaluation.crops import CROPS
from geodiff_plugin.evaluation.datasets import DATASETS, find_pairs
from geodiff_plugin.evaluation.datasets.sample import SampleRef
from geodiff_plugin.evaluation.report import run_facts, write_tables, write_text
from geodiff_plugin.evaluation.runner import processes, run
from geodiff_plugin.evaluation.seed_tables import without_copies
from geodiff_plugin.evaluation.tables import pairs_tables

__all__ = [
    "PAIRS_METHODS",
    "PairsOptions",
    "all_refs",
    "command_line",
    "measure",
    "remarks_on",
    "run_list",
    "run_pairs",
    "select",
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

    def __post_init__(self) -> None:
        check_choice(self.crop, "crop", CROPS)


def all_refs(options: PairsOptions, datasets: Sequence[str] | None = None) -> list[SampleRef]:
    """References to all samples of the data: of the named data sets, else of those that the options name."""
    return find_pairs(
        options.data,
        datasets or options.datasets or None,
        pairs=options.pairs,
        pixel_centre=options.pixel_centre,
    )


def measure(
    refs: Sequence[SampleRef], methods: Sequence[str], options: PairsOptions
) -> list[dict[str, Any]] | None:
    """Run methods, with every further prior and seed of the options.

    Returns:
        The records; ``None`` in every process but the main one, which alone writes tables.

    Raises:
        ValueError, OSError: as ``runner.run``.
    """
    records = run(
        refs,
        with_seeds(with_priors(methods, options.priors), options.settings.seed, options.seeds),
        options.settings,
        options.out,
        crop=options.crop,
        skip_broken=options.skip_broken,
        save_depth=options.save_depth,
        progress=not options.quiet,
    )
    return records if processes(options.settings).is_main_process else None


def select(refs: Sequence[SampleRef], options: PairsOptions) -> list[SampleRef]:
    """Keep the samples whose label contains one of ``scenes``, draw ``sample``, keep the first ``limit``.

    Returns:
        References in the order of ``refs``.

    Raises:
        ValueError: nothing is left, more are to be drawn than there are, or a number is below 1.
    """
    scenes, data = options.scenes, options.data
    for name in ("limit", "sample"):
        count = getattr(options, name)
        if count is not None and count < 1:
            bad_value(name, "at least 1", count)
    kept = [ref for ref in refs if not scenes or any(scene in ref.label for scene in scenes)]
    if not kept:
        found = ", ".join(ref.label for ref in refs) or "no sample of any known data set"
        wanted = f" with {', '.join(scenes)} in its name" if scenes else ""
        bad_value("DIR", f"a folder with a sample{wanted}", f"{data} with {found}", "See: geodiff eval list.")
    if options.sample is not None:
        if options.sample > len(kept):
            bad_value("sample", f"at most {len(kept)}, the number of samples found", options.sample)
        drawn = random.Random(options.settings.seed).sample(range(len(kept)), options.sample)
        kept = [kept[i] for i in sorted(drawn)]
    return kept[: options.limit]


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
    for field in fields(Settings):
        if options.priors and field.name == "prior":
            continue
        value: Any = getattr(options.settings, field.name)
        if value != field.default:
            words += [f"--{field.name}", str(value)]
    return shlex.join(words)


def remarks_on(records: Sequence[dict[str, Any]], options: PairsOptions) -> list[str]:
    """Sentences above the tables: the prior, what methods could not do and why, samples that were broken."""
    settings = options.settings
    remarks = [f"Prior {settings.prior}, seed {settings.seed}, ensemble {settings.ensemble}."]
    if options.priors:
        remarks.append(f"Rows that name no prior: {settings.prior}.")
    if options.seeds > 1:
        remarks.append(f"Every table but the spread over {options.seeds} seeds is of seed {settings.seed}.")
    if options.crop != "none":
        remarks.append(f"Only what lies in the crop {options.crop!r} is scored.")
    reasons: dict[tuple[str, str], int] = {}
    for record in without_copies(records):
        if record["status"] == "not applicable":
            key = (find_method(record["method"]).title, record["reason"])
            reasons[key] = reasons.get(key, 0) + 1
    remarks += [f"{title}: '-' for {n} pairs, {reason}." for (title, reason), n in reasons.items()]
    broken = [record for record in records if record["status"] == "broken"]
    if broken:
        remarks.append(f"{len({(r['dataset'], r['sample']) for r in broken})} broken samples were skipped:")
        remarks += [f"- {r['dataset']}/{r['sample']} ({r['method']}): {r['error']}" for r in broken]
    return remarks


def run_pairs(options: PairsOptions) -> None:
    """Measure methods on pairs, write and print the tables.

    Raises:
        ValueError: bad options, no samples, or a broken sample without ``skip_broken``.
        OSError: missing or unreadable files without ``skip_broken``.
    """
    refs = select(all_refs(options), options)
    records = measure(refs, options.methods, options)
    if records is None:
        return
    facts = run_facts(command_line(options, ("eval", "pairs", str(options.data))))
    remarks = remarks_on(records, options)
    if options.sample is not None:
        remarks.append(f"Drawn with seed {options.settings.seed}: {', '.join(ref.label for ref in refs)}.")
    count = processes(options.settings).num_processes
    if count > 1:
        remarks.append(f"Run by {count} processes.")
    page = write_tables(options.out, "Results", facts, pairs_tables(records), remarks)
    if options.results is not None:
        write_text(options.results, page)
    if not options.quiet:
        sys.stdout.write(page)


def run_list(data: Path | None) -> None:
    """Print for every data set whether ``data`` has it, how many samples, and how to obtain it.

    Raises:
        ValueError: ``data`` is given and is not a folder.
    """
    lines = []
    for name, dataset in DATASETS.items():
        count = 0 if data is None else len(find_pairs(data, [name]))
        found = "not found" if data is not None else "no --data given"
        if count or not dataset.needs_folder:
            found = f"{count or 'any number of'} {'sample' if count == 1 else 'samples'}"
        full = f" of {dataset.full_count}" if count and dataset.full_count else ""
        lines.append(f"{name:<15} {found}{full}\n{'':<15} {dataset.obtain}")
    lines.append("")
    lines += [f"{name:<17} {method.summary}" for name, method in METHODS.items()]
    for name, family in FAMILIES.items():
        summary = re.split(r"[.;]", family.__doc__ or " ", maxsplit=1)[0]
        lines.append(f"{name + ':...':<17} {summary[0].lower()}{summary[1:]}")
    lines.append(f"{'METHOD@PRIOR':<17} a method that uses a prior, with another one than --prior's first")
    lines.append(f"{'METHOD#SEED':<17} the same with another seed than --seed; METHOD@PRIOR#SEED for both")
    sys.stdout.write("\n".join(lines) + "\n")
