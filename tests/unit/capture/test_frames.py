"""``Capture``: neighbours against a loop over shared points; arguments of the solve and of the pipeline."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin import Capture, InputError
from geodiff_plugin.capture import frames as frames_module
from geodiff_plugin.capture.frames import choose_neighbours
from geodiff_plugin.formats.layouts import CaptureFrame
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.multiview import SolvedCapture
from geodiff_plugin.types import Distortion
from tests.unit.capture.cameras import ES, KS, NAMES, SIZES, depth_of, image_of, write_capture
from tests.unit.capture_room import SIZE, K, render, walk, write_transforms


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
        CaptureFrame(name, None, E=E, size=size, K=K)
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
def test_frames_that_are_not_there_are_refused(wanted):
    words = rf"frames \(--frames\) must be NAME,NAME or FIRST:.* from 0 to 3; got '{re.escape(wanted)}'"
    if ":" not in wanted:
        words = r"a frame must be a name of the capture, such as a, b, c; got 'e'\. Names are file stems"
    with pytest.raises(InputError, match=words):
        in_memory().choose(wanted)


def test_two_frames_of_one_name_are_refused_and_poses_are_all_or_none():
    frames = in_memory().frames
    with pytest.raises(InputError, match="of different names; got a, a"):
        Capture([frames[0], frames[0]], "kind", "m", [])
    capture = Capture(frames, "kind", None, [])
    np.testing.assert_array_equal(capture.poses, ES)
    capture.frames[2] = replace(capture.frames[2], E=None)
    assert capture.poses is None


def test_a_solve_gets_every_frame_and_is_kept_until_other_poses_are_asked_for(tmp_path, monkeypatch):
    calls = []

    def solve(images, given, *, poses, threads):
        calls.append((list(images), given, poses, threads))
        return f"solved {len(calls)}"

    monkeypatch.setattr(frames_module, "solve_capture", solve)
    monkeypatch.setattr(frames_module, "available_cores", lambda: 7)
    capture = Capture.open(write_capture(tmp_path))
    with pytest.raises(InputError, match="poses must be one of"):
        capture.solve("moved")
    assert [capture.solve(), capture.solve("refined"), capture.solve("given", threads=3)] == [
        "solved 1",
        "solved 1",
        "solved 2",
    ]
    assert [capture.solve("given"), capture.solve(), capture.solve("refined")] == [
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
        assert given.names == NAMES and given.sizes == SIZES
        np.testing.assert_allclose(given.K, KS)
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


def test_known_depths_that_a_capture_does_not_have_are_refused(tmp_path):
    capture = in_memory()
    for points in ("model", "depth"):
        with pytest.raises(InputError, match=f"known depths that the capture has; got '{points}'"):
            capture.check_points(points)
    with pytest.raises(InputError, match="points must be one of"):
        capture.check_points("sparse")
    with pytest.raises(InputError, match="depth maps that the capture names; got none for b"):
        capture.measured_depth("b")
    for points, field in (("model", {"points": np.ones((1, 3))}), ("depth", {"depth": tmp_path})):
        known = in_memory()
        known.frames[3] = replace(known.frames[3], **field)
        known.check_points(points)
        known.unit = None
        known.check_points(points, scaled=True)
        with pytest.raises(InputError, match="of a capture whose scale is known; got one without a unit"):
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
    notes = Message("capture.scale", "Uncertain."), Message("capture.kept", "Fits.")
    capture.solved = solved = replace(solved_of(status, (True, True, True, False)), notes=notes)
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
    assert capture.guidance("b", ["a"], pose="refine", outlier_width=3.5).config.pose == "refine"
    doubts = capture.doubts
    assert [note.code for note in doubts] == ["capture.scale"] * (capture.unit == "m")
    assert guidance.warned[: len(doubts)] == doubts
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
    with pytest.raises(InputError, match="frame a must be connected to others by shared points"):
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
        capture.depth(pipe, "c", ["d"], seed=3, knobs={"match_noise": 0.2}, num_inference_steps=7) == "depth"
    )
    capture.depth(pipe, "c", 1)
    capture.depth(pipe, "b", points="depth", knobs={"points": depth_of(1) * 2})
    (image, first), (_, second), (_, third) = calls
    np.testing.assert_allclose(image, image_of(2), atol=1e-6)
    assert first["num_inference_steps"] == 7 and set(second) == {"guidance", "generator"}
    assert [call["generator"].initial_seed() for _, call in calls] == [3, 0, 0]
    assert first["guidance"].config.match_noise == 0.2 and second["guidance"].config.match_noise != 0.2
    for call in (first, second):
        points = call["guidance"].inputs[0].points
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
    capture.frames[1] = replace(capture.frames[1], lens=lens)
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
            replace(f, image=tmp_path / "v.mp4", index=3 * i, lens=None) for i, f in enumerate(capture.frames)
        ]
        for index, name in ((3, "f01"), (0, "f00"), (3, "f01")):
            assert (capture.image(name) == np.float32(index / 10)).all()
    assert Reader.opened == 1
