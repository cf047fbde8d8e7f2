"""The newest frame is next, whatever the network does; errors and the end reach the caller."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from geodiff_plugin import InputError, Rig, live
from geodiff_plugin.cameras import Camera
from geodiff_plugin.streaming import loop
from geodiff_plugin.streaming.sources import StereoFrame


@pytest.fixture
def rig(textured_plane) -> Rig:
    camera = Camera(textured_plane.K)
    return Rig(camera, camera, textured_plane.E)


def frames_of(pair, count: int):
    return [(pair.left, pair.right)] * count


def test_every_frame_of_a_source(pipe, rig, textured_plane):
    sent = [StereoFrame(textured_plane.left, textured_plane.right, stamp) for stamp in "abc"]
    results = list(live(pipe, sent, rig, every_frame=True, check_every=2, num_inference_steps=1))
    assert [(each.number, each.stamp, each.checked) for each in results] == [
        (0, "a", True),
        (1, "b", False),
        (2, "c", True),
    ]
    for each, frame in zip(results, sent, strict=True):
        assert 0 < each.latency_s <= time.perf_counter() - frame.arrived_s
        assert each.output.prediction.shape == (1, *textured_plane.left.shape[:2], 1)
        np.testing.assert_array_equal(each.output.prediction, results[0].output.prediction)  # the same noise
        assert each.output.verdict.status == "trusted" or each.output.verdict.reasons


class Rig1:
    """Stands in for a ``LiveRig``: passes frames on."""

    def __init__(self):
        self.prepared = []

    def prepare(self, frame):
        self.prepared.append(frame.stamp)
        return SimpleNamespace(frame=frame, left=frame.left, checked=False)


def test_the_newest_frame_is_next_while_the_network_is_busy():
    """The source is far ahead: the network gets the frame prepared during its last call, then the newest."""
    image, sent = np.zeros((2, 2, 3), np.uint8), threading.Event()

    def source():
        for number in range(100):
            yield StereoFrame(image, image, number)
        sent.set()
        time.sleep(0.2)  # the last frame stays the newest

    def run(prepared):
        assert sent.wait(5)
        return "output"

    rig = Rig1()
    results = list(loop._results(run, source(), rig, waits=False))
    numbers = [each.number for each in results]
    assert numbers[-1] == 99 and len(numbers) <= 4 and numbers == sorted(set(numbers))
    assert rig.prepared == numbers  # no evidence was wasted on a frame without a result


@pytest.mark.parametrize("fails", ["source", "rig", "run"])
def test_an_error_ends_the_threads_and_reaches_the_caller(fails):
    image = np.zeros((2, 2, 3), np.uint8)

    def fail(*_):
        raise OSError(f"{fails} failed")

    def source():
        yield StereoFrame(image, image)
        if fails == "source":
            fail()
        while True:
            yield StereoFrame(image, image)

    rig = Rig1()
    rig.prepare = fail if fails == "rig" else rig.prepare
    results = loop._results(fail if fails == "run" else lambda _: "output", source(), rig, waits=True)
    with pytest.raises(OSError, match=f"{fails} failed"):
        for _ in results:
            pass
    names = {thread.name for thread in threading.enumerate()}
    assert not any(name.startswith("geodiff-live") for name in names)


def test_a_caller_that_stops_ends_the_threads(pipe, rig, textured_plane):
    endless = iter(lambda: (textured_plane.left, textured_plane.right), None)
    results = live(pipe, endless, rig, num_inference_steps=1)
    next(results)
    results.close()
    names = {thread.name for thread in threading.enumerate()}
    assert not any(name.startswith("geodiff-live") for name in names)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rig": "calib.txt"}, "rig must be a Rig.*read_calibration"),
        ({"source": 1.5}, "source must be a device number"),
        ({"preset": "quick"}, "preset"),
        ({"check_every": -1}, "check_every"),
        ({"source": "missing.mp4"}, "missing.mp4"),
    ],
)
def test_arguments_are_checked_at_once(pipe, rig, arguments, message):
    given = {"source": [], "rig": rig} | arguments
    with pytest.raises(InputError, match=message):
        live(pipe, given.pop("source"), given.pop("rig"), **given)


def test_an_item_that_is_no_frame(pipe, rig):
    with pytest.raises(InputError, match="a frame of the source must be a StereoFrame or"):
        list(live(pipe, [np.zeros((2, 2, 3))], rig))


def test_a_pipeline_without_guidance_gets_it(make_pipeline, rig, textured_plane):
    (result,) = live(
        make_pipeline(), frames_of(textured_plane, 1), rig, every_frame=True, num_inference_steps=1
    )
    assert result.output.verdict.status
