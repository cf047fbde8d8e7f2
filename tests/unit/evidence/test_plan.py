"""The plan of phase 1: what each task is given, what completes an evidence, and what closing waits for."""

from __future__ import annotations

import gc
import threading
import time
from contextlib import contextmanager
from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._internal import kernels as _kernels
from geodiff_plugin._internal import threads as _threads
from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin._internal.threads import BackgroundTask, sent_to_cpu, tensors_of
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.evidence import plan as module
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.plan import CheckedRows, EvidencePlan, RowTasks, fit_in_background
from geodiff_plugin.evidence.pose_check import CheckedPoses
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.gaps import find_gaps
from geodiff_plugin.matching.rows import RowImages, RowShifts
from geodiff_plugin.trust import FactSheet, RowsStage, rolling_shutter
from geodiff_plugin.trust.field_of_view import FieldOfView, ViewAngle
from geodiff_plugin.trust.inverse_pose import InversePose, Preference
from geodiff_plugin.trust.letterbox import Letterbox, LetterboxWidth
from tests.views import view_of

NATIVE = PosedViews(view_of(torch.zeros(3, 6, 8), np.eye(3)), ())
FACTS = FactSheet({InversePose: Preference(False)})
OF_POSES, OF_ROWS = FactSheet({FieldOfView: ViewAngle(50.0)}), FactSheet({Letterbox: LetterboxWidth(0.1)})
EVIDENCE = Evidence(NATIVE, NATIVE, None, None, points_outside=3, facts=FACTS)
POSES = BackgroundTask.known(CheckedPoses((), "report", OF_POSES))
ROWS = BackgroundTask.known(CheckedRows("rows", OF_ROWS))


@pytest.mark.parametrize("poses", [None, POSES])
@pytest.mark.parametrize("rows", [None, ROWS])
def test_an_evidence_is_completed_by_its_tasks_and_otherwise_unchanged(poses, rows):
    plan = EvidencePlan(EVIDENCE, rows, poses)
    found = plan.complete()
    assert found.report == (None if poses is None else "report")
    assert found.rows == (None if rows is None else "rows")
    facts = FACTS
    facts = facts if poses is None else facts | OF_POSES
    facts = facts if rows is None else facts | OF_ROWS
    assert found.facts == facts
    for field in fields(Evidence):
        if field.name not in ("rows", "report", "facts"):
            assert getattr(found, field.name) is getattr(EVIDENCE, field.name), field.name
    assert plan.evidence is EVIDENCE and EVIDENCE.report is None and EVIDENCE.facts == FACTS


@pytest.fixture
def threads(monkeypatch):
    """As on a device that leaves the CPU free: tasks run in threads."""
    monkeypatch.setattr(_threads, "leaves_cpu_free", lambda device: True)


@pytest.mark.parametrize("names", [(), ("rows",), ("poses",), ("rows", "poses")])
def test_closing_waits_for_all_tasks_and_what_they_raised_is_for_whoever_asks(threads, names):
    ended = []

    def work() -> None:
        time.sleep(0.05)
        ended.append(1)
        raise ZeroDivisionError

    plan = EvidencePlan(EVIDENCE, **{name: BackgroundTask(work, torch.device("cpu")) for name in names})
    plan.close()
    assert len(ended) == len(names)
    if names:
        with pytest.raises(ZeroDivisionError):
            plan.complete()
    else:
        assert plan.complete() == EVIDENCE


def test_the_fit_is_worked_out_from_one_set_of_grey_images(monkeypatch):
    greys = []
    monkeypatch.setattr(module, "posed_greys", lambda posed: greys.append(posed) or "greys")
    monkeypatch.setattr(module, "fit_of_small", lambda given: ("small", given))
    monkeypatch.setattr(module, "image_facts", lambda given: ("facts", given))
    monkeypatch.setattr(module, "measure_fit", lambda given, small: ("fit", given, small()))
    tasks = fit_in_background(NATIVE)
    assert greys == [NATIVE]
    assert tasks.small.result() == ("small", "greys") and tasks.images.result() == ("facts", "greys")
    assert tasks.fit.result() == ("fit", "greys", ("small", "greys"))


def matches_up_to(nearest: float) -> Matches:
    return Matches(torch.tensor([[[[0.1, nearest]]]]), torch.ones(1, 1, 1, 2), torch.ones(1))


@pytest.mark.parametrize(("of_match", "of_point"), [(0.5, 2.0), (2.0, 0.5), (2.0, None)])
@pytest.mark.parametrize("on_the_left", [False, True])
def test_rows_are_matched_up_to_the_nearest_of_matches_and_known_points(
    monkeypatch, of_match, of_point, on_the_left
):
    """And checked, with the lines of the left image as it is matched."""
    levels = torch.randint(0, 256, (2, 6, 8), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    rgb_images = RowImages(levels, 0.0, 10.0, np.float32(0.7 if on_the_left else -0.7))
    flip = -1 if on_the_left else 1
    left, right = levels.numpy()[:, :, ::flip]
    known = np.ones((6, 8), bool)
    shifts = RowShifts(left, np.zeros((6, 8), np.float32), known, find_gaps(known))

    def match_rows(given, greys, nearest_px):
        assert given is rgb_images and nearest_px == pytest.approx(2.0 * 10.0 * 0.7)
        np.testing.assert_array_equal(greys, (left, right))
        return shifts

    measured = []
    monkeypatch.setattr(module, "match_rows", match_rows)
    monkeypatch.setattr(module, "row_matches", lambda given, found: (given, found))
    monkeypatch.setattr(module, "vertical_lines", lambda grey: ("lines of", grey))
    monkeypatch.setattr(module, "measure", lambda stage: measured.append(stage) or OF_ROWS)
    points = None if of_point is None else matches_up_to(of_point)
    found = RowTasks(rgb_images, (60, 80)).match(matches_up_to(of_match), points).result()
    assert found == CheckedRows((rgb_images, shifts), OF_ROWS)
    (stage,) = measured
    assert isinstance(stage, RowsStage) and stage[:4] == shifts and stage.size == (60, 80)
    said, grey = stage.lines
    assert said == "lines of"
    np.testing.assert_array_equal(grey, left)


def test_tasks_in_threads_share_one_set_of_grey_images(threads):
    left, right = torch.rand(2, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    K, T = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]), np.eye(4)
    T[0, 3] = -0.1
    tasks = fit_in_background(PosedViews(view_of(left, K), (view_of(right, K, T),)))
    assert tasks.fit.result().greys is tasks.small.result().greys
    assert tasks.fit.result().greys.heights == [48, 48] and tasks.fit.result().rig
    assert isinstance(tasks.images.result(), FactSheet)


def _reachable(value: object) -> dict[int, torch.Tensor]:
    """All tensors that a value refers to, however, but for the answers of tasks, which keep their own."""
    seen, found, queue = set[int](), dict[int, torch.Tensor](), [value]
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
def plan() -> EvidencePlan:
    pair = read_demo_pair()
    guidance = GeometryGuidance(pair.right, (pair.rig.K_left, pair.rig.K_right), pair.rig.E)
    left_01 = torch.from_numpy(pair.left).movedim(-1, 0)[None].float() / 255.0
    (made,) = guidance.plan_evidence(left_01)
    return made


def test_every_tensor_of_a_plan_is_kept_for_the_stream_that_reads_it(plan: EvidencePlan):
    found = {id(tensor) for tensor in tensors_of([plan])}
    assert len(found) > 10
    assert found >= set(_reachable(plan))


@pytest.mark.parametrize(("name", "count"), [("rows", 5), ("poses", 1)])
def test_every_tensor_of_a_task_of_a_plan_is_kept_as_well(plan: EvidencePlan, name: str, count: int):
    """Maps and the baseline of the rows; the image of the right view, whose camera is not on the device."""
    answer = getattr(plan, name).result()
    found = {id(tensor) for tensor in tensors_of(answer)}
    assert len(found) == count
    assert found >= set(_reachable(answer))


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
    """A stream of a made-up card; all streams record their calls in one list."""

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
    """A tensor that claims to be on a card, and records the stream that it is kept for."""

    is_cuda = True

    def record_stream(self, stream: Stream) -> None:
        stream.said.append((stream.name, "keeps the tensor"))


#: The stream that work of a thread goes to.
now = threading.local()


@pytest.fixture
def card(monkeypatch) -> SimpleNamespace:
    """A made-up card: its device, and the calls of its two streams."""
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
    assert not answer.failed and card.said[-1] != ("caller", "waits for beside"), "it is not asked for yet"
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
    assert ended == [1] and answer.failed
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


def test_what_a_device_is_asked_for_is_waited_for_where_it_is_needed(card):
    received = sent_to_cpu(torch.arange(3).as_subclass(OnCard))
    assert card.said == [("caller", "records an event")]
    assert received().tolist() == [0, 1, 2] and card.said[1:] == [("caller", "is waited for")]
    here = torch.arange(3)
    assert sent_to_cpu(here)() is here


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_no_work_outlives_a_guided_call_that_ends_early(pipe, textured_plane, monkeypatch, error):
    """As on CUDA, where the rows are matched next to the network, and nobody asks for them then."""
    monkeypatch.setattr(_threads, "leaves_cpu_free", lambda device: True)
    begun, ended, pair = threading.Event(), [], textured_plane

    def slowly(*args):
        begun.set()
        time.sleep(0.3)
        ended.append(1)
        return certain_shear(*args)

    certain_shear = rolling_shutter.certain_shear
    monkeypatch.setattr(rolling_shutter, "certain_shear", slowly)

    def stops(*_):
        assert begun.wait(30)
        raise error

    pipe.unet.register_forward_hook(stops)
    with pytest.raises(error):
        pipe(pair.left, guidance=GeometryGuidance(pair.right, pair.K, pair.E), num_inference_steps=2)
    assert ended == [1]
