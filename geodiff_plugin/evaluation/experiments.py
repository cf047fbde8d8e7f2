"""The paper's tables as runs: samples, methods, files.

Data flow: name of a table + options -> references -> records -> tables on disk.
Paper: Tables 1 to 4, S5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import with_priors
from geodiff_plugin.evaluation.cells import count_of_pairs, label_of
from geodiff_plugin.evaluation.changes import CHANGES, changes_table, flatness_methods, flatness_table
from geodiff_plugin.evaluation.commands import measure, remarks_on
from geodiff_plugin.evaluation.datasets import DATASETS, SampleRef
from geodiff_plugin.evaluation.detail_tables import regions_table
from geodiff_plugin.evaluation.layout import Table
from geodiff_plugin.evaluation.options import PairsOptions, all_refs, command_line, select
from geodiff_plugin.evaluation.paper_tables import FoundColumn, layout_table
from geodiff_plugin.evaluation.published import LAYOUTS, Column, Layout
from geodiff_plugin.evaluation.report import Page, run_facts, write_page
from geodiff_plugin.evaluation.tables import summary_table

__all__ = ["how_to_obtain", "methods_of", "run_changes", "run_experiment"]

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
        refs = all_refs(options, [dataset])
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
    return replace(layout, columns=tuple(kitti + others) or layout.columns)


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


def run_changes(name: str, options: PairsOptions) -> Page | None:
    """Change one thing of the default at a time: its parts, or its numbers.

    Args:
        name: ``"parts"`` or ``"flatness"``.
        options: as of ``geodiff eval pairs``; ``methods`` are run beside the table's own.

    Returns:
        The page; ``None`` in every process but the main one.

    Raises:
        ValueError, OSError: as ``run_experiment``.
    """
    refs = select(all_refs(options), options)
    own = flatness_methods() if name == "flatness" else tuple(method for _, method in CHANGES[name])
    records = measure(refs, tuple(dict.fromkeys((*own, *options.methods))), options)
    if records is None:
        return None
    facts = run_facts(command_line(options, ("eval", name, "--data", str(options.data)), ()))
    if name == "flatness":
        title, tables = "Flatness", [flatness_table(records)]
    else:
        title, tables = "Parts of the default", [changes_table(records, name), regions_table(records)]
    added = [record for record in records if record["method"] not in own]
    if added:
        labels = {label_of(record) for record in added}
        heading = f"Further methods and priors, {count_of_pairs(len(labels))}"
        tables.insert(1, summary_table(added, labels, heading))
    shown = tuple(table for table in tables if table.rows)
    page = Page(title, facts, shown, tuple(remarks_on(records, options)))
    write_page(page, options.out, name)
    return page


def run_experiment(name: str, options: PairsOptions) -> Page | None:
    """Measure what one table of the paper needs, and write it.

    Args:
        name: key of ``LAYOUTS``.
        options: as of ``geodiff eval pairs``; ``methods`` are run beside the table's own.

    Returns:
        The page; ``None`` in every process but the main one.

    Raises:
        ValueError: nothing that the table needs is there (the message says how to obtain it), bad options.
        OSError: missing or unreadable files without ``skip_broken``.
    """
    layout = LAYOUTS[name]
    if name == "ablation":
        layout = _ablation_layout(layout, options)
    # The paper drew its posed pairs at random, and so does the table where there are enough to draw from.
    drawn = {c.title: c.full_count if name == "table3" else None for c in layout.columns}
    chosen = {column: _find(column, options, drawn[column.title]) for column in layout.columns}
    refs = [ref for _, own in chosen.values() for ref in own]
    absent = _missing([column for column, (_, own) in chosen.items() if not own])
    if not refs:
        bad_value("data", f"a folder with the data of {name}", str(options.data), " ".join(absent))
    names = methods_of(name, options.methods)
    records = measure(refs, names, options)
    if records is None:
        return None
    finished = {label_of(record) for record in records if record["status"] != "broken"}
    found = [
        FoundColumn(column, dataset, frozenset(ref.label for ref in own) & finished)
        for column, (dataset, own) in chosen.items()
    ]
    remarks = remarks_on(records, options) + absent
    if name == "table3":
        remarks.append("Pairs: " + ", ".join(ref.label for ref in refs) + ".")
    facts = run_facts(command_line(options, ("eval", name, "--data", str(options.data)), ()))
    tables = _tables(name, layout, found, records, with_priors(names, options.priors))
    page = Page(layout.title, facts, tuple(tables), tuple(remarks))
    write_page(page, options.out, name)
    return page
