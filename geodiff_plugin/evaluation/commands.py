"""Runs methods on pairs and writes the page, for ``geodiff eval pairs`` and similar commands.

Data flow: ``PairsOptions`` -> records -> ``Page``.
Paper: S5 (experiments).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

from geodiff_plugin.evaluation.baselines import find_method, with_poses, with_priors, with_seeds
from geodiff_plugin.evaluation.cells import count_of_pairs, label_of
from geodiff_plugin.evaluation.datasets.perturbed import perturbed_ref
from geodiff_plugin.evaluation.datasets.sample import SampleRef
from geodiff_plugin.evaluation.options import PairsOptions, all_refs, command_line, select
from geodiff_plugin.evaluation.report import Page, run_facts, write_page
from geodiff_plugin.evaluation.runner import processes, run
from geodiff_plugin.evaluation.seed_tables import without_copies
from geodiff_plugin.evaluation.tables import pairs_tables
from geodiff_plugin.formats.out import OutFolder

__all__ = ["measure", "remarks_on", "run_pairs"]

#: First line of the page of ``pairs``.
PURPOSE = "Each pair, interval, region and metric behind a comparison of methods."


def measure(
    refs: Sequence[SampleRef], methods: Sequence[str], options: PairsOptions
) -> list[dict[str, Any]] | None:
    """Run methods, with every further prior and seed of the options.

    Poses given wrongly and the choice of poses apply to all of them and to the method ``guided``.

    Returns:
        The records; ``None`` in every process but the main one, which alone writes tables.

    Raises:
        ValueError, OSError: as ``runner.run``.
    """
    methods = with_poses(methods, options.pose)
    if options.perturb is not None:
        refs = [perturbed_ref(ref, options.perturb) for ref in refs]
    main = processes(options.settings).is_main_process
    with OutFolder(options.out, resume=True) if main else nullcontext():  # one run a folder, of any processes
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
    return records if main else None


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
    remarks += [f"{title}: '-' for {count_of_pairs(n)}, {reason}." for (title, reason), n in reasons.items()]
    broken: dict[tuple[str, str], list[str]] = {}
    for record in records:
        if record["status"] == "broken":
            broken.setdefault((label_of(record), record["error"]), []).append(record["method"])
    if broken:
        count = len({label for label, _ in broken})
        remarks.append(f"{count} broken {'sample was' if count == 1 else 'samples were'} skipped:")
        remarks += [f"- {label} ({', '.join(names)}): {error}" for (label, error), names in broken.items()]
    return remarks


def run_pairs(options: PairsOptions) -> Page | None:
    """Measure methods on pairs and write the tables.

    Returns:
        The page; ``None`` in every process but the main one.

    Raises:
        ValueError: bad options, no samples, or a broken sample without ``skip_broken``.
        OSError: missing or unreadable files without ``skip_broken``.
    """
    refs = select(all_refs(options), options)
    records = measure(refs, options.methods, options)
    if records is None:
        return None
    facts = run_facts(command_line(options, ("eval", "pairs", str(options.data))))
    remarks = remarks_on(records, options)
    if options.sample is not None:
        remarks.append(f"Drawn with seed {options.settings.seed}: {', '.join(ref.label for ref in refs)}.")
    count = processes(options.settings).num_processes
    if count > 1:
        remarks.append(f"Run by {count} processes.")
    page = Page("Results pair by pair", facts, tuple(pairs_tables(records)), tuple(remarks), PURPOSE)
    write_page(page, options.out, "table", options.results)
    return page
