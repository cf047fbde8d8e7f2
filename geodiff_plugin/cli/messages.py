"""Messages and exit codes of the command: one line for bad input, warnings as sentences.

Data flow: an exception or a warning of this package -> one line on stderr (and an exit code).
Paper: none.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from tqdm import tqdm
from typer.core import TyperGroup

from geodiff_plugin._checks import InputError

__all__ = ["EXIT_BAD_INPUT", "EXIT_INTERRUPTED", "CommandGroup", "collected_warnings", "in_options", "say"]

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
PACKAGE_FOLDER = Path(__file__).resolve().parents[1]


def say(line: str) -> None:
    """Print one line on stderr, apart from the results on stdout."""
    tqdm.write(line, file=sys.stderr)  # above a progress bar, if there is one
    sys.stderr.flush()


class Sentences(Protocol):
    """What ``collected_warnings`` needs of a list of sentences."""

    def append(self, sentence: str, /) -> None:
        """Add one."""

    def __contains__(self, sentence: object, /) -> bool: ...


#: Keyword in Python -> option of the command line.
OPTIONS = {
    "widen depth_range": "widen the range of --near and --far",
    "cropped=True": "--cropped",
    "the points' scale as ": "--points-scale ",
    "their scale as ": "--points-scale ",
}


def in_options(sentence: str) -> str:
    """A message with Python keywords replaced by options of the command line."""
    for keyword, option in OPTIONS.items():
        sentence = sentence.replace(keyword, option)
    return sentence


class CommandGroup(TyperGroup):
    """The group of all subcommands: bad input is one line and exit code 2, Ctrl-C is exit code 130."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen subcommand."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            say("geodiff: interrupted")
            sys.exit(EXIT_INTERRUPTED)
        except InputError as error:  # any other is a defect, and keeps its traceback
            say(f"geodiff: {in_options(str(error))}")
            sys.exit(EXIT_BAD_INPUT)


def _warn(sentence: str) -> None:
    say(f"warning: {sentence}")


@contextmanager
def collected_warnings(into: Sentences, tell: Callable[[str], None] = _warn) -> Iterator[None]:
    """Collect this package's warnings as sentences: each is printed once and appended to ``into``.

    Warnings of other packages are shown as usual, and the warning filters are restored at the end.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=UserWarning, module=r"geodiff_plugin")
        shown_elsewhere = warnings.showwarning

        def collect(
            message: Any, category: Any, filename: str, lineno: int, file: Any = None, line: Any = None
        ) -> None:
            if PACKAGE_FOLDER not in Path(filename).resolve().parents:
                shown_elsewhere(message, category, filename, lineno, file, line)
            elif (sentence := in_options(str(message))) not in into:
                into.append(sentence)
                tell(sentence)

        warnings.showwarning = collect
        yield
