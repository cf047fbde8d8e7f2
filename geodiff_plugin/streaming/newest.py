"""``Newest``: passes values from one thread to another; the receiver gets the newest one."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class Newest(Generic[T]):
    """A place for one value. A value that was not taken is dropped when a newer one arrives.

    Args:
        waits: whether ``put`` returns only when the value was taken, so that none is dropped.
    """

    def __init__(self, *, waits: bool = False) -> None:
        self._changed = threading.Condition()
        self._waits = waits
        self._values: list[T] = []  # at most one
        self._closed = False
        self._error: BaseException | None = None

    def put(self, value: T) -> bool:
        """Pass a value on, in place of one that was not taken; ``False`` if nobody will take it."""
        with self._changed:
            if self._closed:
                return False
            self._values = mine = [value]  # the list identifies this value; others may be equal
            self._changed.notify_all()
            if not self._waits:
                return True
            self._changed.wait_for(lambda: self._closed or self._values is not mine)
            if self._values is not mine:
                return True
            self._values = []  # closed before it was taken
            return False

    def take(self) -> T | None:
        """Wait for a value and return it; ``None`` after ``close``, or raise the error that it was given."""
        with self._changed:
            self._changed.wait_for(lambda: self._values or self._closed)
            if self._values:
                (value,), self._values = self._values, []
                self._changed.notify_all()
                return value
            if self._error is not None:
                raise self._error
            return None

    def close(self, error: BaseException | None = None) -> None:
        """End the exchange for both threads.

        A last value can still be taken, unless its sender waits for that. Then ``error`` is raised.
        """
        with self._changed:
            self._closed = True
            self._error = self._error or error
            self._changed.notify_all()
