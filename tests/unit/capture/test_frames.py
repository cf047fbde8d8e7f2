"""``Capture``: neighbours against a loop over shared points; arguments of the solve and of the pipeline."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin import Capture, InputError
from geodiff_plugin.cameras import Camera, Distortion
from geodiff_plugin.capture import frames as frames_module
from geodiff_plugin.capture.agreement import agreed
from geodiff_plugin.capture.frames import choose_neighbours
from geodiff_plugin.capture.results import fuse, write_map, write_mesh
from geodiff_plugin.cli.run import run_capture, summary
from geodiff_plugin.cli.terminal import EXIT_SOME_FAILED
from geodiff_plugin.evaluation.baselines import PriorCache
from geodiff_plugin.evaluation.captures import f_score
from geodiff_plugin.evaluation.options import COMMANDS, CaptureEvalOptions
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.layouts import CaptureFrame
from geodiff_plugin.jobs import capture as run
from geodiff_plugin.jobs import capture_frame, capture_frames, capture_poses
from geodiff_plugin.jobs.lengths import Span, measure, spans_to_measure
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.jobs.prior import prior_of_capture
from geodiff_plugin.plotting import grid
from geodiff_plugin.pose.multiview import GivenFrames, SolvedCapture, candidate_pairs, solve_capture
from geodiff_plugin.pose.reconstruction import Reconstruction
from geodiff_plugin.result.sigma import depth_sigma
from geodiff_plugin.trust import FactSheet, judge
from geodiff_plugin.types import DepthFrame
from tests.cli.conftest import call
from tests.unit.capture.cameras import ES, KS, NAMES, SIZES, depth_of, image_of, write_capture
from tests.unit.capture_room import FLIP, HALF, SIZE, K, perturbed, render, walk, write_transforms
from tests.views import posed_frame

pytest.importorskip("pycolmap")
END_TO_END = pytest.mark.end_to_end


def expected_neighbours(solved: SolvedCapture, frame: int, most: int, among: list[int] | None) -> list[int]:
    """MVSNet's score with half the weight for points that an earlier neighbour sees, point by point."""
    centres = solved.E[:, :3, 3]
    worth = {}
    for other in range(len(centres)):
        if other == frame or not np.isfinite(centres[other]).all() or (among and other not in among):
            continue
        shared = set(solved.seen[frame][1]) & set(solved.seen[other][1])
        if len(shared) < 12:
            continue
        worth[other] = {}
        for point in shared:
            a, b = (solved.points[point] - centres[i] for i in (frame, other))
            angle = math.degrees(math.atan2(np.linalg.norm(np.cross(a, b)), a @ b))
            sigma = 2.5 if angle < 6 else 10
            worth[other][point] = math.exp(-((angle - 6) ** 2) / (2 * sigma**2))
    chosen, times_seen = [], dict.fromkeys(solved.seen[frame][1], 0)
    best_gain = None
    while worth and len(chosen) < most:
        gains = {
            other: sum(value * 0.5 ** times_seen[point] for point, value in values.items())
            for other, values in worth.items()
        }
        best = max(gains, key=gains.get)
        best_gain = gains[best] if best_gain is None else best_gain
        if gains[best] <= 0.15 * best_gain:
            break
        chosen.append(best)
        for point in worth.pop(best):
            times_seen[point] += 1
    return chosen


def made_up(seed: int) -> SolvedCapture:
    """Nine cameras on a wide arc around 90 points of which each sees some; the last has no pose."""
    rng = np.random.default_rng(seed)
    E = np.tile(np.eye(4), (9, 1, 1))
    E[:, :3, :3] = Rotation.random(9, random_state=seed).as_matrix()
    E[:, :3, 3] = np.c_[np.cumsum(rng.uniform(0.1, 0.9, 9)) - 2, rng.normal(0, 0.3, (9, 2))]
    E[8] = np.nan
    points = rng.normal((0, 0, 6), (1.5, 1.5, 1), (90, 3))
    counts = [70, 60, 50, 45, 40, 35, 30, 20, 60]
    seen = tuple((np.zeros((n, 2)), rng.choice(90, n, replace=False)) for n in counts)
    return SolvedCapture("solved", E, E, np.tile(K, (9, 1, 1)), np.arange(9) < 8, points, seen)


@pytest.mark.parametrize("seed", range(2))
def test_neighbours_are_those_that_a_loop_over_shared_points_finds(seed):
    solved, lengths = made_up(seed), []
    for frame in range(8):
        for most, among in ((1, None), (3, None), (8, None), (4, [1, 3, 6, 7, 8])):
            found = choose_neighbours(solved, frame, most, among)
            assert found == expected_neighbours(solved, frame, most, among)
        lengths.append(len(choose_neighbours(solved, frame, 8)))
    assert min(lengths) < 7 and max(lengths) > 3  # some are worth too little, or share too few points
    with np.errstate(invalid="ignore"):
        assert choose_neighbours(solved, 8, 4) == []


def test_twelve_shared_points_make_a_neighbour():
    """Eleven do not; without a neighbour among those that are given none is chosen."""
    points = np.random.default_rng(0).normal((0, 0, 10), 0.1, (40, 3))
    E = np.tile(np.eye(4), (4, 1, 1))
    E[1:, 0, 3] = 1.0, 1.1, -1.0
    seen = [(np.zeros((n, 2)), np.arange(n)) for n in (40, 11, 12, 30)]
    solved = SolvedCapture("solved", E, E, np.tile(K, (4, 1, 1)), np.ones(4, bool), points, tuple(seen))
    assert sorted(choose_neighbours(solved, 0, 5)) == [2, 3]
    assert choose_neighbours(solved, 0, 5, among=[1]) == []


@pytest.mark.parametrize("kept", [False, True])
def test_without_shared_points_frames_that_look_the_same_way_are_neighbours(kept):
    """The viewing direction is the third column of a rotation: rolling a camera about it changes nothing.

    Frames are in order of their numbers' distance; those at the same place give no baseline.
    """
    base = Rotation.from_euler("xyz", [25, -50, 70], degrees=True)
    turns = ["y", 29], ["z", 80], ["x", 31], None, ["x", 28], ["y", -31], ["z", 10], ["x", -29], ["z", 170]
    E = np.tile(np.eye(4), (9, 1, 1))
    for i, turn in enumerate(turns):
        relative = Rotation.identity() if turn is None else Rotation.from_euler(*turn, degrees=True)
        E[i, :3, :3] = (base * relative).as_matrix()
        E[i, :3, 3] = [0.3 * i, 0.1 * i * i, -0.2 * i]
    E[6, :3, 3] = E[3, :3, 3]  # at the same place
    E[7] = np.nan
    nothing = tuple((np.zeros((0, 2)), np.zeros(0, int)) for _ in E)
    other = E[::-1].copy()  # poses that are not asked for: given ones count before solved ones
    solved = SolvedCapture(
        "solved",
        E if kept else other,
        None if kept else E,
        np.tile(K, (9, 1, 1)),
        np.ones(9, bool),
        np.zeros((0, 3)),
        nothing,
    )
    assert choose_neighbours(solved, 3, 9) == [4, 1, 0, 8]
    assert choose_neighbours(solved, 3, 2) == [4, 1]
    assert choose_neighbours(solved, 7, 9) == []


def test_rays_that_are_parallel_or_opposite_have_an_angle():
    """Their product exceeds 1 by rounding. Cameras at one place see every point along the same ray."""
    points = np.random.default_rng(0).normal((0, 0, 5), 1, (40, 3))
    every = tuple((np.zeros((40, 2)), np.arange(40)) for _ in range(2))
    none = tuple((np.zeros((0, 2)), np.zeros(0, int)) for _ in range(2))
    for seed in range(30):
        E = np.tile(np.eye(4), (2, 1, 1))
        E[0, :3, :3] = Rotation.random(random_state=seed).as_matrix()
        E[1, :3, :3] = E[0, :3, :3] @ np.diag([1, -1, -1])
        E[:, :3, 3] = np.random.default_rng(seed).normal(0, 1, 3)
        solved = SolvedCapture("solved", E, E, np.tile(K, (2, 1, 1)), np.ones(2, bool), points, every)
        assert choose_neighbours(solved, 0, 2) == [1]
        E[1, :3, 3] += 1.0
        assert choose_neighbours(replace(solved, seen=none), 0, 2) == []


def in_memory(**changes) -> Capture:
    """Frames without files."""
    made = [
        CaptureFrame(name, None, E=E, camera=Camera(K, size))
        for name, E, size, K in zip(NAMES, ES, SIZES, KS, strict=True)
    ]
    return Capture([replace(frame, **changes) for frame in made], "kind", "m", [])


@pytest.mark.parametrize(
    ("wanted", "names"),
    [
        (None, "a b c d"),
        (":", "a b c d"),
        ("1:", "b c d"),
        (":2", "a b c"),
        ("1:2", "b c"),
        ("3:3", "d"),
        ("0:3:2", "a c"),
        ("1::002", "b d"),
        ("::3", "a d"),
        ("d, b,", "d b"),
    ],
)
def test_frames_are_chosen_by_name_or_by_number(wanted, names):
    capture = in_memory()
    assert capture.choose(wanted) == names.split() and len(capture) == 4
    assert capture.frame("c") is capture.frames[2]


@pytest.mark.parametrize(
    "wanted", ["2:1", "0:4", "4:4", ":9", "0:3:0", "a:b", "::", "1:2:3:4", "-1:2", "a,e", "e"]
)
def test_frames_that_are_not_there_are_rejected(wanted):
    words = rf"frames \(--frames\) must be NAME,NAME or FIRST:.* from 0 to 3; got '{re.escape(wanted)}'"
    if ":" not in wanted:
        words = r"a frame must be a name of the capture, such as a, b, c; got 'e'\. Use file stems as names"
    with pytest.raises(InputError, match=words):
        in_memory().choose(wanted)


def test_two_frames_of_one_name_are_rejected_and_poses_are_all_or_none():
    frames = in_memory().frames
    with pytest.raises(InputError, match="uniquely named; got a, a"):
        Capture([frames[0], frames[0]], "kind", "m", [])
    capture = Capture(frames, "kind", None, [])
    np.testing.assert_array_equal(capture.poses, ES)
    capture.frames[2] = replace(capture.frames[2], E=None)
    assert capture.poses is None


def test_a_solve_gets_every_frame_and_is_kept_until_other_poses_are_asked_for(tmp_path, monkeypatch):
    calls = []

    def solve(images, given, *, poses, threads):
        calls.append((list(images), given, poses, threads))
        return replace(solved_of(), status=f"solved {len(calls)}")

    monkeypatch.setattr(frames_module, "solve_capture", solve)
    monkeypatch.setattr(frames_module, "available_cores", lambda: 7)
    capture = Capture.open(write_capture(tmp_path))
    with pytest.raises(InputError, match="poses must be one of"):
        capture.solve("moved")
    found = capture.solve(), capture.solve("refined"), capture.solve("given", threads=3)
    assert [each.status for each in found] == [
        "solved 1",
        "solved 1",
        "solved 2",
    ]
    found = capture.solve("given"), capture.solve(), capture.solve("refined")
    assert [each.status for each in found] == [
        "solved 2",
        "solved 2",
        "solved 3",
    ]
    assert [(poses, threads) for *_, poses, threads in calls] == [
        ("refined", 7),
        ("given", 3),
        ("refined", 7),
    ]
    for images, given, *_ in calls:
        assert given.names == NAMES and [camera.size for camera in given.cameras] == SIZES
        np.testing.assert_allclose([camera.K for camera in given.cameras], KS)
        np.testing.assert_allclose(given.E, ES, atol=1e-9)
        for number, grey in enumerate(images):  # by the luma weights of ITU-R BT.601
            expected = 255 * image_of(number) @ [0.299, 0.587, 0.114]
            assert grey.dtype == np.uint8 and np.abs(grey - expected).max() < 0.51


def solved_of(status: str = "solved", connected: tuple[bool, ...] = (True,) * 4) -> SolvedCapture:
    """Solved poses that differ from the given ones, and 60 points of which the frames see different parts."""
    E, rng = ES.copy(), np.random.default_rng(5)
    E[:, :3, :3] = (
        Rotation.from_euler("xyz", [[3, -2, 1], [1, 2, 3], [-2, 1, 4], [2, 3, -1]], degrees=True).as_matrix()
        @ E[:, :3, :3]
    )
    E[:, :3, 3] += rng.normal(0, 0.02, (4, 3))
    points = rng.uniform((-1, -1, 1.5), (1.5, 1, 2.6), (60, 3))
    points[-5:] = ES[0, :3, 3] - ES[0, :3, 2] * 2 + rng.normal(0, 0.1, (5, 3))  # behind the first camera
    rows = [np.r_[0:40, 55:60], np.r_[10:60], np.r_[20:60], np.r_[30:60:2, 0]]
    seen = tuple((np.zeros((len(each), 2)), each) for each in rows)
    return SolvedCapture(status, E, ES, KS * [[[1.01], [1.02], [1.0]]], np.array(connected), points, seen)


@pytest.mark.parametrize("status", ["solved", "estimated", "kept", "given"])
def test_points_on_which_three_frames_agree_are_known_depths(status):
    """Only where the solve moved the poses, and in front of the camera."""
    capture = in_memory()
    capture.solved = solved = solved_of(status, (True, True, False, True))
    for number, name in enumerate(NAMES):
        found = capture.known_depths(name, "tracks")
        if status in ("kept", "given") or number == 2:
            assert found is None
            continue
        expected = []
        for point in solved.seen[number][1]:
            if sum(point in rows for _, rows in solved.seen) >= 3:
                seen = np.linalg.solve(solved.E[number], [*solved.points[point], 1])[:3]
                expected += [seen] if seen[2] > 0 else []
        assert len(expected) < len(solved.seen[number][1])
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
        assert found.dtype == np.float32
    capture.solved = replace(solved, seen=tuple((px[:1], rows[:1]) for px, rows in solved.seen))
    assert capture.known_depths("a", "tracks") is None  # no point is seen by three frames


def test_known_depths_of_a_model_and_of_a_sensor_are_in_the_frames_camera(tmp_path):
    capture = Capture.open(write_capture(tmp_path, with_depth=True))
    model = np.random.default_rng(0).uniform(-1, 2, (7, 3))
    capture.frames[1:3] = [replace(frame, points=model) for frame in capture.frames[1:3]]
    capture.frames[1] = replace(capture.frames[1], E=None)
    expected = [np.linalg.solve(ES[2], [*point, 1])[:3] for point in model]
    np.testing.assert_allclose(capture.known_depths("c", "model"), expected, rtol=1e-5, atol=1e-6)
    assert capture.known_depths("b", "model") is None and capture.known_depths("a", "model") is None
    assert capture.known_depths("c", "none") is None
    # A sensor of half the columns and a third of the rows, which does not know everything.
    width, height = SIZES[2]
    sparse = depth_of(2)[1::3, ::2].copy()
    sparse[2:4, 5:9] = 0
    np.save(tmp_path / "c_depth.npy", sparse)
    depth, known = capture.measured_depth("c")
    np.testing.assert_array_equal(known, sparse > 0)
    np.testing.assert_array_equal(depth[known], sparse[known])
    enlarged = capture.known_depths("c", "depth")
    assert enlarged.dtype == np.float32
    np.testing.assert_array_equal(enlarged, sparse.repeat(3, 0).repeat(2, 1)[:height, :width])


def test_known_depths_that_a_capture_does_not_have_are_rejected(tmp_path):
    capture = in_memory()
    for points in ("model", "depth"):
        with pytest.raises(InputError, match=f"known depths of the capture; got '{points}'"):
            capture.check_points(points)
    with pytest.raises(InputError, match="points must be one of"):
        capture.check_points("sparse")
    with pytest.raises(InputError, match="depth maps of the capture; got none for b"):
        capture.measured_depth("b")
    for points, field in (("model", {"points": np.ones((1, 3))}), ("depth", {"depth": tmp_path})):
        known = in_memory()
        known.frames[3] = replace(known.frames[3], **field)
        known.check_points(points)
        known.unit = None
        known.check_points(points, scaled=True)
        with pytest.raises(
            InputError, match="used with a capture of known scale; got a capture without a unit"
        ):
            known.check_points(points)
    capture.unit = None
    capture.check_points("tracks")
    capture.check_points("none")


def test_rescaling_twice_multiplies_every_length_by_both_factors():
    capture = in_memory(points=np.array([[1.0, -2.0, 3.0]]))
    capture.unit, capture.solved = None, solved_of()
    capture.frames[1] = replace(capture.frames[1], E=None, points=None)
    before = capture.solved
    capture.rescale(2.5)
    capture.rescale(0.2)
    assert capture.metres_per_unit == pytest.approx(0.5) and capture.unit == "m"
    halved = np.diag([0.5, 0.5, 0.5, 1.0])
    for i, frame in enumerate(capture.frames):
        if i == 1:
            assert frame.E is None and frame.points is None
            continue
        np.testing.assert_allclose(frame.E[:3, 3], 0.5 * ES[i, :3, 3])
        np.testing.assert_allclose(frame.E[:3, :3], ES[i, :3, :3])
        np.testing.assert_allclose(frame.points, [[0.5, -1.0, 1.5]])
    for poses, true in ((capture.solved.E, before.E), (capture.solved.E_given, before.E_given)):
        np.testing.assert_allclose(poses @ halved, halved @ true)
    np.testing.assert_allclose(capture.solved.points, 0.5 * before.points)
    capture.solved = replace(before, E_given=None)
    capture.rescale(2.0)
    assert capture.solved.E_given is None
    for factor in (0.0, -1.0, float("inf"), "2"):
        with pytest.raises(InputError, match="metres per unit"):
            capture.rescale(factor)


@pytest.mark.parametrize("status", ["solved", "estimated", "kept", "given"])
def test_guidance_has_the_cameras_of_its_right_views(status, tmp_path):
    """Two solved frames have their solved poses. If one of them is not solved, both have the given ones."""
    capture = Capture.open(write_capture(tmp_path))
    findings = Finding("capture.scale", "Uncertain."), Finding("capture.kept", "Fits.")
    capture.solved = solved = replace(solved_of(status, (True, True, True, False)), findings=findings)
    capture.unit = None if status == "kept" else "m"
    guidance = capture.guidance("b", ["d", "a"])
    given, moved = np.linalg.solve(ES[1], ES[3]), np.linalg.solve(solved.E[1], solved.E[0])
    assert len(guidance.rigs) == len(guidance.rights) == 2
    for rig, image, other, E in zip(guidance.rigs, guidance.rights, (3, 0), (given, moved), strict=True):
        np.testing.assert_allclose(rig.E, E, atol=1e-9)
        np.testing.assert_allclose(rig.K_left, solved.K[1])
        np.testing.assert_allclose(rig.K_right, solved.K[other])
        np.testing.assert_allclose(image.permute(1, 2, 0), image_of(other), atol=1e-6)
    assert guidance.unit == capture.unit
    assert guidance.config.pose == ("given" if status in ("solved", "estimated") else "refine")
    assert capture.guidance("b", ["a"], pose="refine", outlier_sigma=3.5).config.pose == "refine"
    reasons = capture.reasons
    assert [reason.code for reason in reasons] == ["capture.scale"] * (capture.unit == "m")
    assert guidance.findings[: len(reasons)] == reasons
    for number, (width, height) in enumerate(SIZES):
        left = torch.zeros(1, 3, height, width)
        if number == 1:
            guidance.check_left_images(left)
        else:
            with pytest.raises(InputError):
                guidance.check_left_images(left)


def test_guidance_chooses_as_many_neighbours_as_are_asked_for(tmp_path):
    capture = Capture.open(write_capture(tmp_path))
    capture.solved = solved = solved_of()
    every = [NAMES[i] for i in expected_neighbours(solved, 0, 9, None)]
    assert len(every) == 2
    for count in (1, 2, 5):
        assert capture.neighbours("a", count) == every[:count]
        rights = capture.guidance("a", count).rights
        assert [tuple(image.shape[:0:-1]) for image in rights] == [
            SIZES[NAMES.index(n)] for n in every[:count]
        ]
    assert capture.neighbours("a") == every
    for count in (0, 33, 1.5, True):
        with pytest.raises(InputError, match="neighbours"):
            capture.neighbours("a", count)
    alone = tuple((px[:0], rows[:0]) for px, rows in solved.seen)
    capture.solved = replace(solved, seen=alone, E_given=np.full_like(ES, np.nan))
    with pytest.raises(InputError, match="frame a must be connected to other frames by shared points"):
        capture.guidance("a")


def test_default_number_of_neighbours_is_five(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        frames_module, "choose_neighbours", lambda solved, frame, most: asked.append((frame, most)) or [1]
    )
    capture = Capture.open(write_capture(tmp_path))
    capture.solved = solved_of()
    assert capture.neighbours("c") == ["b"] and len(capture.guidance("d").rights) == 1
    capture.neighbours("c", 32)
    assert asked == [(2, 5), (3, 5), (2, 32)]


def test_depth_is_that_of_the_pipeline_with_the_frames_points_and_neighbours(tmp_path):
    """The pipeline gets the frame's own image, and noise by the seed that is given."""
    capture = Capture.open(write_capture(tmp_path, with_depth=True))
    capture.solved = solved_of()
    calls = []

    def pipe(image, **call):
        calls.append((image, call))
        return "depth"

    assert (
        capture.depth(pipe, "c", ["d"], seed=3, parameters={"match_sigma": 0.2}, num_inference_steps=7)
        == "depth"
    )
    capture.depth(pipe, "c", 1)
    capture.depth(pipe, "b", points="depth", parameters={"points": depth_of(1) * 2})
    (image, first), (_, second), (_, third) = calls
    np.testing.assert_allclose(image, image_of(2), atol=1e-6)
    assert first["num_inference_steps"] == 7 and set(second) == {"guidance", "generator"}
    assert [call["generator"].initial_seed() for _, call in calls] == [3, 0, 0]
    assert first["guidance"].config.match_sigma == 0.2 and second["guidance"].config.match_sigma != 0.2
    for made in (first, second):
        points = made["guidance"].inputs[0].points
        np.testing.assert_allclose(points.numpy(), capture.known_depths("c", "tracks"), rtol=1e-6)
    assert [tuple(image.shape[1:]) for image in first["guidance"].rights] == [SIZES[3][::-1]]
    assert len(third["guidance"].rights) == len(expected_neighbours(capture.solved, 1, 5, None)) == 2
    np.testing.assert_allclose(third["guidance"].inputs[0].points.numpy(), 2 * depth_of(1))


def test_images_are_those_of_their_files_or_of_a_video_without_lens_distortion(tmp_path):
    """A lens of pure radial distortion: each undistorted pixel shows what its distorted place shows."""
    write_transforms(tmp_path, walk(2), walk(2))
    capture = Capture.open(tmp_path)
    k1 = -0.15
    lens = Distortion("opencv", np.array([k1, 0.0, 0.0, 0.0]))
    capture.frames[1] = replace(capture.frames[1], camera=Camera(K, SIZE, lens))
    taken = render(walk(2)[1])[0].astype(float)
    u, v = np.meshgrid(np.arange(20, SIZE[0] - 20, 7), np.arange(20, SIZE[1] - 20, 7))
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    bent = 1 + k1 * (x**2 + y**2)
    at_u, at_v = K[0, 0] * x * bent + K[0, 2], K[1, 1] * y * bent + K[1, 2]
    left, top = np.floor(at_u).astype(int), np.floor(at_v).astype(int)
    s, t = (at_u - left)[..., None], (at_v - top)[..., None]
    upper = (1 - s) * taken[top, left] + s * taken[top, left + 1]
    lower = (1 - s) * taken[top + 1, left] + s * taken[top + 1, left + 1]
    expected = ((1 - t) * upper + t * lower) / 255
    np.testing.assert_allclose(capture.image("f01")[v, u], expected, atol=0.03)
    np.testing.assert_allclose(capture.image("f00"), render(walk(2)[0])[0] / 255, atol=1e-6)

    class Reader:
        opened = 0

        def __init__(self, path, name):
            assert path == tmp_path / "v.mp4" and str(path) in name
            Reader.opened += 1

        def read(self, index):
            return np.full((4, 6, 3), index / 10, np.float32)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frames_module, "VideoReader", Reader)
        capture.frames = [
            replace(f, image=tmp_path / "v.mp4", index=3 * i, camera=Camera(K, SIZE))
            for i, f in enumerate(capture.frames)
        ]
        for index, name in ((3, "f01"), (0, "f00"), (3, "f01")):
            assert (capture.image(name) == np.float32(index / 10)).all()
    assert Reader.opened == 1


COUNT = 10
SOLVE = "geodiff_plugin.capture.frames.solve_capture"
TRUE = walk(COUNT)
GIVEN = perturbed(TRUE, shift=0.015, turn_deg=2.0, seed=1)


@pytest.fixture(autouse=True)
def few_features(request, monkeypatch):
    """Use a third of the features on the painted walls for whole captures: a ninth of the time."""
    if request.node.get_closest_marker("end_to_end"):
        monkeypatch.setattr("geodiff_plugin.pose.reconstruction.MAX_FEATURES", 450)


def grey(E: np.ndarray) -> np.ndarray:
    return (render(E)[0] @ [0.299, 0.587, 0.114]).astype(np.uint8)


def solve(given: np.ndarray | None, images: list[np.ndarray] | None = None, **how: str) -> SolvedCapture:
    images = [grey(E) for E in TRUE] if images is None else images
    names = [f"f{number}" for number in range(COUNT)]
    return solve_capture(images, GivenFrames(names, [Camera(K, SIZE)] * COUNT, given), **how)


@lru_cache(maxsize=1)
def solved() -> SolvedCapture:
    return solve(GIVEN)


def turn_error_deg(E: np.ndarray) -> float:
    """Of frames two apart, in the median; the world's frame does not matter."""
    found, true = (Rotation.from_matrix((np.linalg.inv(P[:-2]) @ P[2:])[:, :3, :3]) for P in (E, TRUE))
    return float(np.degrees(np.median((found.inv() * true).magnitude())))


def depth_ratios(found: SolvedCapture) -> np.ndarray:
    """Depth of the points over ground truth, median of every frame."""
    medians = []
    for (px, seen), E, ground_truth in zip(found.seen, found.E, TRUE, strict=True):
        T = np.linalg.inv(E)
        z = found.points[seen] @ T[2, :3] + T[2, 3]
        u, v = np.rint(px).astype(int).T
        medians.append(np.median(z / render(ground_truth)[1][v, u]))
    return np.array(medians)


@END_TO_END
def test_inexact_poses_are_mended_and_the_scale_kept():
    found = solved()
    assert found.status == "solved" and found.connected.all()
    assert found.residual_px < 0.25 * found.residual_px_given
    assert turn_error_deg(found.E) < 0.15 * turn_error_deg(GIVEN)
    assert np.abs(depth_ratios(found) - 1).max() < 0.06
    assert 0 < found.scale_rel_std < 0.1
    assert max(found.moved()[0]) < 0.2 and max(found.moved()[1]) < 5


@END_TO_END
def test_exact_poses_are_kept_bit_for_bit_and_given_ones_on_demand():
    found = solve(TRUE)
    assert found.status == "kept" and np.array_equal(found.E, TRUE)
    assert np.abs(depth_ratios(found) - 1).max() < 0.02
    found = solve(GIVEN, poses="given")
    assert found.status == "given" and np.array_equal(found.E, GIVEN)
    assert len(found.points) > 100  # for the choice of neighbours
    still = TRUE.copy()
    still[:, :3, 3] = TRUE[0, :3, 3]
    found = solve(still, [grey(E) for E in still])
    assert found.status in ("given", "kept") and np.array_equal(found.E, still)


@END_TO_END
@pytest.mark.parametrize(
    ("form", "name"), [(GIVEN @ FLIP, "OpenGL"), (np.linalg.inv(GIVEN), "world-to-camera")]
)
def test_other_conventions_are_found_by_the_residuals(form, name):
    found = solve(form)
    assert any(name in note for note in found.findings)
    assert turn_error_deg(found.E) < 0.5


@END_TO_END
def test_a_blurred_frame_and_a_wrong_pose_are_named():
    images = [grey(E) for E in TRUE]
    images[4] = cv2.blur(images[4], (61, 61))
    given = GIVEN.copy()
    given[7, 1, 3] += 1.0
    found = solve(given, images)
    assert not found.connected[4] and found.connected.sum() == COUNT - 1
    assert any("1 of 10 frames" in note and "f4" in note for note in found.findings)
    assert any("f4: blurred" in note for note in found.findings)
    assert any("poses of f7 are far" in note for note in found.findings)
    np.testing.assert_allclose(found.pose(4, 5), np.linalg.inv(GIVEN[4]) @ GIVEN[5], atol=1e-9)
    assert all(4 not in choose_neighbours(found, frame, 4) for frame in (3, 5))


@END_TO_END
@pytest.mark.slow
def test_from_nothing_up_to_a_similarity(monkeypatch):
    once = Reconstruction.from_nothing
    # COLMAP may return frames of the largest model in another one again, which is no part that is left out.
    monkeypatch.setattr(Reconstruction, "from_nothing", lambda base: 2 * once(base))
    found = solve(None)
    assert found.status == "estimated" and found.connected.all() and turn_error_deg(found.E) < 0.3
    assert not found.findings


@END_TO_END
def test_frames_of_nothing_in_common_are_rejected():
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, SIZE[::-1]).astype(np.uint8) for _ in range(COUNT)]
    with pytest.raises(InputError, match="connected"):
        solve(None, noise)
    pairs = candidate_pairs(np.concatenate([walk(20), walk(20)]), 40)
    assert (0, 1) in pairs and (0, 20) in pairs, "followers and revisits"
    assert all(i < j for i, j in pairs) and len(pairs) == len(set(pairs))


def depth_frame(i: int, factor: float = 1.0, confidence: float = 0.6, every: int = 1) -> DepthFrame:
    depth = np.float32(factor) * render(TRUE[i])[1].astype(np.float32)[::every, ::every]
    K_here = np.diag([1 / every, 1 / every, 1.0]) @ K
    return posed_frame(f"f{i}", depth, np.full_like(depth, confidence), K_here, TRUE[i])


@END_TO_END
def test_agreement_averages_within_the_error_marks_what_is_alone_and_outvotes_it():
    ground_truth, wrong = depth_frame(4), depth_frame(4, 1.03)
    wrong.depth[60:90, 80:110] *= 0.7  # an error of this frame alone
    middle, hole = (np.zeros(ground_truth.depth.shape, bool) for _ in range(2))
    middle[20:-20, 40:-40] = hole[62:88, 82:108] = True
    one = agreed(wrong, [depth_frame(5)])
    assert (one.confirmed[hole] == 0).mean() > 0.95 and (one.observers[hole] > 0).mean() > 0.95
    np.testing.assert_allclose(one.depth[hole], wrong.depth[hole], rtol=1e-5)
    np.testing.assert_allclose(one.confidence[hole], 0.6, atol=1e-6)
    three = agreed(wrong, [depth_frame(3, 0.99), depth_frame(5, 1.01), depth_frame(6)])
    off = np.abs(three.depth / ground_truth.depth - 1)
    assert np.median(off[middle & ~hole]) < 0.02 and np.median(off[hole]) < 0.02
    assert (three.confirmed[middle] > 0).mean() > 0.9 and (three.confirmed[hole] > 1).mean() > 0.9
    assert np.median(three.confidence[middle & ~hole]) > 0.6 + 0.1
    sure = replace(wrong, confidence=np.ones_like(wrong.depth))
    doubtful = [depth_frame(i, confidence=0.1) for i in (3, 5)]
    np.testing.assert_allclose(agreed(sure, doubtful).depth[hole], wrong.depth[hole], rtol=1e-5)
    np.testing.assert_allclose(agreed(wrong, []).depth, wrong.depth, rtol=1e-6)
    coarse = [depth_frame(i, every=2) for i in (3, 5, 6)]
    off = np.abs(agreed(wrong, coarse).depth / ground_truth.depth - 1)
    assert (off[hole] < 0.03).mean() > 0.95, "also between the pixels of coarser frames"


@pytest.fixture(scope="module")
def fused():
    """Names of frames, their depth and images by name."""
    frames = {f"f{i}": agreed(depth_frame(i), [depth_frame(i - 1)]) for i in (3, 5)}
    return list(frames), frames.__getitem__, lambda name: render(TRUE[int(name[1:])])[0] / 255


@END_TO_END
def test_the_cloud_lies_on_the_walls_and_its_normals_look_inside(fused):
    cloud, normals, _ = fuse(*fused)
    assert np.median(np.abs(np.abs(cloud.points_m) - HALF).min(1)) < 0.005
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert ((normals * cloud.points_m).sum(1) < 0).mean() > 0.95


@END_TO_END
def test_maps_are_in_colmaps_bytes(tmp_path):
    values = np.arange(24, dtype=np.float32).reshape(3, 4, 2)
    write_map(tmp_path / "map.bin", values)
    head, data = (tmp_path / "map.bin").read_bytes().split(b"&2&")
    assert head == b"4&3"
    np.testing.assert_array_equal(np.frombuffer(data, "<f4").reshape(2, 3, 4), values.transpose(2, 0, 1))


@END_TO_END
def test_a_mesh_is_on_the_walls_or_the_missing_package_is_reported(fused, tmp_path, monkeypatch):
    with monkeypatch.context() as without, pytest.raises(InputError, match="Open3D installed"):
        without.setattr(capture_poses, "find_spec", lambda _: None)
        capture_poses.open_capture(
            CaptureOptions(path=write_transforms(tmp_path, TRUE, GIVEN), export=("mesh",))
        )
    job = tmp_path / "mesh.ply", *fused
    open3d = pytest.importorskip("open3d")
    write_mesh(*job)
    corners = np.asarray(open3d.io.read_triangle_mesh(str(job[0])).vertices)
    assert np.median(np.abs(np.abs(corners) - HALF).min(1)) < 0.01


@END_TO_END
def test_f_score_of_clouds():
    grid = np.stack(np.meshgrid(*[np.arange(4) * 0.2] * 3), -1).reshape(-1, 3)
    assert f_score(grid + 0.02, grid) == 1.0 and f_score(grid[:0], grid) == 0.0
    assert f_score(grid[:32], grid) == pytest.approx(2 / 3)  # all right, half of it there


def depth_by(factor: Callable[[Capture], float], confidence: float = 0.95, **more):
    """A stand-in for ``Capture.depth``: the true depth times a factor of the capture."""

    def depth(capture, pipe, name, *_, **__):
        values = (factor(capture) * render(TRUE[int(name[1:])])[1])[None, ..., None].astype(np.float32)
        sure = np.full_like(values, confidence)
        sigma = depth_sigma(values[0, ..., 0], sure[0, ..., 0])[None, ..., None]
        return SimpleNamespace(prediction=values, confidence=sure, sigma=sigma, **more)

    return depth


@END_TO_END
def test_eval_capture_measures_every_row(tmp_path, monkeypatch):
    data = write_transforms(tmp_path / "scan", TRUE, GIVEN)
    status = {"given": "given", "refined": "solved"}
    monkeypatch.setattr(SOLVE, lambda *_, poses, **__: replace(solved(), status=status[poses]))
    monkeypatch.setattr(PriorCache, "get", lambda self, settings: None)
    monkeypatch.setattr(PriorCache, "fingerprint", lambda self, settings: "prior")
    factor = {"solved": 1.02, "given": 1.1}
    monkeypatch.setattr(Capture, "depth", depth_by(lambda capture: factor[capture.solve().status]))
    capture, rows, out = Capture.open(data), ("given", "capture"), tmp_path / "out"
    assert [capture.solve(way).status for way in ("given", None, "refined")] == ["given", "given", "solved"]
    options = CaptureEvalOptions(data=(data,), count=4, neighbours=(2,), rows=rows, out=out, quiet=True)
    (table,) = COMMANDS["capture"].run(options).tables
    assert table.title == "scan, 4 frames" and [row[1] for row in table.rows] == ["3", "3", "all"]
    assert [float(row[2]) for row in table.rows[:2]] == pytest.approx([0.1, 0.02], abs=2e-4)
    assert float(table.rows[2][2]) < 0.05
    assert "| refined over the capture" in (out / "capture.md").read_text()
    again = replace(options, rows=("capture",))  # from the journal
    monkeypatch.setattr(Capture, "depth", lambda *_, **__: pytest.fail("measured before"))
    assert COMMANDS["capture"].run(again).tables[0].rows == table.rows[1:]


HALVED = TRUE.copy()
HALVED[:, :3, 3] /= 2


@pytest.fixture
def model(tmp_path, monkeypatch):
    """A capture without unit, twice as long in metres, whose calls return the true depth in its unit."""
    source = write_transforms(tmp_path / "scan", TRUE, HALVED, colmap_im_id=1)

    def length(E: np.ndarray) -> float:
        return float(np.linalg.norm(E[9, :3, 3] - E[0, :3, 3]))

    found = replace(solved(), E=HALVED, E_given=HALVED, status="kept", points=solved().points / 2)
    monkeypatch.setattr(SOLVE, lambda *_, **__: found)
    entries = {
        "unit": None,
        "K": K[None],
        "poses": (),
        "verdict": judge(FactSheet()),
        "findings": (),
        "measurable_m": torch.tensor([7.5]),
    }
    depth = depth_by(lambda capture: length(capture.solve().E) / length(TRUE), **entries)

    def with_unit(capture, *args):
        output = depth(capture, *args)
        output.unit = capture.unit
        return output

    monkeypatch.setattr(capture_frame, "depth_of_frame", with_unit)
    for module in (capture_frame, capture_frames):
        monkeypatch.setattr(module, "prior_of_capture", lambda options: None)
    monkeypatch.setattr(capture_frame, "write_maps", lambda folder, output, image, *limits: {})
    return lambda **options: CaptureOptions(
        path=source, out=tmp_path / "out", frames="2:6:2", quiet=True, processes=1, overwrite=True, **options
    )


#: Two pixels of a frame, on two walls of the room.
ENDS = np.array([[40, 50], [200, 120]])


def length_in_the_room(number: int, ends: np.ndarray = ENDS) -> float:
    """Metres between what two pixels of a frame show, by where their rays meet the walls."""
    directions = np.c_[(ends - K[:2, 2]) / K.diagonal()[:2], np.ones(2)] @ TRUE[number, :3, :3].T
    centre = TRUE[number, :3, 3]
    radius = [min((np.sign(d) * HALF - centre) / d) for d in directions]
    return float(np.linalg.norm(directions[0] * radius[0] - directions[1] * radius[1]))


WAYS = [{}, {"metres_per_unit": 2.0}, {"known_length": f"f03:40,50,200,120,{length_in_the_room(3)}"}]
WAYS.append({"distance": f"f01,f08,{np.linalg.norm(TRUE[8, :3, 3] - TRUE[1, :3, 3])}"})


@END_TO_END
@pytest.mark.parametrize("way", WAYS, ids=lambda way: next(iter(way), "none"))
def test_one_length_scales_all_and_without_one_there_are_no_metres(way, model, tmp_path, monkeypatch, capsys):
    options = model(**way)
    report = run.depth_capture(options)
    ground_truth, depth = render(TRUE[4])[1], np.load(tmp_path / "out/f04/depth.npy")
    assert np.median(depth / ground_truth) == pytest.approx(1 if way else 0.5, rel=0.02)
    cloud = (tmp_path / "out/cloud.ply").read_bytes()[:200].decode("latin1")
    texts = [summary(report, options.out), cloud, capsys.readouterr().err]
    texts = [text.replace("for metres pass", "") for text in texts]  # how to get them
    assert any(" m " in text or "metres" in text for text in texts) is bool(way)
    of_frame = json.loads((tmp_path / "out/f04/report.json").read_text())
    assert report["unit"] == of_frame["unit"] and of_frame["measurable_m"] == 7.5
    assert report["unit"] == ("m" if way else None)
    monkeypatch.setattr(capture_frame, "write_maps", lambda *_: pytest.fail("done before"))
    assert [message["text"] for message in report["findings"]] == list(solved().findings)
    again = run.depth_capture(replace(options, overwrite=False))
    assert [frame["frame"] for frame in again["frames"]] == ["f02", "f04", "f06"]
    (tmp_path / "out/poses.npz").write_bytes(b"torn")
    assert capture_poses.load_solved(tmp_path / "out/poses.npz", "") is None


@END_TO_END
def test_neighbours_are_those_whose_rays_meet_at_the_best_angle():
    """Forty points 10 m ahead, seen from the side at 2, 6, 12 and 30 degrees.

    Worth exp(-((a - 6) / s)^2 / 2), s 2.5 below 6 degrees and 10 above; what is seen already counts half,
    and a neighbour must be worth 15 % of the best.
    """
    points = np.random.default_rng(0).normal((0, 0, 10), 0.01, (40, 3))
    E = np.tile(np.eye(4), (5, 1, 1))
    E[1:, 0, 3] = 10 * np.tan(np.radians([2.0, 6.0, 12.0, 30.0]))
    seen = tuple((np.zeros((len(which), 2)), which) for which in [np.arange(40)] * 5)
    found = SolvedCapture("solved", E, E, np.tile(K, (5, 1, 1)), np.ones(5, bool), points, seen)
    assert choose_neighbours(found, 0, 4) == [2, 3]  # 0.28 / 4 and 0.06 / 4 are too little
    assert choose_neighbours(found, 0, 1) == [2]
    halves = [(np.zeros((20, 2)), which) for which in np.split(np.arange(40), 2)]
    for of_second, chosen in ((halves[0], [2]), (halves[1], [2, 1])):  # who sees what the other does not
        some = replace(found, seen=(seen[0], halves[0], of_second, *seen[3:]))
        assert choose_neighbours(some, 0, 3, among=[1, 2]) == chosen
    assert choose_neighbours(found, 0, 3, among=[1, 4]) == [1]


@END_TO_END
def test_a_doubt_about_the_poses_is_one_about_every_frame(tmp_path, monkeypatch):
    source = write_transforms(tmp_path, TRUE, GIVEN)
    uncertain = Finding("capture.scale", "The scale is uncertain by 17 %.")
    turned = Finding("capture.rotated", "The images are rotated by 180 degrees.")
    notes = (Finding("capture.scales", "Scales are 41 % apart."), uncertain, turned)
    monkeypatch.setattr(SOLVE, lambda *_, **__: replace(solved(), findings=notes))
    capture = Capture.open(source)
    assert capture.reasons == [uncertain, turned]
    assert [message for message in capture.guidance("f04").findings if message.is_reason] == capture.reasons
    capture.scale_measured = True
    assert capture.reasons == [turned]
    capture.scale_measured, capture.unit = False, None
    assert capture.reasons == [turned], "what has no unit has no scale"


@END_TO_END
def test_rotated_images_are_reported():
    images = [np.rot90(grey(E), 2).copy() for E in TRUE]
    found = solve(GIVEN, images)
    (note,) = (note for note in found.findings if note.code == "capture.rotated")
    assert "180 degrees" in note and turn_error_deg(found.E @ np.diag([-1.0, -1.0, 1.0, 1.0])) < 0.5


@END_TO_END
def test_frames_that_are_not_trusted_are_named_and_marked(model, monkeypatch):
    options, write, titles, lowest = model(), capture_frame._write_frame, list[str](), list[int]()

    def doubting(capture, options, pipe, item):
        verdict = {"status": "not trusted" if item.key == "f04" else "trusted", "reasons": ["Blurred."]}
        return write(capture, options, pipe, item) | {"verdict": verdict}

    def noting(cells, names, **how):
        titles.extend(names)
        return grid(cells, names, **how)

    def fusing(names, load, image):
        lowest.extend(load(name).observers.min() for name in names)
        return fuse(names, load, image)

    monkeypatch.setattr(capture_frame, "_write_frame", doubting)
    monkeypatch.setattr("geodiff_plugin.capture.results.fuse", fusing)
    monkeypatch.setattr("geodiff_plugin.plotting.grid", noting)
    report = run.depth_capture(options)
    assert report["not_trusted"] == ["f04"]
    assert "; NOT TRUSTED: f04 (f04: Blurred.) -> " in summary(report, options.out)
    assert lowest == [0, 1, 0]  # seen by no other frame; of a doubted one that is no excuse
    assert titles == ["f02", "depth", "f04", "depth, not trusted", "f06", "depth"]
    with pytest.raises(SystemExit):
        run_capture(replace(options, strict=True))


@END_TO_END
def test_a_frame_that_fails_is_named_and_the_rest_is_kept(model, tmp_path, monkeypatch, capsys):
    options, depth = model(), capture_frame.depth_of_frame

    def failing(capture, pipe, name, *args):
        if name == "f04":
            raise InputError("f04 is blank.")
        return depth(capture, pipe, name, *args)

    monkeypatch.setattr(capture_frame, "depth_of_frame", failing)
    with pytest.raises(SystemExit) as leaving:
        run_capture(options)
    assert leaving.value.code == EXIT_SOME_FAILED and "2 of 3 frames" in capsys.readouterr().out
    report = json.loads((tmp_path / "out/capture.json").read_text())
    assert "f04 is blank." in report["frames"][1]["error"] and not (tmp_path / "out/f04").exists()
    monkeypatch.setattr(capture_frame, "depth_of_frame", depth)
    run_capture(replace(options, overwrite=False))
    assert (tmp_path / "out/f04/depth.npy").is_file()


@END_TO_END
def test_shards_start_from_poses_that_were_solved_once_and_the_whole_joins_them(model, tmp_path, monkeypatch):
    options, write, written = replace(model(), overwrite=False), capture_frame._write_frame, list[str]()

    def noting(capture, options, pipe, item):
        written.append(item.key)
        return write(capture, options, pipe, item)

    monkeypatch.setattr(capture_frame, "_write_frame", noting)
    with pytest.raises(
        InputError, match="poses of these frames are not solved yet. Run geodiff capture with --poses-only"
    ):
        run.depth_capture(replace(options, shard="0/2"))
    assert run.depth_capture(replace(options, poses_only=True))["frames"] == [] == written
    monkeypatch.setattr(SOLVE, lambda *_, **__: pytest.fail("solved before"))
    for shard, frames in (("1/2", ["f04"]), ("0/2", ["f02", "f06"])):
        report = run.depth_capture(replace(options, shard=shard))
        assert [frame["frame"] for frame in report["frames"]] == frames
    assert written == ["f04", "f02", "f06"] and not (tmp_path / "out/cloud.ply").exists()
    report = run.depth_capture(options)
    assert [frame["frame"] for frame in report["frames"]] == ["f02", "f04", "f06"] and len(written) == 3
    assert report["files"]["cloud_points"] > 0


@END_TO_END
def test_a_tape_measures_between_two_pixels_of_a_frame(model, tmp_path, capsys):
    spans = ("f04:40,50,200,120", "f02:40,50,200,120")
    options = replace(model(known_length=f"f03:40,50,200,120,{length_in_the_room(3)}", measure=spans))
    run_capture(options)
    measured = json.loads((tmp_path / "out/capture.json").read_text())["measured"]
    assert [(m["frame"], m["unit"], m["trusted"]) for m in measured] == [
        ("f04", "m", False),
        ("f02", "m", False),
    ]
    true = [length_in_the_room(number) for number in (4, 2)]
    assert [m["length"] for m in measured] == pytest.approx(true, rel=0.01)
    assert all(0.02 < m["spread"] / m["length"] < 0.2 for m in measured)
    assert f"f04 (40, 50) to (200, 120): {measured[0]['length']:.2f} ± " in capsys.readouterr().out
    run_capture(replace(options, known_length=None))
    words = capsys.readouterr().out
    assert " units of the poses (not trusted)" in words and " m " not in words


@END_TO_END
def test_a_measured_length_is_as_uncertain_as_the_scale_of_the_capture(model, tmp_path, monkeypatch):
    spreads = []
    for scale_rel_std in (0.0, 0.3):
        found = replace(solved(), E=HALVED, E_given=HALVED, scale_rel_std=scale_rel_std)
        monkeypatch.setattr(SOLVE, lambda *_, found=found, **__: found)
        (measured,) = run.depth_capture(model(measure=("f04:40,50,200,120",)))["measured"]
        spreads.append(measured["spread"] / measured["length"])
    assert spreads[1] == pytest.approx(np.hypot(spreads[0], 0.3))


@END_TO_END
def test_ends_of_a_length_are_pixels_of_the_image_as_taken(tmp_path):
    """Brown's first coefficient by hand: ``x_taken = x (1 + k1 r^2)``."""
    k1, ends = -0.12, np.array([[30.0, 40.0], [200.0, 150.0]])
    write_transforms(tmp_path, TRUE, TRUE, k1=k1)
    rays = (ends - K[:2, 2]) / K.diagonal()[:2]
    taken = rays * (1 + k1 * (rays**2).sum(1, keepdims=True)) * K.diagonal()[:2] + K[:2, 2]
    typed = "f04:" + ",".join(map(repr, taken.reshape(-1).tolist()))
    (span,) = spans_to_measure(Capture.open(tmp_path), CaptureOptions(path=tmp_path, measure=(typed,)))
    np.testing.assert_allclose(span.ends, ends, atol=1e-3)
    np.testing.assert_allclose(span.taken, taken)
    far = CaptureOptions(path=tmp_path, measure=("f04:0,0,100,100",))
    with pytest.raises(InputError, match="also in the undistorted image"):
        spans_to_measure(Capture.open(tmp_path), far)


@END_TO_END
def test_the_ends_of_a_length_are_read_at_the_nearest_pixels(tmp_path):
    """Without lens distortion they lie between pixels; depth rises by 0.1 a column."""
    depth = (2.0 + 0.1 * np.arange(SIZE[0])).repeat(SIZE[1]).reshape(SIZE).T.astype(np.float32)
    (tmp_path / "f04").mkdir()
    maps = {"depth": depth, "confidence": np.full_like(depth, 0.9), "sigma": 0.01 * depth}
    for name, values in maps.items():
        np.save(tmp_path / f"f04/{name}.npy", values)
    capture = SimpleNamespace(names=["f04"], unit="m", camera=lambda name: Camera(K))
    ends = np.array([[10.6, 20.4], [30.3, 25.7]])
    (record,) = measure(capture, [Span("f04", ends, ends)], tmp_path, (), 0.0)
    points = [depth[v, u] * (np.linalg.inv(K) @ (u, v, 1)) for u, v in ((11, 20), (30, 26))]
    assert record["length"] == pytest.approx(np.linalg.norm(points[1] - points[0]), rel=1e-6)


@END_TO_END
@pytest.mark.parametrize("confidence", [0.95, 0.1])
def test_a_scale_from_depth_that_nobody_is_sure_of_is_not_trusted(confidence, model, tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    sure = depth_by(lambda capture: 0.5, confidence, unit=None)
    monkeypatch.setattr(capture_frame, "depth_of_frame", sure)
    options = model(known_length=f"f03:40,50,200,120,{length_in_the_room(3)}")
    capture = capture_poses.open_capture(options)
    scale = capture_poses.solved_poses(capture, options, "key")
    assert scale.factor == pytest.approx(2, rel=0.01)
    doubted = confidence == 0.1
    assert [note.code for note in capture.reasons] == ["capture.length"] * doubted
    assert capture.scale_measured is not doubted


@END_TO_END
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"known_length": "f01:1,2,3,4,-1"}, "above 0"),
        ({"known_length": "f01:1,2,1,2,1"}, "two different pixels"),
        ({"known_length": "f01:1,2,nan,2,1"}, "240x180"),
        ({"distance": "f01,f02"}, "NAME,NAME,METRES"),
        ({"distance": "f01,f02,far"}, "NAME,NAME,METRES"),
        ({"measure": ("f02:1,2,3",)}, "NAME:X1,Y1,X2,Y2"),
        ({"measure": ("1,2,3,4",)}, "NAME:X1,Y1,X2,Y2"),
        ({"measure": ("f01:1,2,3,4",)}, "frames selected by --frames"),
        ({"distance": "f01,f01,1"}, "different camera positions"),
        ({"known_length": "f01:1,2,3,4"}, "NAME:X1,Y1,X2,Y2,METRES"),
        ({"known_length": "f01:1,2,999,4,1"}, "240x180"),
        ({"known_length": "f77:1,2,3,4,1"}, "f77"),
        ({"points": "depth"}, "without a unit"),
    ],
)
def test_bad_lengths_get_a_sentence(options, words, model, tmp_path):
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match=words):  # all but the last and that of positions before any work
        capture = capture_poses.open_capture(model(**options))
        assert words in ("different camera positions", "without a unit")
        capture_poses.solved_poses(capture, model(**options), "key")
        capture.known_depths("f01", options["points"])


@END_TO_END
def test_maps_of_another_model_take_the_prior_s_place(tmp_path, monkeypatch):
    asked = {}
    source = write_transforms(tmp_path / "scan", TRUE, TRUE)
    np.save(tmp_path / "f02.npy", render(TRUE[2])[1])
    monkeypatch.setattr(Capture, "depth", lambda self, pipe, name, count, **call: asked.update(call))
    options = CaptureOptions(path=source, prior_map=tmp_path)
    capture_frame.depth_of_frame(Capture.open(source), None, "f02", options)
    np.testing.assert_array_equal(asked["depth_map"], render(TRUE[2])[1])
    with pytest.raises(FileNotFoundError, match="f03"):
        capture_frame.depth_of_frame(Capture.open(source), None, "f03", options)
    assert "DepthMap" in type(prior_of_capture(options)).__name__


@END_TO_END
@pytest.mark.slow
def test_the_command_writes_every_frame_and_goes_on(tmp_path, capsys):
    source, out = write_transforms(tmp_path / "scan", TRUE, GIVEN), tmp_path / "out"
    options = ["--frames", "f03,f05", "-q", "--neighbours", "2", "--processes", "2", "--steps", "1"]
    command = ["capture", source, "--out", out, *options, "--export", "colmap"]
    assert call(command) == 0
    depth = np.load(out / "f03" / "depth.npy")
    assert depth.dtype == np.float32 and np.mean(np.abs(depth / render(TRUE[3])[1] - 1)) < 0.1
    report = json.loads((out / "capture.json").read_text())
    assert report["poses"]["status"] == "solved" and report["unit"] == "m"
    assert report["agreement"]["f03"]["checked_against"] == 1
    workspace = "images/f03.png stereo/depth_maps/f03.png.geometric.bin sparse/points3D.txt".split()
    files = ["cloud.ply", "cloud.glb", "sheet.jpg", "video.mp4", *(f"colmap/{file}" for file in workspace)]
    assert all((out / name).is_file() for name in files)
    made = (out / "f03" / "depth_alone.npy").stat().st_mtime_ns
    assert call(command) == 0 and (out / "f03" / "depth_alone.npy").stat().st_mtime_ns == made
    assert call([*command, "--overwrite"]) == 0
    assert (out / "f03" / "depth_alone.npy").stat().st_mtime_ns > made
    assert call([*command[:5], "f99", "-q"]) == 2 and "f99" in capsys.readouterr().err
