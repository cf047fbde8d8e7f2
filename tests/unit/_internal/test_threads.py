"""Cores of this process, and work in a thread of its own."""

import os
import threading

import pytest

from geodiff_plugin._internal import threads


def test_cores_are_those_of_this_process(monkeypatch):
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("only Linux limits the cores of a process")
    monkeypatch.setattr(threads.cv2, "getNumberOfCPUs", lambda: 64)
    allowed = {0: {1, 3, 5}}
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: allowed.get(process, set(range(64))))
    assert threads.available_cores() == 3


def test_work_in_a_new_thread_is_not_waited_for():
    may_end = threading.Event()
    answer = threads._in_new_thread(lambda: may_end.wait(10) and threading.current_thread().name)
    assert not answer.done()
    may_end.set()
    assert answer.result(10) != threading.current_thread().name
