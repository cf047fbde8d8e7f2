"""Implements ``geodiff eval poses``: the effect of refining or estimating inaccurate poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.evaluation import experiment, tables
from geodiff_plugin.evaluation.datasets import SampleRef, find_pairs, load, some_pairs
from geodiff_plugin.evaluation.datasets.sample import Numbers, changed_ref, two_numbers
from geodiff_plugin.evaluation.experiment import Experiment, Page, run_experiment
from geodiff_plugin.evaluation.options import PosesOptions
from geodiff_plugin.evaluation.tables import CellOf, Table, count_of_pairs, headline, label_of
from geodiff_plugin.jobs import Item, Record

#: Relative error above which a result counts as wrong by a factor and should have a warning.
BY_A_FACTOR = 0.25


class _Column(NamedTuple):
    """Pairs, and the value of the parameter ``pose`` in their calls."""

    refs: Sequence[SampleRef]
    pose: str


class _Comparison(NamedTuple):
    """One table: the same pairs in every column, in the same order, with different poses."""

    kind: str
    what: str
    columns: Mapping[str, _Column]
    note: str = ""
    views: int = 2

    @property
    def title(self) -> str:
        count = len(next(iter(self.columns.values())).refs)
        return f"AbsRel of {count_of_pairs(count, self.kind)}, {self.what}"


def poses_table(title: str, columns: Mapping[str, Sequence[Record]], note: str) -> Table:
    """Return AbsRel of the same pairs with different poses, and how often warnings were missing."""

    def mean(values: list[float | None], digits: int) -> str:
        count = len(values) - values.count(None)
        return tables.mean_cell(values, digits) + (f" of {count}" if 0 < count < len(values) else "")

    def silently_off(record: Record) -> bool:
        off = (headline(record) or 0.0) > BY_A_FACTOR
        findings = record["notes"]["method"].get("findings", ())
        return off and all(finding["severity"] == "assumption" for finding in findings)

    # Changed samples, in the same order, have different names.
    names = [{"dataset": r["dataset"], "sample": r["sample"]} for r in next(iter(columns.values()))]
    shown = [[r | like for r, like in zip(records, names, strict=True)] for records in columns.values()]
    table = tables.per_pair_table(title, zip(columns, shown, strict=True), headline, 3, note, mean)
    missing = (str(sum(headline(record) is None for record in records)) for records in shown)
    unwarned = (str(sum(map(silently_off, records))) for records in shown)
    more = ("without a result", *missing), (f"off by more than {BY_A_FACTOR:g}, no warning", *unwarned)
    return replace(table, rows=(*table.rows, *more))


def _residual(name: str, group: Sequence[Record]) -> str:
    """Format one number per right view, a dash if there are none."""
    return " / ".join(f"{px:.2f}" for px in tables.value_at(group[0], f"notes.method.{name}") or []) or "-"


_RESIDUALS: dict[str, CellOf] = {
    "pair": lambda group: label_of(group[0]),
    "refined, as given": partial(_residual, "residual_px_given"),
    "refined, as used": partial(_residual, "residual_px"),
}
RESIDUAL_NOTE = "Median distance of matches from epipolar lines in pixels; one number per right view."


def _of_real(real: Sequence[SampleRef], drift: Numbers) -> list[_Comparison]:
    """Return comparisons for two views, three views if available, and drifted rectified pairs."""
    ways = {"refined": "refine", "given": "given", "estimated": "estimated"}
    samples = [(ref, load(ref)) for ref in real]
    several = [ref for ref, sample in samples if sample.extra_views]
    rectified = [ref for ref, sample in samples if sample.rectified and any(drift)]
    drifted = [changed_ref(ref, "drifted", drift) for ref in rectified]
    of_drifted = {"true, given": _Column(rectified, "given"), "drifted, given": _Column(drifted, "given")}
    of_drifted |= {"drifted, refined": _Column(drifted, "refine")}
    withheld = "'estimated' is given the length of the first baseline, and no poses."
    turned = (
        f"The right camera is rotated by {drift[0]:g} degrees and its image is shifted by {drift[1]:g} px"
    )
    return [
        _Comparison("real ", "two views", {name: _Column(real, way) for name, way in ways.items()}, withheld),
        _Comparison(
            "real ", "three views", {name: _Column(several, way) for name, way in ways.items()}, views=3
        ),
        _Comparison("rectified ", "drifted rig", of_drifted, f"{turned} up or down."),
    ]


def _of_exact(exact: Sequence[SampleRef], change: Numbers) -> _Comparison:
    """Return the comparison for pairs with exact poses, perturbed."""
    perturbed = [changed_ref(ref, "perturbed", change) for ref in exact]
    columns = {"true, given": _Column(exact, "given"), "perturbed, given": _Column(perturbed, "given")}
    columns |= {"perturbed, refined": _Column(perturbed, "refine"), "estimated": _Column(exact, "estimated")}
    moved = f"Rotated by up to {change[0]:g} degrees and translated by up to {100 * change[1]:g} %"
    return _Comparison("", "poses perturbed", columns, f"{moved} of the baseline.")


def _cells(comparison: _Comparison, options: PosesOptions) -> list[Item]:
    settings = replace(options.settings, views=comparison.views)
    cells = list[Item]()
    for heading, column in comparison.columns.items():
        of_column = {"table": comparison.title, "column": heading}
        methods = (f"guided:pose={column.pose}",)
        for cell in experiment.method_cells(column.refs, methods, settings, options.out):
            cells.append(replace(cell, head={**cell.head, **of_column}))
    return cells


def _pairs_below(folder: Path | None) -> list[SampleRef]:
    return [] if folder is None else some_pairs(find_pairs(folder), folder)


def run_poses(name: str, options: PosesOptions) -> Page | None:
    """Measure two views, three views if available, drifted rectified pairs, and perturbed exact ones."""
    change, drift = two_numbers(options.perturb, "--perturb"), two_numbers(options.drift, "--drift")
    if options.data is None and options.exact is None:
        bad_value("--data", "set, or --exact", "neither")
    real = _pairs_below(options.data)[: options.limit]
    exact = _pairs_below(options.exact)
    comparisons = [*_of_real(real, drift), _of_exact(exact, change)]
    notes = {comparison.title: comparison.note for comparison in comparisons}

    def page_tables(records: list[Record]) -> list[Table]:
        """Return one table per comparison, and one of the residuals for real pairs."""
        shown = []
        for title, group in tables.grouped(records, "table").items():
            columns = tables.grouped(group, "column")
            shown.append(poses_table(title, columns, notes[title]))
            if title.endswith("two views"):
                shown.append(
                    tables.table_of_groups(
                        "Residuals", columns["refined"], ("key",), _RESIDUALS, RESIDUAL_NOTE
                    )
                )
        return shown

    cells = [cell for comparison in comparisons for cell in _cells(comparison, options)]
    text = (
        f"Prior {options.prior}, seed {options.seed}. All pixels with ground truth; metres without alignment."
    )
    by_pose = Experiment("Results by pose", cells, page_tables, lambda _: [text], experiment.RECORDS_NAME)
    return run_experiment(name, options, by_pose)
