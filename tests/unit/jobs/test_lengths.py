"""Known and measured lengths of a capture, worked out again from the points that its pixels show."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera, Distortion
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.formats.layouts import CaptureFrame
from geodiff_plugin.jobs.lengths import (
    KnownScale,
    check_lengths,
    known_scale,
    measure,
    measured_words,
    spans_to_measure,
)
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.pose.multiview import SolvedCapture
from tests.unit.jobs.made_runs import pose

SIZE = (60, 44)
#: As given, before the solve.
K_GIVEN = np.array([[50.0, 0, 29.0], [0, 54.0, 21.0], [0, 0, 1]])
#: As solved, another one for every frame.
KS = np.stack([K_GIVEN + np.diag([3.0 * n, 2.0 * n, 0]) for n in range(3)])
ES = np.stack(
    [
        pose((2, 5, -3), (0.4, 0.1, 0.2)),
        pose((-4, 1, 2), (1.0, -0.3, 0.5)),
        pose((1, -2, 6), (0.2, 0.9, -0.4)),
    ]
)


def depth_of(name: str) -> np.ndarray:
    width, height = SIZE
    number = int(name[1:])
    return (2.0 + number + 0.02 * np.arange(width)[None] + 0.05 * np.arange(height)[:, None]).astype(float)


def confidence_of(name: str) -> np.ndarray:
    width, height = SIZE
    return np.clip(0.3 + 0.01 * np.arange(width)[None] + 0.0 * np.arange(height)[:, None], 0, 1)


def sigma_of(name: str) -> np.ndarray:
    """Smaller where the confidence is higher, but not what follows from the confidence alone."""
    return depth_of(name) * 0.05 * (1.2 - confidence_of(name))


def maps_of(name: str):
    return depth_of(name), confidence_of(name), sigma_of(name)


@pytest.fixture
def capture() -> Capture:
    lens = Distortion("opencv", np.array([-0.15, 0.02, 0.0, 0.0]))
    frames = [
        CaptureFrame(
            f"f{n}", Path(f"f{n}.png"), E=ES[n], camera=Camera(K_GIVEN, SIZE, lens if n == 2 else None)
        )
        for n in range(3)
    ]
    made = Capture(frames, "test", None, ())
    made.solved = SolvedCapture("solved", ES, None, KS, np.ones(3, bool), np.zeros((0, 3)), ())
    return made


def options(**typed) -> CaptureOptions:
    return CaptureOptions(path=Path("scan"), **typed)


def point(name: str, x: int, y: int) -> np.ndarray:
    """What a pixel of a frame shows, in its camera."""
    K, z = KS[int(name[1:])], depth_of(name)[y, x]
    return np.array([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z])


def relative_spread(name: str, x: int, y: int) -> float:
    return sigma_of(name)[y, x] / depth_of(name)[y, x]


def length_of(name: str, a, b) -> tuple[float, float]:
    """The distance of two pixels' places, and its deviation where errors move each along its ray."""
    first, second = point(name, *a), point(name, *b)
    length = np.linalg.norm(second - first)
    along = [(second - first) / length @ each for each in (first, second)]
    spreads = [relative_spread(name, *each) for each in (a, b)]
    return length, math.hypot(*(x * s for x, s in zip(along, spreads, strict=True)))


def test_a_known_length_sets_the_scale_by_the_depth_of_its_frame(capture):
    asked = []

    def noting(name):
        asked.append(name)
        return maps_of(name)

    scale = known_scale(capture, options(known_length="f1:10,7,52,33,1.75"), noting)
    length, spread = length_of("f1", (10, 7), (52, 33))
    assert asked == ["f1"]
    assert scale.factor == pytest.approx(1.75 / length)
    assert scale.spread == pytest.approx(spread / length)
    assert (scale.doubt is not None) == (spread / length > 0.1)


@pytest.mark.parametrize(("ends", "doubted"), [((40, 3, 58, 40), False), ((1, 2, 9, 4), True)])
def test_a_length_that_is_measured_to_no_better_than_a_tenth_is_doubted(capture, ends, doubted):
    x1, y1, x2, y2 = ends
    length, spread = length_of("f0", (x1, y1), (x2, y2))
    assert (spread / length > 0.1) == doubted
    scale = known_scale(capture, options(known_length=f"f0:{x1},{y1},{x2},{y2},2"), maps_of)
    assert (scale.doubt is not None) == doubted
    if doubted:
        assert scale.doubt.code == "capture.length" and scale.doubt.is_reason
        assert f"in f0 is known to {100 * spread / length:.0f} %" in scale.doubt


def test_without_a_confidence_the_prior_alone_measures(capture):
    scale = known_scale(capture, options(known_length="f0:40,3,58,40,2"), lambda name: (depth_of(name), None))
    assert scale.spread == 1.0 and "known only by the prior" in scale.doubt


def test_a_known_length_of_a_distorted_frame_is_taken_where_its_ends_lie_without_distortion(capture):
    taken = np.array([[12.0, 9.0], [49.0, 36.0]])
    coefficients = np.array([-0.15, 0.02, 0.0, 0.0])
    ends = cv2.undistortPoints(taken[:, None], K_GIVEN, coefficients, P=K_GIVEN)[:, 0]
    pixels = [tuple(np.rint(end).astype(int)) for end in ends]
    assert pixels != [tuple(end) for end in taken.astype(int)]
    length, _ = length_of("f2", *pixels)
    scale = known_scale(capture, options(known_length="f2:12,9,49,36,3"), maps_of)
    assert scale.factor == pytest.approx(3 / length)
    (span,) = spans_to_measure(capture, options(measure=("f2:12,9,49,36",)))
    np.testing.assert_array_equal(span.taken, taken)
    np.testing.assert_allclose(span.ends, ends, atol=1e-3)


def test_the_distance_of_two_frames_and_metres_per_unit_set_the_scale(capture):
    apart = np.linalg.norm(np.subtract((1.0, -0.3, 0.5), (0.2, 0.9, -0.4)))
    scale = known_scale(capture, options(distance="f1, f2 ,2.5"), maps_of)
    assert scale == KnownScale(pytest.approx(2.5 / apart), 0.0, None)
    assert known_scale(capture, options(metres_per_unit=0.75), maps_of) == KnownScale(0.75)
    assert known_scale(capture, options(), maps_of) is None


def test_lengths_are_measured_in_the_finished_maps_with_both_spreads(capture, tmp_path):
    for n in range(3):
        (tmp_path / f"f{n}").mkdir()
        np.save(tmp_path / f"f{n}/depth.npy", depth_of(f"f{n}"))
        np.save(tmp_path / f"f{n}/confidence.npy", confidence_of(f"f{n}"))
        np.save(tmp_path / f"f{n}/sigma.npy", sigma_of(f"f{n}"))
    typed = options(measure=("f0:40,3,58,40", "f1:10,7,52,33"))
    records = measure(capture, spans_to_measure(capture, typed), tmp_path, ["f1"], 0.07)
    for record, name, ends in zip(records, ("f0", "f1"), ((40, 3, 58, 40), (10, 7, 52, 33)), strict=True):
        length, spread = length_of(name, ends[:2], ends[2:])
        assert record["frame"] == name and record["pixels"] == [list(ends[:2]), list(ends[2:])]
        assert record["length"] == pytest.approx(length)
        assert record["spread"] == pytest.approx(math.hypot(spread, 0.07 * length))
        assert record["unit"] is None and record["trusted"] == (name == "f0")
    capture.unit = "m"
    (record,) = measure(capture, spans_to_measure(capture, typed)[:1], tmp_path, [], 0.0)
    length, spread = length_of("f0", (40, 3), (58, 40))
    assert record["unit"] == "m" and record["spread"] == pytest.approx(spread)
    said = measured_words(record | {"length": 1.234, "spread": 0.056})
    assert said == "f0 (40, 3) to (58, 40): 1.23 ± 0.06 m"
    assert measured_words(record | {"spread": None, "trusted": False}).endswith(" (not trusted)")


def test_an_end_in_a_hole_has_no_length(capture, tmp_path):
    (tmp_path / "f0").mkdir()
    depth = depth_of("f0").copy()
    depth[40, 58] = 0
    for name, values in (("depth", depth), ("confidence", confidence_of("f0")), ("sigma", sigma_of("f0"))):
        np.save(tmp_path / f"f0/{name}.npy", values)
    typed = options(measure=("f0:40,3,58,40", "f0:40,3,50,40"))
    hole, other = measure(capture, spans_to_measure(capture, typed), tmp_path, [], 0.0)
    assert (hole["length"], hole["spread"]) == (None, None) and other["length"] > 0
    assert measured_words(hole) == "f0 (40, 3) to (58, 40): no reliable depth at an end"


@pytest.mark.parametrize(
    "typed",
    [
        {"known_length": "f0:1,2,3,4"},
        {"known_length": "1,2,3,4,5"},
        {"known_length": "f0:1,2,3,x,5"},
        {"known_length": "f0:1,2,3,4,0"},
        {"known_length": "f9:1,2,3,4,5"},
        {"known_length": "f0:1,2,1,2,5"},
        {"known_length": "f0:60,2,1,2,5"},
        {"known_length": "f0:1,44,1,2,5"},
        {"known_length": "f0:1,2,-1,2,5"},
        {"distance": "f0,f1"},
        {"distance": "f0,f1,f2,3"},
        {"distance": "f0,f1,x"},
        {"distance": "f0,f1,-1"},
        {"distance": "f0,f9,1"},
        {"measure": ("f0:1,2,3,4,5",)},
        {"measure": ("f1:1,2,3,4",), "frames": "f0,f2"},
    ],
)
def test_lengths_that_a_capture_cannot_have_are_rejected(capture, typed):
    with pytest.raises(InputError, match=r"\A(--known-length|--distance|--measure|a frame)"):
        check_lengths(capture, options(**typed))


@pytest.mark.parametrize(
    "typed",
    [
        {"known_length": "f0:59,43,0,0,5"},
        {"known_length": "f0:1,2,1,3,5"},
        {"known_length": "f0:1,2,0,2,5"},
        {"distance": "f0,f1,0.001"},
        {"measure": ("f0:1,2,3,4", "f2:20,12,30,20"), "frames": "f0,f2"},
        {},
    ],
)
def test_lengths_up_to_the_edges_of_an_image_are_taken(capture, typed):
    check_lengths(capture, options(**typed))


def test_pixels_outside_the_undistorted_image_are_rejected(capture):
    with pytest.raises(InputError, match="in the undistorted image"):
        check_lengths(capture, options(measure=("f2:0,0,30,20",)))


def test_two_frames_at_one_place_and_one_place_twice_set_no_scale(capture):
    E = ES.copy()
    E[1, :3, 3] = E[0, :3, 3]
    capture.solved = SolvedCapture("solved", E, None, KS, np.ones(3, bool), np.zeros((0, 3)), ())
    with pytest.raises(InputError, match="between frames with different camera positions"):
        known_scale(capture, options(distance="f0,f1,1"), maps_of)
    with pytest.raises(InputError, match="between two different points"):  # in one pixel of the map
        known_scale(capture, options(known_length="f0:10,10,10.2,10,1"), maps_of)
