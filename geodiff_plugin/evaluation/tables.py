"""Tables in Markdown, LaTeX and JSON: means with intervals, and those of a comparison of methods."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.jobs.journal import Record
from geodiff_plugin.result.confidence import RIGHT_WITHIN

#: Below this number of images there is no interval: resampling four values says nothing.
FEWEST_FOR_INTERVAL = 5
#: Column headings of the depth metrics, by their names in a record.
HEADINGS = {"abs_rel": "AbsRel", "delta1": "δ1", "delta2": "δ2", "delta3": "δ3"}
HEADINGS |= {"rmse": "RMSE m", "log_rmse": "log RMSE", "silog": "SILog"}

#: What LaTeX reads as a command, or lacks.
_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {character: f"\\{character}" for character in "_%&#${}"}
_LATEX |= {"<": "$<$", ">": "$>$", "|": "$|$", "δ": r"$\delta$", "γ": r"$\gamma$", "ε": r"$\epsilon$"}
_LATEX |= {"±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "†": r"$^\dagger$"}
_LATEX |= {"✓": r"$\checkmark$", "✗": r"$\times$", "×": r"$\times$"}

ValueOf = Callable[[Record], float | None]
#: Records of one row -> what stands in a column.
CellOf = Callable[[list[Record]], str]
#: Method -> label of the pair -> a number.
Values = dict[str, dict[str, float]]
#: Heading and records of a column; numbers of all pairs and digits -> their mean.
Columns = Iterable[tuple[str, Sequence[Record]]]
MeanOf = Callable[[list[float | None], int], str]


@dataclass(frozen=True)
class Mean:
    """A mean of ``count`` numbers, NaN of none, with an interval from ``FEWEST_FOR_INTERVAL`` on."""

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


def mean_with_interval(values: Iterable[float | None]) -> Mean:
    """Mean of the numbers that there are, with a seeded 95 % percentile-bootstrap interval."""
    data = np.array([value for value in values if value is not None], np.float64)
    mean = float(data.mean()) if data.size else float("nan")
    if data.size < FEWEST_FOR_INTERVAL:
        return Mean(mean, None, None, data.size)
    picks = np.random.default_rng(0).integers(0, data.size, (2000, data.size))
    low, high = np.quantile(data[picks].mean(axis=1), [0.025, 0.975])
    return Mean(mean, float(low), float(high), data.size)


def paired_difference(first: Mapping[str, float], second: Mapping[str, float]) -> Mean:
    """Mean of ``first - second`` over the images that both have; an interval without 0 tells them apart."""
    return mean_with_interval([first[name] - second[name] for name in first if name in second])


def cell(value: float | None, digits: int = 3) -> str:
    """A number, or a dash for ``None``."""
    return "-" if value is None else f"{value:.{digits}f}"


def mean_cell(values: Iterable[float | None], digits: int = 3) -> str:
    """The mean of the numbers that there are, without ``None`` and NaN; a dash where there are none."""
    known = [value for value in values if value is not None and value == value]
    return cell(float(np.mean(known)) if known else None, digits)


@dataclass(frozen=True)
class Table:
    """Cells as they are printed; ``groups`` are ``(heading, number of columns)`` over the whole header."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    groups: tuple[tuple[str, int], ...] = ()

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
        """A ``tabular`` for booktabs, its title as a comment."""
        escapes = str.maketrans(_LATEX)
        cells = [[cell.translate(escapes) for cell in row] for row in (self.header, *self.rows)]
        header, *rows = (" & ".join(row) + r" \\" for row in cells)
        groups = [rf"\multicolumn{{{n}}}{{c}}{{{name.translate(escapes)}}}" for name, n in self.groups]
        lines = [f"% {self.title}", rf"\begin{{tabular}}{{l{'r' * (len(self.header) - 1)}}}", r"\toprule"]
        lines += [" & ".join(groups) + r" \\"] if groups else []
        return "\n".join([*lines, header, r"\midrule", *rows, r"\bottomrule", r"\end{tabular}"]) + "\n"


def grouped(records: Iterable[Record], *names: str) -> dict[Any, list[Record]]:
    """Records by the values of some entries, in the order in which these occur."""
    groups: dict[Any, list[Record]] = {}
    for record in records:
        groups.setdefault(itemgetter(*names)(record), []).append(record)
    return groups


def table_of_groups(
    title: str, records: Iterable[Record], names: Sequence[str], columns: Mapping[str, CellOf], note: str = ""
) -> Table:
    """A row for all values of the entries ``names``, with a cell of its records under each heading."""
    groups = grouped(records, *names).values()
    rows = tuple(tuple(cell_of(group) for cell_of in columns.values()) for group in groups)
    return Table(title, tuple(columns), rows, note)


def value_at(record: Record, path: str) -> Any:
    """``capped.raw.abs_rel`` of a record; ``None`` where any part of it is not there."""
    value: Any = record
    for name in path.split("."):
        value = (value or {}).get(name)
    return value


def mean_of(path: str, digits: int = 3, factor: float = 1.0) -> CellOf:
    """A column: the mean of an entry of the records that have it."""
    return lambda rows: mean_cell([factor * v for r in rows if (v := value_at(r, path)) is not None], digits)


def most_of(name: str, digits: int = 3) -> CellOf:
    """A column: the largest value of an entry of the records."""
    return lambda group: cell(max(record[name] for record in group), digits)


def method_title(group: Sequence[Record]) -> str:
    """A column: the title of the method."""
    return find_method(group[0]["method"]).title


def label_of(record: Record) -> str:
    """``dataset/sample`` of a record."""
    return f"{record['dataset']}/{record['sample']}"


def count_of_pairs(count: int, kind: str = "") -> str:
    """``"1 pair"``, ``"5 posed pairs"``."""
    return f"{count} {kind}{'pair' if count == 1 else 'pairs'}"


def pairs_of(records: Iterable[Record]) -> str:
    """How many pairs the records are of, in words."""
    return count_of_pairs(len({label_of(record) for record in records}))


def headline(record: Record) -> float | None:
    """AbsRel over all pixels with truth: not aligned, or aligned for a method without metres."""
    if record["status"] != "ok":
        return None
    both = record["all_pixels"]
    return (both["raw"] or both["aligned"])["abs_rel"]


def by_method(records: Sequence[Record], value_of: Callable[[Record], Any]) -> dict[str, dict[str, Any]]:
    """``method -> label -> value`` over the finished records that have one."""
    values: dict[str, dict[str, Any]] = {}
    for method, group in grouped(records, "method").items():
        known = {label_of(record): value_of(record) for record in group if record["status"] == "ok"}
        values[method] = {label: value for label, value in known.items() if value is not None}
    return values


def metric_values(records: Sequence[Record], alignment: str, metric: str) -> Values:
    """Method -> label -> one metric under the cap, raw or aligned."""
    return by_method(records, lambda record: value_at(record, f"capped.{alignment}.{metric}"))


def groups_of(records: Sequence[Record]) -> dict[str, set[str]]:
    """Labels of all samples, and of the rectified and the posed ones where both kinds are there."""
    kinds = (("rectified ", True), ("posed ", False))
    labels = {name: {label_of(r) for r in records if r.get("rectified") is kind} for name, kind in kinds}
    groups = {"": set().union(*labels.values())} | (labels if all(labels.values()) else {})
    return {count_of_pairs(len(members), kind): members for kind, members in groups.items()}


def whole_mean(values: list[float | None], digits: int = 3) -> str:
    """The mean over pairs, a dash unless every one of them has a number."""
    return mean_cell(() if None in values else values, digits)


def per_pair_table(
    title: str, columns: Columns, value_of: ValueOf, digits: int, note: str = "", mean: MeanOf = whole_mean
) -> Table:
    """One row per sample, one column of records each, then the means of every group."""
    header, records_of = zip(*columns, strict=True)
    values = [{label_of(record): value_of(record) for record in column} for column in records_of]
    every = list(chain(*records_of))
    labels = dict.fromkeys(map(label_of, every))
    rows = [(label, *(cell(column.get(label), digits) for column in values)) for label in labels]
    for group, members in groups_of(every).items():
        if members:
            means = (mean([column.get(label) for label in members], digits) for column in values)
            rows.append((f"mean of {group}", *means))
    return Table(title, ("pair", *header), tuple(rows), note)


def method_columns(records: Sequence[Record]) -> list[tuple[str, list[Record]]]:
    """Heading and records of each method; without metres it needs an oracle, which the heading says."""
    columns = []
    for group in grouped(records, "method").values():
        title, raw = method_title(group), [r["all_pixels"]["raw"] for r in group if r["status"] == "ok"]
        relative = raw and not any(raw) and "oracle" not in title
        columns.append((f"{title} + oracle" if relative else title, group))
    return columns


def summary_table(records: Sequence[Record], members: Collection[str], title: str) -> Table:
    """Mean over some samples and its interval of every metric, a row per method as is and one aligned."""
    scores = [
        {"method": method, "suffix": suffix} | record["capped"][kind]
        for method, group in grouped(records, "method").items()
        for kind, suffix in (("raw", ""), ("aligned", ", aligned"))
        for record in group
        if record["status"] == "ok" and label_of(record) in members and record["capped"][kind]
    ]

    def with_interval(name: str) -> CellOf:
        return lambda group: mean_with_interval([record[name] for record in group]).cell()

    columns: dict[str, CellOf] = {"method": lambda group: method_title(group) + group[0]["suffix"]}
    columns |= {"pairs": lambda group: str(len(group))}
    columns |= {heading: with_interval(name) for name, heading in HEADINGS.items()}
    columns |= {"coverage": mean_of("coverage")}
    note = "Capped at 80 m for KITTI and 10 m for Booster; mean [95 %]."
    return table_of_groups(title, scores, ("method", "suffix"), columns, note)


def versus_table(records: Sequence[Record], reference: str) -> Table:
    """Paired differences in AbsRel, all pixels, as ``headline``: the reference minus each other method."""
    others, rows = by_method(records, headline), []
    values, title = others.pop(reference, {}), find_method(reference).title
    for method, other in others.items():
        difference = paired_difference(values, other)
        if difference.count:
            won = f"{sum(values[x] < other[x] for x in values if x in other)} of {difference.count}"
            rows.append((find_method(method).title, str(difference.count), difference.cell(sign="+"), won))
    header = ("method", "pairs", "mean difference [95 %]", "pairs won")
    note = "Negative: smaller error than the other method. An interval without 0 tells the two apart."
    return Table(f"{title} against each other method, AbsRel", header, tuple(rows), note)


_DISPARITY = {"epe": "EPE px", "bad1": "bad-1", "bad2": "bad-2", "bad3": "bad-3", "d1": "D1"}
_BY_REGION = {
    f"{region}.{name}": f"{region}, {heading}"
    for region in ("visible", "edge", "flat")
    for name, heading in _DISPARITY.items()
    if name != "bad3"
}
REGIONS = "AbsRel by region and material"


class Details(NamedTuple):
    """A table of details: how the paths of its numbers in a record begin, a heading each, its note."""

    where: str
    headings: dict[str, str]
    note: str


DETAILS: dict[str, Details] = {
    REGIONS: Details(
        "regions.",
        {
            **{"visible": "visible", "occluded": "occluded", "out_of_view": "out of view"},
            **{"matched": "matched", "unmatched": "unmatched", "tom": "ToM", "not_tom": "other material"},
        },
        "Under the cap; aligned for methods that know relative depth only. Visible and occluded are known "
        "where the data set has a mask, out of view always; matched is where our sweep of both views has a "
        "match of confidence 0.5 or more, the same pixels for every method; ToM is transparent or mirror "
        "(classes 2, 3).",
    ),
    "Disparity, rectified pairs": Details(
        "disparity.",
        _DISPARITY,
        "Metres turned into disparity at the left image's resolution; shares of pixels for bad-k and D1, "
        "a dash where the truth's step is coarser than the threshold.",
    ),
    "Disparity by region, rectified pairs": Details(
        "disparity.regions.",
        _BY_REGION,
        "Visible: neither hidden in the right view nor beside it; edge: within 4 px of a step of the true "
        "disparity of more than 3 px; flat: the rest.",
    ),
    "Boundaries, dense truth": Details(
        "boundaries.",
        {"f1": "boundary F1", "dbe_acc": "ε acc px", "dbe_comp": "ε comp px"},
        "F1 as Depth Pro defines it, higher is better; distances of depth boundaries as iBims-1 does.",
    ),
    "AUSE": Details(
        "ause",
        {"": "uncertainty", "_confidence.ause": "confidence", "_confidence.random": "random order"},
        "Area under the sparsification error of AbsRel; 0 where the least certain pixels are the worst. An "
        "ensemble of at least 2 has an uncertainty.",
    ),
}


def details_table(records: Sequence[Record], title: str) -> Table:
    """A row per method with a value: the mean of each quantity over the pairs that have it."""
    where, headings, note = DETAILS[title]
    done = [record for record in records if record["status"] == "ok"]
    if title == REGIONS:
        classes = sorted({name for r in done for name in r["regions"] if name.startswith("material_")})
        headings = headings | {name: name.replace("material_", "class ") for name in classes}
    columns: dict[str, CellOf] = {"method": method_title}
    for name, heading in headings.items():
        count = len({label_of(record) for record in done if value_at(record, where + name) is not None})
        columns[f"{heading} ({count_of_pairs(count)})" if count else heading] = mean_of(where + name)
    table = table_of_groups(title, done, ("method",), columns, note)
    return replace(table, rows=tuple(row for row in table.rows if set(row[1:]) != {"-"}))


def confidence_table(records: Sequence[Record]) -> Table:
    """What the confidence of each method promises by decile, and what it keeps; pairs weigh the same."""
    rows = []
    for method, deciles_of in by_method(records, lambda record: record.get("confidence")).items():
        for k, parts in enumerate(zip(*deciles_of.values(), strict=True)):
            shares = np.array([part["share"] for part in parts])
            if shares.any():
                values = [[part[name] or 0.0 for part in parts] for name in ("promised", "kept", "abs_rel")]
                means = (np.array(values) @ shares) / shares.sum()
                name = f"{k / 10:.1f} to {(k + 1) / 10:.1f}"
                rows.append((find_method(method).title, name, cell(shares.mean()), *map(cell, means)))
    note = f"Confidence is the probability of a relative error below {RIGHT_WITHIN:g}; pixels of all pairs."
    header = ("method", "confidence", "share of pixels", "promised", "kept", "AbsRel")
    return Table("Confidence by decile", header, tuple(rows), note)


def pairs_tables(records: Sequence[Record], reference: str = "guided") -> list[Table]:
    """The tables of ``geodiff eval pairs``."""
    note = (
        "All pixels with truth, no cap; metres as they come out, not aligned, except in the columns of "
        "methods that know relative depth only ('oracle'), which get scale and shift from the truth."
    )
    columns = method_columns(records)
    return [
        per_pair_table(f"AbsRel of {pairs_of(records)}", columns, headline, 3, note),
        per_pair_table("Seconds", columns, lambda record: record.get("seconds"), 1),
        *([versus_table(records, reference)] if any(r["method"] == reference for r in records) else []),
        *(summary_table(records, labels, f"All metrics, {g}") for g, labels in groups_of(records).items()),
        *(details_table(records, title) for title in DETAILS),
        confidence_table(records),
    ]
