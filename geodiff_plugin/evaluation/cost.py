"""Seconds and peak memory of methods on a data set, as ratios to the plain pipeline.

Paper: S9 (inference time, run time comparison), as ratios and not as seconds of another machine.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import find_method, with_priors
from geodiff_plugin.evaluation.datasets.sample import SampleRef
from geodiff_plugin.evaluation.experiment import measure_cells
from geodiff_plugin.evaluation.options import PairsOptions, all_refs, command_line, select
from geodiff_plugin.evaluation.pairs import pair_cells, remarks_on
from geodiff_plugin.evaluation.report import Page, run_facts, write_page
from geodiff_plugin.evaluation.table import Table, count_of_pairs, label_of
from geodiff_plugin.priors import PRIORS, find_prior
from geodiff_plugin.priors.base import OwnPipelinePrior
from geodiff_plugin.runner import Record, this_process

__all__ = ["COST_METHODS", "PLAIN", "cost_table", "run_cost"]

PLAIN = "prior-aligned"
"""The stock pipeline, which everything is compared with; its alignment costs nothing beside it."""
COST_METHODS = (PLAIN, "search-only", "guided", "guided:gradient=full", "paper")
#: Denoising steps when none are asked for: what the default guidance takes of a prior that takes any number.
STEPS = 4


def cost_table(records: Sequence[dict[str, Any]]) -> Table:
    """Seconds and memory of every method, and both as multiples of the plain pipeline's.

    Args:
        records: of a run in which ``PLAIN`` is one of the methods.

    Raises:
        ValueError: no pair on which ``PLAIN`` has worked.
    """
    costs = {}
    for name in dict.fromkeys(record["method"] for record in records):
        own = [r for r in records if r["method"] == name and r["status"] == "ok"]
        if own:
            seconds = statistics.median(record["seconds"] for record in own)
            costs[name] = (len(own), seconds, max(record["peak_bytes"] for record in own))
    if PLAIN not in costs:
        cure = "See geodiff eval cost without --skip-broken for the reason."
        bad_value("the pairs", f"some on which {PLAIN} works", "none", cure)
    _, plain_seconds, plain_bytes = costs[PLAIN]
    rows = [
        (
            "plain pipeline" if name == PLAIN else find_method(name).title,
            str(count),
            f"{seconds:.2f}",
            f"{seconds / max(plain_seconds, 1e-3):.2f}",
            f"{peak_bytes / 1e6:.0f}",
            f"{peak_bytes / max(plain_bytes, 1):.2f}",
        )
        for name, (count, seconds, peak_bytes) in costs.items()
    ]
    header = ("method", "pairs", "seconds", "time × plain", "peak MB", "memory × plain")
    pairs = count_of_pairs(len({label_of(record) for record in records}))
    note = (
        "Median seconds and greatest peak over the pairs, each method in a process of its own, all of one "
        "prior with the same number of denoising steps. On CUDA the peak is what was allocated, weights "
        "included, reset for each pair; on the CPU it is the increase of resident memory over the start, "
        "sampled every 50 ms."
    )
    return Table(f"Cost on {pairs}", header, tuple(rows), note)


def _steps_of(prior: str) -> int | None:
    """``STEPS``, or ``None`` for a prior that was trained for fewer: its own number then."""
    adapter = PRIORS[find_prior(prior).key]
    kind = adapter.pipeline_class if issubclass(adapter, OwnPipelinePrior) else adapter
    return STEPS if kind.max_steps is None or kind.max_steps >= STEPS else None


def _method_records(refs: Sequence[SampleRef], method: str, options: PairsOptions) -> list[Record]:
    """Records of one method; called in a process of its own."""
    return measure_cells(pair_cells(refs, (method,), options), options) or []


def run_cost(name: str, options: PairsOptions) -> Page:
    """Measure and write the table; records go to ``out/cost``, apart from those of other commands.

    Args:
        name: ``"cost"``.
        options: as of ``geodiff eval pairs``; ``methods`` are measured beside ``COST_METHODS``.

    Raises:
        ValueError: no samples, bad options, or started as several processes.
        OSError: missing or unreadable files without ``skip_broken``.
    """
    if this_process().count > 1:
        bad_value("the number of processes", "1 for cost", this_process().count)
    refs = select(all_refs(options), options)
    records: list[Record] = []
    taken: dict[str, int | None] = {}
    alone = replace(options, prior=options.prior[:1], out=options.out / "cost")
    for method in with_priors(tuple(dict.fromkeys((*COST_METHODS, *options.methods))), options.prior[1:]):
        prior = find_method(method).prior or options.prior[0]
        if prior not in taken:
            taken[prior] = options.steps or _steps_of(prior)
        # What one method frees stays with the allocator, where the next would find it at no cost.
        with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as fresh_process:
            job = fresh_process.submit(_method_records, refs, method, replace(alone, steps=taken[prior]))
            records += job.result()
    each = [f"{steps or 'its own number'} with {prior}" for prior, steps in taken.items()]
    remarks = [*remarks_on(records, options), f"Denoising steps of each: {', '.join(each)}."]
    page = Page("Cost", run_facts(command_line(name, options)), (cost_table(records),), tuple(remarks))
    write_page(page, options.out, name, options.results)
    return page
