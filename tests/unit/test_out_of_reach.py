"""Depth that the cameras cannot measure is no depth: maps stay finite, and exports leave it out."""

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin._reprojection import PosedCamera, depth_in_camera
from geodiff_plugin.capture.results import _write_agreed
from geodiff_plugin.formats.points import read_ply_points
from geodiff_plugin.jobs.bag import _valid_depth
from geodiff_plugin.jobs.report import depth_summary
from geodiff_plugin.jobs.writing import pixels_of, write_maps
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.types import DepthFrame

K = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
FAR = np.s_[:10]  # rows of a sky
REACH_M = 40.0


def output(**changed) -> MetricDepthOutput:
    """A wall 2 m away below a sky as far away as the cameras can measure."""
    depth_m, confidence = np.full((48, 64), 2.0, np.float32), np.full((48, 64), 0.9, np.float32)
    depth_m[FAR], confidence[FAR] = REACH_M, 0.0
    shaped = {"prediction": depth_m[None, ..., None], "confidence": confidence[None, ..., None], "K": K[None]}
    return MetricDepthOutput(**(shaped | changed))


def test_there_is_a_depth_where_it_and_its_confidence_are_above_0():
    for confidence, known in ((output().confidence, 38 * 64), (None, 48 * 64)):
        made = output(confidence=confidence)
        assert made.valid.dtype == bool and made.valid.shape == (1, 48, 64, 1) and made.valid.sum() == known
    zero = output(prediction=np.zeros((1, 48, 64, 1), np.float32))
    assert not zero.valid.any()
    tensors = {
        name: torch.from_numpy(getattr(output(), name)).permute(0, 3, 1, 2)
        for name in ("prediction", "confidence")
    }
    made = output(**tensors)
    assert made.valid.shape == (1, 1, 48, 64) and made.valid.sum() == 38 * 64


def test_maps_stay_finite_and_everything_else_leaves_it_out(tmp_path):
    image = np.full((48, 64, 3), 0.5, np.float32)
    counts = write_maps(tmp_path, output(), image)
    assert np.load(tmp_path / "depth.npy")[FAR].tolist() == np.full((10, 64), REACH_M).tolist()
    millimetres = np.asarray(Image.open(tmp_path / "depth_mm.png"))
    assert (millimetres[FAR] == 0).all() and (millimetres[10:] == 2000).all()
    points = read_ply_points(tmp_path / "cloud.ply")
    assert len(points) == counts["cloud_points"] <= 38 * 64 and points[:, 2].max() == 2.0
    assert counts["points_out_of_reach"] == 640 and counts["doubtful_points"] == 0
    depth_m, _, _, keep = pixels_of(output(), image, 0.0)
    assert not keep[FAR].any() and keep[12:].all() and depth_m[0, 0] == REACH_M
    assert depth_summary(depth_m * output().valid[0, ..., 0], None)["max_m"] == 2.0


def test_another_camera_does_not_see_it():
    E, size = np.eye(4), (64, 48)
    camera = PosedCamera.checked(K, E, size)
    unknown = np.where(output().valid, output().prediction, 0.0)[0, ..., 0]
    seen = output().into(K, E, size)[0, ..., 0]
    np.testing.assert_array_equal(seen, depth_in_camera(unknown, K, camera))
    assert (seen[:9] == 0).all() and (seen[12:40] == 2.0).all()


def test_bags_and_frames_of_captures_leave_it_out(tmp_path):
    depth, confidence = (getattr(output(), name)[0, ..., 0] for name in ("prediction", "confidence"))
    np.save(tmp_path / "depth.npy", depth)
    np.testing.assert_array_equal(_valid_depth(tmp_path), depth)  # of a preset without confidence
    np.save(tmp_path / "confidence.npy", confidence)
    np.testing.assert_array_equal(_valid_depth(tmp_path), np.where(confidence > 0, depth, 0))
    count = np.ones((48, 64), np.uint8)
    _write_agreed(tmp_path, DepthFrame("a", depth, confidence, K, np.eye(4), count, count), "m")
    assert (np.asarray(Image.open(tmp_path / "depth_mm.png"))[FAR] == 0).all()
    assert (np.load(tmp_path / "depth.npy")[FAR] == REACH_M).all()


CAMERA = np.array([[120.0, 0, 63.5], [0, 120.0, 47.5], [0, 0, 1]])
BASELINE_M = 0.1


def pair_of_shifts(*shifts_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left and right picture of walls one above the other, and the pixels by which each row shifts."""
    height = 96 // len(shifts_px)
    walls = np.random.default_rng(0).random((len(shifts_px), height, 168, 3), np.float32)
    scene = np.concatenate([cv2.GaussianBlur(wall, (0, 0), 1.0) for wall in walls])  # each of its own texture
    scene = (scene - scene.min()) / np.ptp(scene)
    shifts = np.repeat(shifts_px, height)
    right = np.stack([row[16 + px : 144 + px] for row, px in zip(scene, shifts, strict=True)])
    return scene[:, 16:144], right, shifts


@pytest.fixture
def run(make_oracle):
    """One guided call on a pair, by a prior that knows near from far."""

    def call(left, right, order, K=(CAMERA, CAMERA), **knobs):
        relative = (order - order.min()) / np.ptp(order)
        relative = np.repeat(relative[:, None], 128, 1).astype(np.float32)
        E = np.eye(4)
        E[0, 3] = BASELINE_M
        pipe = enable_geometry_guidance(make_oracle(relative, "disparity"))
        return pipe(left, guidance=GeometryGuidance(right, K, E, inner_steps=0, **knobs))

    return call


@pytest.mark.parametrize("far_px", [0, 3])
def test_a_sky_has_none_and_that_makes_no_result_less_trusted(run, far_px):
    """A sky that shifts by nothing between the views, or by what can be measured, above two walls."""
    pair = pair_of_shifts(far_px, 8, 14)
    reach_m = 120 * BASELINE_M / 0.3
    out = run(*pair)
    at_reach = out.prediction[0, ..., 0] > 0.999 * reach_m
    assert np.isfinite(out.prediction).all() and not at_reach[36:].any()
    assert at_reach[:28].mean() > 0.9 if far_px == 0 else not at_reach.any()
    np.testing.assert_array_equal(out.confidence[0, ..., 0] == 0, at_reach)
    (verdict,) = out.verdicts
    assert verdict.trusted, verdict.reasons
    higher = verdict.indicators.confidence - out.confidence.mean()
    assert higher > 0.1 if far_px == 0 else higher == pytest.approx(0, abs=1e-6)
    given = run(*pair, depth_range=(0.5, 10 * reach_m))
    assert (given.confidence > 0).all(), "the user says that things are further away"


def test_a_centre_that_is_not_as_assumed_is_told_in_pixels_and_lowers_confidence(run):
    """The right cx is larger by 6 px: of the shifts -3, 5 and 11 px the first lie behind infinity."""
    left, right, shifts = pair_of_shifts(-3, 5, 11)
    K_right = CAMERA.copy()
    K_right[0, 2] += 6
    own = run(left, right, shifts, K=(CAMERA, K_right))
    assert own.verdicts[0].trusted and own.verdicts[0].indicators.behind_px == 0
    for K, code in ((CAMERA, "camera.other-centre"), ((CAMERA, CAMERA), "views.behind-infinity")):
        out = run(left, right, shifts, K=K)
        (verdict,) = out.verdicts
        (reason,) = [each for each in verdict.reasons if each.code in (code, "views.behind-infinity")]
        assert reason.code == code and verdict.indicators.behind_px == pytest.approx(3, abs=0.5)
        assert ("by 3 px or more. Give its K or cx (K_right, or --cx-right)" in reason) is (K is CAMERA)
        assert out.confidence[0, 68:].mean() < 0.4 < 0.8 < own.confidence[0, 68:].mean()
