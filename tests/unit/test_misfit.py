"""What matches that miss the cameras add to the expected error, and what they take from confidence."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.stats import norm

from geodiff_plugin._threads import BackgroundTask
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.matching.rows import RowChecks, RowMatches
from geodiff_plugin.result.indicators import indicators_of
from geodiff_plugin.result.misfit import NO_MISFIT, Misfit, expected_error, misfit_of, share_left
from geodiff_plugin.types import CameraView, Indicators, PosedViews, PoseReport

K = np.array([[100.0, 0, 63.5], [0, 100.0, 47.5], [0, 0, 1]])
SIZE = (96, 128)
RIG = {"rectified": True}


def camera_at(*centre: float) -> np.ndarray:
    E = np.eye(4)
    E[:3, 3] = centre
    return E


def view_at(*centre: float) -> CameraView:
    return CameraView(
        torch.zeros(3, *SIZE), torch.from_numpy(K), torch.from_numpy(camera_at(*centre)).inverse()
    )


@pytest.mark.parametrize(
    ("found", "size", "expected"),
    [
        ({}, SIZE, (0, 0, 0)),
        # Of right rigs: matches within 0.45 px of their lines, k1 up to .08.
        (RIG | {"epipolar_px": 0.44, "behind_px": 0.0, "distortion": -0.079}, SIZE, (0, 0, 0)),
        ({"straightened_px": 0.99}, SIZE, (0, 0, 0)),  # refined poses of right pairs are bent by up to 1 px
        (RIG | {"epipolar_px": 0.75}, SIZE, (0.6, 0, 0)),  # .75^2 = .45^2 + .6^2
        # Of other poses the whole residual is expected along the lines as well.
        ({"epipolar_px": 0.25}, SIZE, (0.25, 0, 0)),
        ({"epipolar_px": 0.25}, (900, 1664), (0.5, 0, 0)),
        ({"behind_px": 3.0, "behind_infinity": 0.041}, SIZE, (3.0, 0, 0)),
        ({"behind_px": 3.0, "behind_infinity": 0.039}, SIZE, (0, 0, 0)),  # single matches, as on blank walls
        (RIG | {"epipolar_px": 0.75, "behind_px": 0.8, "behind_infinity": 0.1}, SIZE, (1.0, 0, 0)),
        ({"straightened_px": 1.25}, SIZE, (0.75, 0, 0)),
        (RIG | {"straightened_px": 1.25, "epipolar_px": 0.75}, SIZE, (math.hypot(0.75, 0.6), 0, 0)),
        ({"distortion": 0.081}, SIZE, (0, 0.001, 0)),
        ({"distortion": -0.25}, SIZE, (0, 0.17, 0)),
        ({"shear": -0.03}, (480, 600), (18 / 3**0.5, 0, 0)),
        ({"shear": 0.0009}, (480, 600), (0, 0, 0)),
        # .85 of the spread of a scale count.
        ({"scale_spread": 0.04}, SIZE, (0, 0, 0.034)),
        ({"scale_spread": 0.1}, SIZE, (0, 0, 0.085)),
        ({"scale_spread": math.inf}, SIZE, (0, 0, math.inf)),  # no point is in front of the cameras
        # Three tenths of the change by another pose count, or what is beyond .15 if that is more.
        ({"depth_spread": 0.1}, SIZE, (0, 0, 0.03)),
        ({"depth_spread": 0.25}, SIZE, (0, 0, 0.2)),
        ({"scale_spread": 0.1, "depth_spread": 0.2}, SIZE, (0, 0, math.hypot(0.085, math.sqrt(0.0175)))),
        # Residuals are in pixels of a grid of 832 columns at most, what lies behind infinity in the image's.
        (RIG | {"epipolar_px": 0.75, "behind_px": 0.0}, (900, 1664), (1.2, 0, 0)),
        ({"behind_px": 3.0, "behind_infinity": 0.1}, (900, 1664), (3.0, 0, 0)),
    ],
)
def test_what_matches_of_right_pairs_do_not_show_and_an_inexact_pose_are_a_misfit(found, size, expected):
    assert misfit_of(Indicators(**found), size) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("centre", [(0.1, 0, 0), (0.05, -0.1, 0.03)])
def test_an_error_of_the_shift_adds_to_that_of_a_match(centre):
    depth_m = np.random.default_rng(0).uniform(1.0, 5.0, SIZE)
    poses = [camera_at(*centre)]
    found = expected_error(depth_m, K, poses, misfit=Misfit(px=0.6))
    np.testing.assert_allclose(found, expected_error(depth_m, K, poses) * math.hypot(0.25, 0.6) / 0.25)


def test_the_larger_of_two_errors_of_all_depths_together_counts():
    depth_m, poses = np.full(SIZE, 3.0), [camera_at(0.1, 0, 0)]
    alone = expected_error(depth_m, K, poses)
    for scale_spread, relative, larger in ((0.05, 0.2, 0.2), (0.2, 0.05, 0.2), (0.0, 0.1, 0.1)):
        found = expected_error(depth_m, K, poses, scale_spread, Misfit(relative=relative))
        np.testing.assert_allclose(found, np.hypot(alone, larger * 3.0))


@pytest.mark.parametrize("centre", [(0.1, 0, 0), (0.0, 0.1, 0), (0.07, 0.07, 0)])
def test_a_distortion_of_both_pictures_changes_depth_by_as_much_as_it_says(centre):
    """Small shifts under OpenCV's lens, against those without one."""
    k1, depth_m = 0.02, np.full(SIZE, 3.0)
    E = camera_at(*centre)
    v, u = np.indices(SIZE)
    pixels = np.stack([u.ravel(), v.ravel()], -1).astype(np.float64)
    rays = np.c_[(pixels - K[:2, 2]) / 100.0, np.ones(len(pixels))]

    def bent(points: np.ndarray) -> np.ndarray:
        return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([k1, 0, 0, 0]))[0][:, 0]

    shift = np.linalg.norm(bent(3.0 * rays) - bent(3.0 * rays - E[:3, 3] * 1e-3), axis=1)
    straight = 1e-3 * 100.0 * np.linalg.norm(centre) / 3.0
    along = np.linalg.norm((rays[:, :2] @ np.array(centre[:2]))[:, None], axis=1) / np.linalg.norm(centre)
    truth = 3.0 * np.abs(shift / straight - 1.0)  # depth goes with the inverse of the shift, to first order
    error = expected_error(depth_m, K, [E], misfit=Misfit(distortion=k1)).ravel()
    added = np.sqrt(error**2 - expected_error(depth_m, K, [E]).ravel() ** 2)
    along_line = along > 0.99 * np.linalg.norm(rays[:, :2], axis=1)  # across it both change the line as well
    np.testing.assert_allclose(added[along_line], truth[along_line], rtol=0.05, atol=2e-3)
    assert (added >= truth - 2e-3).all()


def test_confidence_keeps_the_share_of_a_normal_error_within_ten_percent():
    depth_m = torch.from_numpy(np.random.default_rng(1).uniform(1.0, 30.0, (1, 1, *SIZE))).float()
    misfit = Misfit(px=1.5)
    found = share_left(depth_m, torch.from_numpy(K), [view_at(0.3, 0, 0)], misfit)[0, 0].numpy()
    shift_px = 100.0 * 0.3 / depth_m[0, 0].numpy()
    within = [2.0 * norm.cdf(0.1 * shift_px / px) - 1.0 for px in (math.hypot(0.25, 1.5), 0.25)]
    np.testing.assert_allclose(found, within[0] / within[1], rtol=1e-4)
    assert found.max() > 0.9 and found.min() < 0.2, "what is near loses little, what is far nearly all"


def test_confidence_counts_an_error_that_all_depths_share():
    """Drawn errors of matches, of which some are within 10 %, and how many are once all share another."""
    rng = np.random.default_rng(2)
    depth_m, spread = torch.full((1, 1, *SIZE), 12.0), 0.06
    match = rng.normal(0.0, 0.25 / (100.0 * 0.3 / 12.0), 400_000)
    both = match + rng.normal(0.0, spread, match.size)
    found = share_left(depth_m, torch.from_numpy(K), [view_at(0.3, 0, 0)], Misfit(relative=spread))
    kept = (np.abs(both) < 0.1).mean() / (np.abs(match) < 0.1).mean()
    torch.testing.assert_close(found, torch.full_like(found, float(kept)), rtol=0.01, atol=0.0)


def test_without_a_misfit_confidence_stays():
    depth_m = torch.ones(1, 1, *SIZE)
    assert (share_left(depth_m, torch.from_numpy(K), [view_at(0.3, 0, 0)], NO_MISFIT) == 1.0).all()


def test_of_several_views_the_best_counts():
    depth_m = torch.full((1, 1, *SIZE), 5.0)
    near, far = view_at(0.05, 0, 0), view_at(0.5, 0, 0)
    both, alone = (
        share_left(depth_m, torch.from_numpy(K), views, Misfit(px=1.0)) for views in ([near, far], [far])
    )
    torch.testing.assert_close(both, alone)
    assert (share_left(depth_m, torch.from_numpy(K), [near], Misfit(px=1.0)) < alone).all()


def test_the_indicators_of_a_run_hold_the_worst_view_in_pixels_of_the_left_image():
    """Poses are checked on a grid of 832 columns at most: two pixels of this image are one of it."""
    left = torch.zeros(3, 20, 1664)
    views = tuple(
        CameraView(left, torch.from_numpy(K), torch.from_numpy(camera_at(-0.1, 0, 0))) for _ in "ab"
    )
    pose = PoseReport(
        "refined", (), (), straightened_px=(0.5, 1.5), behind_px=2.0, depth_spread=0.2, scale_spread=0.1
    )
    pose = replace(pose, exchangeable=0.3, moved=0.2, bars=0.1)
    native = PosedViews(left, views, torch.from_numpy(K))
    found = indicators_of(Evidence(native, native, None, None, report=BackgroundTask.known(pose)), {})
    assert (found.straightened_px, found.behind_px, found.depth_spread) == (1.5, 4.0, 0.2)
    assert (found.exchangeable, found.moved, found.bars) == (0.3, 0.2, 0.1)
    checks = BackgroundTask.known(RowChecks(shear=0.01, occlusion=-0.5))
    rows = BackgroundTask.known(RowMatches(left, left, left, left, torch.tensor(0.1), checks))
    found = indicators_of(Evidence(native, native, None, None, rows=rows), {})
    assert (found.occlusion, found.shear) == (-0.5, pytest.approx(0.01 * 20 / 1664))
