"""The paper's published numbers, and the rows and columns of its tables.

Paper: Table 1 (tab:depth_comparison), 2 (tab:stereo_comparison), 3 (tab:two_views), 4 (tab:ablation_study).
"""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["LAYOUTS", "Column", "Layout", "PaperRow"]


class Column(NamedTuple):
    """One data set of a table.

    Attributes:
        title: heading as in the paper.
        datasets: names in ``DATASETS`` that can stand for it; the first one that is there is taken.
        full_count: number of pairs that the paper used.
    """

    title: str
    datasets: tuple[str, ...]
    full_count: int


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
    """A table as the paper lays it out.

    Attributes:
        name: subcommand of ``geodiff eval``.
        title: heading.
        columns: data sets.
        metrics: numbers per data set, keys of ``evaluate_depth``.
        rows: in the paper's order.
        rules: indices of rows that start a new group.
        methods: what runs by default, beside the rows' own methods.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    metrics: tuple[str, ...]
    rows: tuple[PaperRow, ...]
    rules: tuple[int, ...]
    methods: tuple[str, ...]


_KITTI = Column("KITTI-Stereo", ("kitti2015",), 200)
_BOOSTER = Column("Booster", ("booster",), 228)
_MIDDLEBURY = Column("Middlebury", ("middeval3", "middlebury2014"), 15)
_TANKS = Column("Tanks and Temples", ("robustmvd", "mvsnet"), 116)


#: Tables 1 to 4: title, whether aligned, the method that is built in or how one is named for the row
#: (``word=hint``), and the cells of each column as printed.
_ROWS: dict[str, str] = {
    "table1": """
        MiDaS | aligned | dpt=hf:Intel/dpt-large | 0.63 0.24 11.72 | 0.18 0.71 0.23 | 0.22 0.72 2.09
        Marigold | aligned | prior-aligned | 0.13 0.85 4.81 | 0.04 0.98 0.06 | 0.14 0.83 1.61
        GeoWizard | aligned | geowizard=files:DIR/geowizard | 0.18 0.75 5.7 | 0.04 0.96 0.08 | 0.15 0.81 1.55
        ZoeDepth | metres | zoedepth=hf:Intel/zoedepth-nyu-kitti | 0.74 - 16.26 | 7.37 - 7.72 | 0.60 - 6.04
        UniDepth | metres | unidepth=files:DIR/unidepth | 0.19 0.86 4.18 | 4.55 - 4.91 | 0.61 - 6.03
        DepthPro | metres | depthpro=hf:apple/DepthPro-hf | 0.16 0.81 4.43 | 0.34 0.51 0.67 | 0.54 0.02 5.60
        GeoDiff†{} | metres | paper | 0.07 0.91 3.94 | 0.11 0.81 0.18 | 0.11 0.85 2.31
        GeoDiff{} | aligned | paper | 0.09 0.91 3.72 | 0.04 0.98 0.06 | 0.11 0.87 1.41
    """,
    "table2": """
        RAFT-Stereo | metres | raft=files:DIR/raft-stereo | 5.4 - 18.89
        IGEV-Stereo | metres | igev=files:DIR/igev-stereo | 0.10 0.94 0.31
        GeoDiff†{} | metres | paper | 0.11 0.81 0.18
        GeoDiff{} | aligned | paper | 0.04 0.98 0.06
    """,
    "table3": """
        DUSt3R | metres | dust3r=files:DIR/dust3r | 0.51 0.35 0.56
        GeoDiff†{} | metres | paper | 0.47 0.38 0.62
        DUSt3R | aligned | dust3r=files:DIR/dust3r | 0.07 0.93 0.17
        GeoDiff{} | aligned | paper | 0.08 0.92 0.18
    """,
    "ablation": """
        Learning scale and shift only | metres | paper:optimize_latents=false | 0.14 0.80
        Our full model{} | metres | paper | 0.07 0.91
    """,
}


def _rows(name: str, columns: tuple[Column, ...]) -> tuple[PaperRow, ...]:
    """The rows of one table."""
    rows = []
    for line in _ROWS[name].strip().splitlines():
        title, kind, method, *cells = (part.strip() for part in line.split("|"))
        title = title.replace("{}", ", Algorithm 1 as printed")
        word, named_for, hint = (
            method.partition("=") if "=" in method and not method.startswith("paper:") else ("", "", "")
        )
        published = tuple((c.title, tuple(text.split())) for c, text in zip(columns, cells, strict=True))
        built_in = "" if named_for else method
        rows.append(PaperRow(title, kind == "aligned", built_in, word, hint, published))
    return tuple(rows)


def _layout(
    name: str,
    title: str,
    columns: tuple[Column, ...],
    rules: tuple[int, ...],
    methods: tuple[str, ...],
    metrics: tuple[str, ...] = ("abs_rel", "delta1", "rmse"),
) -> Layout:
    return Layout(name, title, columns, metrics, _rows(name, columns), rules, methods)


_PEERS = ("guided", "no-diffusion", "sweep-sgm", "sgbm")
LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (
        _layout(
            "table1",
            "Table 1: monocular depth on KITTI-Stereo, Booster and Middlebury",
            (_KITTI, _BOOSTER, _MIDDLEBURY),
            (3, 6),
            _PEERS,
        ),
        _layout("table2", "Table 2: stereo on Booster", (_BOOSTER,), (2,), _PEERS),
        _layout(
            "table3",
            "Table 3: two views with known poses on Tanks and Temples",
            (_TANKS,),
            (2,),
            _PEERS[:-1],
        ),
        _layout(
            "ablation",
            "Table 4: ablation on KITTI-Stereo",
            (_KITTI,),
            (),
            ("guided", "scale-shift-only", "reprojection-only", "no-diffusion"),
            ("abs_rel", "delta1"),
        ),
    )
}
"""Every table of the paper by the name of its subcommand."""
