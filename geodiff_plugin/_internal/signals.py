"""Restore signal handlers that a library changed, and defer signals during atomic operations."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@contextmanager
def keeping_sigterm() -> Iterator[None]:
    """Restore the SIGTERM handler after an import.

    The logging of pycolmap installs a handler that prints a stack trace and ends the process.
    """
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        # The handler is reset even if Python reports no change, because C code may have replaced it. Only the
        # main thread can set handlers.
        if before is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)


@dataclass
class _Stop:
    """The nesting depth of ``defer_signals`` and the deferred exception."""

    blocks: int = 0
    waiting: type[KeyboardInterrupt] | None = None


_stop = _Stop()


def stop(kind: type[KeyboardInterrupt]) -> None:
    """Raise ``kind`` now, or at the end of a ``defer_signals`` block; called by signal handlers."""
    if not _stop.blocks:
        raise kind
    _stop.waiting = kind


@contextmanager
def defer_signals() -> Iterator[None]:
    """Defer exceptions from ``stop`` to the end of the block.

    Use it for operations of milliseconds that must be complete, such as creating a temporary file and
    registering it for removal. It has no effect in other threads, because handlers run in the main thread.
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
