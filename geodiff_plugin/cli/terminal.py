"""Print to stdout, draw tables with ``rich``, and define exit codes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # only some commands need rich
    from rich.console import RenderableType
    from rich.table import Table

#: Exit code for invalid input or options.
EXIT_BAD_INPUT = 2
#: Exit code of a run in which some pairs or frames failed and the others were written.
EXIT_SOME_FAILED = 4
#: Exit code of an interrupted run, 128 plus the number of SIGINT.
EXIT_INTERRUPTED = 130
#: Exit code of a terminated run, 128 plus the number of SIGTERM.
EXIT_TERMINATED = 143
#: Line width for files and pipes, in characters.
UNBOUNDED = 10_000


def show(*shown: RenderableType) -> None:
    """Print to the current stdout without markup; trailing blanks are removed for files and pipes."""
    from rich.console import Console

    console = Console(markup=False, highlight=False, emoji=False)
    if not console.is_terminal:
        console.width = UNBOUNDED
    with console.capture() as captured:
        for part in shown:
            console.print(part)
    text = captured.get()
    if not console.is_terminal:
        text = "".join(f"{line.rstrip()}\n" for line in text.splitlines())
    sys.stdout.write(text)


def new_table(header: Sequence[str], title: str = "") -> Table:
    """Create a table with a text column followed by number columns; an empty title is omitted."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    heading = Text(title, style="bold") if title else None  # rich would parse markup in a str
    table = Table(box=box.SIMPLE_HEAD, title=heading, title_justify="left")
    for index, name in enumerate(header):
        table.add_column(name, justify="right" if index else "left", overflow="fold")
    return table


def print_lines(rows: Sequence[tuple[str, str]]) -> None:
    """Print names and values in two columns, wrapping long values within their column."""
    from rich.table import Table

    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*row)
    show(table)
