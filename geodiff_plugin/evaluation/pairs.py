"""Methods side by side on pairs: ``geodiff eval pairs``, and what the tables of the paper share with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from geodiff_plugin.evaluation.baselines import find_method, with_poses, with_priors, with_seeds
from geodiff_plugin.evaluation.datasets.changed import perturbed_ref
from geodiff_plugin.evaluation.datasets.sample import SampleRef
from geodiff_plugin.evaluation.experiment import RECORDS_NAME, Experiment, method_cells
from geodiff_plugin.evaluation.options import PairsOptions, all_refs, command_line, select
from geodiff_plugin.evaluation.report import Page
from geodiff_plugin.evaluation.table import count_of_pairs, label_of
from geodiff_plugin.evaluation.tables import pairs_tables, without_copies
from geodiff_plugin.runner import Item, Record, this_process

__all__ = ["pair_cells", "remarks_on", "run_pairs"]


def pair_cells(refs: Sequence[SampleRef], methods: Sequence[str], options: PairsOptions) -> list[Item]:
    """Cells of methods, with every further prior and seed of the options.

    Poses given wrongly and the choice of poses apply to all of them and to the method ``guided``.
    """
    settings = options.settings
    if options.perturbed is not None:
        refs = [perturbed_ref(ref, options.perturbed) for ref in refs]
    names = with_priors(with_poses(methods, options.pose), options.prior[1:])
    names = with_seeds(names, settings.seed, options.seeds)
    return method_cells(refs, names, settings, options.out, crop=options.crop, save_depth=options.save_depth)


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
    refs = select(all_refs(options), options)

    def remarks(records: Sequence[Record]) -> list[str]:
        sentences = remarks_on(records, options)
        if options.sample is not None:
            sentences.append(f"Drawn with seed {options.seed}: {', '.join(ref.label for ref in refs)}.")
        count = this_process().count
        return [*sentences, f"Run by {count} processes."] if count > 1 else sentences

    return Experiment(
        "table",
        "Results pair by pair",
        pair_cells(refs, options.methods, options),
        pairs_tables,
        remarks,
        "Each pair, interval, region and metric behind a comparison of methods.",
        RECORDS_NAME,
    ).run(options, command_line(name, options))
