"""Tables in Markdown, LaTeX and JSON: means with intervals, and comparisons of methods."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.datasets.splits import TITLES, split_of
from geodiff_plugin.jobs import Record
from geodiff_plugin.result.confidence import RIGHT_WITHIN

#: Minimum number of images for an interval: resampling fewer values is meaningless.
MIN_IMAGES_FOR_INTERVAL = 5
#: Column headings of the depth metrics by their names in a record.
HEADINGS = {"abs_rel": "AbsRel", "delta1": "δ1", "delta2": "δ2", "delta3": "δ3"}
HEADINGS |= {"rmse": "RMSE m", "log_rmse": "log RMSE", "silog": "SILog"}

#: Characters that LaTeX interprets as commands, or lacks.
_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {character: f"\\{character}" for character in "_%&#${}"}
_LATEX |= {"<": "$<$", ">": "$>$", "|": "$|$", "δ": r"$\delta$", "γ": r"$\gamma$", "ε": r"$\epsilon$"}
_LATEX |= {"±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "†": r"$^\dagger$"}
_LATEX |= {"✓": r"$\checkmark$", "✗": r"$\times$", "×": r"$\times$"}

ValueOf = Callable[[Record], float | None]
#: Function from the records of a row to a cell.
CellOf = Callable[[list[Record]], str]
#: Method -> label of the pair -> value.
Values = dict[str, dict[str, float]]
#: Columns: heading and records.
Columns = Iterable[tuple[str, Sequence[Record]]]
MeanOf = Callable[[list[float | None], int], str]


@dataclass(frozen=True)
class Mean:
    """A mean of ``count`` numbers (NaN if none), with an interval from ``MIN_IMAGES_FOR_INTERVAL`` on."""

    value: float
    low: float | None
    high: float | None
    count: int

    def cell(self, digits: int = 3, sign: str = "") -> str:
        """Format the mean with its interval, if any; a dash for no values."""
        if self.count == 0:
            return "-"
        value, low, high = (f"{n or 0.0:{sign}.{digits}f}" for n in (self.value, self.low, self.high))
        return value if self.low is None else f"{value} [{low}, {high}]"


def mean_with_interval(values: Iterable[float | None]) -> Mean:
    """Return the mean of the available numbers, with a seeded 95 % percentile-bootstrap interval."""
    data = np.array([value for value in values if value is not None], np.float64)
    mean = float(data.mean()) if data.size else float("nan")
    if data.size < MIN_IMAGES_FOR_INTERVAL:
        return Mean(mean, None, None, data.size)
    picks = np.random.default_rng(0).integers(0, data.size, (2000, data.size))
    low, high = np.quantile(data[picks].mean(axis=1), [0.025, 0.975])
    return Mean(mean, float(low), float(high), data.size)


def paired_difference(first: Mapping[str, float], second: Mapping[str, float]) -> Mean:
    """Mean of ``first - second`` over common images; significant if the interval excludes 0."""
    return mean_with_interval([first[name] - second[name] for name in first if name in second])


def cell(value: float | None, digits: int = 3) -> str:
    """Format a number, or a dash for ``None``."""
    return "-" if value is None else f"{value:.{digits}f}"


def mean_cell(values: Iterable[float | None], digits: int = 3) -> str:
    """Format the mean of the available numbers, without ``None`` and NaN; a dash if there are none."""
    known = [value for value in values if value is not None and value == value]
    return cell(float(np.mean(known)) if known else None, digits)


@dataclass(frozen=True)
class Table:
    """Cells as printed; ``groups`` are ``(heading, number of columns)`` above the whole header."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    groups: tuple[tuple[str, int], ...] = ()

    def full_header(self) -> tuple[str, ...]:
        """Return column headings in one line each, prefixed with their group."""
        groups = [heading for heading, count in self.groups for _ in range(count)] or [""] * len(self.header)
        return tuple(f"{g}: {name}" if g else name for g, name in zip(groups, self.header, strict=True))

    def markdown(self) -> str:
        """Return a heading, the note and a pipe table; group headings are merged into the header line."""
        lines = [f"## {self.title}", "", *([self.note, ""] if self.note else [])]
        cells = [[cell.replace("|", r"\|") for cell in row] for row in (self.full_header(), *self.rows)]
        rows = [f"| {' | '.join(row)} |" for row in cells]
        lines += [rows[0], "| --- |" + " ---: |" * (len(self.header) - 1), *rows[1:]]
        return "\n".join(lines) + "\n"

    def latex(self) -> str:
        """Return a ``tabular`` for booktabs, with its title as a comment."""
        escapes = str.maketrans(_LATEX)
        cells = [[cell.translate(escapes) for cell in row] for row in (self.header, *self.rows)]
        header, *rows = (" & ".join(row) + r" \\" for row in cells)
        groups = [rf"\multicolumn{{{n}}}{{c}}{{{name.translate(escapes)}}}" for name, n in self.groups]
        lines = [f"% {self.title}", rf"\begin{{tabular}}{{l{'r' * (len(self.header) - 1)}}}", r"\toprule"]
        lines += [" & ".join(groups) + r" \\"] if groups else []
        return "\n".join([*lines, header, r"\midrule", *rows, r"\bottomrule", r"\end{tabular}"]) + "\n"


def grouped(records: Iterable[Record], *names: str) -> dict[Any, list[Record]]:
    """Group records by the values of some entries, in order of occurrence."""
    groups: dict[Any, list[Record]] = {}
    for record in records:
        groups.setdefault(itemgetter(*names)(record), []).append(record)
    return groups


def table_of_groups(
    title: str, records: Iterable[Record], names: Sequence[str], columns: Mapping[str, CellOf], note: str = ""
) -> Table:
    """Return a table with a row per combination of the entries ``names``, and a cell per heading."""
    groups = grouped(records, *names).values()
    rows = tuple(tuple(cell_of(group) for cell_of in columns.values()) for group in groups)
    return Table(title, tuple(columns), rows, note)


def value_at(record: Record, path: str) -> Any:
    """Return the value at ``capped.raw.abs_rel`` in a record; ``None`` if any part is missing."""
    value: Any = record
    for name in path.split("."):
        value = (value or {}).get(name)
    return value


def mean_of(path: str, digits: int = 3, factor: float = 1.0) -> CellOf:
    """Column function: the mean of an entry of the records that have it."""
    return lambda rows: mean_cell([factor * v for r in rows if (v := value_at(r, path)) is not None], digits)


def max_of(name: str, digits: int = 3) -> CellOf:
    """Column function: the maximum of an entry of the records."""
    return lambda group: cell(max(record[name] for record in group), digits)


def method_title(group: Sequence[Record]) -> str:
    """Column function: the title of the method."""
    return find_method(group[0]["method"]).title


def label_of(record: Record) -> str:
    """Return ``dataset/sample`` of a record."""
    return f"{record['dataset']}/{record['sample']}"


def count_of_pairs(count: int, kind: str = "") -> str:
    """Format ``"1 pair"``, ``"5 posed pairs"``."""
    return f"{count} {kind}{'pair' if count == 1 else 'pairs'}"


def pairs_of(records: Iterable[Record]) -> str:
    """Format the number of pairs of the records."""
    return count_of_pairs(len({label_of(record) for record in records}))


def headline(record: Record) -> float | None:
    """Return AbsRel over all pixels with ground truth: unaligned, or aligned for relative methods."""
    if record["status"] != "ok":
        return None
    both = record["all_pixels"]
    return (both["raw"] or both["aligned"])["abs_rel"]


def by_method(records: Sequence[Record], value_of: Callable[[Record], Any]) -> dict[str, dict[str, Any]]:
    """Return ``method -> label -> value`` over finished records that have a value."""
    values: dict[str, dict[str, Any]] = {}
    for method, group in grouped(records, "method").items():
        known = {label_of(record): value_of(record) for record in group if record["status"] == "ok"}
        values[method] = {label: value for label, value in known.items() if value is not None}
    return values


def metric_values(records: Sequence[Record], alignment: str, metric: str) -> Values:
    """Return method -> label -> one metric under the cap, raw or aligned."""
    return by_method(records, lambda record: value_at(record, f"capped.{alignment}.{metric}"))


def groups_of(records: Sequence[Record]) -> dict[str, list[str]]:
    """Return labels of all samples in order of occurrence, and of rectified and posed ones if both occur.

    The order matters: the resampled images of an interval depend on it.
    """
    by_kind: dict[str, list[str]] = {}
    for kind, is_rectified in (("rectified ", True), ("posed ", False)):
        labels = (label_of(record) for record in records if record.get("rectified") is is_rectified)
        by_kind[kind] = list(dict.fromkeys(labels))
    either = {label for labels in by_kind.values() for label in labels}
    everything = [label for label in dict.fromkeys(map(label_of, records)) if label in either]
    groups = {"": everything} | (by_kind if all(by_kind.values()) else {})
    return {count_of_pairs(len(members), kind): members for kind, members in groups.items()}


def whole_mean(values: list[float | None], digits: int = 3) -> str:
    """Format the mean over pairs, a dash unless all of them have a value."""
    return mean_cell(() if None in values else values, digits)


def per_pair_table(
    title: str, columns: Columns, value_of: ValueOf, digits: int, note: str = "", mean: MeanOf = whole_mean
) -> Table:
    """Return a row per sample, a column per group of records, then the means of each group of samples."""
    headings = []
    all_records: list[Record] = []
    values_of_columns = []
    for heading, records in columns:
        headings.append(heading)
        all_records += records
        values_of_columns.append({label_of(record): value_of(record) for record in records})
    rows = [
        (label, *(cell(values.get(label), digits) for values in values_of_columns))
        for label in dict.fromkeys(map(label_of, all_records))
    ]
    for group, members in groups_of(all_records).items():
        if members:
            means = (mean([values.get(label) for label in members], digits) for values in values_of_columns)
            rows.append((f"mean of {group}", *means))
    return Table(title, ("pair", *headings), tuple(rows), note)


def method_columns(records: Sequence[Record]) -> list[tuple[str, list[Record]]]:
    """Return heading and records of each method; relative methods are marked as using an oracle."""
    columns = []
    for group in grouped(records, "method").values():
        title = method_title(group)
        raw = [r["all_pixels"]["raw"] for r in group if r["status"] == "ok"]
        relative = raw and not any(raw) and "oracle" not in title
        columns.append((f"{title} + oracle" if relative else title, group))
    return columns


def summary_table(records: Sequence[Record], members: Collection[str], title: str) -> Table:
    """Return mean and interval of all metrics over some samples, a raw and an aligned row per method."""
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


def _counted(text: str, count: int, total: int) -> str:
    """Append how many of ``total`` values a cell is made of, if not all."""
    return text if count in (0, total) else f"{text} ({count} of {total})"


def _mean_and_median(values: Mapping[str, float], members: Collection[str]) -> tuple[str, str]:
    """Format mean with interval and median over the members that have a value."""
    known = [values[label] for label in members if label in values]
    median = cell(float(np.median(known)) if known else None)
    return _counted(mean_with_interval(known).cell(), len(known), len(members)), median


def _percentage(path: str, digits: int) -> CellOf:
    """Column function: the mean of an entry in per cent, over the records that have it."""

    def cell_of(group: list[Record]) -> str:
        known = [100 * value for record in group if (value := value_at(record, path)) is not None]
        return _counted(mean_cell(known, digits), len(known), len(group))

    return cell_of


def split_tables(records: Sequence[Record]) -> list[Table]:
    """Return a table per split with AbsRel of each method; none for a split without records."""
    shown = []
    for split, title in TITLES.items():
        listed = [r for r in records if split_of(r["dataset"], r["sample"]) == split]
        groups = groups_of(listed)
        rows = [
            (find_method(method).title, *chain(*(_mean_and_median(values, m) for m in groups.values())))
            for method, values in by_method(listed, headline).items()
        ]
        headings = (("", 1), *((name, 2) for name in groups))
        header = ("method", *("mean [95 %]", "median") * len(groups))
        note = "AbsRel of all pixels with ground truth, without alignment except for relative methods."
        shown.append(Table(f"{pairs_of(listed)} {title}", header, tuple(rows), note, headings))
    return [table for table in shown if table.rows]


def benchmark_tables(records: Sequence[Record]) -> list[Table]:
    """Return the metrics of the datasets' own benchmarks, for rectified and for posed pairs."""
    done = [record for record in records if record["status"] == "ok" and record["all_pixels"]["raw"]]
    columns: dict[str, CellOf] = {"dataset": lambda group: group[0]["dataset"], "method": method_title}
    columns |= {"pairs": lambda group: str(len(group)), "AbsRel": mean_of("all_pixels.raw.abs_rel")}
    bad: dict[str, CellOf] = {
        "bad": lambda group: f"> {group[0]['benchmark']['bad_px']:g} px",
        "all, %": _percentage("benchmark.all", 2),
        "noc, %": _percentage("benchmark.noc", 2),
    }
    near: dict[str, CellOf] = {"inliers 1.03, %": _percentage("all_pixels.raw.inliers", 1)}
    rectified = [record for record in done if record.get("benchmark")]
    posed = [record for record in done if record.get("rectified") is False]
    by = ("dataset", "method")
    title = "Metrics of the datasets' benchmarks"
    return [
        table_of_groups(f"{title}, rectified pairs", rectified, by, columns | bad, _BAD_NOTE),
        table_of_groups(f"{title}, posed pairs", posed, by, columns | near, _NEAR_NOTE),
    ]


def versus_table(records: Sequence[Record], reference: str) -> Table:
    """Return paired differences in AbsRel over all pixels, as ``headline``: reference minus each method."""
    others = by_method(records, headline)
    rows = []
    values = others.pop(reference, {})
    title = find_method(reference).title
    for method, other in others.items():
        difference = paired_difference(values, other)
        if difference.count:
            won = f"{sum(values[x] < other[x] for x in values if x in other)} of {difference.count}"
            rows.append((find_method(method).title, str(difference.count), difference.cell(sign="+"), won))
    header = ("method", "pairs", "mean difference [95 %]", "pairs won")
    note = "Negative: smaller error than the other method. Significant if the interval excludes 0."
    return Table(f"{title} against each other method, AbsRel", header, tuple(rows), note)


_DISPARITY = {"epe": "EPE px", "bad1": "bad-1", "bad2": "bad-2", "bad3": "bad-3", "d1": "D1"}
_BY_REGION = {
    f"{region}.{name}": f"{region}, {heading}"
    for region in ("visible", "edge", "flat")
    for name, heading in _DISPARITY.items()
    if name != "bad3"
}
REGIONS = "AbsRel by region and material"


_BAD_NOTE = (
    "Fraction of pixels with a disparity error above the threshold, at the resolution of the files. "
    "A hole is an error. All: pixels with ground truth. Noc: without pixels that the dataset marks as "
    "occluded (disp_noc, mask0nocc.png, or the right view's disparities). A dash: no "
    "file with that information."
)
_NEAR_NOTE = (
    "Metres, without alignment. Inliers: depths within 3 % of the ground truth, as in the Robust Multi-View "
    "Depth Benchmark."
)


class Details(NamedTuple):
    """A table of details: prefixes of its values in a record, a heading each, and its note."""

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
        "Under the cap; aligned for methods with relative depth only. Visible and occluded need a mask of "
        "the dataset, out of view does not. Matched: our plane sweep of both views has a match with a "
        "confidence of at least 0.5; the same pixels for every method. ToM: transparent or mirror (classes "
        "2, 3).",
    ),
    "Disparity, rectified pairs": Details(
        "disparity.",
        _DISPARITY,
        "Metres converted to disparity at the left image's resolution. bad-k and D1 are fractions of "
        "pixels; a dash if the ground truth is quantized more coarsely than the threshold.",
    ),
    "Disparity by region, rectified pairs": Details(
        "disparity.regions.",
        _BY_REGION,
        "Visible: neither occluded in the right view nor outside it; edge: within 4 px of a ground-truth "
        "disparity step of more than 3 px; flat: the rest.",
    ),
    "Boundaries, dense ground truth": Details(
        "boundaries.",
        {"f1": "boundary F1", "dbe_acc": "ε acc px", "dbe_comp": "ε comp px"},
        "Boundary F1 of Depth Pro, higher is better; depth boundary errors of iBims-1.",
    ),
    "AUSE": Details(
        "ause",
        {"": "uncertainty", "_confidence.ause": "confidence", "_confidence.random": "random order"},
        "Area under the sparsification error of AbsRel; 0 if the least certain pixels have the largest "
        "errors. Uncertainty needs an ensemble of at least 2.",
    ),
}


def details_table(records: Sequence[Record], title: str) -> Table:
    """Return a row per method with a value: the mean of each quantity over pairs that have it."""
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
    """Compare predicted confidence with observed accuracy by decile; pairs have equal weights."""
    rows = []
    for method, deciles_of in by_method(records, lambda record: record.get("confidence")).items():
        for k, parts in enumerate(zip(*deciles_of.values(), strict=True)):
            fractions = np.array([part["fraction"] for part in parts])
            if fractions.any():
                values = [
                    [part[name] or 0.0 for part in parts] for name in ("predicted", "observed", "abs_rel")
                ]
                means = (np.array(values) @ fractions) / fractions.sum()
                name = f"{k / 10:.1f} to {(k + 1) / 10:.1f}"
                rows.append((find_method(method).title, name, cell(fractions.mean()), *map(cell, means)))
    note = (
        f"Confidence is the probability of a relative error below {RIGHT_WITHIN:g}, if the calibration is "
        "correct; pixels of all pairs."
    )
    header = ("method", "confidence", "fraction of pixels", "predicted", "observed", "AbsRel")
    return Table("Confidence by decile", header, tuple(rows), note)


#: Coverages in percent of the columns of ``risk_table``.
COVERAGES = (100, 90, 75, 50, 25)


def mean_risk(records: Sequence[Record]) -> dict[str, dict[str, np.ndarray]]:
    """Return the risk-coverage curves of each method with confidence, averaged over its pairs.

    ``risk`` and ``oracle`` ``(steps,)`` are at coverages from 1 down to 1 / steps.
    """
    curves = by_method(records, lambda record: record.get("risk_coverage"))
    return {
        method: {
            name: np.mean([curve[name] for curve in of_pairs.values()], axis=0) for name in ("risk", "oracle")
        }
        for method, of_pairs in curves.items()
        if of_pairs
    }


def risk_table(records: Sequence[Record]) -> Table:
    """Show the AbsRel of the most confident pixels by coverage; pairs have equal weights."""
    rows = []
    for method, curves in mean_risk(records).items():
        for name, order in (("risk", "confidence"), ("oracle", "error (best possible)")):
            risk = curves[name]
            steps = len(curves[name])
            cells = [cell(risk[steps - round(steps * percent / 100)]) for percent in COVERAGES]
            area = cell(float(np.mean(risk - curves["oracle"])))
            rows.append((find_method(method).title, order, *cells, area))
    note = (
        "AbsRel of the pixels that remain if only the most confident ones are kept. Confidence is useful if "
        "it falls towards the right. AUSE is the area between both curves of a method."
    )
    header = ("method", "pixels ordered by", *(f"best {percent} %" for percent in COVERAGES), "AUSE")
    return Table("Risk and coverage", header, tuple(rows), note)


def pairs_tables(records: Sequence[Record], reference: str = "guided") -> list[Table]:
    """Return the tables of ``geodiff eval pairs``."""
    note = (
        "All pixels with ground truth, no cap; metres without alignment, except for methods with relative "
        "depth only ('oracle'), which get scale and shift from the ground truth."
    )
    columns = method_columns(records)
    return [
        *split_tables(records),
        per_pair_table(f"AbsRel of {pairs_of(records)}", columns, headline, 3, note),
        per_pair_table("Seconds", columns, lambda record: record.get("seconds"), 1),
        *([versus_table(records, reference)] if any(r["method"] == reference for r in records) else []),
        *(summary_table(records, labels, f"All metrics, {g}") for g, labels in groups_of(records).items()),
        *benchmark_tables(records),
        *(details_table(records, title) for title in DETAILS),
        confidence_table(records),
        risk_table(records),
    ]
