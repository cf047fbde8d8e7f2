"""A table of cells in Markdown, LaTeX and JSON, and the means with intervals that fill it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = [
    "FEWEST_FOR_INTERVAL",
    "HEADINGS",
    "Mean",
    "Table",
    "by_method",
    "cell",
    "count_of_pairs",
    "interval_cell",
    "label_of",
    "latex_escape",
    "mean_with_interval",
    "metric_values",
    "paired_difference",
]

FEWEST_FOR_INTERVAL = 5
"""Below this number of images no interval is given: resampling four values says nothing."""


@dataclass(frozen=True)
class Mean:
    """A mean over images.

    Attributes:
        value: the mean; NaN for no image.
        low: 2.5 % quantile of the bootstrap, ``None`` for fewer than ``FEWEST_FOR_INTERVAL`` images.
        high: 97.5 % quantile.
        count: number of images.
    """

    value: float
    low: float | None
    high: float | None
    count: int


def mean_with_interval(values: Sequence[float], seed: int = 0, draws: int = 2000) -> Mean:
    """Mean over images and its 95 % percentile-bootstrap interval.

    Args:
        values: one number per image.
        seed: of the resampling; the same seed gives the same interval.
        draws: number of resamplings.

    Returns:
        ``Mean``.
    """
    data = np.asarray(values, np.float64)
    if data.size == 0:
        return Mean(float("nan"), None, None, 0)
    if data.size < FEWEST_FOR_INTERVAL:
        return Mean(float(data.mean()), None, None, data.size)
    picks = np.random.default_rng(seed).integers(0, data.size, (draws, data.size))
    low, high = np.quantile(data[picks].mean(axis=1), [0.025, 0.975])
    return Mean(float(data.mean()), float(low), float(high), data.size)


def paired_difference(first: dict[str, float], second: dict[str, float], seed: int = 0) -> Mean:
    """Mean of ``first - second`` over the images that both have, with its interval.

    Args:
        first: value by image.
        second: value by image.
        seed: of the resampling.

    Returns:
        ``Mean`` of the differences; an interval that excludes 0 tells the two methods apart.
    """
    shared = [name for name in first if name in second]
    return mean_with_interval([first[name] - second[name] for name in shared], seed)


_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "_": r"\_",
        "%": r"\%",
        "&": r"\&",
        "#": r"\#",
        "$": r"\$",
        "{": r"\{",
        "}": r"\}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"$<$",
        ">": r"$>$",
        "|": r"$|$",
        "δ": r"$\delta$",
        "γ": r"$\gamma$",
        "±": r"$\pm$",
        "↓": r"$\downarrow$",
        "↑": r"$\uparrow$",
        "×": r"$\times$",
        "†": r"$^\dagger$",
        "✓": r"$\checkmark$",
        "✗": r"$\times$",
    }
)


def latex_escape(text: str) -> str:
    """Text for LaTeX: its special characters escaped, the symbols of our tables as commands."""
    return text.translate(_LATEX)


@dataclass(frozen=True)
class Table:
    """Cells as they are printed.

    Attributes:
        title: heading, one line.
        header: column headings; the first column names the row.
        rows: as long as the header each.
        note: what a reader needs beside it, or empty.
        groups: ``(heading, number of columns)`` over the whole header, an empty heading for columns on their
            own; empty for a header of one line.
        rules: indices of rows that start a new group of rows.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    groups: tuple[tuple[str, int], ...] = ()
    rules: tuple[int, ...] = ()

    def _group_of_columns(self) -> list[str]:
        headings = [heading for heading, count in self.groups for _ in range(count)]
        return headings or [""] * len(self.header)

    def full_header(self) -> tuple[str, ...]:
        """Column headings in one line each, with the heading of their group before them."""
        return tuple(
            f"{group}: {name}" if group else name
            for group, name in zip(self._group_of_columns(), self.header, strict=True)
        )

    def markdown(self) -> str:
        """A heading, the note and a pipe table; Markdown has one line of headings, so groups go into it."""
        lines = [f"## {self.title}", ""]
        if self.note:
            lines += [self.note, ""]
        rows = [[cell.replace("|", r"\|") for cell in row] for row in (self.full_header(), *self.rows)]
        lines += ["| " + " | ".join(rows[0]) + " |", "| --- |" + " ---: |" * (len(self.header) - 1)]
        lines += ["| " + " | ".join(row) + " |" for row in rows[1:]]
        return "\n".join(lines) + "\n"

    def _latex_groups(self) -> list[str]:
        """The line of group headings and the partial rules below it."""
        if not self.groups:
            return []
        cells, rules, first = [], [], 1
        for heading, count in self.groups:
            cells.append(rf"\multicolumn{{{count}}}{{c}}{{{latex_escape(heading)}}}" if heading else "")
            if heading:
                rules.append(rf"\cmidrule(lr){{{first}-{first + count - 1}}}")
            else:
                cells += [""] * (count - 1)
            first += count
        return [" & ".join(cells) + r" \\", " ".join(rules)]

    def latex(self) -> str:
        """A ``tabular`` with booktabs rules, its title as a comment."""
        lines = [f"% {self.title}", rf"\begin{{tabular}}{{l{'r' * (len(self.header) - 1)}}}", r"\toprule"]
        lines += [*self._latex_groups(), " & ".join(map(latex_escape, self.header)) + r" \\", r"\midrule"]
        for index, row in enumerate(self.rows):
            if index and index in self.rules:
                lines.append(r"\midrule")
            lines.append(" & ".join(map(latex_escape, row)) + r" \\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"

    def as_json(self) -> dict[str, Any]:
        """The same as plain values."""
        return {
            "title": self.title,
            "note": self.note,
            "groups": [list(group) for group in self.groups],
            "header": list(self.header),
            "rows": [list(row) for row in self.rows],
        }


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


def metric_values(
    records: Sequence[dict[str, Any]], alignment: str, metric: str
) -> Mapping[str, dict[str, float]]:
    """Method -> label -> one metric under the cap, raw or aligned."""

    def value_of(record: dict[str, Any]) -> float | None:
        scores = record["capped"][alignment]
        return None if scores is None else scores[metric]

    return by_method(records, value_of)
