"""The expected error and the misfit of matches under general cameras, by projecting points."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm

from geodiff_plugin import _strips as strips
from geodiff_plugin.result.misfit import NO_MISFIT, Misfit, expected_error, misfit_of, share_left
from geodiff_plugin.types import CameraView, Indicators

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
    with_both = expected_error(DEPTH, K, POSES, 0.02, Misfit(px=0.6, relative=0.05))
    by_shift = np.min([error_by_moving_points(E, math.hypot(0.25, 0.6)) for E in POSES], axis=0)
    np.testing.assert_allclose(with_both, np.hypot(by_shift, 0.05 * DEPTH), rtol=1e-5)
    with_both = expected_error(DEPTH, K, POSES, 0.08, Misfit(relative=0.05))
    np.testing.assert_allclose(with_both, np.hypot(best, 0.08 * DEPTH), rtol=1e-5)


@pytest.mark.parametrize("strip", [1 << 20, 5 * SIZE[1]])
def test_a_distortion_adds_the_share_of_depth_that_its_formula_states(monkeypatch, strip):
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
    found = expected_error(DEPTH, K, POSES, misfit=Misfit(distortion=0.03))
    np.testing.assert_allclose(found, np.min(expected, 0), rtol=1e-5)


def test_a_camera_on_the_ray_of_a_pixel_measures_nothing_there():
    E = pose((0.0, 0.0, 0.5))
    found = expected_error(DEPTH, K, [E])
    assert np.isinf(found[10, 11]) and np.isfinite(np.delete(found.ravel(), 10 * SIZE[1] + 11)).all()


def test_the_rest_of_a_confidence_is_a_ratio_of_normal_probabilities():
    """Views hold the pose of the left frame in the right one; the depth keeps its dtype."""
    misfit = Misfit(0.8, 0.05, 0.04)
    depth = torch.from_numpy(DEPTH)[None, None].float()
    views = [
        CameraView(torch.zeros(3, 4, 4), torch.eye(3), torch.from_numpy(np.linalg.inv(E))) for E in POSES
    ]
    found = share_left(depth, torch.from_numpy(K), views, misfit)
    assert found.dtype == torch.float32 and found.shape == depth.shape
    within = [
        norm.cdf(0.1 * DEPTH / expected_error(DEPTH, K, POSES, misfit=each)) - 0.5
        for each in (misfit, NO_MISFIT)
    ]
    np.testing.assert_allclose(found[0, 0], within[0] / within[1], rtol=1e-4)
    assert found.min() < 0.9 and found.max() <= 1.0


#: Indicators on both sides of what right pairs have, and the misfit: pixels, distortion, share of depth.
USUAL = [
    ({"rectified": True, "epipolar_px": 0.45}, (0, 0, 0)),
    ({"rectified": True, "epipolar_px": 0.53}, (math.sqrt(0.53**2 - 0.45**2), 0, 0)),
    ({"epipolar_px": 0.3}, (0.3, 0, 0)),
    ({"straightened_px": 1.0}, (0, 0, 0)),
    ({"straightened_px": 1.3}, (math.sqrt(0.69), 0, 0)),
    ({"epipolar_px": 0.3, "straightened_px": 1.3}, (math.sqrt(0.78), 0, 0)),
    ({"behind_px": 2.5, "behind_infinity": 0.04}, (0, 0, 0)),
    ({"behind_px": 2.5, "behind_infinity": 0.0401}, (1.5, 0, 0)),
    ({"behind_px": 2.5, "behind_infinity": math.nan}, (0, 0, 0)),
    ({"distortion": 0.08}, (0, 0, 0)),
    ({"distortion": -0.08}, (0, 0, 0)),
    ({"distortion": -0.12}, (0, 0.04, 0)),
    ({"distortion": 0.12}, (0, 0.04, 0)),
    ({"shear": 0.001}, (0, 0, 0)),
    ({"shear": -0.001}, (0, 0, 0)),
    ({"shear": -0.002}, (0.002 * 1248 / math.sqrt(3) / 1.5, 0, 0)),
    ({"shear": 0.002}, (0.002 * 1248 / math.sqrt(3) / 1.5, 0, 0)),
    ({"scale_spread": 0.2}, (0, 0, 0.17)),
    ({"depth_spread": 0.15}, (0, 0, 0.045)),
    ({"depth_spread": 0.2}, (0, 0, math.sqrt(0.04 - 0.0225))),
    ({"depth_spread": 0.155}, (0, 0, 0.0465)),
    ({"scale_spread": 0.2, "depth_spread": 0.1}, (0, 0, math.hypot(0.17, 0.03))),
]


@pytest.mark.parametrize(("found", "expected"), USUAL)
@pytest.mark.parametrize("size", [(700, 1248), (1248, 700)])
def test_what_right_pairs_show_is_no_misfit_and_what_is_beyond_is(found, expected, size):
    """Of a picture one and a half times as long as the grid of the poses; a shear goes with its width."""
    px, distortion, relative = expected
    width = size[1] / 1248 if "shear" in found else 1.0
    behind = 2.5 if "behind_px" in found and px else 0.0  # in pixels of the picture already
    in_picture = behind or 1.5 * px * width
    np.testing.assert_allclose(
        misfit_of(Indicators(**found), size), (in_picture, distortion, relative), atol=1e-9
    )


def test_the_parts_of_a_shift_are_independent():
    parts = {"epipolar_px": 0.4}, {"behind_px": 1.2, "behind_infinity": 0.5}, {"shear": 0.004}
    alone = [misfit_of(Indicators(**part), (300, 416)).px for part in parts]
    together = misfit_of(Indicators(**{k: v for part in parts for k, v in part.items()}), (300, 416)).px
    assert all(part > 0.3 for part in alone) and together == pytest.approx(math.hypot(*alone))
    assert misfit_of(Indicators(), (300, 416)) == NO_MISFIT == Misfit(0.0, 0.0, 0.0)
