"""Agreement of frames against loops over their pixels, and the motion of a video against known poses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, median_filter
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from geodiff_plugin.cameras import Camera
from geodiff_plugin.capture import agreement
from geodiff_plugin.capture.agreement import agreed, rendered, scene_poses, seen_in, temporally_smoothed
from geodiff_plugin.pose import tracks
from geodiff_plugin.types import DepthFrame
from tests.lab.sequence import flicker, true_frames
from tests.scenes import render_sequence
from tests.unit.capture.cameras import ES, KS, SIZES, frame_of
from tests.unit.capture_room import render
from tests.views import posed_frame

END_TO_END = pytest.mark.end_to_end

#: A third of each side: pixels are compared in Python loops.
SMALL = np.diag([1 / 3, 1 / 3, 1])


def small(number: int, seed: int = 0) -> DepthFrame:
    """A frame of the room with errors, doubts and, in most frames, a region that is too near or too far."""
    rng = np.random.default_rng([number, seed])
    K, size = SMALL @ KS[number], tuple(side // 3 for side in SIZES[number])
    depth = render(ES[number], size, K)[1] * rng.normal(1, 0.012, size[::-1])
    depth[3:8, 4:9] *= [0.72, 1.0, 1.35, 0.85][number]
    confidence = rng.uniform(0.0, 1.0, depth.shape)
    confidence[2:9, 3:10] *= [0.2, 1, 0.3, 0.9][number]
    return posed_frame("abcd"[number], depth.astype(np.float32), confidence.astype(np.float32), K, ES[number])


def pixels(frame: DepthFrame):
    """Row, column and world point of every pixel, by one 4x4 inverse of the projection."""
    P = np.eye(4)
    P[:3] = frame.camera.K @ np.linalg.inv(frame.camera.E)[:3]
    for row, column in np.ndindex(frame.depth.shape):
        z = float(frame.depth[row, column])
        yield row, column, np.linalg.solve(P, [column * z, row * z, z, 1])[:3]


def seen_by(frame: DepthFrame, point: np.ndarray):
    """Row, column and depth of a world point in a camera, ``None`` outside of its image."""
    x, y, z = frame.camera.K @ np.linalg.solve(frame.camera.E, [*point, 1])[:3]
    height, width = frame.depth.shape
    if z <= 1e-6 or not (-0.5 < x / z < width - 0.5 and -0.5 < y / z < height - 0.5):
        return None
    return round(y / z), round(x / z), z


@pytest.mark.parametrize(("of", "into"), [(0, 1), (1, 2), (2, 3), (3, 0)])
def test_points_of_a_frame_are_seen_by_another_camera_where_they_project(of, into):
    frame, other = small(of), small(into)
    found, inside = seen_in(frame, other), 0
    for row, column, point in pixels(frame):
        expected = seen_by(other, point)
        assert found.inside[row, column] == (expected is not None)
        at = found.row[row, column], found.column[row, column]
        if expected is None:
            assert at == (0, 0)
            continue
        inside += 1
        assert at == expected[:2]
        assert found.z[row, column] == pytest.approx(expected[2], rel=1e-9)
    assert 0.2 < inside / frame.depth.size < 0.97


def expected_render(other: DepthFrame, frame: DepthFrame, values: np.ndarray):
    """A z-buffer of points, whose gaps take what is above, then below, left and right of them."""
    height, width = frame.depth.shape
    depth = np.zeros((height + 2, width + 2))
    shown = np.zeros((height + 2, width + 2, *values.shape[2:]))
    for row, column, point in pixels(other):
        at = seen_by(frame, point)
        if at and (depth[at[0] + 1, at[1] + 1] == 0 or at[2] <= depth[at[0] + 1, at[1] + 1]):
            depth[at[0] + 1, at[1] + 1], shown[at[0] + 1, at[1] + 1] = at[2], values[row, column]
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        before, was_shown = depth.copy(), shown.copy()
        for row in range(1, height + 1):
            for column in range(1, width + 1):
                if before[row, column] == 0:
                    depth[row, column] = before[row + down, column + right]
                    shown[row, column] = was_shown[row + down, column + right]
    return depth[1:-1, 1:-1], shown[1:-1, 1:-1]


@pytest.mark.parametrize(("other", "frame"), [(0, 3), (1, 0), (2, 1), (3, 2)])
def test_a_frame_is_rendered_into_another_camera_nearest_point_first(other, frame):
    other, frame = small(other), small(frame)
    values = np.dstack([other.depth, 10 * other.confidence + 1])
    depth, shown = rendered(other, frame, values)
    expected_depth, expected_values = expected_render(other, frame, values)
    np.testing.assert_allclose(depth, expected_depth, rtol=1e-9)
    np.testing.assert_allclose(shown, expected_values, rtol=1e-6)
    assert shown.dtype == values.dtype and (depth > 0).mean() > 0.1


def expected_sums(frame: DepthFrame, others: list[DepthFrame]) -> dict[tuple[int, int], list[float]]:
    """Inverse depth, confidence, confirming and observing frames, and own weight, before any vote."""
    sums = {}
    for row, column, point in pixels(frame):
        z, sure = float(frame.depth[row, column]), float(frame.confidence[row, column])
        weights, inverses, missing, observers = [2 * (0.05 + sure)], [1 / z], 1 - sure, 0
        for other in others:
            at = seen_by(other, point)
            if at is None:
                continue
            there, theirs = float(other.depth[at[:2]]), float(other.confidence[at[:2]])
            observers += there > 0.94 * at[2]
            back = np.linalg.solve(other.camera.K, [at[1], at[0], 1]) * there
            d = np.linalg.solve(frame.camera.E, other.camera.E @ [*back, 1])[2]
            if abs(there / at[2] - 1) < 0.06 and abs(d / z - 1) < 0.06:
                weights.append(0.05 + theirs)
                inverses.append(1 / d)
                missing *= 1 - 0.4 * theirs
        mean = np.dot(weights, inverses) / sum(weights)
        sums[row, column] = [mean, 1 - missing, len(weights) - 1, observers, weights[0]]
    return sums


def heaviest_group(heard: list[tuple[float, float]]) -> tuple[list[tuple[float, float]], float]:
    """Depths and confidences that agree with one of them and have the most weight together."""
    groups = [[(d, c) for d, c in heard if abs(reference / d - 1) < 0.06] for reference, _ in heard]
    weights = [sum(0.05 + c for _, c in group) for group in groups]
    return (groups[int(np.argmax(weights))], max(weights)) if groups else ([], 0.0)


def expected_agreement(frame: DepthFrame, others: list[DepthFrame], moving: bool):
    """Depth, confidence, confirmed, observers and whether it was outvoted, pixel by pixel."""
    sums, replaced = expected_sums(frame, others), np.zeros(frame.depth.shape, bool)
    renders = [rendered(other, frame, other.confidence) for other in others]
    for at, found in sums.items():
        if found[2] or (moving and frame.confidence[at] >= 0.8):
            continue
        heard = [(depth[at], sure[at]) for depth, sure in renders if depth[at] > 0]
        found[3] += sum(d < 0.94 * frame.depth[at] for d, _ in heard)
        best, most = heaviest_group(heard)
        if len(best) >= 2 and most > found[4]:
            found[0] = sum((0.05 + c) / d for d, c in best) / most
            found[1], found[2] = 1 - np.prod([1 - 0.4 * c for _, c in best]), len(best)
            replaced[at] = True
    maps = [np.array([found[k] for found in sums.values()]).reshape(frame.depth.shape) for k in range(4)]
    near = binary_dilation(replaced, np.ones((3, 3)))
    for _ in range(3):
        maps[0] = np.where(near, median_filter(maps[0].astype(np.float32), 5, mode="nearest"), maps[0])
    return 1 / maps[0], maps[1], maps[2], np.maximum(maps[2], maps[3]), replaced


@pytest.mark.parametrize(("number", "moving"), [(0, False), (1, True), (2, False), (3, False), (3, True)])
def test_agreement_is_what_a_loop_over_pixels_finds(number, moving):
    frame, others = small(number), [small(other, 1) for other in range(4) if other != number]
    others = [replace(other, confidence=0.4 + 0.6 * other.confidence) for other in others]
    found = agreed(frame, others, moving=True) if moving else agreed(frame, others)
    depth, confidence, confirmed, observers, replaced = expected_agreement(frame, others, moving)
    np.testing.assert_array_equal(found.confirmed, confirmed)
    np.testing.assert_array_equal(found.observers, observers)
    np.testing.assert_allclose(found.depth, depth, rtol=1e-5)
    np.testing.assert_allclose(found.confidence, confidence, atol=1e-6)
    assert {values.dtype for values in (found.depth, found.confidence)} == {np.dtype(np.float32)}
    assert found.name == frame.name and found.camera is frame.camera
    if number == 3:  # what is sure keeps its depth if it may have moved
        sure = replaced & (frame.confidence >= 0.8)
        assert sure.any() != moving
    if number == 0:
        assert replaced.sum() > 5 and len(np.unique(confirmed)) == 4 and len(np.unique(observers)) >= 3


def test_agreement_does_not_depend_on_the_unit_or_on_the_order_of_the_frames():
    frames = [small(number) for number in range(4)]

    def in_unit(factor: float) -> list[DepthFrame]:
        lengths = np.array([[1, 1, 1, factor]] * 3 + [[1] * 4])
        cameras = [replace(f.camera, E=f.camera.E * lengths) for f in frames]
        pairs = zip(frames, cameras, strict=True)
        return [replace(f, depth=f.depth * np.float32(factor), camera=camera) for f, camera in pairs]

    found = agreed(frames[0], frames[1:])
    changed = [(agreed(frames[0], frames[:0:-1]), 1)]
    for factor in (8, 0.125):
        first, *others = in_unit(factor)
        changed.append((agreed(first, others), factor))
    for other, factor in changed:
        np.testing.assert_allclose(other.depth, factor * found.depth, rtol=1e-5)
        for name in ("confidence", "confirmed", "observers"):
            np.testing.assert_allclose(getattr(other, name), getattr(found, name), atol=1e-6)


def made_up_matches(count: int, seed: int = 0):
    """Two images with matching features at the exact pixels of random points, and the motion between them.

    Points are at pixels of the first, whose depth map is right only there.
    """
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [5, -8, 12], degrees=True).as_matrix()
    T[:3, 3] = 0.2, -0.1, 0.15
    K_before, K_after = np.array(
        [[[310.0, 0, 155], [0, 280, 96], [0, 0, 1]], [[260.0, 0, 140], [0, 330, 110], [0, 0, 1]]]
    )
    height, width = 200, 300
    at = rng.choice(height * width, count, replace=False)
    px = np.c_[at % width, at // width].astype(float)
    depth = np.full((height, width), 50.0)
    z = rng.uniform(2, 6, count)
    depth.flat[at] = z
    # Features may lie a little outside of the outermost pixel centres.
    px[:3] = [[width - 0.4, 50], [70, height - 0.4], [-0.6, 33]]
    depth[50, -1], depth[-1, 70], depth[33, 0] = z[:3]
    points = np.c_[px, np.ones(count)] @ np.linalg.inv(K_before).T * z[:, None]
    seen = (points @ T[:3, :3].T + T[:3, 3]) @ K_after.T
    px_after = seen[:, :2] / seen[:, 2:]
    descriptors = rng.normal(size=(count, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    order = rng.permutation(count)
    more = np.zeros((count, 2))
    before = agreement._Image((np.c_[px, more], descriptors), Camera(K_before), depth)
    after = agreement._Image(
        (np.c_[px_after[order], more], descriptors[order]), Camera(K_after), np.ones((20, 30))
    )
    return before, after, T


def test_a_motion_needs_twenty_matches_that_fit_it():
    before, after, T = made_up_matches(20)
    np.testing.assert_allclose(agreement._motion(before, after), T, atol=1e-4)
    assert agreement._motion(*made_up_matches(19)[:2]) is None
    before, after, T = made_up_matches(32)
    px = after.features[0].copy()
    px[:12, 0] += np.random.default_rng(1).uniform(30, 90, 12)  # leaves twenty
    np.testing.assert_allclose(
        agreement._motion(before, after._replace(features=(px, after.features[1]))), T, atol=1e-3
    )
    px[12, 1] -= 40.0
    assert agreement._motion(before, after._replace(features=(px, after.features[1]))) is None


@pytest.mark.parametrize(("off_px", "fits"), [(0.8, True), (2.2, False)])
def test_a_match_fits_to_within_one_and_a_half_pixels(off_px, fits):
    """The last five of thirty are off: the motion is exact only if they are left out."""
    before, after, T = made_up_matches(30, seed=2)
    px = after.features[0].copy()
    px[-5:, 0] += off_px
    found = agreement._motion(before, after._replace(features=(px, after.features[1])))
    off = np.abs(found - T).max()
    assert (off > 2e-4) if fits else (off < 2e-5), off


@pytest.fixture(scope="module")
def video() -> tuple[np.ndarray, list[tuple[DepthFrame, np.ndarray]]]:
    """Poses, depth and images of a camera that moves along and about all axes. After a cut it looks back."""
    K, size = np.array([[210.0, 0, 118.0], [0, 185.0, 95.0], [0, 0, 1]]), (240, 180)
    E = np.tile(np.eye(4), (5, 1, 1))
    for i, pose in enumerate(E):
        turn = Rotation.from_euler("xyz", [10 + 2 * i, 15 - 3 * i, 20 + 4 * i], degrees=True)
        pose[:3, :3] = (turn * Rotation.from_euler("y", 180 * (i > 2), degrees=True)).as_matrix()
        pose[:3, 3] = 0.07 * i - 0.1, 0.05 * (i % 2), -0.3 + 0.06 * i
    frames = []
    for pose in E:
        image, depth = render(pose, size, K)
        depth = depth.astype(np.float32)
        frames.append(
            (posed_frame("", depth, np.ones_like(depth), K, np.eye(4)), image.astype(np.float32) / 255)
        )
    return E, frames


@pytest.mark.parametrize("long_side", [832, 168])
def test_poses_of_a_video_are_metric_and_a_cut_begins_another_world(video, long_side, monkeypatch):
    """At their own size, and shrunk to a grid on which depth and K have to be shrunk as well."""
    sizes, find = [], agreement.sift_features
    monkeypatch.setattr(tracks, "LONG_SIDE", long_side)
    monkeypatch.setattr(agreement, "sift_features", lambda grey: sizes.append(grey.shape) or find(grey))
    depths, motion = [], agreement._motion
    monkeypatch.setattr(agreement, "_motion", lambda *pair: depths.append(pair[1].depth) or motion(*pair))
    E, frames = video
    scenes = scene_poses(iter(frames))
    assert set(sizes) == {(180, 240) if long_side > 240 else (126, 168)}
    for shrunk, (frame, _) in zip(depths, frames[1:], strict=True):  # depth is never mixed across an edge
        assert shrunk.shape == sizes[0] and np.isin(shrunk, frame.depth).all()
    assert [len(scene) for scene in scenes] == [3, 2]
    for scene, first in zip(scenes, (0, 3), strict=True):
        np.testing.assert_array_equal(scene[0], np.eye(4))
        for i, found in enumerate(scene):
            true = np.linalg.solve(E[first], E[first + i])
            np.testing.assert_allclose(found[:3, 3], true[:3, 3], atol=6e-3)
            turned = Rotation.from_matrix(found[:3, :3].T @ true[:3, :3]).magnitude()
            assert np.degrees(turned) < 0.25


def test_frames_of_a_video_agree_with_three_before_and_after_in_their_scene():
    """Each has a depth and a confidence of its own; the camera does not move within a scene."""
    K, inverse, sure = np.array([[12.0, 0, 4.2], [0, 10.0, 3.1], [0, 0, 1]]), [], []

    def load(i: int) -> DepthFrame:
        depth = np.full((7, 9), 1 / inverse[i], np.float32)
        return posed_frame(f"f{i}", depth, np.full_like(depth, sure[i]), K, np.full((4, 4), np.nan))

    inverse, sure = 1 / (2 + 0.01 * np.arange(11)), np.linspace(0.2, 0.7, 11)
    moved = np.eye(4)
    moved[2, 3] = 1e-3  # so that frames of both scenes would agree
    scenes = [[np.eye(4)] * 8, [moved] * 3]
    found = list(temporally_smoothed(scenes, load))
    assert [frame.name for frame in found] == [f"f{i}" for i in range(11)]
    for i, frame in enumerate(found):
        scene = range(8) if i < 8 else range(8, 11)
        near = [j for j in scene if abs(j - i) <= 3]
        weights = [(1 + (j == i)) * (0.05 + sure[j]) for j in near]
        np.testing.assert_allclose(frame.depth, sum(weights) / np.dot(weights, inverse[near]), rtol=1e-5)
        assert (frame.confirmed == len(near) - 1).all()
        np.testing.assert_array_equal(frame.camera.E, np.eye(4) if i < 8 else moved)


@pytest.mark.parametrize("confidence", [0.79, 0.81])
def test_what_may_have_moved_in_a_video_is_not_outvoted_if_it_is_sure(confidence):
    """Something at 1 m that is before the wall in the middle frame alone."""
    K = np.array([[12.0, 0, 4.2], [0, 10.0, 3.1], [0, 0, 1]])

    def load(i: int) -> DepthFrame:
        depth = np.full((7, 9), 1.0 if i == 2 else 2.0, np.float32)
        return posed_frame("", depth, np.full_like(depth, confidence if i == 2 else 1.0), K, np.eye(4))

    found = list(temporally_smoothed([[np.eye(4)] * 5], load))
    np.testing.assert_allclose(found[2].depth, 1.0 if confidence > 0.8 else 2.0, rtol=1e-6)


def test_sigma_is_bounded_by_what_the_agreed_confidence_implies_and_that_of_other_frames_depth():
    frames = [small(number) for number in range(4)]
    sigma = 0.4 * frames[0].depth
    sigma[:, ::2] = 0.001 * frames[0].depth[:, ::2]
    sigma[1, 1] = np.nan  # unknown before other frames agreed
    found = agreed(replace(frames[0], sigma=sigma.astype(np.float32)), frames[1:])
    plain = agreed(frames[0], frames[1:])
    np.testing.assert_array_equal(found.depth, plain.depth)
    assert plain.sigma is None
    bound = found.depth * 0.1 / norm.ppf((1 + np.clip(found.confidence.astype(float), 0.05, 0.999)) / 2)
    own = np.isclose(found.sigma, sigma, rtol=1e-5)
    bounded = np.isclose(found.sigma, bound, rtol=1e-4)
    assert (own | bounded).all() and (found.sigma[:, ::2][own[:, ::2]] < 0.01).all()
    outvoted = np.abs(found.depth / frames[0].depth - 1) > 0.06
    assert outvoted.any() and bounded[outvoted].all(), "not the error of the depth that was replaced"
    assert own.mean() > 0.3 and bounded[:, 1::2].mean() > 0.9


def test_depth_of_a_frame_without_others_stays():
    frame = frame_of(2)
    found = agreed(frame, [])
    np.testing.assert_allclose(found.depth, frame.depth, rtol=1e-6)
    np.testing.assert_allclose(found.confidence, frame.confidence, rtol=1e-6)
    assert not found.confirmed.any() and not found.observers.any()


def test_pixels_without_depth_stay_so_and_do_not_affect_other_frames():
    frame, *others = (small(number) for number in range(4))
    hole = np.zeros(frame.depth.shape, bool)
    hole[:, : hole.shape[1] // 3] = True
    masked = replace(
        frame, depth=np.where(hole, 0, frame.depth), confidence=np.where(hole, 0, frame.confidence)
    )
    found = agreed(masked, others)
    assert (
        (found.depth[hole] == 0).all()
        and (found.confidence[hole] == 0).all()
        and (found.confirmed[hole] == 0).all()
    )
    assert (found.depth[~hole] > 0).all() and np.isfinite(found.depth).all()
    assert not seen_in(masked, others[0]).inside[hole].any()
    shown, _ = rendered(masked, others[0], masked.confidence)
    whole, _ = rendered(frame, others[0], frame.confidence)
    assert shown[shown > 0].min() >= whole[whole > 0].min()


@pytest.fixture(scope="module")
def sequence():
    return render_sequence(1, 4, size=(144, 192))


def of_depth(sequence, depths):
    """The frames of a sequence with these depths, their pose not known, and their images."""
    images = [view.image_01.permute(1, 2, 0).numpy() for view in sequence.lefts]
    K, sure = sequence.K.numpy().astype(np.float64), np.full(depths[0].shape, 0.5)
    return [posed_frame("", depth, sure, K, np.eye(4)) for depth in depths], images


@END_TO_END
def test_the_motion_of_the_camera_is_found_and_a_cut_begins_a_scene(sequence):
    ground_truth = true_frames(sequence)
    known, images = of_depth(sequence, [np.nan_to_num(frame.depth, nan=50.0) for frame in ground_truth])
    (poses,) = scene_poses(zip(known, images, strict=True))
    for frame, E in zip(ground_truth, poses, strict=True):
        assert np.allclose(E, np.linalg.inv(ground_truth[0].camera.E) @ frame.camera.E, atol=0.01)
    images[2:] = [image[:, ::-1].copy() for image in images[2:]]
    assert [len(scene) for scene in scene_poses(zip(known, images, strict=True))] == [2, 2]
    images[1] = np.zeros_like(images[1])  # nothing to be seen
    assert [len(scene) for scene in scene_poses(zip(known, images, strict=True))] == [1, 1, 2]


@END_TO_END
def test_frames_that_agree_are_averaged_within_their_scene(sequence):
    ground_truth = true_frames(sequence)
    off = [0.02 * (-1) ** k for k in range(4)]
    known, _ = of_depth(
        sequence, [frame.depth * np.exp(o) for frame, o in zip(ground_truth, off, strict=True)]
    )
    of_camera = [np.linalg.inv(ground_truth[0].camera.E) @ frame.camera.E for frame in ground_truth]
    temporal_smoothing = list(temporally_smoothed([of_camera], known.__getitem__))
    errors = [
        np.log(frame.depth / true.depth) for frame, true in zip(temporal_smoothing, ground_truth, strict=True)
    ]
    assert flicker(errors, ground_truth)[0] < 0.4 * 0.04
    assert max(np.nanmean(np.abs(error)) for error in errors) < 0.7 * 0.02
    known[1].depth[40:80, 60:100] *= 0.5  # something that moves: no other frame has it there
    known[1].confidence[40:80, 60:100] = 0.9
    there = list(temporally_smoothed([of_camera], known.__getitem__))[1]
    np.testing.assert_allclose(
        there.depth[45:75, 65:95], np.nan_to_num(known[1].depth[45:75, 65:95]), rtol=1e-6
    )
    assert not there.confirmed[45:75, 65:95].any()
    apart = list(
        temporally_smoothed([[E] for E in of_camera], known.__getitem__)
    )  # every frame a scene of its own
    assert all(np.allclose(a.depth, np.nan_to_num(k.depth)) for a, k in zip(apart, known, strict=True))
