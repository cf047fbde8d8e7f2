"""What the command says: lines on stderr, warnings as sentences, and tables that ``rich`` draws on stdout."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # drawn by few commands
    from rich.console import RenderableType
    from rich.table import Table

EXIT_BAD_INPUT, EXIT_SOME_FAILED, EXIT_INTERRUPTED = 2, 4, 130
PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
#: Characters a line may have where nobody's terminal bounds it.
UNBOUNDED = 10_000


def say(line: str) -> None:
    """Print one line on stderr, apart from the results on stdout, and above a progress bar."""
    tqdm = sys.modules.get("tqdm")
    if tqdm is None:
        print(line, file=sys.stderr, flush=True)
    else:
        tqdm.tqdm.write(line, file=sys.stderr)
        sys.stderr.flush()


class StopWatch:
    """Wall-clock seconds by stage, in the order of the stages."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what is inside."""
        started = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - started


@contextmanager
def collected_warnings(tell: Callable[[str], None] = say) -> Iterator[None]:
    """Tell every warning of this package once, as a line; those of others are shown as usual."""
    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=UserWarning, module=r"geodiff_plugin")
        shown_elsewhere, told = warnings.showwarning, set[str]()

        def collect(message: Any, category: Any, filename: str, *rest: Any, **named: Any) -> None:
            if PACKAGE_FOLDER not in Path(filename).resolve().parents:
                shown_elsewhere(message, category, filename, *rest, **named)
            elif str(message) not in told:
                told.add(str(message))
                tell(f"warning: {message}")

        warnings.showwarning = collect
        yield


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
