"""Bar charts of the tables of results, made from the tables themselves: SVG, for light and dark pages."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from statistics import median
from textwrap import wrap
from typing import NamedTuple

from geodiff_plugin.formats.out import write_text

FOLDER = "charts"
#: Pixels of the drawing, which pages scale to their width.
WIDTH_PX = 760
MARGIN_PX = 14
LINE_PX = 15
#: Between two rows, and between two columns.
GAP_PX = 7
COLUMN_GAP_PX = 16
BAR_PX = 11
#: Width of a letter of 12 px, on average.
LETTER_PX = 6.7
#: Letters of a line of a row's name.
NAME_LETTERS = 34
#: A value of more times the median is cut, with a gap in its bar; its number says how large it is.
CUT = 6.0
#: What the charts make stand out.
OURS = "guided"
STYLE = """
text { font: 12px system-ui, sans-serif; fill: #333 }
.title, .column { font-weight: 600 }
.card { fill: #fafafa; stroke: #ddd }
.bar { fill: #b9b4c6 }
.ours { fill: #6a3fb5 }
.line { stroke: #555 }
.gap { stroke: #fafafa; stroke-width: 3 }
@media (prefers-color-scheme: dark) {
  text { fill: #ddd }
  .card { fill: #23242e; stroke: #444 }
  .bar { fill: #66627a }
  .ours { fill: #b394f0 }
  .line { stroke: #aaa }
  .gap { stroke: #23242e }
}
"""


class Column(NamedTuple):
    """A column of a table by its place, 0 for the first, and its title where the header's is not enough."""

    place: int
    title: str = ""


@dataclass(frozen=True)
class Chart:
    """What is drawn of the ``number``-th table of a page, whose first ``names`` columns name the rows.

    Bars of one scale can be compared between columns. ``turned`` exchanges rows and columns.
    """

    page: str
    number: int
    title: str
    columns: tuple[Column, ...] = ()  # default: all
    names: int = 1
    one_scale: bool = True
    turned: bool = False
    rows: str = ""  # how the names of the rows begin

    @property
    def file(self) -> str:
        """Name of the picture."""
        return f"{self.page}-{self.number}.svg"

    @property
    def line(self) -> str:
        """The line of the page that shows it."""
        return f"![Bar chart of the table below. {self.title}](../images/{FOLDER}/{self.file})"


LOWER = "lower is better"
PROMISED = "Share within 10 % of the truth, and the confidence that promises it"


def _real_and_rendered(first_real: int, first_rendered: int, *names: str) -> tuple[Column, ...]:
    """Columns of the names, side by side from a first one on, of real pairs and of rendered ones."""
    return tuple(
        Column(first + place, f"{data}: {name}")
        for data, first in (("real", first_real), ("rendered", first_rendered))
        for place, name in enumerate(names)
    )


SHARES = _real_and_rendered(2, 5, "not trusted", "said, of those > 20% off")
PROMISES = _real_and_rendered(3, 8, "within 10 %", "confidence")
CHARTS = (
    Chart("results", 1, f"Mean AbsRel; {LOWER}"),
    Chart("results", 2, "AbsRel of guided minus that of the other method, with its interval"),
    Chart("results", 3, f"Distance of walls from a plane, % of their inverse depth; {LOWER}"),
    Chart("results", 4, f"AbsRel of scenes with mirrors or glass; {LOWER}"),
    Chart("results-13-pairs", 1, f"AbsRel; {LOWER}"),
    Chart("results-13-pairs", 2, f"Errors of disparity ({LOWER}) and F1 (higher is better)", one_scale=False),
    Chart("results-captures", 1, f"AbsRel ({LOWER}) and F-score (higher is better)", one_scale=False),
    Chart("results-pose", 1, f"AbsRel; {LOWER}", turned=True, rows="mean of"),
    Chart("results-pose", 2, f"AbsRel; {LOWER}", turned=True, rows="mean of"),
    Chart("results-pose", 3, f"AbsRel; {LOWER}", turned=True, rows="mean of"),
    Chart("results-pose", 4, f"AbsRel; {LOWER}", turned=True, rows="mean of"),
    Chart(
        "results-trust", 1, "Shares that were not trusted, and that got a warning or were not trusted", SHARES
    ),
    Chart("results-trust", 2, PROMISED, (Column(3), Column(4)), names=2),
    Chart(
        "results-trust",
        3,
        "Confidence of plain walls where they are off and where right, and how well it tells these apart",
        (Column(3), Column(4), Column(7)),
    ),
    Chart("results-trust", 4, PROMISED, PROMISES),
    Chart(
        "results-trust",
        5,
        "Shares that were not trusted, and that got a warning or were not trusted",
        (Column(6), Column(7)),
    ),
    Chart("results-trust", 6, PROMISED, (Column(3), Column(4))),
    Chart("strength", 1, f"Errors by the prior's own error; {LOWER}", names=2, one_scale=False),
    Chart(
        "strength",
        2,
        "AbsRel of guided minus that of the prior fit, with its interval; negative: smaller error",
        (Column(1),),
    ),
)


class Value(NamedTuple):
    """A cell: its number, the ends of its interval where it has one, and how it is written."""

    number: float
    low: float
    high: float
    text: str


@dataclass(frozen=True)
class Table:
    """A table of a page: its header, its rows, and the line of the page where it begins, from 0 on."""

    header: list[str]
    rows: list[list[str]]
    begins: int


class Bars(NamedTuple):
    """A column of the drawing: its title, and a value for every row."""

    title: str
    values: list[Value | None]


def tables_of(text: str) -> list[Table]:
    """The tables of a page in Markdown."""
    found: list[Table] = []
    lines = text.splitlines()
    for number, line in enumerate(lines[:-1]):
        if line.startswith("|") and re.fullmatch(r"[|\s:-]+", lines[number + 1]):
            end = next((n for n in range(number, len(lines)) if not lines[n].startswith("|")), len(lines))
            header, _, *rows = ([c.strip() for c in row.split("|")[1:-1]] for row in lines[number:end])
            found.append(Table(header, rows, number))
    return found


def value_of(cell: str) -> Value | None:
    """The number of a cell; of ``4 of 13`` the share. ``None`` where it has none."""
    number = r"[+-]?\d+(?:\.\d+)?"
    if match := re.fullmatch(rf"({number}) \[({number}), ({number})\]", cell):
        middle, low, high = map(float, match.groups())
    elif match := re.fullmatch(r"(\d+) of (\d+)", cell):
        middle = low = high = int(match[1]) / int(match[2])
    elif match := re.match(rf"{number}(?= of \d+$|$)", cell):  # 0.089 of 59: a mean over 59
        middle = low = high = float(match[0])
    else:
        return None
    return Value(middle, low, high, cell)


def draw(chart: Chart, table: Table) -> str:
    """The chart as SVG."""
    rows = [row for row in table.rows if row[0].startswith(chart.rows)]
    names = [", ".join(row[: chart.names]) for row in rows]
    columns = chart.columns or tuple(Column(place) for place in range(chart.names, len(table.header)))
    bars = [
        Bars(column.title or table.header[column.place], [value_of(row[column.place]) for row in rows])
        for column in columns
    ]
    if chart.turned:
        turned = zip(names, zip(*(each.values for each in bars), strict=True), strict=True)
        names, bars = [each.title for each in bars], [Bars(name, list(values)) for name, values in turned]
    ends = [_ends([value for each in bars for value in each.values if value])] * len(bars)
    if not chart.one_scale:
        ends = [_ends([value for value in each.values if value]) for each in bars]
    return _drawing(chart, names, list(zip(bars, ends, strict=True)))


class _Ends(NamedTuple):
    low: float
    high: float


def _ends(values: Sequence[Value]) -> _Ends:
    """What the bars of a column reach from and to; 0 is among it."""
    most = max(value.high for value in values)
    if min(value.low for value in values) >= 0:
        most = min(most, CUT * median(value.number for value in values) or most)
    return _Ends(min(0.0, *(value.low for value in values)), max(0.0, most))


def _drawing(chart: Chart, names: Sequence[str], columns: Sequence[tuple[Bars, _Ends]]) -> str:
    wrapped = [wrap(name, NAME_LETTERS) for name in names]
    names_px = LETTER_PX * max(len(line) for lines in wrapped for line in lines) + COLUMN_GAP_PX
    column_px = (WIDTH_PX - 2 * MARGIN_PX - names_px) / len(columns)
    titles = [wrap(bars.title, max(8, int((column_px - COLUMN_GAP_PX) / LETTER_PX))) for bars, _ in columns]
    below_titles = MARGIN_PX + LINE_PX * (1 + max(map(len, titles))) + 2 * GAP_PX
    tops, y = [], float(below_titles)
    for lines in wrapped:
        tops.append(y)
        y += LINE_PX * len(lines) + GAP_PX
    height = round(y + MARGIN_PX - GAP_PX)
    ours = [[_is_ours(name) or _is_ours(bars.title) for name in names] for bars, _ in columns]
    letters = [max(len(value.text) for value in bars.values if value) for bars, _ in columns]
    every = not any(map(any, ours))  # where none stands out all have the colour
    parts = [
        f'<text class="title" x="{MARGIN_PX}" y="{MARGIN_PX + LINE_PX - 4}">{escape(chart.title)}</text>',
        *(_lines(MARGIN_PX, top, lines) for top, lines in zip(tops, wrapped, strict=True)),
    ]
    for place, ((bars, ends), title) in enumerate(zip(columns, titles, strict=True)):
        x = MARGIN_PX + names_px + place * column_px
        parts.append(_lines(x, MARGIN_PX + LINE_PX + GAP_PX, title, "column"))
        longest = max(letters) if chart.one_scale else letters[place]
        scale = _Scale(x, column_px - COLUMN_GAP_PX - LETTER_PX * longest - 5, ends)
        x = scale.at(0.0)
        parts.append(f'<path class="line" d="M{x:.1f} {below_titles - 3:.1f}V{height - MARGIN_PX + 3}"/>')
        for row, (top, lines, value) in enumerate(zip(tops, wrapped, bars.values, strict=True)):
            kind = "ours" if every or ours[place][row] else "bar"
            parts.append(_bar(scale, top + LINE_PX * (len(lines) - 1) / 2, value, kind))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX} {height}" width="{WIDTH_PX}" '
        f'height="{height}" role="img"><title>{escape(chart.title)}</title><style>{STYLE}</style>'
        f'<rect class="card" x=".5" y=".5" width="{WIDTH_PX - 1}" height="{height - 1}" rx="6"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def _is_ours(name: str) -> bool:
    """Whether it names the method itself, alone, before its explanation or behind a prior's error."""
    return OURS in name.split(", ")


def _lines(x: float, top: float, lines: Sequence[str], kind: str = "name") -> str:
    return "".join(
        f'<text class="{kind}" x="{x:.1f}" y="{top + LINE_PX * (number + 1) - 4:.1f}">{escape(line)}</text>'
        for number, line in enumerate(lines)
    )


@dataclass(frozen=True)
class _Scale:
    """Where numbers of a column are: from ``left`` on, ``wide`` pixels."""

    left: float
    wide: float
    ends: _Ends

    def at(self, number: float) -> float:
        """The pixel of a number, of one that is too large the last one."""
        low, high = self.ends
        return self.left + self.wide * (min(number, high) - low) / ((high - low) or 1.0)


def _bar(scale: _Scale, top: float, value: Value | None, kind: str) -> str:
    """A bar with its number; an interval is a line with a dot."""
    middle = top + LINE_PX / 2
    if value is None:
        return f'<text x="{scale.at(0.0) + 5:.1f}" y="{top + LINE_PX - 4:.1f}">-</text>'
    zero, x = scale.at(0.0), scale.at(value.number)
    ends = [scale.at(value.low), scale.at(value.high)]
    drawn = (
        f'<rect class="{kind}" x="{zero:.1f}" y="{middle - BAR_PX / 2:.1f}" width="{x - zero:.1f}" '
        f'height="{BAR_PX}"/>'
    )
    if value.low < value.high:
        drawn = (
            f'<path class="line" d="M{ends[0]:.1f} {middle:.1f}H{ends[1]:.1f}"/>'
            f'<circle class="{kind}" cx="{x:.1f}" cy="{middle:.1f}" r="4"/>'
        )
    elif value.number > scale.ends.high:
        slant = f"M{x - 12:.1f} {middle + BAR_PX / 2 + 1:.1f}l6 {-BAR_PX - 2}"
        drawn += f'<path class="gap" d="{slant}"/>'
    text_x = max(*ends, zero) + 5
    return f'{drawn}<text x="{text_x:.1f}" y="{top + LINE_PX - 4:.1f}">{escape(value.text)}</text>'


def with_charts(page: str, text: str) -> tuple[str, dict[str, str]]:
    """A page with the line of every chart above its table, and the charts by the names of their files."""
    lines, drawn = text.splitlines(), {}
    tables = tables_of(text)
    for chart in sorted((each for each in CHARTS if each.page == page), key=lambda each: -each.number):
        table = tables[chart.number - 1]
        drawn[chart.file] = draw(chart, table)
        above = table.begins - 2
        if lines[above].endswith(f"/{chart.file})"):
            lines[above] = chart.line
        else:
            lines[table.begins : table.begins] = [chart.line, ""]
    return "\n".join(lines) + "\n", drawn


def write_charts(pages: Path, images: Path) -> None:
    """Draw the charts of all pages anew, and put the missing ones above their tables."""
    for page in dict.fromkeys(chart.page for chart in CHARTS):
        path = pages / f"{page}.md"
        text, drawn = with_charts(page, path.read_text(encoding="utf-8"))
        write_text(path, text)
        for name, svg in drawn.items():
            write_text(images / FOLDER / name, svg)
