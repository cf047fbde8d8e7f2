"""torch's number of threads in a guided call: within the cores, and afterwards as it was found."""

from __future__ import annotations

import os
import threading

import pytest
import torch

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin import _threads as threads
from geodiff_plugin.guidance import guidance as guidance_module

#: One core, so that the tests are quick on a machine that is busy: there two threads wait for each other.
CORES, MORE = 1, 2


@pytest.fixture(autouse=True)
def one_core(monkeypatch):
    """One core, whatever the machine has, and the number of threads put back."""
    before = torch.get_num_threads()
    monkeypatch.setattr(threads, "available_cores", lambda: CORES)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def call(make_pipeline, textured_plane):
    """A guided call of two steps, and the numbers of threads that its network saw."""
    pipe, seen = enable_geometry_guidance(make_pipeline()), []
    pipe.unet.register_forward_pre_hook(lambda *_: seen.append(torch.get_num_threads()))

    def run(callback=None, guided=True):
        seen.clear()
        pair = textured_plane
        guidance = GeometryGuidance.paper(pair.right, pair.K, pair.E) if guided else None
        pipe(pair.left, guidance=guidance, num_inference_steps=2, callback_on_step_end=callback)
        return list(seen)

    run.pipe = pipe
    return run


@pytest.mark.parametrize(("cores", "chosen", "inside"), [(4, 1, 1), (1, 5, 1)])
def test_a_number_holds_up_to_the_cores(call, monkeypatch, cores, chosen, inside):
    monkeypatch.setattr(threads, "available_cores", lambda: cores)
    torch.set_num_threads(chosen)
    assert call() == [inside] * 2
    assert torch.get_num_threads() == chosen


def test_a_callback_has_the_users_number(call):
    torch.set_num_threads(MORE)
    seen = []
    assert call(lambda *_: seen.append(torch.get_num_threads())) == [CORES] * 2
    assert seen == [MORE] * 2


def test_a_number_that_is_set_in_a_callback_holds_from_there_on(call):
    torch.set_num_threads(MORE)
    call(lambda *_: torch.set_num_threads(1))
    assert torch.get_num_threads() == 1


def test_a_number_that_is_set_inside_is_not_taken_back():
    torch.set_num_threads(MORE)
    with threads.WithinCores():
        assert torch.get_num_threads() == CORES
        torch.set_num_threads(MORE + 1)
    assert torch.get_num_threads() == MORE + 1


@pytest.mark.parametrize("where", ["network", "callback"])
def test_the_number_is_put_back_when_the_call_raises(call, where):
    def fails(*_):
        raise RuntimeError("stopped")

    torch.set_num_threads(MORE)
    if where == "network":
        call.pipe.unet.register_forward_hook(fails)
    with pytest.raises(RuntimeError, match="stopped"):
        call(fails if where == "callback" else None)
    assert torch.get_num_threads() == MORE


def test_the_stock_call_is_left_alone(call):
    torch.set_num_threads(MORE)
    assert set(call(guided=False)) == {MORE}


def test_evidence_outside_of_a_call_stays_within_the_cores(textured_plane, monkeypatch):
    torch.set_num_threads(MORE)
    seen, make = [], guidance_module.make_evidence
    monkeypatch.setattr(
        guidance_module,
        "make_evidence",
        lambda *given: (seen.append(torch.get_num_threads()), make(*given))[1],
    )
    pair = textured_plane
    left = torch.from_numpy(pair.left).permute(2, 0, 1)[None].float()
    GeometryGuidance.paper(pair.right, pair.K, pair.E).prepare(left)
    assert seen == [CORES] and torch.get_num_threads() == MORE


def test_blocks_of_two_threads_do_not_meet():
    """Each thread has its own number; the one that ends last does not leave the other's cap behind."""
    torch.set_num_threads(MORE)
    meet, found = threading.Barrier(2, timeout=30), {}

    def work(name, ends_first):
        torch.set_num_threads(MORE)
        with threads.WithinCores():
            meet.wait()
            if not ends_first:
                meet.wait()
            found[name, "inside"] = torch.get_num_threads()
        found[name, "after"] = torch.get_num_threads()
        if ends_first:
            meet.wait()

    both = [threading.Thread(target=work, args=args) for args in (("first", True), ("last", False))]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert {value for (_, when), value in found.items() if when == "inside"} == {CORES}
    assert {value for (_, when), value in found.items() if when == "after"} == {MORE}
    later = []
    thread = threading.Thread(target=lambda: later.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert later == [MORE] and torch.get_num_threads() == MORE


@pytest.mark.parametrize(("counted", "cores"), [(1, 1), (10**6, None), (0, 1)])
def test_the_least_of_quota_and_affinity_counts(monkeypatch, counted, cores):
    monkeypatch.undo()
    monkeypatch.setattr(threads.cv2, "getNumberOfCPUs", lambda: counted)
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else counted
    assert threads.available_cores() == (usable if cores is None else cores)


def test_one_core_of_the_affinity_is_one_core(monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3}, raising=False)
    assert threads.available_cores() == 1


def test_parts_of_a_program_share_the_cores(monkeypatch):
    monkeypatch.setattr(threads, "available_cores", lambda: 6)
    torch.set_num_threads(5)
    for among, inside in ((1, 5), (2, 3), (4, 1), (12, 1)):
        with threads.WithinCores(among):
            assert torch.get_num_threads() == inside
        assert torch.get_num_threads() == 5
