"""The expected error of depth under general cameras, by projecting points, and what confidence it leaves."""

import math

import cv2
import numpy as np
import pytest
import torch
from scipy.stats import norm

from geodiff_plugin._internal import strips
from geodiff_plugin.cameras import Camera, View
from geodiff_plugin.result.expected_error import expected_error, remaining_confidence
from geodiff_plugin.trust import NO_ERROR, MatchError
from tests.views import view_of

SIZE = (18, 26)
K = np.array([[70.0, 0, 11.0], [0, 50.0, 10.0], [0, 0, 1]])
DEPTH = np.random.default_rng(0).uniform(2.0, 6.0, SIZE)


def pose(centre, turn=0.0) -> np.ndarray:
    c, s = math.cos(turn), math.sin(turn)
    E = np.eye(4)
    E[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    E[:3, 3] = centre
    return E


def error_by_moving_points(E: np.ndarray, noise_px: float) -> np.ndarray:
    """The noise over how fast a point's pixel moves with its depth, in a parallel camera at the right one."""
    v, u = np.indices(SIZE)
    rays = np.stack([u, v, np.ones(SIZE)], -1) @ np.linalg.inv(K).T
    step = 1e-6

    def seen(z):
        p = (rays * z[..., None] - E[:3, 3]) @ K.T
        return p[..., :2] / p[..., 2:]

    return noise_px / (np.linalg.norm(seen(DEPTH + step) - seen(DEPTH - step), axis=-1) / (2 * step))


POSES = [pose((0.1, 0.05, 0.8), 0.2), pose((-0.08, -0.1, 0.8), -0.5), pose((0.0, 0.12, 0.8))]


@pytest.mark.parametrize("strip", [1 << 20, 5 * SIZE[1]])
def test_the_best_of_several_turned_cameras_decides_pixel_by_pixel(monkeypatch, strip):
    monkeypatch.setattr(strips, "STRIP_PIXELS", strip)
    alone = [error_by_moving_points(E, 0.25) for E in POSES]
    for E, expected in zip(POSES, alone, strict=True):
        np.testing.assert_allclose(expected_error(DEPTH, K, [E]), expected, rtol=1e-5)
    best = np.min(alone, axis=0)
    assert all((each == best).any() for each in alone)
    np.testing.assert_allclose(expected_error(DEPTH, K, POSES), best, rtol=1e-5)
    with_both = expected_error(DEPTH, K, POSES, 0.02, MatchError(px=0.6, relative=0.05))
    by_shift = np.min([error_by_moving_points(E, math.hypot(0.25, 0.6)) for E in POSES], axis=0)
    np.testing.assert_allclose(with_both, np.hypot(by_shift, 0.05 * DEPTH), rtol=1e-5)
    with_both = expected_error(DEPTH, K, POSES, 0.08, MatchError(relative=0.05))
    np.testing.assert_allclose(with_both, np.hypot(best, 0.08 * DEPTH), rtol=1e-5)


@pytest.mark.parametrize("strip", [1 << 20, 5 * SIZE[1]])
def test_a_distortion_adds_the_fraction_of_depth_that_its_formula_states(monkeypatch, strip):
    """``k1 (|r|^2 + 2 r_b^2)``, with ``r_b`` along the line from the epipole to the ray."""
    monkeypatch.setattr(strips, "STRIP_PIXELS", strip)
    v, u = np.indices(SIZE)
    rays = np.stack([u, v, np.ones(SIZE)], -1) @ np.linalg.inv(K).T
    expected = []
    for E in POSES:
        line = E[:2, 3] - rays[..., :2] * E[2, 3]
        along = (rays[..., :2] * line).sum(-1) ** 2 / (line**2).sum(-1)
        added = 0.03 * ((rays[..., :2] ** 2).sum(-1) + 2 * along) * DEPTH
        expected.append(np.hypot(error_by_moving_points(E, 0.25), added))
    found = expected_error(DEPTH, K, POSES, extra=MatchError(distortion=0.03))
    np.testing.assert_allclose(found, np.min(expected, 0), rtol=1e-5)


def test_a_camera_on_the_ray_of_a_pixel_measures_nothing_there():
    E = pose((0.0, 0.0, 0.5))
    found = expected_error(DEPTH, K, [E])
    assert np.isinf(found[10, 11]) and np.isfinite(np.delete(found.ravel(), 10 * SIZE[1] + 11)).all()


def test_the_rest_of_a_confidence_is_a_ratio_of_normal_probabilities():
    """Views hold the pose of the left frame in the right one; the depth keeps its dtype."""
    error = MatchError(0.8, 0.05, 0.04)
    depth = torch.from_numpy(DEPTH)[None, None].float()
    views = [view_of(torch.zeros(3, 4, 4), np.eye(3), np.linalg.inv(E)) for E in POSES]
    found = remaining_confidence(depth, Camera(K), views, error)
    assert found.dtype == torch.float32 and found.shape == depth.shape
    within = [
        norm.cdf(0.1 * DEPTH / expected_error(DEPTH, K, POSES, extra=each)) - 0.5
        for each in (error, NO_ERROR)
    ]
    np.testing.assert_allclose(found[0, 0], within[0] / within[1], rtol=1e-4)
    assert found.min() < 0.9 and found.max() <= 1.0


@pytest.mark.parametrize("centre", [(0.1, 0, 0), (0.0, 0.1, 0), (0.07, 0.07, 0)])
def test_a_distortion_of_both_images_changes_depth_by_as_much_as_expected(centre):
    """Small shifts under OpenCV's lens, against those without one."""
    k1, size = 0.02, (96, 128)
    K_square = np.array([[100.0, 0, 63.5], [0, 100.0, 47.5], [0, 0, 1]])
    depth_m, E = np.full(size, 3.0), pose(centre)
    v, u = np.indices(size)
    pixels = np.stack([u.ravel(), v.ravel()], -1).astype(np.float64)
    rays = np.c_[(pixels - K_square[:2, 2]) / 100.0, np.ones(len(pixels))]

    def bent(points: np.ndarray) -> np.ndarray:
        lens = np.array([k1, 0, 0, 0])
        return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K_square, lens)[0][:, 0]

    shift = np.linalg.norm(bent(3.0 * rays) - bent(3.0 * rays - E[:3, 3] * 1e-3), axis=1)
    straight = 1e-3 * 100.0 * np.linalg.norm(centre) / 3.0
    along = np.linalg.norm((rays[:, :2] @ np.array(centre[:2]))[:, None], axis=1) / np.linalg.norm(centre)
    ground_truth = 3.0 * np.abs(
        shift / straight - 1.0
    )  # depth goes with the inverse of the shift, to first order
    error, without = (
        expected_error(depth_m, K_square, [E], extra=extra).ravel()
        for extra in (MatchError(distortion=k1), NO_ERROR)
    )
    added = np.sqrt(error**2 - without**2)
    on_line = along > 0.99 * np.linalg.norm(rays[:, :2], axis=1)  # across it both change the line as well
    np.testing.assert_allclose(added[on_line], ground_truth[on_line], rtol=0.05, atol=2e-3)
    assert (added >= ground_truth - 2e-3).all()


FAR = torch.from_numpy(np.random.default_rng(1).uniform(1.0, 30.0, (1, 1, *SIZE))).float()
LEFT = Camera(np.array([[100.0, 0, 11.0], [0, 100.0, 10.0], [0, 0, 1]]))


def view_at(x: float) -> View:
    return view_of(torch.zeros(3, 4, 4), np.eye(3), np.linalg.inv(pose((x, 0, 0))))


def test_what_is_near_keeps_its_confidence_and_what_is_far_loses_it():
    found = remaining_confidence(FAR, LEFT, [view_at(0.3)], MatchError(px=1.5))
    assert found.max() > 0.9 and found.min() < 0.2
    nearer = FAR.flatten().argsort()
    assert (found.flatten()[nearer].diff() <= 1e-6).all()


def test_confidence_counts_an_error_that_all_depths_share():
    """Drawn errors of matches, of which some are within 10 %, and how many are once all share another."""
    rng = np.random.default_rng(2)
    depth_m, relative = torch.full((1, 1, *SIZE), 12.0), 0.06
    match = rng.normal(0.0, 0.25 / (100.0 * 0.3 / 12.0), 400_000)
    both = match + rng.normal(0.0, relative, match.size)
    found = remaining_confidence(depth_m, LEFT, [view_at(0.3)], MatchError(relative=relative))
    kept = (np.abs(both) < 0.1).mean() / (np.abs(match) < 0.1).mean()
    torch.testing.assert_close(found, torch.full_like(found, float(kept)), rtol=0.01, atol=0.0)


def test_of_several_views_the_best_counts_and_without_an_error_confidence_stays():
    near, far = view_at(0.05), view_at(0.5)
    error = MatchError(px=1.0)
    both, best, worst = (
        remaining_confidence(FAR, LEFT, views, error) for views in ([near, far], [far], [near])
    )
    torch.testing.assert_close(both, best)
    assert (worst < best).all()
    assert (remaining_confidence(FAR, LEFT, [near], NO_ERROR) == 1.0).all()
