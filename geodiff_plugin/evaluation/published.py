"""The paper's published numbers, and the rows and columns of its tables.

Paper: Table 1 (tab:depth_comparison), 2 (tab:stereo_comparison), 3 (tab:two_views), 4 (tab:ablation_study).
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["LAYOUTS", "Column", "Layout", "PaperRow"]

_THREE = ("abs_rel", "delta1", "rmse")


@dataclass(frozen=True)
class Column:
    """One data set of a table.

    Attributes:
        title: heading as in the paper.
        datasets: names in ``DATASETS`` that can stand for it; the first one that is there is taken.
        full_count: number of pairs that the paper used.
    """

    title: str
    datasets: tuple[str, ...]
    full_count: int


@dataclass(frozen=True)
class PaperRow:
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


@dataclass(frozen=True)
class Layout:
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


def _three_sets(kitti: str, booster: str, middlebury: str) -> tuple[tuple[str, tuple[str, ...]], ...]:
    cells = (tuple(text.split()) for text in (kitti, booster, middlebury))
    return tuple(zip((c.title for c in (_KITTI, _BOOSTER, _MIDDLEBURY)), cells, strict=True))


def _one_set(column: Column, text: str) -> tuple[tuple[str, tuple[str, ...]], ...]:
    return ((column.title, tuple(text.split())),)


_TABLE1 = (
    PaperRow(
        "MiDaS",
        True,
        word="dpt",
        hint="hf:Intel/dpt-large",
        published=_three_sets("0.63 0.24 11.72", "0.18 0.71 0.23", "0.22 0.72 2.09"),
    ),
    PaperRow(
        "Marigold",
        True,
        method="prior-aligned",
        published=_three_sets("0.13 0.85 4.81", "0.04 0.98 0.06", "0.14 0.83 1.61"),
    ),
    PaperRow(
        "GeoWizard",
        True,
        word="geowizard",
        hint="files:DIR/geowizard",
        published=_three_sets("0.18 0.75 5.7", "0.04 0.96 0.08", "0.15 0.81 1.55"),
    ),
    PaperRow(
        "ZoeDepth",
        False,
        word="zoedepth",
        hint="hf:Intel/zoedepth-nyu-kitti",
        published=_three_sets("0.74 - 16.26", "7.37 - 7.72", "0.60 - 6.04"),
    ),
    PaperRow(
        "UniDepth",
        False,
        word="unidepth",
        hint="files:DIR/unidepth",
        published=_three_sets("0.19 0.86 4.18", "4.55 - 4.91", "0.61 - 6.03"),
    ),
    PaperRow(
        "DepthPro",
        False,
        word="depthpro",
        hint="hf:apple/DepthPro-hf",
        published=_three_sets("0.16 0.81 4.43", "0.34 0.51 0.67", "0.54 0.02 5.60"),
    ),
    PaperRow(
        "GeoDiff†, Algorithm 1 as printed",
        False,
        method="paper",
        published=_three_sets("0.07 0.91 3.94", "0.11 0.81 0.18", "0.11 0.85 2.31"),
    ),
    PaperRow(
        "GeoDiff, Algorithm 1 as printed",
        True,
        method="paper",
        published=_three_sets("0.09 0.91 3.72", "0.04 0.98 0.06", "0.11 0.87 1.41"),
    ),
)
_TABLE2 = (
    PaperRow(
        "RAFT-Stereo",
        False,
        word="raft",
        hint="files:DIR/raft-stereo",
        published=_one_set(_BOOSTER, "5.4 - 18.89"),
    ),
    PaperRow(
        "IGEV-Stereo",
        False,
        word="igev",
        hint="files:DIR/igev-stereo",
        published=_one_set(_BOOSTER, "0.10 0.94 0.31"),
    ),
    PaperRow(
        "GeoDiff†, Algorithm 1 as printed",
        False,
        method="paper",
        published=_one_set(_BOOSTER, "0.11 0.81 0.18"),
    ),
    PaperRow(
        "GeoDiff, Algorithm 1 as printed",
        True,
        method="paper",
        published=_one_set(_BOOSTER, "0.04 0.98 0.06"),
    ),
)
_DUST3R = {"word": "dust3r", "hint": "files:DIR/dust3r"}
_TABLE3 = (
    PaperRow("DUSt3R", False, **_DUST3R, published=_one_set(_TANKS, "0.51 0.35 0.56")),
    PaperRow(
        "GeoDiff†, Algorithm 1 as printed",
        False,
        method="paper",
        published=_one_set(_TANKS, "0.47 0.38 0.62"),
    ),
    PaperRow("DUSt3R", True, **_DUST3R, published=_one_set(_TANKS, "0.07 0.93 0.17")),
    PaperRow(
        "GeoDiff, Algorithm 1 as printed", True, method="paper", published=_one_set(_TANKS, "0.08 0.92 0.18")
    ),
)
_TABLE4 = (
    PaperRow(
        "Learning scale and shift only",
        False,
        method="paper:optimize_latents=false",
        published=_one_set(_KITTI, "0.14 0.80"),
    ),
    PaperRow(
        "Our full model, Algorithm 1 as printed",
        False,
        method="paper",
        published=_one_set(_KITTI, "0.07 0.91"),
    ),
)

LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (
        Layout(
            "table1",
            "Table 1: monocular depth on KITTI-Stereo, Booster and Middlebury",
            (_KITTI, _BOOSTER, _MIDDLEBURY),
            _THREE,
            _TABLE1,
            (3, 6),
            ("guided", "no-diffusion", "sweep-sgm", "sgbm"),
        ),
        Layout(
            "table2",
            "Table 2: stereo on Booster",
            (_BOOSTER,),
            _THREE,
            _TABLE2,
            (2,),
            ("guided", "no-diffusion", "sweep-sgm", "sgbm"),
        ),
        Layout(
            "table3",
            "Table 3: two views with known poses on Tanks and Temples",
            (_TANKS,),
            _THREE,
            _TABLE3,
            (2,),
            ("guided", "no-diffusion", "sweep-sgm"),
        ),
        Layout(
            "ablation",
            "Table 4: ablation on KITTI-Stereo",
            (_KITTI,),
            ("abs_rel", "delta1"),
            _TABLE4,
            (),
            ("guided", "scale-shift-only", "reprojection-only", "no-diffusion"),
        ),
    )
}
"""Every table of the paper by the name of its subcommand."""
