"""A table in Markdown, LaTeX and JSON.

Data flow: cells -> ``Table`` -> text.
Paper: Tables 1 to 4 in layout (grouped columns, rules between groups of rows).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

__all__ = ["Table", "latex_escape"]

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
