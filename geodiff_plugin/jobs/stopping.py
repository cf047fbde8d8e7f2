"""A process that is asked to end (SIGTERM) ends as by Ctrl-C: what it began is cleared away."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from geodiff_plugin._signals import stop


class Terminated(KeyboardInterrupt):
    """The process was asked to end by SIGTERM."""


def _end(*_: Any) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # asked again it goes on clearing away
    stop(Terminated)


def _interrupt(*_: Any) -> None:
    stop(KeyboardInterrupt)


@contextmanager
def ending_on_sigterm() -> Iterator[None]:
    """Raise ``Terminated`` inside the block on SIGTERM; that, and Ctrl-C, when no ``undisturbed`` is left.

    In a thread nothing changes, nor where Ctrl-C does something else than Python's own.
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
