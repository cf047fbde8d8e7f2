"""Runs the paper's tables 1 to 4 in its layout, with published numbers next to complete data sets."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.evaluation import tables
from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.datasets import DATASETS, SampleRef, all_refs, select
from geodiff_plugin.evaluation.experiment import Page
from geodiff_plugin.evaluation.options import PairsOptions
from geodiff_plugin.evaluation.pairs import CHANGES, Comparison, changes_table, compare
from geodiff_plugin.evaluation.tables import Table, count_of_pairs
from geodiff_plugin.jobs import Record


class Column(NamedTuple):
    """A data set of a table, with ``full_count`` pairs in the paper: the first available of ``datasets``."""

    title: str
    datasets: tuple[str, ...]
    full_count: int
    dataset: str | None = None
    labels: frozenset[str] = frozenset()

    @property
    def complete(self) -> bool:
        """Whether this is the set used by the paper, so that its numbers are comparable."""
        return self.dataset == self.datasets[0] and len(self.labels) == self.full_count

    @property
    def heading(self) -> str:
        """Return the paper's name, the set used instead if different, and the number of pairs."""
        if self.dataset is None:
            return f"{self.title} (not found)"
        other = "" if self.dataset == self.datasets[0] else f"{self.dataset}, "
        return f"{self.title} ({other}{count_of_pairs(len(self.labels))})"


def _is_outside(method: str) -> bool:
    """Whether a row's method is named by the user."""
    return method.startswith(("hf:", "files:"))


def _filler(method: str, methods: Sequence[str]) -> str:
    """Return the method that fills the row of ``method``, empty if none ran.

    files:DIR/unidepth matches any method with that word after its colon.
    """
    word = method.rpartition("/")[2].partition("-")[0].lower()
    ran = (n for n in methods if n == method or _is_outside(method) and word in n.lower().partition(":")[2])
    return next(ran, "")


class Row(NamedTuple):
    """A row of a table; ``published`` are the paper's cells by column title."""

    title: str
    aligned: bool
    method: str
    published: Mapping[str, Sequence[str]]


class Layout(NamedTuple):
    """A table in the paper's layout; ``methods`` run by default in addition to the rows' own."""

    title: str
    columns: tuple[Column, ...]
    methods: tuple[str, ...]
    metrics: tuple[str, ...]
    rows: tuple[Row, ...]


#: Metrics and their headings; Table 4 has the first two.
METRICS = {"abs_rel": "AbsRel ↓", "delta1": "δ1 ↑", "rmse": "RMSE m ↓"}


def _layout(text: str, columns: tuple[Column, ...], methods: tuple[str, ...]) -> Layout:
    """Parse a layout: the title, then rows of title, whether aligned, method, and each column's cells."""
    title, *lines = (line.strip() for line in text.strip().splitlines())
    rows = []
    for line in lines:
        name, kind, method, *cells = (part.strip() for part in line.split("|"))
        published = {c.title: of.split() for c, of in zip(columns, cells, strict=True)}
        rows.append(Row(name, kind == "aligned", method, published))
    return Layout(title, columns, methods, tuple(METRICS)[: len(cells[0].split())], tuple(rows))


_KITTI = Column("KITTI-Stereo", ("kitti2015",), 200)
_BOOSTER = Column("Booster", ("booster",), 228)
_MIDDLEBURY = Column("Middlebury", ("middeval3", "middlebury2014"), 15)
_TANKS = Column("Tanks and Temples", ("robustmvd", "mvsnet"), 116)
_PEERS = ("guided", "no-diffusion", "sweep-sgm", "sgbm")

_TABLE1 = """
    Table 1: monocular depth on KITTI-Stereo, Booster and Middlebury
    MiDaS | aligned | hf:Intel/dpt-large | 0.63 0.24 11.72 | 0.18 0.71 0.23 | 0.22 0.72 2.09
    Marigold | aligned | prior-aligned | 0.13 0.85 4.81 | 0.04 0.98 0.06 | 0.14 0.83 1.61
    GeoWizard | aligned | files:DIR/geowizard | 0.18 0.75 5.7 | 0.04 0.96 0.08 | 0.15 0.81 1.55
    ZoeDepth | metres | hf:Intel/zoedepth-nyu-kitti | 0.74 - 16.26 | 7.37 - 7.72 | 0.60 - 6.04
    UniDepth | metres | files:DIR/unidepth | 0.19 0.86 4.18 | 4.55 - 4.91 | 0.61 - 6.03
    DepthPro | metres | hf:apple/DepthPro-hf | 0.16 0.81 4.43 | 0.34 0.51 0.67 | 0.54 0.02 5.60
    GeoDiff†, Algorithm 1 as printed | metres | paper | 0.07 0.91 3.94 | 0.11 0.81 0.18 | 0.11 0.85 2.31
    GeoDiff, Algorithm 1 as printed | aligned | paper | 0.09 0.91 3.72 | 0.04 0.98 0.06 | 0.11 0.87 1.41
"""
_TABLE2 = """
    Table 2: stereo on Booster
    RAFT-Stereo | metres | files:DIR/raft-stereo | 5.4 - 18.89
    IGEV-Stereo | metres | files:DIR/igev-stereo | 0.10 0.94 0.31
    GeoDiff†, Algorithm 1 as printed | metres | paper | 0.11 0.81 0.18
    GeoDiff, Algorithm 1 as printed | aligned | paper | 0.04 0.98 0.06
"""
_TABLE3 = """
    Table 3: two views with known poses on Tanks and Temples
    DUSt3R | metres | files:DIR/dust3r | 0.51 0.35 0.56
    GeoDiff†, Algorithm 1 as printed | metres | paper | 0.47 0.38 0.62
    DUSt3R | aligned | files:DIR/dust3r | 0.07 0.93 0.17
    GeoDiff, Algorithm 1 as printed | aligned | paper | 0.08 0.92 0.18
"""
_TABLE4 = """
    Table 4: ablation on KITTI-Stereo
    Learning scale and shift only | metres | paper:optimize_latents=false | 0.14 0.80
    Our full model, Algorithm 1 as printed | metres | paper | 0.07 0.91
"""

_PARTS = ("guided", "scale-shift-only", "reprojection-only", "no-diffusion")

LAYOUTS: dict[str, Layout] = {
    "table1": _layout(_TABLE1, (_KITTI, _BOOSTER, _MIDDLEBURY), _PEERS),
    "table2": _layout(_TABLE2, (_BOOSTER,), _PEERS),
    "table3": _layout(_TABLE3, (_TANKS,), _PEERS[:-1]),
    "ablation": _layout(_TABLE4, (_KITTI,), _PARTS),
}
"""All tables of the paper by subcommand."""
ABLATED = ("guided", "paper")
"""Keys of ``CHANGES`` whose tables follow Table 4."""


def _filled(layout: Layout, methods: Sequence[str], in_metres: Collection[str]) -> list[Row]:
    """Return the layout's rows with their methods, then rows of other methods, metric ones first."""
    rows = [row._replace(method=_filler(row.method, methods)) for row in layout.rows]
    taken = {row.method for row in rows}
    for name in (name for name in methods if name not in taken):
        title = find_method(name).title
        rows += [Row(f"{title}†", False, name, {})] if name in in_metres else []
        rows.append(Row(title, True, name, {}))
    return rows


def layout_table(
    layout: Layout, columns: Sequence[Column], records: Sequence[Record], methods: Sequence[str]
) -> Table:
    """Return rows of other methods below the paper's; published cells are next to complete data sets."""
    count = len(layout.metrics)
    values = dict[bool, list[tables.Values]]()
    for kind in ("raw", "aligned"):
        values[kind == "aligned"] = [tables.metric_values(records, kind, metric) for metric in layout.metrics]
    groups = [("", 2)]
    for column in columns:
        groups.append((column.heading, count))
        groups += [(f"{column.title}, as published", count)] if column.complete else []
    in_metres = [name for name in methods if values[False][0].get(name)]
    rows = []
    for title, aligned, method, published in _filled(layout, methods, in_metres):
        cells = [title, "✓" if aligned else "✗"]
        for column in columns:
            of_method = (metric.get(method, {}) for metric in values[aligned])
            cells += [tables.whole_mean([values.get(x) for x in column.labels]) for values in of_method]
            cells += published.get(column.title, ["-"] * count) if column.complete else []
        rows.append(tuple(cells))
    note = "Capped at 80 m for KITTI and 10 m for Booster. † in metres without alignment."
    empty = [
        f"{row.title} (--methods {row.method})"
        for row in layout.rows
        if _is_outside(row.method) and not _filler(row.method, methods)
    ]
    note += f" Not run here: {', '.join(dict.fromkeys(empty))}." if empty else ""
    header = ("Method", "GT-aligned", *[METRICS[metric] for metric in layout.metrics] * (len(groups) - 1))
    return Table(layout.title, header, tuple(rows), note, tuple(groups))


def methods_of(name: str, added: Sequence[str]) -> tuple[str, ...]:
    """Return all methods of a table: the paper's rows, additional ones, and the user's."""
    layout = LAYOUTS[name]
    changed = ABLATED if name == "ablation" else ()
    printed = (row.method for row in layout.rows if not _is_outside(row.method))
    names = [*printed, *layout.methods, *added]
    return tuple(dict.fromkeys([*names, *(method for preset in changed for _, method in CHANGES[preset])]))


def _find(column: Column, options: PairsOptions, draw: bool) -> tuple[Column, list[SampleRef]]:
    """Return the column with its first available data set, and the samples to measure."""
    wanted = options.datasets or column.datasets
    for dataset in (name for name in column.datasets if name in wanted):
        refs = all_refs(options, (dataset,))
        # --scenes may match samples of one column only
        refs = [ref for ref in refs if not options.scenes or any(s in ref.label for s in options.scenes)]
        if refs:
            drawn = column.full_count if draw and column.full_count <= len(refs) else None
            chosen = select(replace(options, sample=options.sample or drawn), refs)
            return column._replace(dataset=dataset), chosen
    return column, []


def _ablation_columns(options: PairsOptions) -> tuple[Column, ...]:
    """Return KITTI if available, and all other data sets found."""
    available = {ref.dataset for ref in all_refs(options)}
    kitti = (_KITTI,) if available & set(_KITTI.datasets) else ()
    others = (Column(name, (name,), 0) for name in DATASETS if name in available - set(_KITTI.datasets))
    return (*kitti, *others) or (_KITTI,)


def run_paper_table(name: str, options: PairsOptions) -> Page | None:
    """Measure one table of the paper and write it, with additional ``options.methods``."""
    layout = LAYOUTS[name]
    posed = name == "table3"
    ablation = name == "ablation"
    if options.data is None and not ablation:
        obtain = " ".join(f"{c.title}: {DATASETS[c.datasets[0]].obtain}" for c in layout.columns)
        bad_value("--data", "set", "nothing", obtain)
    if posed:
        options = replace(options, pairs="all")
    columns = _ablation_columns(options) if ablation else layout.columns
    # The paper drew its posed pairs at random; so does this table if there are enough.
    chosen = [_find(column, options, draw=posed) for column in columns]
    refs = [ref for _, members in chosen for ref in members]
    missing = ((c.title, DATASETS[c.datasets[0]].obtain) for c, members in chosen if not members)
    more = [f"{title} was not found. To obtain it: {obtain}" for title, obtain in missing]
    if not refs:
        bad_value("--data", f"a folder with the data of {name}", str(options.data), " ".join(more))
    if posed:
        more.append("Pairs: " + ", ".join(ref.label for ref in refs) + ".")
    names = methods_of(name, options.methods)

    def page_tables(records: list[Record]) -> list[Table]:
        finished = frozenset(tables.label_of(r) for r in records if r["status"] != "broken")
        measured = [c._replace(labels=finished & {r.label for r in refs}) for c, refs in chosen]
        shown = [layout_table(layout, measured, records, names)]
        shown += [changes_table(records, preset) for preset in (ABLATED if ablation else ())]
        for column in measured:
            title = f"All metrics, {column.title}, {count_of_pairs(len(column.labels))}"
            shown.append(tables.summary_table(records, column.labels, title))
        return [*shown, tables.details_table(records, tables.REGIONS)]

    return compare(name, options, Comparison(layout.title, refs, names, page_tables, more))
