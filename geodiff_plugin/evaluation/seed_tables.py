"""Spread of a method's errors over the seeds of its noise.

Data flow: records of ``METHOD`` and ``METHOD#SEED`` -> ``Table``.
Paper: none; it reports one seed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.cells import by_method, cell
from geodiff_plugin.evaluation.layout import Table

__all__ = ["spread_table", "without_copies"]


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


def _row(title: str, group: str, members: set[str], seeds: Sequence[dict[str, float]]) -> tuple[str, ...]:
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
    rows, rules = [], []
    for name, family in families.items():
        seeds, title = [values[one] for one in family], find_method(name).title
        own = [_row(title, group, members, seeds) for group, members in groups.items()]
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
