"""Tables of ``geodiff eval pairs``, from records.

Data flow: records -> ``Table``.
Paper: none; per pair, with intervals and paired differences.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.cells import (
    HEADINGS,
    by_method,
    cell,
    count_of_pairs,
    interval_cell,
    label_of,
)
from geodiff_plugin.evaluation.detail_tables import (
    confidence_table,
    disparity_table,
    regions_table,
    uncertainty_table,
)
from geodiff_plugin.evaluation.layout import Table
from geodiff_plugin.evaluation.runner import headline
from geodiff_plugin.evaluation.seed_tables import spread_table, without_copies
from geodiff_plugin.evaluation.statistics import mean_with_interval, paired_difference

__all__ = ["groups", "pairs_tables", "per_pair_table", "summary_table", "versus_table"]

_SUMMARY = ("abs_rel", "delta1", "delta2", "delta3", "rmse", "log_rmse", "silog")


def groups(records: Sequence[dict[str, Any]]) -> dict[str, set[str]]:
    """Labels of all samples, and of the rectified and the posed ones where both kinds are there."""
    rectified = {label_of(r) for r in records if r.get("rectified") is True}
    posed = {label_of(r) for r in records if r.get("rectified") is False}
    everything = {count_of_pairs(len(rectified | posed)): rectified | posed}
    if rectified and posed:
        everything |= {
            count_of_pairs(len(rectified), "rectified "): rectified,
            count_of_pairs(len(posed), "posed "): posed,
        }
    return everything


def _heading(records: Sequence[dict[str, Any]], method: str) -> str:
    """A method's title, saying so where it knows relative depth only."""
    title = find_method(method).title
    own = [r["all_pixels"]["raw"] for r in records if r["method"] == method and r["status"] == "ok"]
    relative = bool(own) and all(raw is None for raw in own)
    return f"{title} + oracle" if relative and "oracle" not in title else title


def per_pair_table(
    records: Sequence[dict[str, Any]],
    title: str,
    value_of: Callable[[dict[str, Any]], float | None],
    digits: int,
    note: str,
) -> Table:
    """One row per sample, one column per method, then the means of every group.

    A mean stands only where the method has a number for every sample of the group.
    """
    values = by_method(records, value_of)
    labels = list(dict.fromkeys(label_of(record) for record in records))
    rows = [(label, *(cell(values[m].get(label), digits) for m in values)) for label in labels]
    for group, members in groups(records).items():
        means = (
            mean_with_interval([values[m][x] for x in members]).value if members <= values[m].keys() else None
            for m in values
        )
        if members:
            rows.append((f"mean of {group}", *(cell(mean, digits) for mean in means)))
    return Table(title, ("pair", *(_heading(records, m) for m in values)), tuple(rows), note)


def _summary_cells(scores: Sequence[dict[str, float | None]]) -> tuple[str, ...]:
    """Mean and interval of every metric, then the mean coverage."""
    means = [mean_with_interval([s[metric] for s in scores if s[metric] is not None]) for metric in _SUMMARY]
    coverage = mean_with_interval([s["coverage"] for s in scores])
    return (*(interval_cell(mean) for mean in means), cell(coverage.value))


def summary_table(records: Sequence[dict[str, Any]], members: set[str], title: str) -> Table:
    """Mean over images and its interval of every metric, a row per method as it comes out and one aligned.

    Args:
        records: of a run.
        members: labels of the samples that count.
        title: heading.
    """
    rows = []
    for method in dict.fromkeys(record["method"] for record in records):
        own = [
            record["capped"]
            for record in records
            if record["method"] == method and record["status"] == "ok" and label_of(record) in members
        ]
        for column, name in (
            ("raw", find_method(method).title),
            ("aligned", f"{find_method(method).title}, aligned"),
        ):
            scores = [both[column] for both in own if both[column] is not None]
            if scores:
                rows.append((name, str(len(scores)), *_summary_cells(scores)))
    header = ("method", "pairs", *(HEADINGS[metric] for metric in _SUMMARY), "coverage")
    return Table(title, header, tuple(rows), "Capped at 80 m for KITTI and 10 m for Booster; mean [95 %].")


def versus_table(records: Sequence[dict[str, Any]], reference: str) -> Table:
    """Paired differences in AbsRel, all pixels, as ``headline``: the reference minus each other method."""
    values = by_method(records, headline)
    rows = []
    for method in values:
        if method != reference and values[method] and values.get(reference):
            difference = paired_difference(values[reference], values[method])
            wins = sum(
                values[reference][x] < values[method][x] for x in values[reference] if x in values[method]
            )
            rows.append(
                (
                    find_method(method).title,
                    str(difference.count),
                    interval_cell(difference, signed=True),
                    f"{wins} of {difference.count}",
                )
            )
    return Table(
        f"{find_method(reference).title} against each other method, AbsRel",
        ("method", "pairs", "mean difference [95 %]", "pairs won"),
        tuple(rows),
        "Negative: smaller error than the other method. An interval without 0 tells the two apart.",
    )


def pairs_tables(records: Sequence[dict[str, Any]], reference: str = "guided") -> list[Table]:
    """The tables of ``geodiff eval pairs``.

    Args:
        records: of a run; further seeds of a method in it count in the table of their spread only.
        reference: the method that the others are compared with.
    """
    spread = spread_table(records, groups(records), headline)
    records = without_copies(records)
    count = len({label_of(record) for record in records})
    tables = [
        per_pair_table(
            records,
            f"AbsRel of {count_of_pairs(count)}",
            headline,
            3,
            "All pixels with truth, no cap; metres as they come out, not aligned, except in the columns of "
            "methods that know relative depth only ('oracle'), which get scale and shift from the truth.",
        ),
        per_pair_table(records, "Seconds", lambda record: record["seconds"], 1, ""),
    ]
    if any(record["method"] == reference for record in records):
        tables.append(versus_table(records, reference))
    for group, members in groups(records).items():
        tables.append(summary_table(records, members, f"All metrics, {group}"))
    tables += [regions_table(records), disparity_table(records), uncertainty_table(records)]
    tables += [confidence_table(records), spread]
    return [table for table in tables if table.rows]
