"""torch's number of threads in a guided call: within the cores, and afterwards as it was found."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import pytest
import torch

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._internal import threads

pytestmark = pytest.mark.end_to_end

#: One core, so that the tests are quick on a machine that is busy: there two threads wait for each other.
CORES, MORE = 1, 2


@pytest.fixture(autouse=True)
def one_core(monkeypatch):
    """One core, whatever the machine has, and the number of threads put back."""
    before = torch.get_num_threads()
    monkeypatch.setattr(threads, "available_cores", lambda: CORES)
    torch.set_num_threads(MORE)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def call(pipe, textured_plane):
    """A call of two steps; the numbers of threads that its network saw."""
    seen, pair = [], textured_plane
    pipe.unet.register_forward_pre_hook(lambda *_: seen.append(torch.get_num_threads()))

    def run(callback=None, guided=True):
        seen.clear()
        guidance = GeometryGuidance.paper(pair.right, pair.K, pair.E) if guided else None
        pipe(pair.left, guidance=guidance, num_inference_steps=2, callback_on_step_end=callback)
        return list(seen)

    return run


@pytest.mark.parametrize(("cores", "chosen", "inside"), [(4, 1, 1), (1, 5, 1)])
def test_a_number_holds_up_to_the_cores_in_guided_calls_alone(call, monkeypatch, cores, chosen, inside):
    monkeypatch.setattr(threads, "available_cores", lambda: cores)
    torch.set_num_threads(chosen)
    assert call() == [inside] * 2 and torch.get_num_threads() == chosen
    assert set(call(guided=False)) == {chosen}


def test_a_callback_has_the_users_number_and_may_set_another(call):
    seen = []
    assert call(lambda *_: seen.append(torch.get_num_threads())) == [CORES] * 2
    assert seen == [MORE] * 2
    call(lambda *_: torch.set_num_threads(1))
    assert torch.get_num_threads() == 1
    with threads.WithinCores():
        assert torch.get_num_threads() == CORES
        torch.set_num_threads(MORE + 1)
    assert torch.get_num_threads() == MORE + 1


@pytest.mark.parametrize("where", ["network", "callback"])
def test_the_number_is_put_back_when_the_call_raises(call, pipe, where):
    fails = Mock(side_effect=RuntimeError("stopped"))
    if where == "network":
        pipe.unet.register_forward_hook(fails)
    with pytest.raises(RuntimeError, match="stopped"):
        call(fails if where == "callback" else None)
    assert torch.get_num_threads() == MORE


def test_blocks_of_two_threads_do_not_meet():
    """Each thread has its own number; the block that ends last does not leave the other's cap behind."""
    meet, inside, after = threading.Barrier(2, timeout=30), [], []

    def work(ends_first):
        torch.set_num_threads(MORE)
        with threads.WithinCores():
            meet.wait()
            if not ends_first:
                meet.wait()
            inside.append(torch.get_num_threads())
        after.append(torch.get_num_threads())
        if ends_first:
            meet.wait()

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(work, (True, False)))
    assert (inside, after, torch.get_num_threads()) == ([CORES] * 2, [MORE] * 2, MORE)


def test_the_least_of_quota_and_affinity_counts_and_parts_share_it(monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)), raising=False)
    for counted, cores in ((1, 1), (10**6, 6), (0, 1)):
        monkeypatch.setattr(threads.cv2, "getNumberOfCPUs", lambda counted=counted: counted)
        assert threads.available_cores() == cores
    monkeypatch.setattr(threads, "available_cores", lambda: 6)
    torch.set_num_threads(5)
    for among, inside in ((1, 5), (2, 3), (4, 1), (12, 1)):
        with threads.WithinCores(among):
            assert torch.get_num_threads() == inside
        assert torch.get_num_threads() == 5
