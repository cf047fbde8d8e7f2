"""Sends messages of a job to its user, line by line, through a callable; warnings become such lines too."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

#: Receives one line for the user: ``say`` on the command line, ``silent`` in a program that wants none.
Notify = Callable[[str], None]
#: Matches control characters other than tabs and line ends.
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
PACKAGE_FOLDER = Path(__file__).resolve().parents[1]


def say(line: str) -> None:
    """Print one line on stderr, above a progress bar.

    Escapes control characters, which names in files may contain, so that no file can control the terminal.
    """
    line = CONTROL.sub(lambda found: f"\\x{ord(found[0]):02x}", line)
    tqdm = sys.modules.get("tqdm")
    if tqdm is None:
        print(line, file=sys.stderr, flush=True)
    else:
        tqdm.tqdm.write(line, file=sys.stderr)
        sys.stderr.flush()


def silent(_: str) -> None:
    """Discard the line."""


@contextmanager
def collected_warnings(notify: Notify = say) -> Iterator[None]:
    """Report each warning of this package once, as a line; other warnings are shown as usual."""
    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=UserWarning, module=r"geodiff_plugin")
        shown_elsewhere = warnings.showwarning
        reported = set[str]()

        def collect(message: Any, category: Any, filename: str, *rest: Any, **named: Any) -> None:
            if PACKAGE_FOLDER not in Path(filename).resolve().parents:
                shown_elsewhere(message, category, filename, *rest, **named)
            elif str(message) not in reported:
                reported.add(str(message))
                notify(f"warning: {message}")

        warnings.showwarning = collect
        yield
