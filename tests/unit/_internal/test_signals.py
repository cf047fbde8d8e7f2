"""Handlers of signals are put back, and a stop waits for the end of a block."""

import signal
import sys
import threading

import pytest

from geodiff_plugin._internal import signals as _signals
from geodiff_plugin._internal.signals import defer_signals, keeping_sigterm, stop

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM to be caught")


class Ended(KeyboardInterrupt):
    pass


def test_a_handler_that_an_import_sets_is_undone():
    before = signal.getsignal(signal.SIGTERM)
    for leave in (lambda: None, lambda: 1 / 0):
        try:
            with keeping_sigterm():
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
                leave()
        except ZeroDivisionError:
            pass
        assert signal.getsignal(signal.SIGTERM) == before


def test_in_a_thread_and_with_a_handler_of_c_nothing_is_set(monkeypatch):
    errors = []

    def work():
        try:
            with keeping_sigterm():
                pass
        except ValueError as error:  # signals are set in the main thread only
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert errors == []
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    monkeypatch.setattr(signal, "signal", lambda *given: errors.append(given))
    with keeping_sigterm():
        pass
    assert errors == []


def test_a_stop_is_raised_at_once_or_at_the_end_of_the_outermost_block():
    with pytest.raises(Ended):
        stop(Ended)
    done = []
    with pytest.raises(Ended), defer_signals():
        with defer_signals():
            stop(KeyboardInterrupt)
            stop(Ended)
            done.append("inner")
        done.append("outer")
    assert done == ["inner", "outer"] and _signals._stop.blocks == 0 and _signals._stop.waiting is None
    with defer_signals():
        done.append("again")
    with pytest.raises(Ended), defer_signals():
        stop(Ended)
        raise ValueError("the block fails as well")
    with pytest.raises(ValueError, match="alone"), defer_signals():
        raise ValueError("alone")
    assert _signals._stop.blocks == 0


def test_in_a_thread_a_block_does_not_count():
    counts = []

    def work():
        with defer_signals():
            counts.append(_signals._stop.blocks)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert counts == [0]
