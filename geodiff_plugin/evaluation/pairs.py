"""Methods side by side on pairs: ``geodiff eval pairs``, ``parts``, ``flatness`` and ``cost`` (S5.3, S9)."""

from __future__ import annotations

import importlib
import statistics
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from operator import itemgetter
from typing import NamedTuple

from geodiff_plugin._checks import bad_value
from geodiff_plugin.algorithm.gradients import RULES
from geodiff_plugin.config import DEFAULT, value_of
from geodiff_plugin.evaluation import experiment, tables
from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.datasets import DATASETS, SampleRef, select
from geodiff_plugin.evaluation.experiment import Page
from geodiff_plugin.evaluation.options import DirOptions, PairsOptions
from geodiff_plugin.evaluation.tables import Table, cell, count_of_pairs, mean_cell, pairs_of
from geodiff_plugin.jobs.failures import Failures
from geodiff_plugin.jobs.journal import Item, Journal, Record, Shard
from geodiff_plugin.jobs.telling import silent
from geodiff_plugin.options import on_ray
from geodiff_plugin.priors import PRIORS, find_prior


def pair_cells(refs: Sequence[SampleRef], methods: Sequence[str], options: PairsOptions) -> list[Item]:
    """Cells of methods on samples, each method once."""
    names = tuple(dict.fromkeys(methods))
    return experiment.method_cells(refs, names, options.settings, options.out, options.save_depth)


@dataclass(frozen=True)
class Comparison:
    """Methods on pairs, and how the page shows their records."""

    title: str
    refs: Sequence[SampleRef]
    methods: Sequence[str]
    tables: experiment.Tables
    remarks: Sequence[str] = ()  # after those on what was run


def compare(name: str, options: PairsOptions, comparison: Comparison) -> Page | None:
    """``run_experiment`` of methods on pairs, with remarks on what was run."""
    cells = pair_cells(comparison.refs, comparison.methods, options)

    def remarks(records: list[Record]) -> list[str]:
        return [*remarks_on(records, options), *comparison.remarks]

    journal = experiment.RECORDS_NAME  # all such commands share their records
    of_pairs = experiment.Experiment(comparison.title, cells, comparison.tables, remarks, journal)
    return experiment.run_experiment(name, options, of_pairs)


def remarks_on(records: Sequence[Record], options: PairsOptions) -> list[str]:
    """Sentences above the tables: the prior, what methods could not do and why, samples that were broken."""
    remarks = [f"Prior {options.prior}, seed {options.seed}, ensemble {options.ensemble}."]
    by_status = tables.grouped(records, "status")
    impossible = tables.grouped(by_status.get("not applicable", ()), "method", "reason")
    for (method, reason), group in impossible.items():
        remarks.append(f"{find_method(method).title}: '-' for {count_of_pairs(len(group))}, {reason}.")
    broken = by_status.get("broken", ())
    if broken:
        count = len(set(map(tables.label_of, broken)))
        remarks.append(f"{count} broken {'sample was' if count == 1 else 'samples were'} skipped:")
    for (_, _, error), group in tables.grouped(broken, "dataset", "sample", "error").items():
        names = ", ".join(record["method"] for record in group)
        remarks.append(f"- {tables.label_of(group[0])} ({names}): {error}")
    return remarks


def _measure_on_ray(refs: Sequence[SampleRef], options: DirOptions) -> None:
    """Measure the cells without a record by Ray; this process tries those that fail there, and tells why."""
    items_on_actors = on_ray("items_on_actors")
    cells = {cell.key: cell for cell in pair_cells(refs, options.methods, options)}
    make = partial(_cells_by_key, options, modules_of_datasets())
    with Journal(options.out / experiment.RECORDS_NAME) as journal:
        failures = Failures(len(cells), "cell", silent)
        items_on_actors(list(cells.values()), journal, make, options, failures, not options.quiet)


def _cells_by_key(options: DirOptions, modules: Sequence[str]) -> Callable[[str], Record]:
    """What an actor does with the key of a cell."""
    _import_all(modules)
    cells = {cell.key: cell for cell in pair_cells(select(options), options.methods, options)}
    return lambda key: cells[key].payload()


def run_pairs(name: str, options: DirOptions) -> Page | None:
    """Measure methods on pairs and write the tables; errors as ``run_experiment``."""
    refs, more = select(options), []
    if options.engine == "ray":
        _measure_on_ray(refs, options)
    if options.sample is not None:
        more.append(f"Drawn with seed {options.seed}: {', '.join(ref.label for ref in refs)}.")
    title = "Results pair by pair"
    return compare(name, options, Comparison(title, refs, options.methods, tables.pairs_tables, more))


#: What is changed, by table: ``(row, method)``, the unchanged preset first. ``guided`` and ``paper`` stand
#: below the paper's Table 4 (no sample has known points); ``parts`` is what goes beyond the paper.
CHANGES: dict[str, tuple[tuple[str, str], ...]] = {
    "guided": (
        ("as it is", "guided"),
        ("scale and shift only", "scale-shift-only"),
        ("reprojection only", "reprojection-only"),
        ("no diffusion", "no-diffusion"),
        ("gradient to z_t (full)", "guided:gradient=full"),
        *((f"rule {name}", f"guided:rule={name}") for name in RULES if name != "adam"),
        *((f"without {name}", f"guided:weights.{name}=0") for name in DEFAULT.weights if name != "points"),
    ),
    "paper": (
        ("as it is", "paper"),
        ("scale and shift only", "paper:optimize_latents=false"),
        ("γ = 0", "paper:weights.prior_pull=0"),
        # One number that is searched within a thousandth of 1 is 1.
        ("g_s = 1", "paper:g_s_range=[0.999,1.001]"),
        ("gradient to the clean latent (denoised)", "paper:gradient=denoised"),
        *((f"rule {name}", f"paper:rule={name}") for name in RULES if name != "summed"),
    ),
    "parts": (
        ("as it is", "guided"),
        ("search only", "search-only"),
        ("photometric only", "guided:weights.matches=0"),
        ("matches only", "guided:weights.photometric=0"),
        ("no diffusion", "no-diffusion"),
        ("without correction in the loop", "guided:correct=false"),
        ("with a correction in every step", "guided:corrections=1000"),
        ("with gradient updates", "guided:inner_steps=5"),
        ("without the last fit and crisp edges", "guided:crisp=false"),
        ("without rejection of reflections", "guided:reject_reflections=false"),
        ("without cleaning of photographs", "guided:clean_photographs=false"),
        ("without exposure", "guided:exposure=false"),
        ("without z-test", "guided:z_test=false"),
    ),
}
_NAMES = {"guided": "The default preset", "paper": "Algorithm 1 as printed", "parts": "The default's parts"}

#: The numbers that decide the default's result, by knob.
NUMBERS = (
    *("min_steps", "corrections", "outlier_width", "match_noise", "smoothness"),
    *("weights.photometric", "weights.matches", "weights.anchor", "sweep_pixels"),
)


def changes_table(records: Sequence[Record], name: str) -> Table:
    """Every row of ``CHANGES[name]`` that ran, with its paired difference to the unchanged preset."""
    abs_rel, delta1 = (tables.metric_values(records, "raw", metric) for metric in ("abs_rel", "delta1"))
    seconds, unchanged, rows = tables.by_method(records, itemgetter("seconds")), CHANGES[name][0][1], []
    for title, method in CHANGES[name]:
        values = abs_rel.get(method)
        if values:
            difference = tables.paired_difference(values, abs_rel.get(unchanged, {})).cell(sign="+")
            cells = [tables.mean_with_interval(values.values()).cell(), cell(max(values.values()))]
            cells.append(tables.mean_with_interval(delta1[method].values()).cell())
            cells.append("-" if method == unchanged else difference)
            rows.append((title, str(len(values)), *cells, mean_cell(seconds[method].values(), 1)))
    header = ("change", "pairs", "AbsRel ↓ [95 %]", "worst", "δ1 ↑ [95 %]", "AbsRel more", "seconds")
    note = "Metres as they come out; each change alone, and what the knobs leave open follows it."
    return Table(f"{_NAMES[name]}, one thing changed, {pairs_of(records)}", header, tuple(rows), note)


def _at(number: str, factor: float) -> str:
    """The method with a number of the default at a multiple of itself; integers stay integers."""
    value = value_of(number, DEFAULT)
    changed = max(1, round(value * factor)) if isinstance(value, int) else float(f"{value * factor:.6g}")
    return f"guided:{number}={changed:g}"


#: The default, and every one of ``NUMBERS`` at half and at twice its value.
FLATNESS = ("guided", *(_at(number, factor) for number in NUMBERS for factor in (0.5, 2.0)))


def flatness_table(records: Sequence[Record]) -> Table:
    """Mean AbsRel with every number at half and at twice its value, and the pair that it changes most."""
    values = tables.metric_values(records, "raw", "abs_rel")
    unchanged, rows = values.get("guided", {}), []
    for number in NUMBERS:
        cells, most = [], (0.0, "-")
        for factor in (0.5, 2.0):
            changed = values.get(_at(number, factor), {})
            shared = [label for label in changed if label in unchanged]
            cells.append(mean_cell([changed[label] for label in shared], 4))
            most = max([most, *((abs(changed[label] - unchanged[label]), label) for label in shared)])
        moved = f"{cell(most[0])} ({most[1]})" if most[0] else cell(0.0)
        rows.append((f"`{number}`", f"{value_of(number, DEFAULT):g}", *cells, moved))
    title = f"Every number of the default at half and at twice its value, {count_of_pairs(len(unchanged))}"
    header = ("number", "value", "at half", "at twice", "largest change of a pair")
    note = f"Mean AbsRel; {mean_cell(unchanged.values(), 4)} as they are."
    return Table(title, header, tuple(rows), note)


def run_changes(name: str, options: PairsOptions) -> Page | None:
    """Change one thing of the default at a time: its ``parts``, or the numbers of ``flatness``."""
    flat, refs = name == "flatness", select(options)
    methods = FLATNESS if flat else tuple(method for _, method in CHANGES[name])

    def page_tables(records: list[Record]) -> list[Table]:
        added = [record for record in records if record["method"] not in methods]
        title = f"Further methods and priors, {pairs_of(added)}"
        further = tables.summary_table(added, set(map(tables.label_of, added)), title)
        if flat:
            return [flatness_table(records), further]
        return [changes_table(records, name), further, tables.details_table(records, tables.REGIONS)]

    title = "Flatness" if flat else "Parts of the default"
    return compare(name, options, Comparison(title, refs, (*methods, *options.methods), page_tables))


#: The stock pipeline, which everything is compared with; its alignment costs nothing beside it.
PLAIN = "prior-aligned"
COST_METHODS = (PLAIN, "search-only", "guided", "guided:gradient=full", "paper")
#: Denoising steps when none are asked for: what the default guidance takes of a prior that takes any number.
STEPS = 4


class _Cost(NamedTuple):
    """What a method took: pairs, median seconds, greatest peak of memory in bytes."""

    pairs: int
    seconds: float
    peak: int


def cost_table(records: Sequence[Record]) -> Table:
    """Seconds and memory of every method, and both as multiples of the plain pipeline's."""
    costs, rows = dict[str, _Cost](), []
    for method, group in tables.grouped((r for r in records if r["status"] == "ok"), "method").items():
        peak = max(record["peak_bytes"] for record in group)
        costs[method] = _Cost(len(group), statistics.median(record["seconds"] for record in group), peak)
    if PLAIN not in costs:
        cure = "See geodiff eval cost with --stop-on-broken for the reason."
        bad_value("the pairs", f"some on which {PLAIN} works", "none", cure)
    plain = costs[PLAIN]
    for method, cost in costs.items():
        title = "plain pipeline" if method == PLAIN else find_method(method).title
        times = f"{cost.seconds:.2f}", f"{cost.seconds / max(plain.seconds, 1e-3):.2f}"
        memory = f"{cost.peak / 1e6:.0f}", f"{cost.peak / max(plain.peak, 1):.2f}"
        rows.append((title, str(cost.pairs), *times, *memory))
    note = (
        "Median seconds and greatest peak over the pairs, each method in a process of its own, all of one "
        "prior with the same number of denoising steps. On CUDA the peak is what was allocated, weights "
        "included, reset for each pair; on the CPU it is the increase of resident memory over the start, "
        "sampled every 50 ms."
    )
    header = ("method", "pairs", "seconds", "time × plain", "peak MB", "memory × plain")
    return Table(f"Cost on {pairs_of(records)}", header, tuple(rows), note)


def _steps_of(prior: str) -> int | None:
    """``STEPS``, or ``None`` for a prior that was trained for fewer: its own number then."""
    most = PRIORS[find_prior(prior).key].max_steps
    return STEPS if most is None or most >= STEPS else None


def _method_records(refs: Sequence[SampleRef], method: str, options: PairsOptions) -> list[Record]:
    """Records of one method; called in a process of its own."""
    return experiment.measure_cells(pair_cells(refs, (method,), options), options) or []


def _import_all(modules: Sequence[str]) -> None:
    for module in modules:
        importlib.import_module(module)


def modules_of_datasets() -> list[str]:
    """The modules that another process imports to know every registered data set."""
    # A file that was run is read again by a new process, but not what `python -m` ran.
    return sorted({dataset.load.__module__ for dataset in DATASETS.values()} - {"__main__"})


def fresh_process() -> ProcessPoolExecutor:
    """One new process, which knows every registered data set."""
    context, modules = get_context("spawn"), modules_of_datasets()
    return ProcessPoolExecutor(1, mp_context=context, initializer=_import_all, initargs=(modules,))


def run_cost(name: str, options: PairsOptions) -> Page:
    """Measure ``COST_METHODS`` and further ones, and write the table; records go to ``out/cost``."""
    if not Shard.of(None).whole:
        bad_value("the number of processes", "1 for cost", Shard.of(None).count)
    refs = select(options)
    records, taken = list[Record](), dict[str, int | None]()
    alone = replace(options, out=options.out / "cost")
    for method in dict.fromkeys((*COST_METHODS, *options.methods)):
        prior = find_method(method).prior or options.prior
        taken[prior] = options.steps or _steps_of(prior)
        # What one method frees stays with the allocator, where the next would find it at no cost.
        with fresh_process() as process:
            job = process.submit(_method_records, refs, method, replace(alone, steps=taken[prior]))
            records += job.result()
    steps = [f"{count or 'its own number'} with {prior}" for prior, count in taken.items()]
    remarks = (*remarks_on(records, options), f"Denoising steps of each: {', '.join(steps)}.")
    return experiment.write_page(name, options, "Cost", [cost_table(records)], remarks)
