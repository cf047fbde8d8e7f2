"""The paper's tables 1 to 4 as runs, in its layout, with its published numbers beside a full data set.

Paper: Table 1 (tab:depth_comparison), 2 (tab:stereo_comparison), 3 (tab:two_views), 4 (tab:ablation_study).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import find_method, with_priors
from geodiff_plugin.evaluation.changes import CHANGES, changes_table
from geodiff_plugin.evaluation.datasets import DATASETS, SampleRef
from geodiff_plugin.evaluation.experiment import Page
from geodiff_plugin.evaluation.options import PairsOptions, all_refs, select
from geodiff_plugin.evaluation.pairs import pairs_experiment
from geodiff_plugin.evaluation.tables import (
    HEADINGS,
    Table,
    cell,
    count_of_pairs,
    label_of,
    mean_with_interval,
    metric_values,
    regions_table,
    summary_table,
)
from geodiff_plugin.runner import Record


class Column(NamedTuple):
    """One data set of a table, and what stands for it.

    Attributes:
        title: heading as in the paper.
        datasets: names in ``DATASETS`` that can stand for it; the first one that is there is taken.
        full_count: number of pairs that the paper used.
        dataset: the data set that was measured, or ``None``.
        labels: samples that were measured.
    """

    title: str
    datasets: tuple[str, ...]
    full_count: int
    dataset: str | None = None
    labels: frozenset[str] = frozenset()

    @property
    def complete(self) -> bool:
        """Whether this is the set as the paper used it, so that its numbers may stand beside."""
        return self.dataset == self.datasets[0] and len(self.labels) == self.full_count

    @property
    def heading(self) -> str:
        """The paper's name, the set that stands for it where it is another, the number of pairs."""
        if self.dataset is None:
            return f"{self.title} (not found)"
        other = "" if self.dataset == self.datasets[0] else f"{self.dataset}, "
        return f"{self.title} ({other}{count_of_pairs(len(self.labels))})"

    @property
    def obtain(self) -> str:
        """Where the set comes from."""
        return DATASETS[self.datasets[0]].obtain


class PaperRow(NamedTuple):
    """One row of a table.

    Attributes:
        title: as in the paper; a dagger marks its own metric result.
        aligned: whether predictions are aligned with the truth.
        method: a name that ``find_method`` knows, or empty where none is built in.
        word: a method whose name after the colon has this word fills the row, such as ``hf:Intel/dpt-large``
            or ``files:predictions/unidepth``.
        hint: such a method, for the note below the table.
        published: by the column's title, the cells as printed; a dash where the paper has none.
    """

    title: str
    aligned: bool
    method: str = ""
    word: str = ""
    hint: str = ""
    published: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def cells(self, column: str, count: int) -> tuple[str, ...]:
        """Published cells under one column, dashes where there are none."""
        return dict(self.published).get(column, ("-",) * count)


class Layout(NamedTuple):
    """A table as the paper lays it out, with the ``metrics`` of each column.

    Rows of the indices ``rules`` start a group; ``methods`` run by default, beside the rows' own.
    """

    title: str
    columns: tuple[Column, ...]
    rules: tuple[int, ...]
    methods: tuple[str, ...]
    metrics: tuple[str, ...]
    rows: tuple[PaperRow, ...]


def _layout(
    title: str,
    columns: tuple[Column, ...],
    rules: tuple[int, ...],
    methods: tuple[str, ...],
    text: str,
    metrics: tuple[str, ...] = ("abs_rel", "delta1", "rmse"),
) -> Layout:
    """A layout of rows as text: title, whether aligned, the method, and the cells of each column as printed.

    The method is one that is built in, or how one is named for the row (``word=hint``).
    """
    rows = []
    for line in text.strip().splitlines():
        name, kind, method, *cells = (part.strip() for part in line.split("|"))
        word, named, hint = ("", "", "") if method.startswith("paper") else method.partition("=")
        published = tuple((c.title, tuple(of.split())) for c, of in zip(columns, cells, strict=True))
        name, built_in = name.replace("{}", ", Algorithm 1 as printed"), "" if named else method
        rows.append(PaperRow(name, kind == "aligned", built_in, word if named else "", hint, published))
    return Layout(title, columns, rules, methods, metrics, tuple(rows))


_KITTI = Column("KITTI-Stereo", ("kitti2015",), 200)
_BOOSTER = Column("Booster", ("booster",), 228)
_MIDDLEBURY = Column("Middlebury", ("middeval3", "middlebury2014"), 15)
_TANKS = Column("Tanks and Temples", ("robustmvd", "mvsnet"), 116)
_PEERS = ("guided", "no-diffusion", "sweep-sgm", "sgbm")

LAYOUTS: dict[str, Layout] = {
    "table1": _layout(
        "Table 1: monocular depth on KITTI-Stereo, Booster and Middlebury",
        (_KITTI, _BOOSTER, _MIDDLEBURY),
        (3, 6),
        _PEERS,
        """
        MiDaS | aligned | dpt=hf:Intel/dpt-large | 0.63 0.24 11.72 | 0.18 0.71 0.23 | 0.22 0.72 2.09
        Marigold | aligned | prior-aligned | 0.13 0.85 4.81 | 0.04 0.98 0.06 | 0.14 0.83 1.61
        GeoWizard | aligned | geowizard=files:DIR/geowizard | 0.18 0.75 5.7 | 0.04 0.96 0.08 | 0.15 0.81 1.55
        ZoeDepth | metres | zoedepth=hf:Intel/zoedepth-nyu-kitti | 0.74 - 16.26 | 7.37 - 7.72 | 0.60 - 6.04
        UniDepth | metres | unidepth=files:DIR/unidepth | 0.19 0.86 4.18 | 4.55 - 4.91 | 0.61 - 6.03
        DepthPro | metres | depthpro=hf:apple/DepthPro-hf | 0.16 0.81 4.43 | 0.34 0.51 0.67 | 0.54 0.02 5.60
        GeoDiff†{} | metres | paper | 0.07 0.91 3.94 | 0.11 0.81 0.18 | 0.11 0.85 2.31
        GeoDiff{} | aligned | paper | 0.09 0.91 3.72 | 0.04 0.98 0.06 | 0.11 0.87 1.41
        """,
    ),
    "table2": _layout(
        "Table 2: stereo on Booster",
        (_BOOSTER,),
        (2,),
        _PEERS,
        """
        RAFT-Stereo | metres | raft=files:DIR/raft-stereo | 5.4 - 18.89
        IGEV-Stereo | metres | igev=files:DIR/igev-stereo | 0.10 0.94 0.31
        GeoDiff†{} | metres | paper | 0.11 0.81 0.18
        GeoDiff{} | aligned | paper | 0.04 0.98 0.06
        """,
    ),
    "table3": _layout(
        "Table 3: two views with known poses on Tanks and Temples",
        (_TANKS,),
        (2,),
        _PEERS[:-1],
        """
        DUSt3R | metres | dust3r=files:DIR/dust3r | 0.51 0.35 0.56
        GeoDiff†{} | metres | paper | 0.47 0.38 0.62
        DUSt3R | aligned | dust3r=files:DIR/dust3r | 0.07 0.93 0.17
        GeoDiff{} | aligned | paper | 0.08 0.92 0.18
        """,
    ),
    "ablation": _layout(
        "Table 4: ablation on KITTI-Stereo",
        (_KITTI,),
        (),
        ("guided", "scale-shift-only", "reprojection-only", "no-diffusion"),
        """
        Learning scale and shift only | metres | paper:optimize_latents=false | 0.14 0.80
        Our full model{} | metres | paper | 0.07 0.91
        """,
        ("abs_rel", "delta1"),
    ),
}
"""Every table of the paper by the name of its subcommand."""
ABLATED = ("guided", "paper")
"""Keys of ``CHANGES`` whose tables stand below Table 4."""
_ARROWS = {"abs_rel": "↓", "rmse": "↓", "delta1": "↑"}


def _means(
    column: Column, records: Sequence[Record], method: str, alignment: str, metrics: Sequence[str]
) -> list[str]:
    """A cell per metric; a dash unless the method has a number for every pair of the column."""
    cells = []
    for metric in metrics:
        values = metric_values(records, alignment, metric).get(method, {})
        whole = column.labels and column.labels <= values.keys()
        cells.append(cell(mean_with_interval([values[x] for x in column.labels]).value if whole else None))
    return cells


def _filler(row: PaperRow, methods: Sequence[str]) -> str:
    """The method that fills a row of the paper, empty where none ran."""
    if row.method in methods:
        return row.method
    return next((name for name in methods if row.word and row.word in name.lower().partition(":")[2]), "")


def _own_rows(methods: Sequence[str], records: Sequence[Record]) -> list[PaperRow]:
    """Rows for methods that the paper does not have: as they come out where they know metres, and aligned."""
    raw, rows = metric_values(records, "raw", "abs_rel"), []
    for name in methods:
        title = find_method(name).title
        rows += [PaperRow(f"{title}†", False, name)] if raw.get(name) else []
        rows.append(PaperRow(title, True, name))
    return rows


def layout_table(
    layout: Layout, columns: Sequence[Column], records: Sequence[Record], methods: Sequence[str]
) -> Table:
    """A table in the paper's layout, with rows of our own below the paper's.

    Args:
        layout: of ``LAYOUTS``.
        columns: its columns, with what was measured.
        records: of the run.
        methods: names of the methods that ran.

    Returns:
        One column per data set and metric; beside each complete data set the paper's cells, as printed.
    """
    count = len(layout.metrics)
    groups = [("", 2)]
    for column in columns:
        groups.append((column.heading, count))
        groups += [(f"{column.title}, as published", count)] if column.complete else []
    header = [f"{HEADINGS[metric]} {_ARROWS[metric]}" for metric in layout.metrics] * (len(groups) - 1)
    filled = {row: _filler(row, methods) for row in layout.rows}
    own = _own_rows([name for name in methods if name not in filled.values()], records)
    rows = []
    for row in (*layout.rows, *own):
        cells = [row.title, "✓" if row.aligned else "✗"]
        for column in columns:
            alignment = "aligned" if row.aligned else "raw"
            cells += _means(column, records, filled.get(row, row.method), alignment, layout.metrics)
            cells += row.cells(column.title, count) if column.complete else ()
        rows.append(tuple(cells))
    note = "Capped at 80 m for KITTI and 10 m for Booster. † in metres as they come out."
    if empty := [row for row in layout.rows if not filled[row] and row.hint]:
        recipes = ", ".join(dict.fromkeys(f"{row.title} (--methods {row.hint})" for row in empty))
        note += f" Not run here: {recipes}."
    rules = (*layout.rules, len(layout.rows)) if own else layout.rules
    return Table(layout.title, ("Method", "GT-aligned", *header), tuple(rows), note, tuple(groups), rules)


def methods_of(name: str, added: Sequence[str]) -> tuple[str, ...]:
    """Every method that a table runs: the paper's rows, our own beside them, and what the user adds."""
    layout = LAYOUTS[name]
    names = [*(row.method for row in layout.rows if row.method), *layout.methods, *added]
    if name == "ablation":
        names += [method for preset in ABLATED for _, method in CHANGES[preset]]
    return tuple(dict.fromkeys(names))


def _find(column: Column, options: PairsOptions, draw: bool) -> tuple[Column, list[SampleRef]]:
    """The column with the first data set that can stand for it, and the samples to measure."""
    wanted = options.datasets or column.datasets
    for dataset in (name for name in column.datasets if name in wanted):
        refs = all_refs(options, (dataset,))
        # One column may have what --scenes names while another has not.
        refs = [ref for ref in refs if not options.scenes or any(s in ref.label for s in options.scenes)]
        if refs:
            drawn = column.full_count if draw and column.full_count <= len(refs) else None
            chosen = select(refs, replace(options, sample=options.sample or drawn))
            return column._replace(dataset=dataset), chosen
    return column, []


def _ablation_columns(options: PairsOptions) -> tuple[Column, ...]:
    """KITTI where it is there, and everything else that is."""
    there = {ref.dataset for ref in all_refs(options)}
    kitti = [column for column in LAYOUTS["ablation"].columns if there & set(column.datasets)]
    named = {dataset for column in kitti for dataset in column.datasets}
    others = [Column(name, (name,), 0) for name in DATASETS if name in there - named]
    return (*kitti, *others) or LAYOUTS["ablation"].columns


def run_paper_table(name: str, options: PairsOptions) -> Page | None:
    """Measure what one table of the paper needs, and write it; ``options.methods`` are run beside its own.

    Raises:
        ValueError: nothing that the table needs is there (the message says how to obtain it), bad options.
        OSError: missing or unreadable files without ``skip_broken``.
    """
    layout, posed = LAYOUTS[name], name == "table3"
    if options.data is None and name != "ablation":
        obtain = " ".join(f"{column.title}: {column.obtain}" for column in layout.columns)
        bad_value("--data", "given", "nothing", obtain)
    if posed:
        options = replace(options, pairs="all")
    columns = _ablation_columns(options) if name == "ablation" else layout.columns
    # The paper drew its posed pairs at random, and so does the table where there are enough to draw from.
    chosen = [_find(column, options, draw=posed) for column in columns]
    refs = [ref for _, own in chosen for ref in own]
    more = [f"{c.title} was not found. To obtain it: {c.obtain}" for c, own in chosen if not own]
    if not refs:
        bad_value("--data", f"a folder with the data of {name}", str(options.data), " ".join(more))
    if posed:
        more.append("Pairs: " + ", ".join(ref.label for ref in refs) + ".")
    names = methods_of(name, options.methods)

    def tables(records: list[Record]) -> list[Table]:
        finished = {label_of(record) for record in records if record["status"] != "broken"}
        measured = [c._replace(labels=frozenset(ref.label for ref in own) & finished) for c, own in chosen]
        shown = [layout_table(layout, measured, records, with_priors(names, options.prior[1:]))]
        shown += [changes_table(records, preset) for preset in (ABLATED if name == "ablation" else ())]
        for column in measured:
            own = [record for record in records if label_of(record) in column.labels]
            title = f"All metrics, {column.title}, {count_of_pairs(len(column.labels))}"
            shown.append(summary_table(own, set(column.labels), title))
        return [*shown, regions_table(records)]

    experiment = pairs_experiment(name, layout.title, refs, names, options, tables, more)
    return experiment.run(name, options)
