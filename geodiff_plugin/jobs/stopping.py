"""A process that is asked to end (SIGTERM) ends as by Ctrl-C: what it began is cleared away."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import wait
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


@contextmanager
def ending_with_parent() -> Iterator[None]:
    """Of a helping process: only its parent ends it, by SIGTERM, or by being gone."""
    parent = multiprocessing.parent_process()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent too
    if parent is not None:
        threading.Thread(target=_wait_for, args=(parent.sentinel,), daemon=True).start()
    with ending_on_sigterm():
        yield


def _wait_for(parent: Any) -> None:
    wait([parent])
    os.kill(os.getpid(), signal.SIGTERM)
