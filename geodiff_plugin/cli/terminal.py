"""Tables and lines on standard output, drawn by ``rich``.

Data flow: cells -> text as wide as the terminal, or as wide as it needs where standard output is a file or a
    pipe.
Paper: none.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich import box
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

__all__ = ["new_console", "new_table", "print_lines", "show"]

#: Characters a line may have where nobody's terminal bounds it.
UNBOUNDED = 10_000


def new_console() -> Console:
    """A console on the present standard output that takes text as it is, without markup."""
    console = Console(markup=False, highlight=False, emoji=False)
    if not console.is_terminal:
        console.width = UNBOUNDED
    return console


def show(*shown: RenderableType) -> None:
    """Print on the present standard output; lines of a file or a pipe do not end in blanks."""
    console = new_console()
    if console.is_terminal:
        for one in shown:
            console.print(one)
        return
    with console.capture() as captured:
        for one in shown:
            console.print(one)
    sys.stdout.write("".join(f"{line.rstrip()}\n" for line in captured.get().splitlines()))


def new_table(header: Sequence[str], title: str = "") -> Table:
    """A table whose first column is text and whose others are numbers.

    Args:
        header: column headings.
        title: above it, or empty.
    """
    # Text instead of str: a title as str would have its markup read whatever the console says.
    table = Table(
        box=box.SIMPLE_HEAD,
        title=Text(title, style="bold") if title else None,
        title_justify="left",
    )
    for index, name in enumerate(header):
        table.add_column(name, justify="right" if index else "left", overflow="fold")
    return table


def print_lines(rows: Sequence[tuple[str, str]]) -> None:
    """Print names and values in two columns, with values wrapped inside their own."""
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, value)
    show(table)
