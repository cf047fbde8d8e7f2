"""Tables of ``geodiff eval strength``: errors by strength of the prior and by method, for groups of pairs.

Data flow: records of ``evaluation.strength`` -> means over pairs -> ``Table`` of each group.
Paper: none; S5 measures one prior.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.cells import count_of_pairs
from geodiff_plugin.evaluation.layout import Table

__all__ = ["strength_tables"]

#: Field of a record -> heading of its column.
_VALUES = {"abs_rel": "AbsRel", "delta1": "δ1", "edges": "at edges", "surfaces": "surfaces"}


def strength_tables(records: Sequence[dict[str, Any]]) -> tuple[Table, ...]:
    """One table a group of pairs (all, rendered rectified, rendered posed, real), strengths by methods.

    Args:
        records: of ``run_strength``.
    """
    groups = {
        "All pairs": lambda r: True,
        "Rendered, rectified": lambda r: r["rendered"] and r["rectified"],
        "Rendered, any pose": lambda r: r["rendered"] and not r["rectified"],
        "Real": lambda r: not r["rendered"],
    }
    tables = []
    for title, belongs in groups.items():
        own = [record for record in records if belongs(record)]
        if own:
            tables.append(_table(title, own))
    return tuple(tables)


def _table(title: str, records: Sequence[dict[str, Any]]) -> Table:
    strengths = list(dict.fromkeys(record["strength"] for record in records))
    methods = list(dict.fromkeys(record["method"] for record in records))
    rows, rules = [], []
    for strength in strengths:
        rules.append(len(rows))
        for method in methods:
            own = [r for r in records if r["strength"] == strength and r["method"] == method]
            if not own:
                continue
            means = {name: _mean([r[name] for r in own]) for name in _VALUES}
            worst = max(r["abs_rel"] for r in own)
            shown = [f"{means[n]:.2f}" if n == "surfaces" else f"{means[n]:.4f}" for n in _VALUES]
            rows.append((strength, find_method(method).title, *shown, f"{worst:.3f}"))
    # Not by label: pairs of one name in two folders are two.
    pairs = count_of_pairs(max(Counter((r["strength"], r["method"]) for r in records).values()))
    note = (
        f"{pairs}. AbsRel and δ1 in metres, without alignment but for the prior with oracle; AbsRel within "
        f"3 px of the truth's edges; error of the slope of log depth away from them, per mille a pixel."
    )
    header = ("prior's error", "method", *_VALUES.values(), "worst AbsRel")
    return Table(title, header, tuple(rows), note, rules=tuple(rules[1:]))


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else float("nan")
