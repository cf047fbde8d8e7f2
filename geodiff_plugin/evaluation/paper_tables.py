"""Tables in the paper's layout, from records.

Data flow: ``Layout`` + records -> ``Table``.
Paper: Tables 1 to 4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.cells import (
    HEADINGS,
    by_method,
    cell,
    count_of_pairs,
)
from geodiff_plugin.evaluation.layout import Table
from geodiff_plugin.evaluation.published import Column, Layout, PaperRow
from geodiff_plugin.evaluation.statistics import mean_with_interval

__all__ = ["FoundColumn", "layout_table", "metric_values"]

_ARROWS = {"abs_rel": "↓", "rmse": "↓", "delta1": "↑"}


@dataclass(frozen=True)
class FoundColumn:
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


def metric_values(
    records: Sequence[dict[str, Any]], alignment: str, metric: str
) -> Mapping[str, dict[str, float]]:
    """Method -> label -> one metric under the cap, raw or aligned."""

    def value_of(record: dict[str, Any]) -> float | None:
        scores = record["capped"][alignment]
        return None if scores is None else scores[metric]

    return by_method(records, value_of)


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
