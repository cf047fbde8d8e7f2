"""Compares methods on pairs: ``geodiff eval pairs``, ``parts``, ``flatness`` and ``cost`` (S5.3, S9)."""

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

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.algorithm.optimizers import OPTIMIZERS
from geodiff_plugin.config import DEFAULT, value_of
from geodiff_plugin.evaluation import experiment, tables
from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.datasets import DATASETS, SampleRef, select
from geodiff_plugin.evaluation.experiment import Page
from geodiff_plugin.evaluation.options import DirOptions, PairsOptions
from geodiff_plugin.evaluation.tables import Table, cell, count_of_pairs, mean_cell, pairs_of
from geodiff_plugin.jobs import Item, Journal, Record, Runner, Shard, on_ray, silent
from geodiff_plugin.priors import PRIORS, find_prior


def pair_cells(refs: Sequence[SampleRef], methods: Sequence[str], options: PairsOptions) -> list[Item]:
    """Return cells of methods on samples, each method once."""
    names = tuple(dict.fromkeys(methods))
    return experiment.method_cells(refs, names, options.settings, options.out, options.save_depth)


@dataclass(frozen=True)
class Comparison:
    """Methods on pairs, and the presentation of their records."""

    title: str
    refs: Sequence[SampleRef]
    methods: Sequence[str]
    tables: experiment.Tables
    remarks: Sequence[str] = ()  # after those about the run


def compare(name: str, options: PairsOptions, comparison: Comparison) -> Page | None:
    """Call ``run_experiment`` for methods on pairs, with remarks about the run."""
    cells = pair_cells(comparison.refs, comparison.methods, options)

    def remarks(records: list[Record]) -> list[str]:
        return [*remarks_on(records, options), *comparison.remarks]

    journal = experiment.RECORDS_NAME  # shared by all such commands
    of_pairs = experiment.Experiment(comparison.title, cells, comparison.tables, remarks, journal)
    return experiment.run_experiment(name, options, of_pairs)


def remarks_on(records: Sequence[Record], options: PairsOptions) -> list[str]:
    """Return remarks above the tables: the prior, methods that were not applicable, broken samples."""
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
    """Measure cells without a record with Ray; this process retries those that fail, and reports why."""
    cells = {cell.key: cell for cell in pair_cells(refs, options.methods, options)}
    make = partial(_cells_by_key, options, modules_of_datasets())
    with Journal(options.out / experiment.RECORDS_NAME) as journal:
        runner = Runner(list(cells.values()), journal, noun="cell", progress=not options.quiet)
        runner.run_elsewhere(partial(on_ray("items_on_actors"), make, options), silent)


def _cells_by_key(options: DirOptions, modules: Sequence[str]) -> Callable[[str], Record]:
    """Return an actor's function from the key of a cell to its record."""
    _import_all(modules)
    cells = {cell.key: cell for cell in pair_cells(select(options), options.methods, options)}
    return lambda key: cells[key].payload()


def run_pairs(name: str, options: DirOptions) -> Page | None:
    """Measure methods on pairs and write the tables; errors as in ``run_experiment``."""
    refs = select(options)
    more = []
    if options.engine == "ray":
        _measure_on_ray(refs, options)
    if options.sample is not None:
        more.append(f"Drawn with seed {options.seed}: {', '.join(ref.label for ref in refs)}.")
    title = "Results per pair"
    return compare(name, options, Comparison(title, refs, options.methods, tables.pairs_tables, more))


#: Changes by table: ``(row, method)``, the unchanged preset first. ``guided`` and ``paper`` are below the
#: paper's Table 4 (no sample has known points); ``parts`` are the extensions beyond the paper.
CHANGES: dict[str, tuple[tuple[str, str], ...]] = {
    "guided": (
        ("unchanged", "guided"),
        ("scale and shift only", "scale-shift-only"),
        ("reprojection only", "reprojection-only"),
        ("no diffusion", "no-diffusion"),
        ("gradient to z_t (full)", "guided:gradient=full"),
        *((f"optimizer {name}", f"guided:optimizer={name}") for name in OPTIMIZERS if name != "adam"),
        *((f"without {name}", f"guided:weights.{name}=0") for name in DEFAULT.weights if name != "points"),
    ),
    "paper": (
        ("unchanged", "paper"),
        ("scale and shift only", "paper:optimize_latents=false"),
        ("γ = 0", "paper:weights.affine_reg=0"),
        # A searched value within a thousandth of 1 is 1.
        ("g_s = 1", "paper:g_s_range=[0.999,1.001]"),
        ("gradient to the clean latent (denoised)", "paper:gradient=denoised"),
        *((f"optimizer {name}", f"paper:optimizer={name}") for name in OPTIMIZERS if name != "summed"),
    ),
    "parts": (
        ("unchanged", "guided"),
        ("search only", "search-only"),
        ("photometric only", "guided:weights.matches=0"),
        ("matches only", "guided:weights.photometric=0"),
        ("no diffusion", "no-diffusion"),
        ("without match fitting in the loop", "guided:fit_matches=false"),
        ("with match fitting in every step", "guided:match_fits=1000"),
        ("with gradient updates", "guided:guidance_steps=5"),
        ("without final fit and edge refinement", "guided:refine_edges=false"),
        ("without rejection of reflections", "guided:reject_reflections=false"),
        ("without image cleaning", "guided:clean_images=false"),
        ("without exposure compensation", "guided:exposure=false"),
        ("without occlusion mask", "guided:occlusion_mask=false"),
    ),
}
_NAMES = {
    "guided": "The default preset",
    "paper": "Algorithm 1 as printed",
    "parts": "Ablation of the default",
}

#: The numbers that determine the default's result, by parameter.
NUMBERS = (
    *("min_steps", "match_fits", "outlier_sigma", "match_sigma", "smoothness"),
    *("weights.photometric", "weights.matches", "weights.anchor", "sweep_pixels"),
)


def changes_table(records: Sequence[Record], name: str) -> Table:
    """Return all rows of ``CHANGES[name]`` that ran, with paired differences to the unchanged preset."""
    abs_rel, delta1 = (tables.metric_values(records, "raw", metric) for metric in ("abs_rel", "delta1"))
    seconds = tables.by_method(records, itemgetter("seconds"))
    unchanged = CHANGES[name][0][1]
    rows = []
    for title, method in CHANGES[name]:
        values = abs_rel.get(method)
        if values:
            difference = tables.paired_difference(values, abs_rel.get(unchanged, {})).cell(sign="+")
            cells = [tables.mean_with_interval(values.values()).cell(), cell(max(values.values()))]
            cells.append(tables.mean_with_interval(delta1[method].values()).cell())
            cells.append("-" if method == unchanged else difference)
            rows.append((title, str(len(values)), *cells, mean_cell(seconds[method].values(), 1)))
    header = ("change", "pairs", "AbsRel ↓ [95 %]", "worst", "δ1 ↑ [95 %]", "AbsRel change", "seconds")
    note = "Metric depth without alignment; one change at a time; parameters derived from it follow."
    return Table(f"{_NAMES[name]}, one change at a time, {pairs_of(records)}", header, tuple(rows), note)


def _at(number: str, factor: float) -> str:
    """Return the method with a parameter of the default multiplied by a factor; integers stay integers."""
    value = value_of(number, DEFAULT)
    changed = max(1, round(value * factor)) if isinstance(value, int) else float(f"{value * factor:.6g}")
    return f"guided:{number}={changed:g}"


#: The default, and each of ``NUMBERS`` at half and twice its value.
FLATNESS = ("guided", *(_at(number, factor) for number in NUMBERS for factor in (0.5, 2.0)))


def flatness_table(records: Sequence[Record]) -> Table:
    """Return mean AbsRel with each parameter at half and twice its value, and the largest pair change."""
    values = tables.metric_values(records, "raw", "abs_rel")
    unchanged = values.get("guided", {})
    rows = []
    for number in NUMBERS:
        means = list[str]()
        changes = list[tuple[float, str]]()
        for factor in (0.5, 2.0):
            changed = values.get(_at(number, factor), {})
            shared = [label for label in changed if label in unchanged]
            means.append(mean_cell([changed[label] for label in shared], 4))
            changes += [(abs(changed[label] - unchanged[label]), label) for label in shared]
        largest, label = max(changes, default=(0.0, ""))
        change = f"{cell(largest)} ({label})" if largest else cell(0.0)
        rows.append((f"`{number}`", f"{value_of(number, DEFAULT):g}", *means, change))
    title = f"Each parameter of the default at half and twice its value, {count_of_pairs(len(unchanged))}"
    header = ("parameter", "value", "at half", "at twice", "largest change of a pair")
    note = f"Mean AbsRel; {mean_cell(unchanged.values(), 4)} with default values."
    return Table(title, header, tuple(rows), note)


def run_changes(name: str, options: PairsOptions) -> Page | None:
    """Change one part of the default at a time: its ``parts``, or the numbers of ``flatness``."""
    flat = name == "flatness"
    refs = select(options)
    methods = FLATNESS if flat else tuple(method for _, method in CHANGES[name])

    def page_tables(records: list[Record]) -> list[Table]:
        added = [record for record in records if record["method"] not in methods]
        title = f"Further methods and priors, {pairs_of(added)}"
        further = tables.summary_table(added, set(map(tables.label_of, added)), title)
        if flat:
            return [flatness_table(records), further]
        return [changes_table(records, name), further, tables.details_table(records, tables.REGIONS)]

    title = "Hyperparameter sensitivity" if flat else "Ablation"
    return compare(name, options, Comparison(title, refs, (*methods, *options.methods), page_tables))


#: The stock pipeline, the reference of all comparisons; the time of its alignment is negligible.
PLAIN = "prior-aligned"
COST_METHODS = (PLAIN, "search-only", "guided", "guided:gradient=full", "paper")


class _Cost(NamedTuple):
    """Cost of a method: pairs, median seconds, peak memory in bytes."""

    pairs: int
    seconds: float
    peak: int


def cost_table(records: Sequence[Record]) -> Table:
    """Return seconds and memory of every method, absolute and relative to the plain pipeline."""
    costs = dict[str, _Cost]()
    rows = []
    for method, group in tables.grouped((r for r in records if r["status"] == "ok"), "method").items():
        peak = max(record["peak_bytes"] for record in group)
        costs[method] = _Cost(len(group), statistics.median(record["seconds"] for record in group), peak)
    if PLAIN not in costs:
        hint = "See geodiff eval cost with --stop-on-broken for the reason."
        bad_value("the pairs", f"some that {PLAIN} supports", "none", hint)
    plain = costs[PLAIN]
    for method, cost in costs.items():
        title = "plain pipeline" if method == PLAIN else find_method(method).title
        times = f"{cost.seconds:.2f}", f"{cost.seconds / max(plain.seconds, 1e-3):.2f}"
        memory = f"{cost.peak / 1e6:.0f}", f"{cost.peak / max(plain.peak, 1):.2f}"
        rows.append((title, str(cost.pairs), *times, *memory))
    note = (
        "Median seconds and maximum peak memory over the pairs, each method in a separate process, all "
        "with the same "
        "prior and number of denoising steps. On CUDA the peak is the allocated memory including "
        "weights, reset for each "
        "pair; on the CPU it is the increase of resident memory since the start, sampled every 50 ms."
    )
    header = ("method", "pairs", "seconds", "time × plain", "peak MB", "memory × plain")
    return Table(f"Cost on {pairs_of(records)}", header, tuple(rows), note)


def _steps_of(prior: str) -> int | None:
    """Return the default guidance's steps; ``None`` (own number) for a prior trained for fewer."""
    max_steps = PRIORS[find_prior(prior).key].max_steps
    return DEFAULT.min_steps if max_steps is None or max_steps >= DEFAULT.min_steps else None


def _method_records(refs: Sequence[SampleRef], method: str, options: PairsOptions) -> list[Record]:
    """Return records of one method; called in a separate process."""
    return experiment.measure_cells(pair_cells(refs, (method,), options), options) or []


def _import_all(modules: Sequence[str]) -> None:
    for module in modules:
        importlib.import_module(module)


def modules_of_datasets() -> list[str]:
    """Return the modules that another process imports to know every registered data set."""
    # A new process imports a script that was run as a file, but not a module run with `python -m`.
    return sorted({dataset.load.__module__ for dataset in DATASETS.values()} - {"__main__"})


def fresh_process() -> ProcessPoolExecutor:
    """Return an executor of one new process that knows every registered data set."""
    context = get_context("spawn")
    modules = modules_of_datasets()
    return ProcessPoolExecutor(1, mp_context=context, initializer=_import_all, initargs=(modules,))


def run_cost(name: str, options: PairsOptions) -> Page:
    """Measure ``COST_METHODS`` and further methods, and write the table; records go to ``out/cost``."""
    if not Shard.of(None).whole:
        bad_value("the number of processes", "1 for cost", Shard.of(None).count)
    refs = select(options)
    records = list[Record]()
    taken = dict[str, int | None]()
    alone = replace(options, out=options.out / "cost")
    for method in dict.fromkeys((*COST_METHODS, *options.methods)):
        prior = find_method(method).prior or options.prior
        taken[prior] = options.steps or _steps_of(prior)
        # Memory freed by one method stays with the allocator, which would favour the next one.
        with fresh_process() as process:
            job = process.submit(_method_records, refs, method, replace(alone, steps=taken[prior]))
            records += job.result()
    steps = [f"{count or 'default number'} with {prior}" for prior, count in taken.items()]
    remarks = (*remarks_on(records, options), f"Denoising steps per method: {', '.join(steps)}.")
    return experiment.write_page(name, options, "Cost", [cost_table(records)], remarks)
