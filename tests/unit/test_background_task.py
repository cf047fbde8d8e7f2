"""``BackgroundTask``: what its answer holds, and that it is the function's own."""

from __future__ import annotations

import gc
import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch

from geodiff_plugin import GeometryGuidance, _kernels, _threads
from geodiff_plugin._kernels import without_kernels
from geodiff_plugin._threads import BackgroundTask, sent_to_cpu, tensors_of
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.matching import rows


def _reachable(evidence: Evidence) -> dict[int, torch.Tensor]:
    """All tensors that an evidence refers to, however, without what its rows are still working on."""
    seen, found, queue = set[int](), dict[int, torch.Tensor](), [evidence]
    while queue:
        value = queue.pop()
        if id(value) in seen or isinstance(value, (type, BackgroundTask)) or callable(value):
            continue
        seen.add(id(value))
        if isinstance(value, torch.Tensor):
            found[id(value)] = value
        else:
            queue += gc.get_referents(value)
    return found


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    pair = read_demo_pair()
    guidance = GeometryGuidance(pair.right, (pair.rig.K_left, pair.rig.K_right), pair.rig.E)
    left_01 = torch.from_numpy(pair.left).movedim(-1, 0)[None].float() / 255.0
    (made,) = guidance.prepare(left_01)
    return made


def test_every_tensor_of_an_evidence_is_kept_for_the_stream_that_reads_it(evidence: Evidence):
    found = {id(tensor) for tensor in tensors_of([evidence])}
    assert len(found) > 10
    assert found >= set(_reachable(evidence))


def test_the_answer_is_worked_out_at_once_where_the_caller_needs_the_same_cores():
    calls: list[int] = []
    answer = BackgroundTask(lambda: calls.append(1) or "answer", torch.device("cpu"), own_stream=True)
    assert calls == [1]
    assert (answer.result(), answer.result(), calls) == ("answer", "answer", [1])
    answer.close()


def test_what_the_function_raises_at_once_reaches_the_caller():
    with pytest.raises(ZeroDivisionError):
        BackgroundTask(lambda: 1 / 0, torch.device("cpu"))


class Stream:
    """A stream of a made-up card; all streams note in one list what they are told."""

    def __init__(self, name: str, said: list[tuple[str, str]], device: torch.device) -> None:
        self.name, self.said, self.device = name, said, device

    def record_event(self) -> SimpleNamespace:
        self.said.append((self.name, "records an event"))
        return SimpleNamespace(
            wait=lambda: self.said.append((now.stream.name, "waits for the event")),
            synchronize=lambda: self.said.append((self.name, "is waited for")),
        )

    def wait_stream(self, other: Stream) -> None:
        self.said.append((self.name, f"waits for {other.name}"))


class OnCard(torch.Tensor):
    """A tensor that says that it is on a card, and notes the stream that it is kept for."""

    is_cuda = True

    def record_stream(self, stream: Stream) -> None:
        stream.said.append((stream.name, "keeps the tensor"))


#: The stream that work of a thread goes to.
now = threading.local()


@pytest.fixture
def card(monkeypatch) -> SimpleNamespace:
    """A made-up card: its device, and what its two streams, the caller's and one beside it, are told."""
    device, said = torch.device("cuda", 0), list[tuple[str, str]]()
    beside = Stream("beside", said, device)

    @contextmanager
    def on(stream: Stream):
        before, now.stream = getattr(now, "stream", None), stream
        yield
        now.stream = before

    now.stream = Stream("caller", said, device)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda _: now.stream)
    monkeypatch.setattr(torch.cuda, "stream", on)
    monkeypatch.setattr(_threads, "_task_stream", lambda _: beside)
    return SimpleNamespace(device=device, said=said)


def test_on_a_card_the_callers_stream_waits_for_the_answer_and_keeps_its_tensors_once(card):
    seen = []

    def work() -> dict[str, list[torch.Tensor]]:
        seen.append((now.stream.name, torch.is_grad_enabled(), threading.current_thread().name))
        return {"parts": [torch.zeros(2), torch.zeros(3).as_subclass(OnCard)]}

    answer = BackgroundTask(work, card.device, own_stream=True)
    first = answer.result()
    assert answer.result() is first
    ((stream, gradients, thread),) = seen
    assert (stream, gradients) == ("beside", False) and thread != threading.current_thread().name
    assert card.said == [
        ("caller", "records an event"),
        ("beside", "waits for the event"),
        ("caller", "waits for beside"),
        ("caller", "keeps the tensor"),
    ]


def test_every_stream_that_asks_waits_for_the_answer(card):
    """As that of another thread does, whose pipeline shares the guidance."""
    answer = BackgroundTask(lambda: torch.zeros(2).as_subclass(OnCard), card.device, own_stream=True)
    answer.result()
    now.stream = Stream("another", card.said, card.device)
    before = len(card.said)
    for _ in range(2):
        answer.result()
    assert card.said[before:] == [("another", "waits for beside"), ("another", "keeps the tensor")]


def test_the_stream_of_who_closes_waits_for_what_nobody_asked_for(card):
    """Else the memory that the work still reads could be given away."""
    answer = BackgroundTask(lambda: torch.zeros(2), card.device, own_stream=True)
    answer.close()
    assert card.said[-1] == ("caller", "waits for beside")


def test_work_that_reads_nothing_of_the_caller_waits_for_nothing_on_its_stream(card):
    answer = BackgroundTask(lambda: now.stream.name, card.device, own_stream=True, follows=False)
    assert answer.result() == "beside"
    assert card.said == [("caller", "waits for beside")]


def test_without_a_stream_of_its_own_the_work_goes_to_the_callers(card):
    answer = BackgroundTask(lambda: now.stream.name, card.device)
    assert answer.result() == "caller" and card.said == []


def test_the_thread_has_the_context_of_its_caller(card):
    kept = _kernels._switched_on
    with without_kernels():
        answer = BackgroundTask(kept.get, card.device)
    assert answer.result() is False and kept.get() is True


def test_closing_waits_for_the_work_and_what_it_raised_is_for_whoever_asks(card):
    ended = []

    def work() -> None:
        time.sleep(0.05)
        ended.append(1)
        raise ZeroDivisionError

    answer = BackgroundTask(work, card.device)
    answer.close()
    assert ended == [1]
    with pytest.raises(ZeroDivisionError):
        answer.result()


def test_a_thread_stays_for_the_next_work(card):
    first = BackgroundTask(threading.get_ident, card.device).result()
    deadline = time.monotonic() + 30
    while BackgroundTask(threading.get_ident, card.device).result() != first:  # it may not be idle at once
        assert time.monotonic() < deadline


def test_work_may_wait_for_other_work_however_deep(card):
    def depth(left: int) -> int:
        return left and 1 + BackgroundTask(lambda: depth(left - 1), card.device).result()

    assert BackgroundTask(lambda: depth(100), card.device).result() == 100


def test_closing_waits_for_the_threads_that_an_answer_holds(card):
    ended = []

    def work() -> None:
        time.sleep(0.05)
        ended.append(1)

    answer = BackgroundTask(lambda: {"still": [BackgroundTask(work, card.device)]}, card.device)
    answer.close()
    assert ended == [1]


def test_what_a_device_is_asked_for_is_waited_for_where_it_is_needed(card):
    received = sent_to_cpu(torch.arange(3).as_subclass(OnCard))
    assert card.said == [("caller", "records an event")]
    assert received().tolist() == [0, 1, 2] and card.said[1:] == [("caller", "is waited for")]
    here = torch.arange(3)
    assert sent_to_cpu(here)() is here


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_no_work_outlives_a_guided_call_that_ends_early(pipe, textured_plane, monkeypatch, error):
    """As on CUDA, where the rows are matched beside the network, and nobody asks for them then."""
    monkeypatch.setattr(_threads, "leaves_cpu_free", lambda device: True)
    begun, ended, pair = threading.Event(), [], textured_plane

    def slowly(*args):
        begun.set()
        time.sleep(0.3)
        ended.append(1)
        return certain_shear(*args)

    certain_shear = rows.certain_shear
    monkeypatch.setattr(rows, "certain_shear", slowly)

    def stops(*_):
        assert begun.wait(30)
        raise error

    pipe.unet.register_forward_hook(stops)
    with pytest.raises(error):
        pipe(pair.left, guidance=GeometryGuidance(pair.right, pair.K, pair.E), num_inference_steps=2)
    assert ended == [1]
