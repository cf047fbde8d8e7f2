"""Signals: a library's change of a handler is undone, and a stop waits for what must not be half done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@contextmanager
def keeping_sigterm() -> Iterator[None]:
    """Keep what SIGTERM does over an import: pycolmap's logging would print its stack and end the process."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        # Set from C, it is not what Python remembers; in a thread it cannot be set.
        if before is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)


@dataclass
class _Stop:
    """How many blocks of ``undisturbed`` there are, one in another, and the stop that waits for their end."""

    blocks: int = 0
    waiting: type[KeyboardInterrupt] | None = None


_stop = _Stop()


def stop(kind: type[KeyboardInterrupt]) -> None:
    """Raise ``kind``, in a block of ``undisturbed`` at its end; what a handler of a signal does."""
    if not _stop.blocks:
        raise kind
    _stop.waiting = kind


@contextmanager
def undisturbed() -> Iterator[None]:
    """Do the block as a whole: a ``stop`` is raised when it is done.

    Making a file and noting that it is to be removed belong in one block, else a stop between the two would
    leave the file. For what takes milliseconds. In a thread nothing changes: handlers run in the main one.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _stop.blocks += 1
    try:
        yield
    finally:
        _stop.blocks -= 1
        if not _stop.blocks and (kind := _stop.waiting) is not None:
            _stop.waiting = None
            raise kind
