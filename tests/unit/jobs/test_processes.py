"""A worker process: answers, errors, warnings, and its end."""

import math
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from itertools import permutations
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
import torch

from geodiff_plugin._internal.checks import InputFileError, captured_warnings
from geodiff_plugin.jobs.failures import DiskFull, full_disk
from geodiff_plugin.jobs.processes import (
    CHUNK,
    ProcessEnded,
    WorkerProcess,
    WorkerProcesses,
    _program_has_guard,
    can_have_workers,
)
from tests.unit.jobs.work_elsewhere import (
    cannot_begin,
    clears_away,
    fails_in_its_own_way,
    make_and_wait,
    wait_for,
    warns,
)

pytestmark = pytest.mark.end_to_end


@pytest.fixture(scope="module")
def process():
    process = WorkerProcess("math")
    yield process
    process.close()


@pytest.mark.parametrize("count", [0, 1, 10**4, CHUNK // 8, CHUNK // 8 + 1, 3 * 10**6])
def test_arrays_of_all_sizes_are_sent_and_answered_whole(process, count):
    values = np.arange(count)
    halves, odd = process.call(np.divmod, values, 2)
    np.testing.assert_array_equal(halves, values // 2)
    np.testing.assert_array_equal(odd, values % 2)
    halves += 1  # an answer may be changed


def test_it_answers_with_tensors_and_from_another_process(process):
    answer = process.call(torch.add, torch.ones(3), 1)
    assert torch.equal(answer, torch.full((3,), 2.0)) and not answer.is_shared()
    assert not process.call(torch.Tensor.is_shared, answer)
    assert process.call(os.getpid) not in (os.getpid(), process.call(os.getppid))


def test_an_error_is_raised_with_its_traceback_and_the_next_call_goes_on(process):
    with pytest.raises(ValueError, match="expected a nonnegative input|math domain") as caught:
        process.call(math.sqrt, -1)
    assert "Traceback" in caught.value.__notes__[0] and "serve" not in str(caught.value)
    with pytest.raises(RuntimeError, match="Odd: nobody") as caught:
        process.call(fails_in_its_own_way, False)
    assert "fails_in_its_own_way" in caught.value.__notes__[0]
    with pytest.raises(FileNotFoundError):
        process.call(os.stat, "/nowhere/at/all")
    assert process.call(math.sqrt, 4) == 2


def test_a_full_disk_is_still_known_as_one(process):
    with pytest.raises(DiskFull, match="No space left") as caught:
        process.call(fails_in_its_own_way, True)
    assert full_disk(caught.value) is caught.value
    assert full_disk(InputFileError("cut off")) is None


def test_what_is_warned_of_is_warned_of_here(process):
    with captured_warnings() as reported, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert process.call(warns, "a") == "a"
    assert [message.code for message in reported] == ["camera.assumed-intrinsics"]
    assert [str(each.message) for each in caught] == ["cy is assumed in a."]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_a_killed_process_is_reported_and_closing_it_is_no_error():
    process = WorkerProcess("math")
    with pytest.raises(ProcessEnded, match=r"ended \(exit code -9\)"):
        process.call(os.kill, process.call(os.getpid), signal.SIGKILL)
    with pytest.raises(ProcessEnded):
        process.call(math.sqrt, 4)
    process.close()


def test_several_processes_work_at_once_and_the_loss_of_one_is_reported(tmp_path):
    first, second = str(tmp_path / "first"), str(tmp_path / "second")
    processes = WorkerProcesses(make_and_wait.__module__, 2)
    with ThreadPoolExecutor(2) as pool:  # each waits for the other
        calls = [
            pool.submit(processes.call, make_and_wait, *files) for files in permutations((first, second))
        ]
        assert len({call.result() for call in calls}) == 2
    with pytest.raises(ProcessEnded, match=r"A worker process ended \(exit code 3\)"):
        processes.call(os._exit, 3)
    processes.close()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no groups of processes")
def test_ctrl_c_and_a_stop_of_the_group_do_not_reach_it(process):
    assert process.call(os.getpgrp) != os.getpgrp()
    process.call(os.kill, process.call(os.getpid), signal.SIGINT)
    assert process.call(math.sqrt, 4) == 2


BUSY = "import threading, time; threading.Thread(target=process.call, args=(time.sleep, 600)).start(); "


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
@pytest.mark.parametrize("work", ["", BUSY + "time.sleep(1); "], ids=["idle", "busy"])
def test_it_ends_when_the_process_that_asks_is_killed(work):
    code = (
        "import os; from geodiff_plugin.jobs.processes import WorkerProcess; "
        "process = WorkerProcess('math'); print(process.call(os.getpid), flush=True); "
        f"{work}os.kill(os.getpid(), 9)"
    )
    killed = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=False)
    assert killed.returncode == -signal.SIGKILL
    pid, until = int(killed.stdout), time.monotonic() + 60
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < until
        time.sleep(0.05)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM to be caught")
def test_one_that_is_ended_clears_away_what_it_is_at(tmp_path):
    began, cleared = tmp_path / "began", tmp_path / "cleared"
    process = WorkerProcess(clears_away.__module__)
    with ThreadPoolExecutor(1) as pool:
        called = pool.submit(process.call, clears_away, str(began), str(cleared))
        wait_for(str(began))
        assert process.alive
        process.end()
        with pytest.raises(ProcessEnded, match=r"exit code 143"):
            called.result()
    assert cleared.exists() and not process.alive
    process.close()


def test_a_worker_whose_function_reports_its_end_is_ended():
    process = WorkerProcess(cannot_begin.__module__)
    with pytest.raises(ProcessEnded, match="It cannot begin"):
        process.call(cannot_begin)
    with pytest.raises(ProcessEnded, match="ended"):
        process.call(math.sqrt, 4)
    assert not process.alive
    process.close()


def test_daemons_of_multiprocessing_have_none():
    assert can_have_workers()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(can_have_workers) is False


PROGRAM = """
import math
from geodiff_plugin.jobs.processes import ProcessEnded, WorkerProcess

math.added = "by the program"
{guard}
    process = WorkerProcess("math", extended=True)
    try:
        print(process.call(eval, "getattr(__import__('math'), 'added', None)"))
    except ProcessEnded:
        print("cannot begin")
    process.close()
"""
GUARDS = {
    "if __name__ == '__main__':": "by the program",
    "if True:": "None",  # without a guard it is not run again
    "if __name__: pass\nif True:": "cannot begin",  # work outside of it does not begin again
}


@pytest.mark.parametrize(("guard", "answer"), GUARDS.items(), ids=["guard", "none", "elsewhere"])
def test_it_knows_what_a_program_with_a_guard_adds(guard, answer, tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM.format(guard=guard))
    for how in (["program.py"], ["-m", "program"]):
        ran = subprocess.run([sys.executable, *how], capture_output=True, text=True, cwd=tmp_path)
        assert ran.stdout.splitlines() == [answer], ran.stderr


@pytest.mark.parametrize("content", [None, "if __name__ ==", "print(1)"], ids=["absent", "damaged", "none"])
def test_a_program_without_readable_guard_has_none(content, tmp_path, monkeypatch):
    program = tmp_path / "program.py"
    if content is not None:
        program.write_text(content)
    monkeypatch.setitem(sys.modules, "__main__", SimpleNamespace(__file__=str(program)))
    assert _program_has_guard() is False
