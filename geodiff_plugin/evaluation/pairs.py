"""Methods side by side on pairs: ``geodiff eval pairs``, and what other commands share with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from geodiff_plugin.evaluation.baselines import find_method, with_poses, with_priors, with_seeds
from geodiff_plugin.evaluation.datasets import SampleRef
from geodiff_plugin.evaluation.experiment import RECORDS_NAME, Experiment, Page, method_cells
from geodiff_plugin.evaluation.options import PairsOptions, all_refs, select
from geodiff_plugin.evaluation.tables import Table, count_of_pairs, label_of, pairs_tables, without_copies
from geodiff_plugin.runner import Item, Record, this_process


def pair_cells(refs: Sequence[SampleRef], methods: Sequence[str], options: PairsOptions) -> list[Item]:
    """Cells of methods, with every further prior and seed of the options.

    Poses given wrongly and the choice of poses apply to all of them and to the method ``guided``.
    """
    settings, refs = options.settings, options.changed(refs)
    names = with_priors(with_poses(methods, options.pose), options.prior[1:])
    names = with_seeds(names, settings.seed, options.seeds)
    return method_cells(refs, names, settings, options.out, crop=options.crop, save_depth=options.save_depth)


def pairs_experiment(
    name: str,
    title: str,
    refs: Sequence[SampleRef],
    methods: Sequence[str],
    options: PairsOptions,
    tables: Callable[[list[Record]], Sequence[Table]],
    more: Sequence[str] = (),
    purpose: str = "",
) -> Experiment:
    """Methods on pairs, with remarks on what was run and ``more``; all such commands share their records."""

    def remarks(records: list[Record]) -> list[str]:
        return [*remarks_on(records, options), *more]

    cells = pair_cells(refs, tuple(dict.fromkeys(methods)), options)
    return Experiment(name, title, cells, tables, remarks, purpose, RECORDS_NAME)


def remarks_on(records: Sequence[Record], options: PairsOptions) -> list[str]:
    """Sentences above the tables: the prior, what methods could not do and why, samples that were broken."""
    prior = options.prior[0]
    remarks = [f"Prior {prior}, seed {options.seed}, ensemble {options.ensemble}."]
    if options.prior[1:]:
        remarks.append(f"Rows that name no prior: {prior}.")
    if options.seeds > 1:
        remarks.append(f"Every table but the spread over {options.seeds} seeds is of seed {options.seed}.")
    if options.crop != "none":
        remarks.append(f"Only what lies in the crop {options.crop!r} is scored.")
    reasons = Counter(
        (find_method(record["method"]).title, record["reason"])
        for record in without_copies(records)
        if record["status"] == "not applicable"
    )
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


def run_pairs(name: str, options: PairsOptions) -> Page | None:
    """Measure methods on pairs and write the tables; errors as ``Experiment.run``."""
    refs, count, more = select(all_refs(options), options), this_process().count, []
    if options.sample is not None:
        more.append(f"Drawn with seed {options.seed}: {', '.join(ref.label for ref in refs)}.")
    if count > 1:
        more.append(f"Run by {count} processes.")
    purpose = "Each pair, interval, region and metric behind a comparison of methods."
    experiment = pairs_experiment(
        "table", "Results pair by pair", refs, options.methods, options, pairs_tables, more, purpose
    )
    return experiment.run(name, options)
