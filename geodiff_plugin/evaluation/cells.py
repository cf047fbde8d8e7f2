"""Formatting of numbers as cells of tables.

Data flow: records -> values by method and sample -> text.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from geodiff_plugin.evaluation.statistics import Mean

__all__ = ["HEADINGS", "by_method", "cell", "count_of_pairs", "interval_cell", "label_of"]

HEADINGS = {
    "abs_rel": "AbsRel",
    "delta1": "δ1",
    "delta2": "δ2",
    "delta3": "δ3",
    "rmse": "RMSE m",
    "log_rmse": "log RMSE",
    "silog": "SILog",
}
"""Column headings of the depth metrics, by their names in a record."""


def cell(value: float | None, digits: int = 3) -> str:
    """A number, or a dash for ``None``."""
    return "-" if value is None else f"{value:.{digits}f}"


def interval_cell(mean: Mean, digits: int = 3, signed: bool = False) -> str:
    """A mean with its interval where it has one; a dash for the mean of nothing."""
    if mean.count == 0:
        return "-"
    sign = "+" if signed else ""
    text = f"{mean.value:{sign}.{digits}f}"
    if mean.low is not None:
        text += f" [{mean.low:{sign}.{digits}f}, {mean.high:{sign}.{digits}f}]"
    return text


def label_of(record: dict[str, Any]) -> str:
    """``dataset/sample`` of a record."""
    return f"{record['dataset']}/{record['sample']}"


def count_of_pairs(count: int, kind: str = "") -> str:
    """``"1 pair"``, ``"5 posed pairs"``."""
    return f"{count} {kind}{'pair' if count == 1 else 'pairs'}"


def by_method(
    records: Sequence[dict[str, Any]], value_of: Callable[[dict[str, Any]], float | None]
) -> dict[str, dict[str, float]]:
    """``method -> label -> value`` over the finished records that have one."""
    values: dict[str, dict[str, float]] = {}
    for record in records:
        by_label = values.setdefault(record["method"], {})
        value = value_of(record) if record["status"] == "ok" else None
        if value is not None:
            by_label[label_of(record)] = value
    return values
