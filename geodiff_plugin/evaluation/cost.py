"""Seconds and peak memory of methods on a data set, as ratios to the plain pipeline (paper S9)."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import find_method, with_priors
from geodiff_plugin.evaluation.datasets import SampleRef
from geodiff_plugin.evaluation.experiment import Page, measure_cells, run_facts
from geodiff_plugin.evaluation.options import PairsOptions, all_refs, select
from geodiff_plugin.evaluation.pairs import pair_cells, remarks_on
from geodiff_plugin.evaluation.tables import Table, count_of_pairs, label_of
from geodiff_plugin.priors import PRIORS, find_prior
from geodiff_plugin.runner import Record, this_process

PLAIN = "prior-aligned"
"""The stock pipeline, which everything is compared with; its alignment costs nothing beside it."""
COST_METHODS = (PLAIN, "search-only", "guided", "guided:gradient=full", "paper")
#: Denoising steps when none are asked for: what the default guidance takes of a prior that takes any number.
STEPS = 4


def cost_table(records: Sequence[Record]) -> Table:
    """Seconds and memory of every method, and both as multiples of the plain pipeline's.

    Args:
        records: of a run in which ``PLAIN`` has worked on some pair; ``ValueError`` without.
    """
    costs = {}
    for name in dict.fromkeys(record["method"] for record in records):
        own = [r for r in records if r["method"] == name and r["status"] == "ok"]
        if own:
            seconds, peak = statistics.median(r["seconds"] for r in own), max(r["peak_bytes"] for r in own)
            costs[name] = len(own), seconds, peak
    if PLAIN not in costs:
        cure = "See geodiff eval cost without --skip-broken for the reason."
        bad_value("the pairs", f"some on which {PLAIN} works", "none", cure)
    _, plain_seconds, plain_bytes = costs[PLAIN]
    rows = []
    for name, (count, seconds, peak) in costs.items():
        times = f"{seconds:.2f}", f"{seconds / max(plain_seconds, 1e-3):.2f}"
        memory = f"{peak / 1e6:.0f}", f"{peak / max(plain_bytes, 1):.2f}"
        title = "plain pipeline" if name == PLAIN else find_method(name).title
        rows.append((title, str(count), *times, *memory))
    header = ("method", "pairs", "seconds", "time × plain", "peak MB", "memory × plain")
    note = (
        "Median seconds and greatest peak over the pairs, each method in a process of its own, all of one "
        "prior with the same number of denoising steps. On CUDA the peak is what was allocated, weights "
        "included, reset for each pair; on the CPU it is the increase of resident memory over the start, "
        "sampled every 50 ms."
    )
    pairs = count_of_pairs(len({label_of(record) for record in records}))
    return Table(f"Cost on {pairs}", header, tuple(rows), note)


def _steps_of(prior: str) -> int | None:
    """``STEPS``, or ``None`` for a prior that was trained for fewer: its own number then."""
    most = getattr(PRIORS[find_prior(prior).key].pipeline_class, "max_steps", None)
    return STEPS if most is None or most >= STEPS else None


def _method_records(refs: Sequence[SampleRef], method: str, options: PairsOptions) -> list[Record]:
    """Records of one method; called in a process of its own."""
    return measure_cells(pair_cells(refs, (method,), options), options) or []


def run_cost(name: str, options: PairsOptions) -> Page:
    """Measure ``COST_METHODS`` and further ones, and write the table.

    Records go to ``out/cost``, apart from those of other commands.

    Raises:
        ValueError: no samples, bad options, or started as several processes.
        OSError: missing or unreadable files without ``skip_broken``.
    """
    if this_process().count > 1:
        bad_value("the number of processes", "1 for cost", this_process().count)
    refs = select(all_refs(options), options)
    records, taken = list[Record](), dict[str, int | None]()
    alone = replace(options, prior=options.prior[:1], out=options.out / "cost")
    for method in with_priors(tuple(dict.fromkeys((*COST_METHODS, *options.methods))), options.prior[1:]):
        prior = find_method(method).prior or options.prior[0]
        if prior not in taken:
            taken[prior] = options.steps or _steps_of(prior)
        # What one method frees stays with the allocator, where the next would find it at no cost.
        with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as fresh_process:
            job = fresh_process.submit(_method_records, refs, method, replace(alone, steps=taken[prior]))
            records += job.result()
    steps = [f"{count or 'its own number'} with {prior}" for prior, count in taken.items()]
    remarks = (*remarks_on(records, options), f"Denoising steps of each: {', '.join(steps)}.")
    page = Page("Cost", run_facts(name, options), (cost_table(records),), remarks)
    return page.write(options.out, name, options.results)
