"""Tables of errors by region and material, in disparity, and of the calibration of uncertainty.

Data flow: records -> ``Table``.
Paper: S5.2 (transparent and mirroring surfaces) as a number; in disparity as stereo benchmarks have it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.cells import by_method, cell, count_of_pairs, interval_cell
from geodiff_plugin.evaluation.layout import Table
from geodiff_plugin.evaluation.statistics import mean_with_interval
from geodiff_plugin.runtime.confidence import RIGHT_WITHIN

__all__ = ["confidence_table", "disparity_table", "regions_table", "uncertainty_table"]

_REGIONS = {
    "visible": "visible",
    "occluded": "occluded",
    "out_of_view": "out of view",
    "matched": "matched",
    "unmatched": "unmatched",
    "tom": "ToM",
    "not_tom": "other material",
}
_DISPARITY = {"epe": "EPE px", "bad1": "bad-1", "bad2": "bad-2", "bad3": "bad-3", "d1": "D1"}

Values = dict[str, dict[str, float]]


def _columns_table(
    records: Sequence[dict[str, Any]],
    columns: dict[str, str],
    value_of: Callable[[dict[str, Any], str], float | None],
    title: str,
    note: str,
) -> Table:
    """A row per method, a column per quantity: the mean over the pairs that have it; no rows for no value."""
    values: dict[str, Values] = {
        name: by_method(records, lambda record, name=name: value_of(record, name)) for name in columns
    }
    header = []
    for name, heading in columns.items():
        labels = {label for own in values[name].values() for label in own}
        header.append(f"{heading} ({count_of_pairs(len(labels))})" if labels else heading)
    rows = []
    for method in dict.fromkeys(record["method"] for record in records):
        own = [list(values[name][method].values()) for name in columns]
        if any(own):
            cells = (cell(mean_with_interval(numbers).value) if numbers else "-" for numbers in own)
            rows.append((find_method(method).title, *cells))
    return Table(title, ("method", *header), tuple(rows), note)


def regions_table(records: Sequence[dict[str, Any]]) -> Table:
    """AbsRel by what the right camera sees, matches and material, mean over the pairs with such pixels.

    Args:
        records: of a run.

    Returns:
        Columns for what is visible, occluded and out of view, for where the two views match and where they
        do not, for Booster's "transparent or mirror" classes and the others, then for each class that
        occurs; a dash where no pair says so.
    """
    classes = sorted({name for r in records for name in r.get("regions") or {} if name.startswith("mat")})
    columns = _REGIONS | {name: name.replace("material_", "class ") for name in classes}
    return _columns_table(
        records,
        columns,
        lambda record, name: record["regions"].get(name),
        "AbsRel by region and material",
        "Under the cap; aligned for methods that know relative depth only. Visible and occluded are known "
        "where the data set has a mask, out of view always; matched is where our sweep of both views has "
        "a match of confidence 0.5 or more, the same pixels for every method; ToM is transparent or mirror "
        "(classes 2 and 3).",
    )


def disparity_table(records: Sequence[dict[str, Any]]) -> Table:
    """Errors in disparity, mean over the rectified pairs, not aligned.

    Args:
        records: of a run.

    Returns:
        A dash where the truth's step is not finer than the threshold; no rows without a rectified pair.
    """
    return _columns_table(
        records,
        _DISPARITY,
        lambda record, name: (record["disparity"] or {}).get(name),
        "Disparity, rectified pairs",
        "Metres turned into disparity at the left image's resolution; shares of pixels for bad-k and D1.",
    )


def uncertainty_table(records: Sequence[dict[str, Any]]) -> Table:
    """AUSE of the methods that give an uncertainty (an ensemble of at least 2)."""
    values = by_method(records, lambda record: record["ause"])
    rows = [
        (find_method(method).title, str(len(own)), interval_cell(mean_with_interval(list(own.values()))))
        for method, own in values.items()
        if own
    ]
    note = "Area under the sparsification error of AbsRel; 0 where the least certain pixels are the worst."
    return Table("Uncertainty", ("method", "pairs", "AUSE [95 %]"), tuple(rows), note)


def confidence_table(records: Sequence[dict[str, Any]]) -> Table:
    """What the confidence of each method promises by decile, and what it keeps; pairs weigh the same."""
    rows = []
    for method, own in by_method(records, lambda record: record.get("confidence")).items():
        pairs = [deciles for deciles in own.values() if deciles]
        for k in range(10):
            filled = [deciles[k] for deciles in pairs if deciles[k]["share"]]
            weight = sum(one["share"] for one in filled)
            if not filled:
                continue
            means = [
                sum(one[name] * one["share"] for one in filled) / weight
                for name in ("promised", "kept", "abs_rel")
            ]
            title = find_method(method).title
            rows.append(
                (title, f"{k / 10:.1f} to {(k + 1) / 10:.1f}", cell(weight / len(pairs)), *map(cell, means))
            )
    note = f"Confidence is the probability of a relative error below {RIGHT_WITHIN:g}; pixels of all pairs."
    header = ("method", "confidence", "share of pixels", "promised", "kept", "AbsRel")
    return Table("Confidence by decile", header, tuple(rows), note)
