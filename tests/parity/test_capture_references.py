"""Captures, poses, formats and phase 3 against NumPy, or against made-up captures whose metres are known."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin import Capture
from geodiff_plugin.cameras import Camera
from geodiff_plugin.capture.agreement import agreed, rendered, seen_in
from geodiff_plugin.formats.depth import disparity_of_depth
from geodiff_plugin.formats.transforms import nerf_pose
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.matching import Matches
from geodiff_plugin.pose.multiview import SolvedCapture, _rescale
from geodiff_plugin.pose.tracks import grey_image, grey_views
from geodiff_plugin.result.expected_error import expected_error
from geodiff_plugin.result.median import _upsampled
from geodiff_plugin.result.output import MetricDepthOutput, _in_the_priors_metres
from geodiff_plugin.trust import Call, KnownPoints, ResultStage, measure_result
from geodiff_plugin.trust.match_statistics import match_statistics
from geodiff_plugin.types import DepthFrame
from tests.views import posed_frame, posed_of

K = np.array([[400.0, 0.0, 159.5], [0.0, 410.0, 119.5], [0.0, 0.0, 1.0]])

#: Of frames of some ten pixels.
K_SMALL = np.array([[10.0, 0.0, 3.0], [0.0, 10.0, 2.0], [0.0, 0.0, 1.0]])


def poses(count: int) -> np.ndarray:
    """``(count, 4, 4)`` camera-to-world on a winding walk."""
    E = np.tile(np.eye(4), (count, 1, 1))
    for i, pose in enumerate(E):
        pose[:3, 3] = 0.3 * i, 0.2 * math.sin(i), 0.1 * math.cos(2 * i)
        turn = [5.0 * math.sin(i), 3.0 * i, 4.0 * math.cos(i)]
        pose[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    return E


def test_a_solve_comes_back_to_the_given_frame_from_any_other():
    """The solve of a synthetic capture is ground truth in another world: scaled, rotated and translated."""
    true, points = poses(9), np.random.default_rng(0).uniform((-2, -2, 3), (2, 2, 8), (40, 3))
    R, t = Rotation.from_euler("xyz", [20.0, -35.0, 50.0], degrees=True).as_matrix(), np.array([3.0, -1, 2])
    moved = true.copy()
    moved[:, :3, :3], moved[:, :3, 3] = R @ true[:, :3, :3], (true[:, :3, 3] @ R.T) / 1.7 + t
    seen = tuple((np.zeros((40, 2)), np.arange(40)) for _ in true)
    solved = SolvedCapture(
        "solved", moved, true, np.tile(K, (9, 1, 1)), np.ones(9, bool), points @ R.T / 1.7 + t, seen
    )
    depths = [dict(enumerate(((points - E[:3, 3]) @ E[:3, 2]).tolist())) for E in true]
    found = _rescale(solved, depths, [{k: z / 1.7 for k, z in of.items()} for of in depths])
    np.testing.assert_allclose(found.E, true, atol=1e-9)
    np.testing.assert_allclose(found.points, points, atol=1e-9)
    assert found.scale_depth == pytest.approx(1.7) and found.scale_trajectory == pytest.approx(1.7)
    assert found.scale_rel_std == pytest.approx((0.015**-2 + 0.02**-2) ** -0.5, rel=1e-3)
    # The depth of the scene gives 1.3 times as much: the mean by the inverse variances.
    torn = _rescale(solved, depths, [{k: z / 1.7 / 1.3 for k, z in of.items()} for of in depths])
    fractions = np.array([0.015, 0.02]) ** -2.0
    fractions /= fractions.sum()
    longer = math.exp(fractions[0] * math.log(1.3))
    apart = np.linalg.norm(np.diff(torn.E[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(apart, longer * np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1))
    assert torn.scale_rel_std == pytest.approx(
        math.hypot(math.sqrt(fractions[0] * fractions[1]) * math.log(1.3), found.scale_rel_std), rel=1e-3
    )


def test_everything_of_a_capture_is_rescaled_together(tmp_path):
    """A capture in feet whose metres are known: poses, given poses, points of the solve and of the model."""
    E = poses(3)
    for i in range(3):
        Image.new("RGB", (320, 240)).save(tmp_path / f"{i}.png")
    frames = [
        {"file_path": f"{i}.png", "transform_matrix": (E[i] @ OPENGL_FROM_OPENCV).tolist()} for i in range(3)
    ]
    camera = {"fl_x": 400.0, "fl_y": 410.0, "cx": 160.0, "cy": 120.0, "w": 320, "h": 240}
    (tmp_path / "transforms.json").write_text(json.dumps(camera | {"frames": frames}))
    capture = Capture.open(tmp_path)
    known = np.array([[1.0, 2.0, 3.0]])
    capture.frames = [replace(frame, points=known) for frame in capture.frames]
    seen = tuple((np.zeros((1, 2)), np.zeros(1, int)) for _ in E)
    capture.solved = SolvedCapture("solved", E, E, np.tile(K, (3, 1, 1)), np.ones(3, bool), known, seen)
    before = capture.solved.pose(0, 2)
    capture.rescale(0.3048)
    after = capture.solved.pose(0, 2)
    np.testing.assert_allclose(after[:3, 3], 0.3048 * before[:3, 3])
    np.testing.assert_allclose(after[:3, :3], before[:3, :3])
    np.testing.assert_allclose(capture.solved.points, 0.3048 * known)
    np.testing.assert_allclose(capture.solved.E_given[:, :3, 3], 0.3048 * E[:, :3, 3])
    np.testing.assert_allclose(capture.poses[:, :3, 3], 0.3048 * E[:, :3, 3])
    np.testing.assert_allclose(capture.frames[1].points, 0.3048 * known)
    assert capture.unit == "m"


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("shift", "lost"), [(-0.4, None), (-0.6, 0), (0.4, None), (0.6, -1)])
def test_a_point_is_in_an_image_up_to_the_outer_edges_of_its_pixels(axis, shift, lost):
    """Another camera at the same place, whose principal point lies part of a pixel further on."""
    depth, E = np.full((5, 7), 2.0), poses(3)[1]
    moved = K_SMALL.copy()
    moved[axis, 2] += shift
    frame, other = (posed_frame("", depth, np.ones_like(depth), each, E) for each in (K_SMALL, moved))
    expected = np.ones(depth.shape, bool)
    if lost is not None:
        expected[(slice(None), lost) if axis == 0 else lost] = False
    seen = seen_in(frame, other)
    np.testing.assert_array_equal(seen.inside, expected)
    for at, found, along in zip(np.indices(depth.shape), (seen.row, seen.column), (1, 0), strict=True):
        nearest = np.rint(at + (shift if axis == along else 0.0))
        np.testing.assert_array_equal(found[expected], nearest[expected])
    np.testing.assert_allclose(seen.z, 2.0)


def _agreed(depth: float, sure: float, others: list[tuple[float, float]], moving: bool) -> tuple:
    """Depth, confidence, confirming and observing frames of a pixel, with its depth in other frames."""
    near = [d / depth for d, _ in others]
    confirming = [(d, c) for (d, c), ratio in zip(others, near, strict=True) if abs(ratio - 1) < 0.06]
    observers = sum(ratio > 0.94 for ratio in near)
    own = 2.0 * (0.05 + sure)
    weights = [own, *(0.05 + c for _, c in confirming)]
    inverse = sum(w / d for w, d in zip(weights, (depth, *(d for d, _ in confirming)), strict=True))
    inverse, missing = inverse / sum(weights), (1 - sure) * math.prod(1 - 0.4 * c for _, c in confirming)
    confirmed = len(confirming)
    if not confirmed and not (moving and sure >= 0.8):
        observers += sum(0 < ratio < 0.94 for ratio in near)
        groups = [[(e, c) for e, c in others if e > 0 and abs(d / e - 1) < 0.06] for d, _ in others if d > 0]
        best = max(groups, key=lambda group: sum(0.05 + c for _, c in group), default=[])
        said = sum(0.05 + c for _, c in best)
        if len(others) >= 2 and len(best) >= 2 and said > own:
            inverse = sum((0.05 + c) / d for d, c in best) / said
            missing, confirmed = math.prod(1 - 0.4 * c for _, c in best), len(best)
    return 1.0 / inverse, 1.0 - missing, confirmed, max(observers, confirmed)


@pytest.mark.parametrize(
    ("sure", "others", "moving"),
    [
        (0.5, [], False),
        (0.5, [(2.1, 0.7), (1.9, 0.2), (3.0, 0.9)], False),  # two confirm it, one sees something behind
        (0.5, [(1.5, 0.9), (2.05, 0.4)], False),  # one sees a surface before it
        (0.3, [(1.5, 0.9)], False),  # nobody outvotes it alone
        (0.3, [(1.5, 0.9), (1.45, 0.6), (3.0, 0.9)], False),  # two do together
        (0.3, [(1.5, 0.2), (1.45, 0.2), (3.0, 0.9)], False),  # but not with less weight
        (0.9, [(1.5, 0.9), (1.45, 0.95), (1.5, 0.8)], True),  # nor what may have moved, if it is sure
        (0.7, [(1.5, 0.9), (1.45, 0.95), (1.5, 0.8)], True),
        (0.1, [(0.0, 0.9), (0.0, 0.9), (1.0, 0.4)], False),  # without a depth they say nothing
        (0.1, [(0.0, 0.9), (0.95, 0.4), (1.05, 0.4)], False),  # nor of what others agree on
    ],
)
def test_a_depth_and_that_of_other_frames_agree_as_written(sure, others, moving):
    """Frames of one camera, each of one depth; a pixel is worked out by hand."""

    def frame(depth: float, confidence: float) -> DepthFrame:
        full = np.full((7, 9), depth)
        return posed_frame("", full, np.full_like(full, confidence), K_SMALL, poses(3)[1])

    found = agreed(frame(2.0, sure), [frame(*each) for each in others], moving)
    expected = _agreed(2.0, sure, others, moving)
    for values, each in zip(
        (found.depth, found.confidence, found.confirmed, found.observers), expected, strict=True
    ):
        np.testing.assert_allclose(values, each, rtol=1e-5)


def test_frames_that_outvote_a_depth_observe_it_though_they_do_not_see_its_point():
    """A wall at 4 m, which one frame has at 0.5 m: there its points are outside of the others' images."""

    def frame(depth: float, x: float) -> DepthFrame:
        full, E = np.full((7, 9), depth), np.eye(4)
        E[0, 3] = x
        return posed_frame("", full, np.full_like(full, 0.5), K_SMALL, E)

    found = agreed(
        replace(frame(0.5, 0.0), confidence=np.full((7, 9), 0.1)), [frame(4.0, 0.8), frame(4.0, -0.8)]
    )
    middle = (3, 4)
    assert found.depth[middle] == pytest.approx(4.0, rel=1e-5)
    assert found.confirmed[middle] == found.observers[middle] == 2


def test_of_several_points_of_a_finer_frame_a_pixel_shows_the_nearest():
    """Nine of them; one in three is nearer, and comes before the others."""
    finer = np.diag([3.0, 3.0, 1.0]) @ K_SMALL
    depth = np.full((21, 27), 3.0)
    depth[:, 2::3] = 2.0
    other = posed_frame("", depth, np.ones_like(depth), finer, np.eye(4))
    frame = posed_frame("", np.full((7, 9), 5.0), np.ones((7, 9)), K_SMALL, np.eye(4))
    seen, values = rendered(other, frame, np.where(depth < 2.5, 7, 1))
    assert (seen[:, 1:] == 2.0).all() and (values[:, 1:] == 7).all()


def test_points_that_three_frames_see_are_known_depths_of_each_in_its_camera(tmp_path):
    """Of four points one is seen by two frames, one by all four, and one lies behind the first camera."""
    E = poses(4)
    points = np.array([[0.0, 0.1, 3.0], [0.5, -0.2, 4.0], [0.1, 0.3, 5.0], [0.0, 0.0, -6.0]])
    by_frame = ([0, 1, 2, 3], [0, 1, 2, 3], [1, 2, 3], [2])
    for i in range(4):
        Image.new("RGB", (320, 240)).save(tmp_path / f"{i}.png")
    frames = [{"file_path": f"{i}.png", "transform_matrix": np.eye(4).tolist()} for i in range(4)]
    camera = {"fl_x": 400.0, "fl_y": 410.0, "cx": 160.0, "cy": 120.0, "w": 320, "h": 240}
    (tmp_path / "transforms.json").write_text(json.dumps(camera | {"frames": frames}))
    capture = Capture.open(tmp_path)
    seen = tuple((np.zeros((len(which), 2)), np.array(which)) for which in by_frame)
    connected = np.array([True, True, True, False])
    capture.solved = SolvedCapture("solved", E, E, np.tile(K, (4, 1, 1)), connected, points, seen)
    for name, pose, which in (("0", E[0], [1, 2]), ("1", E[1], [1, 2]), ("2", E[2], [1, 2])):
        expected = (points[which] - pose[:3, 3]) @ pose[:3, :3]
        np.testing.assert_allclose(capture.known_depths(name, "tracks"), expected, rtol=1e-5)
    assert capture.known_depths("3", "tracks") is None  # the solve does not hold it


def test_a_reduced_image_keeps_every_ray_and_right_views_have_the_same_resolution():
    image = torch.rand(3, 240, 320)
    shrunk = grey_image(image, Camera(K), 0.25).camera
    # The middle of the first pixel's block of 4 x 4 is at (1.5, 1.5).
    np.testing.assert_allclose(np.linalg.solve(shrunk.K, [0, 0, 1]), np.linalg.solve(K, [1.5, 1.5, 1]))
    finer = K.copy()
    finer[:2] *= 2.0
    left, right = grey_views(posed_of(image, K, (torch.rand(3, 480, 640), finer, np.eye(4))))
    assert left.grey.shape == right.grey.shape == (240, 320)
    assert right.camera.K[0, 0] == pytest.approx(left.camera.K[0, 0])


def test_disparity_of_depth_is_what_both_cameras_see():
    """Of a point projected into both cameras, whose principal points differ (doffs)."""
    K_right, E = K.copy(), np.eye(4)
    K_right[0, 2], E[0, 3] = K[0, 2] + 7.0, 0.2
    depth = np.array([[2.0, 5.0], [np.inf, 0.0]])
    X = np.array([0.3, -0.1, 5.0])
    left, right = K @ X, K_right @ (X - E[:3, 3])
    found = disparity_of_depth(depth, K, K_right, E)
    assert found[0, 1] == pytest.approx(left[0] / left[2] - right[0] / right[2], rel=1e-6)
    assert np.isinf(found[1]).all()


def test_applied_scale_of_a_file_is_taken_out():
    """Nerfstudio multiplied the positions by it when it wrote the file."""
    E = poses(3)[2]
    written = E @ OPENGL_FROM_OPENCV
    written[:3, 3] *= 0.25
    found = nerf_pose({"transform_matrix": written.tolist(), "applied_scale": 0.25})
    np.testing.assert_allclose(found, E, atol=1e-12)


def test_everything_with_a_length_comes_out_in_the_priors_metres():
    over_prior = torch.tensor([[4.0, 4.0, 4.0]])
    output = MetricDepthOutput(
        prediction=np.array([8.0, 12.0]),
        uncertainty=np.array([0.4, 0.8]),
        global_scale=torch.tensor([[2.0]]),
        prior_scale=torch.tensor([[4.0]]),
    )
    found = _in_the_priors_metres(output, over_prior)
    np.testing.assert_allclose(found.prediction, [2.0, 3.0])
    np.testing.assert_allclose(found.uncertainty, [0.1, 0.2])
    assert float(found.global_scale) == 0.5 and float(found.prior_scale) == 1.0 and found.rescaled == 0.25


@pytest.mark.parametrize("centre", [(0.2, 0.0, 0.0), (0.1, 0.05, 0.5), (0.1, -0.05, -0.5), (0.0, 0.1, 0.2)])
def test_expected_error_is_a_quarter_pixel_over_the_change_of_the_right_pixel_with_depth(centre):
    E = np.eye(4)
    E[:3, 3] = centre
    depth, step = np.random.default_rng(0).uniform(2.0, 6.0, (6, 8)), 1e-6
    small = np.array([[10.0, 0, 3.5], [0, 10.0, 2.5], [0, 0, 1]])
    v, u = np.indices(depth.shape)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(small).T

    def right_px(z: np.ndarray) -> np.ndarray:
        p = (rays * z[..., None] - E[:3, 3]) @ small.T
        return p[..., :2] / p[..., 2:]

    moves = np.linalg.norm(right_px(depth + step) - right_px(depth - step), axis=-1) / (2 * step)
    np.testing.assert_allclose(expected_error(depth, small, [E]), 0.25 / moves, rtol=1e-5)
    both = expected_error(depth, small, [E], scale_rel_std=0.1)
    np.testing.assert_allclose(both, np.hypot(0.25 / moves, 0.1 * depth), rtol=1e-5)


def _matches(inverse_depth: np.ndarray, confidence: np.ndarray, step: float) -> Matches:
    def tensor(x: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(x.astype(np.float32))[None]

    return Matches(tensor(inverse_depth), tensor(confidence), torch.tensor(step))


def test_statistics_of_matches_and_points_against_numpy():
    rng, step = np.random.default_rng(0), 0.001
    inverse = rng.uniform(0.1, 1.0, (24, 32))
    confidence = rng.uniform(0.0, 1.0, inverse.shape)
    depth = np.exp(rng.normal(0.05, 0.1, inverse.shape)) / inverse
    known = np.zeros(inverse.shape)
    known[2::5, 2::5] = 1.0
    smooth = np.full(inverse.shape, 0.5)
    matches = _matches(inverse, confidence, step)
    numbers = match_statistics(matches, torch.from_numpy(depth)[None, None].float())
    sure = confidence > 0.5
    assert float(numbers["matched"]) == pytest.approx(sure.mean())
    assert float(numbers["log_deviation"]) == pytest.approx(
        np.sort(np.abs(np.log(depth * inverse)[sure]))[(sure.sum() - 1) // 2], rel=1e-4
    )
    low, high = np.quantile(inverse[sure], (0.05, 0.95))
    assert float(numbers["log_range"]) == pytest.approx(np.log(high / low), rel=1e-4)
    assert float(numbers["median_m"]) == pytest.approx(1.0 / np.median(inverse[sure]), rel=2e-2)
    # Points 1.15 times as far as the matches, a third of them 1.25 times.
    far = np.where(np.arange(inverse.size).reshape(inverse.shape) % 3, 1.15, 1.25)
    points = _matches(smooth / far, known, step)
    native = posed_of(torch.zeros(3, 24, 32), np.eye(3))
    matches = _matches(smooth, np.ones_like(smooth), step)
    stage = ResultStage(Call(), native, matches, points, torch.full((1, 1, 24, 32), 2.0))
    found = measure_result(stage)[KnownPoints]
    assert found.ratio == pytest.approx(1.15, rel=1e-4)
    assert found.fraction_off == pytest.approx((far[known > 0] > 1.2).mean())
    assert found.count == KnownPoints.scalars(stage)["compared"] == known.sum()


def test_enlarged_votes_lie_where_the_pixels_do():
    """Votes that rise along x and y, in one colour, rise the same when enlarged, without a shift."""
    rows, columns, factor = 8, 10, 4
    v, u = np.indices((rows, columns), dtype=np.float32)
    voted = torch.from_numpy(0.01 * u + 0.02 * v)
    found = _upsampled(voted, torch.zeros(3, rows, columns), torch.zeros(3, rows * factor, columns * factor))
    y, x = (np.indices((rows * factor, columns * factor)) + 0.5) / factor - 0.5
    inner = slice(6, -6)
    off = found.numpy()[inner, inner] - (0.01 * x + 0.02 * y)[inner, inner]
    assert abs(off.mean()) < 1e-4 and np.abs(off).max() < 4e-3
