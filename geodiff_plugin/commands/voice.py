"""How a command speaks: one line for bad input, exit codes, warnings without a source line.

Hop: an exception or a warning of this package -> one line on stderr (and an exit code).
Paper: none.
"""

from __future__ import annotations

import dis
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm
from typer.core import TyperGroup

__all__ = ["EXIT_BAD_INPUT", "EXIT_INTERRUPTED", "DoorGroup", "collected_warnings", "is_bad_input", "say"]

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
PACKAGE_FOLDER = Path(__file__).resolve().parents[1]


def say(line: str) -> None:
    """Print one line on stderr, where it does not mix with what a command answers."""
    tqdm.write(line, file=sys.stderr)  # above a progress bar, if there is one
    sys.stderr.flush()


def is_bad_input(error: BaseException) -> bool:
    """Whether this package raised the error on purpose, as an answer to what the user gave.

    True for a ``ValueError``, ``TypeError`` or ``OSError`` whose innermost frame is a ``raise`` statement of
    this package. The same types out of a library, or out of an expression that went wrong, are defects,
    and a defect keeps its traceback.
    """
    if not isinstance(error, (ValueError, TypeError, OSError)):
        return False
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None:
        return False
    code = trace.tb_frame.f_code
    raised = dis.opname[code.co_code[trace.tb_lasti]] == "RAISE_VARARGS"
    return raised and PACKAGE_FOLDER in Path(code.co_filename).resolve().parents


class DoorGroup(TyperGroup):
    """The group of all subcommands: bad input is one line and exit code 2, Ctrl-C is exit code 130."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen subcommand."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            say("geodiff: interrupted")
            sys.exit(EXIT_INTERRUPTED)
        except (ValueError, TypeError, OSError) as error:
            if not is_bad_input(error):
                raise
            say(f"geodiff: {error}")
            sys.exit(EXIT_BAD_INPUT)


@contextmanager
def collected_warnings(into: list[str]) -> Iterator[None]:
    """Take this package's warnings as sentences: each is said once and appended to ``into``.

    What other packages warn about is shown as ever, and the warning filters are restored at the end.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=UserWarning, module=r"geodiff_plugin")
        shown_elsewhere = warnings.showwarning

        def collect(
            message: Any, category: Any, filename: str, lineno: int, file: Any = None, line: Any = None
        ) -> None:
            if PACKAGE_FOLDER not in Path(filename).resolve().parents:
                shown_elsewhere(message, category, filename, lineno, file, line)
            elif str(message) not in into:
                into.append(str(message))
                say(f"warning: {message}")

        warnings.showwarning = collect
        yield
