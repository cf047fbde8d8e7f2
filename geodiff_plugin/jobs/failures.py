"""Failures of the items of a job, each cause told once."""

from __future__ import annotations

import errno
import traceback
from collections.abc import Callable

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats.out import reason_of
from geodiff_plugin.jobs.journal import Item

#: Items of one cause that are named.
MOST_NAMES = 5
#: With one of these causes the next item cannot be written either.
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
#: What is said of a run that ended early.
RESUMES = "Finished pairs stay; the same command goes on with the rest."


class DiskFull(InputError):
    """The disk of ``--out`` is full."""


def full_disk(error: BaseException) -> DiskFull | None:
    """What to say where an error comes from a full disk, which ends a whole run; ``None`` for all others."""
    if isinstance(error, DiskFull):
        return error
    cause: BaseException | None = error
    while cause is not None and getattr(cause, "errno", None) not in DISK_FULL:
        cause = cause.__cause__ or cause.__context__
    if not isinstance(cause, OSError):
        return None
    return DiskFull(f"The disk of --out is full ({reason_of(cause)}). {RESUMES}")


class Failures:
    """What made items fail: the first of a cause is told at once, unless all items fail as the first did.

    ``total`` is how many items there are, ``noun`` what one is, and ``tell`` takes the lines.
    """

    def __init__(self, total: int, noun: str, tell: Callable[[str], None]) -> None:
        self._total, self._noun, self._tell = total, noun, tell
        self._struck: dict[str, list[str]] = {}  # labels of the items that failed, by the cause
        self._unsaid: list[str] = []  # the first failure, as long as every item fails as the first one did
        self._any_passed = False

    def passed(self) -> None:
        """Note that an item did not fail."""
        self._any_passed = True
        self._say()

    def add(self, item: Item, error: Exception) -> str:
        """Note a failure, to be told unless its cause has been; the message."""
        is_plain = isinstance(error, (InputError, OSError, ValueError))
        message = str(error) if is_plain else f"{type(error).__name__}: {error}"
        cause = message
        for word in sorted(item.words or (item.label,), key=len, reverse=True):
            cause = cause.replace(word, "")
        if cause not in self._struck:
            self._unsaid.append(f"{item.label}: {message}")
            if not is_plain:  # a defect of ours
                self._tell("".join(traceback.format_exception(error)).rstrip())
        self._struck.setdefault(cause, []).append(item.label)
        if self._any_passed or len(self._struck) > 1:
            self._say()
        return message

    def _say(self) -> None:
        for message in self._unsaid:
            self._tell(f"geodiff: {message}")
        self._unsaid.clear()

    def report(self) -> None:
        """Tell which items each cause struck, where several; raise if it was one, and all items."""
        if self._unsaid and sum(map(len, self._struck.values())) == self._total > 1:
            everywhere = f"The same holds for all {self._total} {self._noun}s; nothing was computed."
            raise InputError(f"{self._unsaid[0]} {everywhere}")
        self._say()
        for labels in self._struck.values():
            if len(labels) > 1:
                names = ", ".join(labels[:MOST_NAMES]) + (", ..." if len(labels) > MOST_NAMES else "")
                count = f"{len(labels)} of {self._total} {self._noun}s"
                self._tell(f"geodiff: {count} failed for one reason: {names}.")
