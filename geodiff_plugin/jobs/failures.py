"""Reports failures of the items of a job, each cause once."""

from __future__ import annotations

import errno
import traceback
from collections.abc import Callable

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.findings import some_names
from geodiff_plugin.formats import reason_of
from geodiff_plugin.jobs.journal import Item

#: Error numbers after which no further item can be written.
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
#: Appended to the message of a run that ended early.
RESUMES = "Finished pairs are kept; run the same command again to resume."


class DiskFull(InputError):
    """The disk of ``--out`` is full."""


def full_disk(error: BaseException) -> DiskFull | None:
    """Return an error for the user if the cause is a full disk, which ends the run; otherwise ``None``."""
    if isinstance(error, DiskFull):
        return error
    cause: BaseException | None = error
    while cause is not None and getattr(cause, "errno", None) not in DISK_FULL:
        cause = cause.__cause__ or cause.__context__
    if not isinstance(cause, OSError):
        return None
    return DiskFull(f"The disk of --out is full ({reason_of(cause)}). {RESUMES}")


class Failures:
    """Reports the first failure of each cause at once, unless all items so far failed for the same reason.

    ``total`` is the number of items, ``noun`` the name of an item, and ``notify`` receives the messages.
    """

    def __init__(self, total: int, noun: str, notify: Callable[[str], None]) -> None:
        self._total, self._noun, self._notify = total, noun, notify
        self._labels: dict[str, list[str]] = {}  # labels of the failed items by cause
        self._pending: list[
            str
        ] = []  # the first failure, while every item so far has failed for the same reason
        self._any_passed = False

    def passed(self) -> None:
        """Record that an item did not fail."""
        self._any_passed = True
        self._say()

    def add(self, item: Item, error: Exception) -> str:
        """Record a failure, report it if its cause is new, and return the message."""
        is_plain = isinstance(error, (InputError, OSError, ValueError))
        message = str(error) if is_plain else f"{type(error).__name__}: {error}"
        cause = message
        for word in sorted(item.words or (item.label,), key=len, reverse=True):
            cause = cause.replace(word, "")
        if cause not in self._labels:
            self._pending.append(f"{item.label}: {message}")
            if not is_plain:  # an internal error
                self._notify("".join(traceback.format_exception(error)).rstrip())
        self._labels.setdefault(cause, []).append(item.label)
        if self._any_passed or len(self._labels) > 1:
            self._say()
        return message

    def _say(self) -> None:
        for message in self._pending:
            self._notify(f"geodiff: {message}")
        self._pending.clear()

    def report(self) -> None:
        """Report which items each cause affected, if several; raise if one cause affected all items."""
        if self._pending and sum(map(len, self._labels.values())) == self._total > 1:
            everywhere = f"All {self._total} {self._noun}s failed for this reason; nothing was computed."
            raise InputError(f"{self._pending[0]} {everywhere}")
        self._say()
        for labels in self._labels.values():
            if len(labels) > 1:
                count = f"{len(labels)} of {self._total} {self._noun}s"
                self._notify(f"geodiff: {count} failed for the same reason: {some_names(labels)}.")
