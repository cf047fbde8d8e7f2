"""Makes SIGTERM end a process like Ctrl-C, with cleanup."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from geodiff_plugin._internal.signals import stop


class Terminated(KeyboardInterrupt):
    """Raised when the process receives SIGTERM."""


def _end(*_: Any) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # further signals do not interrupt the cleanup
    stop(Terminated)


def _interrupt(*_: Any) -> None:
    stop(KeyboardInterrupt)


@contextmanager
def ending_on_sigterm() -> Iterator[None]:
    """Raise ``Terminated`` inside the block on SIGTERM; raise it and Ctrl-C after the last ``defer_signals``.

    Does nothing in a thread, or if Ctrl-C has a handler other than Python's.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {signal.SIGTERM: _end}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        handlers[signal.SIGINT] = _interrupt
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
