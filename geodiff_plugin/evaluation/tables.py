"""Tables in Markdown, LaTeX and JSON: means with intervals, and those of a comparison of methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.runner import Record
from geodiff_plugin.runtime.confidence import RIGHT_WITHIN

FEWEST_FOR_INTERVAL = 5
"""Below this number of images no interval is given: resampling four values says nothing."""
HEADINGS = {"abs_rel": "AbsRel", "delta1": "δ1", "delta2": "δ2", "delta3": "δ3"}
HEADINGS |= {"rmse": "RMSE m", "log_rmse": "log RMSE", "silog": "SILog"}
"""Column headings of the depth metrics, by their names in a record."""

ValueOf = Callable[[Record], float | None]
Values = Mapping[str, dict[str, float]]
"""Method -> label of the pair -> a number."""


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

    def cell(self, digits: int = 3, sign: str = "") -> str:
        """The mean with its interval where it has one; a dash for the mean of nothing."""
        if self.count == 0:
            return "-"
        value, low, high = (f"{n or 0.0:{sign}.{digits}f}" for n in (self.value, self.low, self.high))
        return value if self.low is None else f"{value} [{low}, {high}]"


def mean_with_interval(values: Sequence[float], seed: int = 0, draws: int = 2000) -> Mean:
    """Mean over images and its 95 % percentile-bootstrap interval; one seed gives one interval."""
    data = np.asarray(values, np.float64)
    if data.size < FEWEST_FOR_INTERVAL:
        return Mean(float(data.mean()) if data.size else float("nan"), None, None, data.size)
    picks = np.random.default_rng(seed).integers(0, data.size, (draws, data.size))
    low, high = np.quantile(data[picks].mean(axis=1), [0.025, 0.975])
    return Mean(float(data.mean()), float(low), float(high), data.size)


def paired_difference(first: Mapping[str, float], second: Mapping[str, float], seed: int = 0) -> Mean:
    """Mean of ``first - second`` over the images that both have; an interval without 0 tells them apart."""
    return mean_with_interval([first[name] - second[name] for name in first if name in second], seed)


_LATEX: dict[str, str | int | None] = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}
_LATEX |= {character: f"\\{character}" for character in "_%&#${}"}
_LATEX |= {"<": "$<$", ">": "$>$", "|": "$|$", "δ": r"$\delta$", "γ": r"$\gamma$", "±": r"$\pm$"}
_LATEX |= {"↓": r"$\downarrow$", "↑": r"$\uparrow$", "×": r"$\times$", "†": r"$^\dagger$"}
_LATEX |= {"✓": r"$\checkmark$", "✗": r"$\times$"}


def latex_escape(text: str) -> str:
    """Text for LaTeX: its special characters escaped, the symbols of our tables as commands."""
    return text.translate(str.maketrans(_LATEX))


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

    def full_header(self) -> tuple[str, ...]:
        """Column headings in one line each, with the heading of their group before them."""
        groups = [heading for heading, count in self.groups for _ in range(count)] or [""] * len(self.header)
        return tuple(f"{g}: {name}" if g else name for g, name in zip(groups, self.header, strict=True))

    def markdown(self) -> str:
        """A heading, the note and a pipe table; Markdown has one line of headings, so groups go into it."""
        lines = [f"## {self.title}", "", *([self.note, ""] if self.note else [])]
        cells = [[cell.replace("|", r"\|") for cell in row] for row in (self.full_header(), *self.rows)]
        rows = [f"| {' | '.join(row)} |" for row in cells]
        lines += [rows[0], "| --- |" + " ---: |" * (len(self.header) - 1), *rows[1:]]
        return "\n".join(lines) + "\n"

    def latex(self) -> str:
        """A ``tabular`` with booktabs rules, its title as a comment."""
        lines = [f"% {self.title}", rf"\begin{{tabular}}{{l{'r' * (len(self.header) - 1)}}}", r"\toprule"]
        cells, rules, first = list[str](), list[str](), 1
        for heading, count in self.groups:
            if heading:
                cells.append(rf"\multicolumn{{{count}}}{{c}}{{{latex_escape(heading)}}}")
                rules.append(rf"\cmidrule(lr){{{first}-{first + count - 1}}}")
            else:
                cells += [""] * count
            first += count
        lines += [" & ".join(cells) + r" \\", " ".join(rules)] if self.groups else []
        lines += [" & ".join(map(latex_escape, self.header)) + r" \\", r"\midrule"]
        for index, row in enumerate(self.rows):
            lines += [r"\midrule"] * bool(index and index in self.rules)
            lines.append(" & ".join(map(latex_escape, row)) + r" \\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"

    def as_json(self) -> dict[str, Any]:
        """The same as plain values."""
        return {name: value for name, value in asdict(self).items() if name != "rules"}


def cell(value: float | None, digits: int = 3) -> str:
    """A number, or a dash for ``None``."""
    return "-" if value is None else f"{value:.{digits}f}"


def label_of(record: Record) -> str:
    """``dataset/sample`` of a record."""
    return f"{record['dataset']}/{record['sample']}"


def count_of_pairs(count: int, kind: str = "") -> str:
    """``"1 pair"``, ``"5 posed pairs"``."""
    return f"{count} {kind}{'pair' if count == 1 else 'pairs'}"


def headline(record: Record) -> float | None:
    """AbsRel over all pixels with truth: not aligned, or aligned for a method without metres."""
    if record["status"] != "ok":
        return None
    both = record["all_pixels"]
    return (both["raw"] or both["aligned"])["abs_rel"]


def seconds_of(record: Record) -> float | None:
    """Of one method on one pair."""
    return record.get("seconds")


def by_method(records: Sequence[Record], value_of: ValueOf) -> dict[str, dict[str, float]]:
    """``method -> label -> value`` over the finished records that have one."""
    values: dict[str, dict[str, float]] = {}
    for record in records:
        of_label = values.setdefault(record["method"], {})
        value = value_of(record) if record["status"] == "ok" else None
        if value is not None:
            of_label[label_of(record)] = value
    return values


def metric_values(records: Sequence[Record], alignment: str, metric: str) -> Values:
    """Method -> label -> one metric under the cap, raw or aligned."""
    return by_method(records, lambda record: (record["capped"][alignment] or {}).get(metric))


def groups_of(records: Sequence[Record]) -> dict[str, set[str]]:
    """Labels of all samples, and of the rectified and the posed ones where both kinds are there."""
    kinds = (True, False)
    rectified, posed = ({label_of(r) for r in records if r.get("rectified") is kind} for kind in kinds)
    groups = {count_of_pairs(len(rectified | posed)): rectified | posed}
    if rectified and posed:
        groups[count_of_pairs(len(rectified), "rectified ")] = rectified
        groups[count_of_pairs(len(posed), "posed ")] = posed
    return groups


def _heading(records: Sequence[Record], method: str) -> str:
    """A method's title, saying so where it knows relative depth only."""
    title = find_method(method).title
    raw = [r["all_pixels"]["raw"] for r in records if r["method"] == method and r["status"] == "ok"]
    relative = bool(raw) and not any(raw)
    return f"{title} + oracle" if relative and "oracle" not in title else title


def per_pair_table(records: Sequence[Record], title: str, value_of: ValueOf, digits: int, note: str) -> Table:
    """One row per sample, one column per method, then the means of every group.

    A mean stands only where the method has a number for every sample of the group.
    """
    values = by_method(records, value_of)
    labels = list(dict.fromkeys(map(label_of, records)))
    rows = [(label, *(cell(values[m].get(label), digits) for m in values)) for label in labels]
    for group, members in groups_of(records).items():
        means = [_whole_mean(values[m], members) for m in values]
        rows += [(f"mean of {group}", *(cell(mean, digits) for mean in means))] if members else []
    return Table(title, ("pair", *(_heading(records, m) for m in values)), tuple(rows), note)


def _whole_mean(values: Mapping[str, float], members: set[str]) -> float | None:
    return mean_with_interval([values[x] for x in members]).value if members <= values.keys() else None


def summary_table(records: Sequence[Record], members: set[str], title: str) -> Table:
    """Mean over some samples and its interval of every metric, a row per method as is and one aligned."""
    rows = []
    records = [r for r in records if r["status"] == "ok" and label_of(r) in members]
    for method in dict.fromkeys(record["method"] for record in records):
        done = [r["capped"] for r in records if r["method"] == method]
        for column, suffix in (("raw", ""), ("aligned", ", aligned")):
            scores = [both[column] for both in done if both[column] is not None]
            if not scores:
                continue
            columns = [[v for s in scores if (v := s[name]) is not None] for name in (*HEADINGS, "coverage")]
            *means, coverage = map(mean_with_interval, columns)
            cells = [*(mean.cell() for mean in means), cell(coverage.value)]
            rows.append((find_method(method).title + suffix, str(len(scores)), *cells))
    header = ("method", "pairs", *HEADINGS.values(), "coverage")
    return Table(title, header, tuple(rows), "Capped at 80 m for KITTI and 10 m for Booster; mean [95 %].")


def versus_table(records: Sequence[Record], reference: str) -> Table:
    """Paired differences in AbsRel, all pixels, as ``headline``: the reference minus each other method."""
    values, rows = by_method(records, headline), []
    own, title = values.get(reference, {}), find_method(reference).title
    for method, other in values.items():
        if method != reference and other and own:
            difference = paired_difference(own, other)
            wins = f"{sum(own[x] < other[x] for x in own if x in other)} of {difference.count}"
            rows.append((find_method(method).title, str(difference.count), difference.cell(sign="+"), wins))
    header = ("method", "pairs", "mean difference [95 %]", "pairs won")
    note = "Negative: smaller error than the other method. An interval without 0 tells the two apart."
    return Table(f"{title} against each other method, AbsRel", header, tuple(rows), note)


_DISPARITY = {"epe": "EPE px", "bad1": "bad-1", "bad2": "bad-2", "bad3": "bad-3", "d1": "D1"}


class _Details(NamedTuple):
    """A table of means, a column per quantity; ``value_of(column, record)`` may be ``None``."""

    title: str
    columns: Mapping[str, str]
    value_of: Callable[[str, Record], float | None]
    note: str

    def table(self, records: Sequence[Record], columns: Mapping[str, str] | None = None) -> Table:
        """A row per method with a value: the mean of each quantity over the pairs that have it."""
        columns = columns or self.columns
        values = [by_method(records, partial(self.value_of, name)) for name in columns]
        header, rows = ["method"], []
        for of_method, heading in zip(values, columns.values(), strict=True):
            count = len({label for own in of_method.values() for label in own})
            header.append(f"{heading} ({count_of_pairs(count)})" if count else heading)
        for method in dict.fromkeys(record["method"] for record in records):
            own = [list(of_method[method].values()) for of_method in values]
            if any(own):
                cells = (cell(mean_with_interval(numbers).value) if numbers else "-" for numbers in own)
                rows.append((find_method(method).title, *cells))
        return Table(self.title, tuple(header), tuple(rows), self.note)


def _disparity_by_region(column: str, record: Record) -> float | None:
    region, name = column.split()
    return ((record["disparity"] or {}).get("regions") or {}).get(region, {}).get(name)


def _ause(name: str, record: Record) -> float | None:
    return record["ause"] if name == "uncertainty" else (record.get("ause_confidence") or {}).get(name)


_REGIONS = _Details(
    "AbsRel by region and material",
    {
        "visible": "visible",
        "occluded": "occluded",
        "out_of_view": "out of view",
        "matched": "matched",
        "unmatched": "unmatched",
        "tom": "ToM",
        "not_tom": "other material",
    },
    lambda name, record: record["regions"].get(name),
    "Under the cap; aligned for methods that know relative depth only. Visible and occluded are known where "
    "the data set has a mask, out of view always; matched is where our sweep of both views has a match of "
    "confidence 0.5 or more, the same pixels for every method; ToM is transparent or mirror (classes 2, 3).",
)
_DETAILS = (
    _Details(
        "Disparity, rectified pairs",
        _DISPARITY,
        lambda name, record: (record["disparity"] or {}).get(name),
        "Metres turned into disparity at the left image's resolution; shares of pixels for bad-k and D1, "
        "a dash where the truth's step is coarser than the threshold.",
    ),
    _Details(
        "Disparity by region, rectified pairs",
        {
            f"{region} {name}": f"{region}, {heading}"
            for region in ("visible", "edge", "flat")
            for name, heading in _DISPARITY.items()
            if name != "bad3"
        },
        _disparity_by_region,
        "Visible: neither hidden in the right view nor beside it; edge: within 4 px of a step of the true "
        "disparity of more than 3 px; flat: the rest.",
    ),
    _Details(
        "Boundaries, dense truth",
        {"f1": "boundary F1", "dbe_acc": "ε acc px", "dbe_comp": "ε comp px"},
        lambda name, record: (record.get("boundaries") or {}).get(name),
        "F1 as Depth Pro defines it, higher is better; distances of depth boundaries as iBims-1 does.",
    ),
    _Details(
        "AUSE",
        {"uncertainty": "uncertainty", "ause": "confidence", "random": "random order"},
        _ause,
        "Area under the sparsification error of AbsRel; 0 where the least certain pixels are the worst. An "
        "ensemble of at least 2 has an uncertainty.",
    ),
)


def regions_table(records: Sequence[Record]) -> Table:
    """AbsRel by what the right camera sees, by matches and material, and for each class that occurs."""
    classes = sorted({name for r in records for name in r.get("regions") or {} if name.startswith("mat")})
    more = {name: name.replace("material_", "class ") for name in classes}
    return _REGIONS.table(records, {**_REGIONS.columns, **more})


def details_tables(records: Sequence[Record]) -> list[Table]:
    """Regions, disparity, boundaries and AUSE, as far as there are numbers."""
    return [regions_table(records), *(details.table(records) for details in _DETAILS)]


def confidence_table(records: Sequence[Record]) -> Table:
    """What the confidence of each method promises by decile, and what it keeps; pairs weigh the same."""
    rows = []
    deciles_of: Any = by_method(records, lambda record: record.get("confidence"))
    for method, own in deciles_of.items():
        for k in range(10):
            filled = [deciles[k] for deciles in own.values() if deciles[k]["share"]]
            weight = sum(part["share"] for part in filled)
            if filled:
                names = ("promised", "kept", "abs_rel")
                means = [sum(part[n] * part["share"] for part in filled) / weight for n in names]
                name, share = f"{k / 10:.1f} to {(k + 1) / 10:.1f}", cell(weight / len(own))
                rows.append((find_method(method).title, name, share, *map(cell, means)))
    note = f"Confidence is the probability of a relative error below {RIGHT_WITHIN:g}; pixels of all pairs."
    header = ("method", "confidence", "share of pixels", "promised", "kept", "AbsRel")
    return Table("Confidence by decile", header, tuple(rows), note)


def _families(records: Sequence[Record]) -> dict[str, list[str]]:
    """``METHOD`` -> its name and those of its ``METHOD#SEED``, for every method that was run unbound."""
    names = list(dict.fromkeys(record["method"] for record in records))
    families = {name: [name] for name in names if find_method(name).seed is None}
    for name in names:
        method = find_method(name)
        if method.seed is not None and method.seedless_name in families:
            families[method.seedless_name].append(name)
    return families


def without_copies(records: Sequence[Record]) -> list[Record]:
    """The records but for those of ``METHOD#SEED`` where ``METHOD`` itself was run."""
    copies = {name for family in _families(records).values() for name in family[1:]}
    return [record for record in records if record["method"] not in copies]


def spread_table(records: Sequence[Record]) -> Table:
    """Mean AbsRel of each method over the seeds that it was run with; no rows where that is one.

    A row per method and group. A mean stands only where every seed has a number for every pair of the group;
    the largest spread is over the pairs that every seed has a number for.
    """
    values, rows, rules = by_method(records, headline), list[tuple[str, ...]](), list[int]()
    families = {name: family for name, family in _families(records).items() if len(family) > 1}
    for name, family in families.items():
        seeds = [values[copy] for copy in family]
        rules.append(len(rows))
        for group, members in groups_of(records).items():
            shared = [x for x in seeds[0] if x in members and all(x in own for own in seeds)]
            if not shared:
                continue
            errors = np.array([[own[label] for label in shared] for own in seeds])  # (seeds, pairs)
            means, spread = errors.mean(axis=1), np.ptp(errors, axis=0)
            over_seeds = (means.mean(), means.std(ddof=1), means.min(), means.max())
            cells = [cell(float(v) if len(shared) == len(members) else None, 4) for v in over_seeds]
            pair = cell(float(spread.max()), 4), shared[int(spread.argmax())]
            rows.append((find_method(name).title, group, *cells, *pair))
    header = ("method", "AbsRel of", "mean", "deviation", "least", "largest", "spread of a pair", "that pair")
    note = (
        "All pixels, as in the first table. Over the seeds: mean, standard deviation (n - 1), least and "
        "largest of the mean of these pairs; then the greatest difference between two seeds on one pair."
    )
    count = max(map(len, families.values()), default=1)
    return Table(f"Spread over {count} seeds", header, tuple(rows), note, rules=tuple(rules))


def pairs_tables(records: Sequence[Record], reference: str = "guided") -> list[Table]:
    """The tables of ``geodiff eval pairs``.

    Args:
        records: of a run; further seeds of a method in it count in the table of their spread only.
        reference: the method that the others are compared with.
    """
    spread, records = spread_table(records), without_copies(records)
    title = f"AbsRel of {count_of_pairs(len({label_of(record) for record in records}))}"
    note = (
        "All pixels with truth, no cap; metres as they come out, not aligned, except in the columns of "
        "methods that know relative depth only ('oracle'), which get scale and shift from the truth."
    )
    tables = [per_pair_table(records, title, headline, 3, note)]
    tables.append(per_pair_table(records, "Seconds", seconds_of, 1, ""))
    if any(record["method"] == reference for record in records):
        tables.append(versus_table(records, reference))
    groups = groups_of(records).items()
    tables += [summary_table(records, members, f"All metrics, {group}") for group, members in groups]
    tables += [*details_tables(records), confidence_table(records), spread]
    return [table for table in tables if table.rows]
