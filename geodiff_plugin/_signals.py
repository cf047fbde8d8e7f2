"""Handlers of signals that a library replaces when it is imported, kept."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


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
