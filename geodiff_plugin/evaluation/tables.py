"""Tables of a comparison: pair by pair, by metric, region, disparity, edges, confidence and seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.experiment import headline
from geodiff_plugin.evaluation.table import (
    HEADINGS,
    Table,
    by_method,
    cell,
    count_of_pairs,
    interval_cell,
    label_of,
    mean_with_interval,
    paired_difference,
)
from geodiff_plugin.runner import Record
from geodiff_plugin.runtime.confidence import RIGHT_WITHIN

__all__ = [
    "confidence_table",
    "boundaries_table",
    "disparity_regions_table",
    "disparity_table",
    "groups",
    "pairs_tables",
    "per_pair_table",
    "regions_table",
    "sorting_table",
    "spread_table",
    "summary_table",
    "uncertainty_table",
    "versus_table",
    "without_copies",
]

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
    there = {name: [v for s in scores if (v := s[name]) is not None] for name in (*_SUMMARY, "coverage")}
    means = [mean_with_interval(there[metric]) for metric in _SUMMARY]
    coverage = mean_with_interval(there["coverage"])
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
    tables += [regions_table(records), disparity_table(records), disparity_regions_table(records)]
    tables += [boundaries_table(records), uncertainty_table(records), sorting_table(records)]
    tables += [confidence_table(records), spread]
    return [table for table in tables if table.rows]


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
        name: by_method(records, partial(lambda name, record: value_of(record, name), name))
        for name in columns
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


def disparity_table(records: Sequence[Record]) -> Table:
    """Errors in disparity, mean over the rectified pairs, not aligned; no rows without a rectified pair."""
    return _columns_table(
        records,
        _DISPARITY,
        lambda record, name: (record["disparity"] or {}).get(name),
        "Disparity, rectified pairs",
        "Metres turned into disparity at the left image's resolution; shares of pixels for bad-k and D1, "
        "a dash where the truth's step is coarser than the threshold.",
    )


def disparity_regions_table(records: Sequence[Record]) -> Table:
    """The same by what the right camera sees and by nearness to an edge."""
    columns = {
        f"{region} {name}": f"{region}, {heading}"
        for region in ("visible", "edge", "flat")
        for name, heading in _DISPARITY.items()
        if name != "bad3"
    }

    def value_of(record: Record, column: str) -> float | None:
        region, name = column.split()
        return ((record["disparity"] or {}).get("regions") or {}).get(region, {}).get(name)

    return _columns_table(
        records,
        columns,
        value_of,
        "Disparity by region, rectified pairs",
        "Visible: neither hidden in the right view nor beside it; edge: within 4 px of a step of the true "
        "disparity of more than 3 px; flat: the rest.",
    )


def boundaries_table(records: Sequence[Record]) -> Table:
    """How well the boundaries of a map follow those of dense truth."""
    columns = {"f1": "boundary F1", "dbe_acc": "ε acc px", "dbe_comp": "ε comp px"}
    return _columns_table(
        records,
        columns,
        lambda record, name: (record.get("boundaries") or {}).get(name),
        "Boundaries, dense truth",
        "F1 as Depth Pro defines it, higher is better; distances of depth boundaries as iBims-1 does.",
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


def sorting_table(records: Sequence[Record]) -> Table:
    """How well the confidence sorts pixels by their error, beside a random order; an oracle's is 0."""
    return _columns_table(
        records,
        {"ause": "AUSE", "random": "AUSE of a random order"},
        lambda record, name: (record.get("ause_confidence") or {}).get(name),
        "AUSE of the confidence",
        "Area under the sparsification error of AbsRel; 0 where the least certain pixels are the worst.",
    )


def confidence_table(records: Sequence[dict[str, Any]]) -> Table:
    """What the confidence of each method promises by decile, and what it keeps; pairs weigh the same."""
    rows = []
    deciles_of: Any = by_method(records, lambda record: record.get("confidence"))
    for method, own in deciles_of.items():
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


def _families(records: Sequence[dict[str, Any]]) -> dict[str, list[str]]:
    """``METHOD`` -> its name and those of its ``METHOD#SEED``, for every method that was run unbound."""
    names = list(dict.fromkeys(record["method"] for record in records))
    families = {name: [name] for name in names if find_method(name).seed is None}
    for name in names:
        method = find_method(name)
        if method.seed is not None and method.seedless_name in families:
            families[method.seedless_name].append(name)
    return families


def without_copies(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The records but for those of ``METHOD#SEED`` where ``METHOD`` itself was run."""
    copies = {name for family in _families(records).values() for name in family[1:]}
    return [record for record in records if record["method"] not in copies]


def _spread_row(
    title: str, group: str, members: set[str], seeds: Sequence[dict[str, float]]
) -> tuple[str, ...]:
    """Cells of one method and group; ``seeds`` holds one value per pair for each of its seeds."""
    shared = [label for label in seeds[0] if label in members and all(label in own for own in seeds)]
    if not shared:
        return ()
    values = np.array([[own[label] for label in shared] for own in seeds])  # (seeds, pairs)
    means = values.mean(axis=1)
    whole = len(shared) == len(members)
    over_seeds = (float(f(means)) for f in (np.mean, lambda x: np.std(x, ddof=1), np.min, np.max))
    cells = [cell(value if whole else None, 4) for value in over_seeds]
    spread = values.max(axis=0) - values.min(axis=0)
    worst = int(spread.argmax())
    return title, group, *cells, cell(float(spread[worst]), 4), shared[worst]


def spread_table(
    records: Sequence[dict[str, Any]],
    groups: Mapping[str, set[str]],
    value_of: Callable[[dict[str, Any]], float | None],
) -> Table:
    """Mean AbsRel of each method over the seeds that it was run with; no rows where that is one.

    Args:
        records: of a run.
        groups: labels of samples by the name of their group.
        value_of: AbsRel of a record.

    Returns:
        A row per method and group. A mean stands only where every seed has a number for every pair of the
        group; the largest spread is over the pairs that every seed has a number for.
    """
    values = by_method(records, value_of)
    families = {name: family for name, family in _families(records).items() if len(family) > 1}
    rows: list[tuple[str, ...]] = []
    rules: list[int] = []
    for name, family in families.items():
        seeds, title = [values[one] for one in family], find_method(name).title
        own = [_spread_row(title, group, members, seeds) for group, members in groups.items()]
        rules.append(len(rows))
        rows += [row for row in own if row]
    count = max(map(len, families.values()), default=1)
    header = (
        "method",
        "AbsRel of",
        "mean",
        "deviation",
        "least",
        "largest",
        "spread of a pair",
        "that pair",
    )
    note = (
        "All pixels, as in the first table. Over the seeds: mean, standard deviation (n - 1), least and "
        "largest of the mean of these pairs; then the greatest difference between two seeds on one pair."
    )
    return Table(f"Spread over {count} seeds", header, tuple(rows), note, rules=tuple(rules))
