"""Depth that the cameras cannot measure is no depth: maps stay finite, and exports leave it out."""

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin._reprojection import TargetCamera, depth_in_camera
from geodiff_plugin.capture.results import _write_agreed
from geodiff_plugin.formats.points import read_ply_points
from geodiff_plugin.jobs.bag import _valid_depth
from geodiff_plugin.jobs.report import depth_summary
from geodiff_plugin.jobs.writing import pixels_of, write_maps
from geodiff_plugin.types import DepthFrame, MetricDepthOutput

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
    camera = TargetCamera.checked(K, E, size)
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


@pytest.mark.parametrize("shift", [0, 3])
def test_a_sky_has_none_and_that_makes_no_result_less_trusted(make_oracle, shift):
    """A sky that shifts by nothing between the views, or by what can be measured, above two walls."""
    noise = np.random.default_rng(0).random((96, 152, 3), np.float32)
    scene = cv2.GaussianBlur(noise, (0, 0), 1.0)
    scene = (scene - scene.min()) / np.ptp(scene)
    inverse = np.repeat([shift, 8, 14], [40, 28, 28])[:, None] * np.ones((1, 128), np.float32)
    left = scene[:, 8:136]
    right = np.stack([row[8 + int(px) : 136 + int(px)] for row, px in zip(scene, inverse[:, 0], strict=True)])
    camera, E = np.array([[120.0, 0, 63.5], [0, 120.0, 47.5], [0, 0, 1]]), np.eye(4)
    E[0, 3] = 0.1
    pipe = enable_geometry_guidance(make_oracle((inverse - inverse.min()) / np.ptp(inverse), "disparity"))

    def run(**knobs):
        return pipe(left, guidance=GeometryGuidance(right, (camera, camera), E, inner_steps=0, **knobs))

    reach_m = 120 * 0.1 / 0.3
    out = run()
    at_reach = out.prediction[0, ..., 0] > 0.999 * reach_m
    assert np.isfinite(out.prediction).all() and not at_reach[44:].any()
    assert at_reach[:36].mean() > 0.9 if shift == 0 else not at_reach.any()
    np.testing.assert_array_equal(out.confidence[0, ..., 0] == 0, at_reach)
    (verdict,) = out.verdicts
    assert verdict.trusted, verdict.reasons
    higher = verdict.indicators.confidence - out.confidence.mean()
    assert higher > 0.1 if shift == 0 else higher == pytest.approx(0, abs=1e-6)
    given = run(depth_range=(0.5, 10 * reach_m))
    assert (given.confidence > 0).all(), "the user says that things are further away"
