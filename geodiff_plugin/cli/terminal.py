"""What the command answers on stdout: tables that ``rich`` draws, and exit codes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # drawn by few commands
    from rich.console import RenderableType
    from rich.table import Table

#: Exit status of a command whose input is refused, as of one with a wrong option.
EXIT_BAD_INPUT = 2
#: Of a run some of whose pairs or frames failed, while the others are written.
EXIT_SOME_FAILED = 4
#: Of an interrupted run: 128 and the number of the signal, as shells have it.
EXIT_INTERRUPTED = 130
#: Likewise of a run that was asked to end.
EXIT_TERMINATED = 143
#: Characters a line may have where nobody's terminal bounds it.
UNBOUNDED = 10_000


def show(*shown: RenderableType) -> None:
    """Print on the present standard output, text as it is; lines of a file or a pipe do not end in blanks."""
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
    """A table whose first column is text and whose others are numbers; no title where that is empty."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    heading = Text(title, style="bold") if title else None  # of a str the markup would be read
    table = Table(box=box.SIMPLE_HEAD, title=heading, title_justify="left")
    for index, name in enumerate(header):
        table.add_column(name, justify="right" if index else "left", overflow="fold")
    return table


def print_lines(rows: Sequence[tuple[str, str]]) -> None:
    """Print names and values in two columns, with values wrapped inside their own."""
    from rich.table import Table

    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*row)
    show(table)
