"""The paper's tables as runs and in its layout (Tables 1 to 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import find_method, with_priors
from geodiff_plugin.evaluation.changes import CHANGES, changes_table
from geodiff_plugin.evaluation.datasets import DATASETS, SampleRef
from geodiff_plugin.evaluation.experiment import RECORDS_NAME, Experiment
from geodiff_plugin.evaluation.options import PairsOptions, all_refs, command_line, select
from geodiff_plugin.evaluation.pairs import pair_cells, remarks_on
from geodiff_plugin.evaluation.published import LAYOUTS, Column, Layout, PaperRow
from geodiff_plugin.evaluation.report import Page
from geodiff_plugin.evaluation.table import (
    HEADINGS,
    Table,
    cell,
    count_of_pairs,
    label_of,
    mean_with_interval,
    metric_values,
)
from geodiff_plugin.evaluation.tables import regions_table, summary_table
from geodiff_plugin.runner import Record

__all__ = ["FoundColumn", "how_to_obtain", "layout_table", "methods_of", "run_paper_table"]

_ARROWS = {"abs_rel": "↓", "rmse": "↓", "delta1": "↑"}


class FoundColumn(NamedTuple):
    """A column of a layout and what stands for it.

    Attributes:
        column: of the layout.
        dataset: the data set that was found, or ``None``.
        labels: samples that were measured.
    """

    column: Column
    dataset: str | None
    labels: frozenset[str]

    @property
    def complete(self) -> bool:
        """Whether this is the set as the paper used it, so that its numbers may stand beside."""
        return self.dataset == self.column.datasets[0] and len(self.labels) == self.column.full_count

    @property
    def heading(self) -> str:
        """The paper's name, the set that stands for it where it is another, the number of pairs."""
        if self.dataset is None:
            return f"{self.column.title} (not found)"
        other = "" if self.dataset == self.column.datasets[0] else f"{self.dataset}, "
        return f"{self.column.title} ({other}{count_of_pairs(len(self.labels))})"


def _means(
    found: FoundColumn, records: Sequence[dict[str, Any]], method: str, alignment: str, metrics: Sequence[str]
) -> tuple[str, ...]:
    """A cell per metric; a dash unless the method has a number for every pair of the column."""
    cells = []
    for metric in metrics:
        values = metric_values(records, alignment, metric).get(method, {})
        whole = found.labels and found.labels <= values.keys()
        mean = mean_with_interval([values[x] for x in found.labels]).value if whole else None
        cells.append(cell(mean))
    return tuple(cells)


def _filler(row: PaperRow, methods: Sequence[str]) -> str:
    """The method that fills a row of the paper, empty where none ran."""
    if row.method in methods:
        return row.method
    return next((name for name in methods if row.word and row.word in name.lower().partition(":")[2]), "")


def _own_rows(methods: Sequence[str], records: Sequence[dict[str, Any]]) -> list[PaperRow]:
    """Rows for methods that the paper does not have: as they come out where they know metres, and aligned."""
    rows = []
    for name in methods:
        title, metric = find_method(name).title, metric_values(records, "raw", "abs_rel").get(name)
        rows += [PaperRow(f"{title}†", False, name)] if metric else []
        rows.append(PaperRow(title, True, name))
    return rows


def layout_table(
    layout: Layout,
    columns: Sequence[FoundColumn],
    records: Sequence[dict[str, Any]],
    methods: Sequence[str],
) -> Table:
    """A table in the paper's layout, with rows of our own below the paper's.

    Args:
        layout: of ``LAYOUTS``.
        columns: what was found for each of its columns.
        records: of the run.
        methods: names of the methods that ran.

    Returns:
        One column per data set and metric; beside each complete data set the paper's cells, as printed.
    """
    count = len(layout.metrics)
    header = [f"{HEADINGS[metric]} {_ARROWS[metric]}" for metric in layout.metrics]
    groups, heads = [("", 2)], ["Method", "GT-aligned"]
    for found in columns:
        groups.append((found.heading, count))
        heads += header
        if found.complete:
            groups.append((f"{found.column.title}, as published", count))
            heads += header
    filled = {row: _filler(row, methods) for row in layout.rows}
    own = _own_rows([name for name in methods if name not in filled.values()], records)
    rows = []
    for row in (*layout.rows, *own):
        method = filled[row] if row in filled else row.method
        cells = [row.title, "✓" if row.aligned else "✗"]
        for found in columns:
            cells += _means(found, records, method, "aligned" if row.aligned else "raw", layout.metrics)
            cells += row.cells(found.column.title, count) if found.complete else ()
        rows.append(tuple(cells))
    empty = [row for row in layout.rows if not filled[row] and row.hint]
    note = "Capped at 80 m for KITTI and 10 m for Booster. † in metres as they come out."
    if empty:
        recipes = ", ".join(dict.fromkeys(f"{row.title} (--methods {row.hint})" for row in empty))
        note += f" Not run here: {recipes}."
    rules = (*layout.rules, len(layout.rows)) if own else layout.rules
    return Table(layout.title, tuple(heads), tuple(rows), note, tuple(groups), rules)


ABLATED = ("guided", "paper")
"""Keys of ``CHANGES`` whose tables stand below Table 4."""


def methods_of(name: str, added: Sequence[str]) -> tuple[str, ...]:
    """Every method that a table runs: the paper's rows, our own beside them, and what the user adds."""
    layout = LAYOUTS[name]
    names = [*(row.method for row in layout.rows if row.method), *layout.methods, *added]
    if name == "ablation":
        names += [method for preset in ABLATED for _, method in CHANGES[preset]]
    return tuple(dict.fromkeys(names))


def _find(column: Column, options: PairsOptions, sample: int | None) -> tuple[str | None, list[SampleRef]]:
    """The first data set that can stand for a column, and the samples to measure."""
    wanted = options.datasets or column.datasets
    for dataset in (name for name in column.datasets if name in wanted):
        refs = all_refs(options, (dataset,))
        # One column may have what --scenes names while another has not.
        refs = [ref for ref in refs if not options.scenes or any(s in ref.label for s in options.scenes)]
        if refs:
            drawn = sample if sample is not None and sample <= len(refs) else None
            return dataset, select(refs, replace(options, sample=options.sample or drawn))
    return None, []


def how_to_obtain(name: str) -> str:
    """Sentences that say where the data sets of a table come from."""
    return " ".join(f"{c.title}: {DATASETS[c.datasets[0]].obtain}" for c in LAYOUTS[name].columns)


def _missing(columns: Sequence[Column]) -> list[str]:
    return [f"{c.title} was not found. To obtain it: {DATASETS[c.datasets[0]].obtain}" for c in columns]


def _ablation_layout(layout: Layout, options: PairsOptions) -> Layout:
    """Table 4 on KITTI where it is there, and on everything else that is."""
    there = {ref.dataset for ref in all_refs(options)}
    kitti = [column for column in layout.columns if there & set(column.datasets)]
    others = [
        Column(name, (name,), 0)
        for name in DATASETS
        if name in there - {d for c in kitti for d in c.datasets}
    ]
    return layout._replace(columns=tuple(kitti + others) or layout.columns)


def _tables(
    name: str, layout: Layout, found: Sequence[FoundColumn], records: Sequence[dict[str, Any]], methods: Any
) -> list[Table]:
    tables = [layout_table(layout, found, records, methods)]
    if name == "ablation":
        tables += [changes_table(records, preset) for preset in ABLATED]
    for column in found:
        if column.labels:
            own = [record for record in records if label_of(record) in column.labels]
            title = f"All metrics, {column.column.title}, {count_of_pairs(len(column.labels))}"
            tables.append(summary_table(own, set(column.labels), title))
    tables.append(regions_table(records))
    return [table for table in tables if table.rows]


def run_paper_table(name: str, options: PairsOptions) -> Page | None:
    """Measure what one table of the paper needs, and write it.

    Args:
        name: key of ``LAYOUTS``.
        options: as of ``geodiff eval pairs``; ``methods`` are run beside the table's own.

    Raises:
        ValueError: nothing that the table needs is there (the message says how to obtain it), bad options.
        OSError: missing or unreadable files without ``skip_broken``.
    """
    if options.data is None and name != "ablation":
        bad_value("--data", "given", "nothing", how_to_obtain(name))
    layout = LAYOUTS[name]
    if name == "table3":
        options = replace(options, pairs="all")
    if name == "ablation":
        layout = _ablation_layout(layout, options)
    # The paper drew its posed pairs at random, and so does the table where there are enough to draw from.
    drawn = {c.title: c.full_count if name == "table3" else None for c in layout.columns}
    chosen = {column: _find(column, options, drawn[column.title]) for column in layout.columns}
    refs = [ref for _, found in chosen.values() for ref in found]
    absent = _missing([column for column, (_, found) in chosen.items() if not found])
    if not refs:
        bad_value("--data", f"a folder with the data of {name}", str(options.data), " ".join(absent))
    names = methods_of(name, options.methods)

    def tables(records: list[Record]) -> list[Table]:
        finished = {label_of(record) for record in records if record["status"] != "broken"}
        columns = [
            FoundColumn(column, dataset, frozenset(ref.label for ref in found) & finished)
            for column, (dataset, found) in chosen.items()
        ]
        return _tables(name, layout, columns, records, with_priors(names, options.prior[1:]))

    def remarks(records: list[Record]) -> list[str]:
        pairs = ["Pairs: " + ", ".join(ref.label for ref in refs) + "."] if name == "table3" else []
        return [*remarks_on(records, options), *absent, *pairs]

    cells = pair_cells(refs, names, options)
    experiment = Experiment(name, layout.title, cells, tables, remarks, journal=RECORDS_NAME)
    return experiment.run(options, command_line(name, options))
