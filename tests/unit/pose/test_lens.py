"""Distortion that both images still have, of cameras that differ and are turned against each other."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from geodiff_plugin.pose import lens
from geodiff_plugin.pose.lens import Remaining, remaining_distortion, undistorted_rays
from geodiff_plugin.pose.tracks import blocks, epipolar
from tests.unit.pose.posed_scene import K_LEFT, K_RIGHTS, make_scene, moved, off_lines

VIEWS = pytest.mark.parametrize("v", [0, 1])


def distorted(px: np.ndarray, K: np.ndarray, k1: float) -> np.ndarray:
    """OpenCV's radial model."""
    rays = np.c_[(px - K[:2, 2]) / np.diag(K)[:2], np.ones(len(px))]
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array([k1, 0, 0, 0]))[0][:, 0]


def undistorted(px: np.ndarray, K: np.ndarray, k1: float) -> np.ndarray:
    return cv2.undistortPoints(px[:, None], K, np.array([k1, 0, 0, 0]), P=K)[:, 0]


def bent_scene(v: int, k1: float, count: int = 500, noise_px: float = 0.1):
    scene = make_scene(count, noise_px=noise_px)
    tracks = scene.tracks.alone(v)
    left_px = distorted(tracks.left_px, K_LEFT, k1)
    right_px = distorted(tracks.right_px[0], K_RIGHTS[v], k1)[None]
    return replace(tracks, left_px=left_px, right_px=right_px), scene.Ts[v]


@VIEWS
@pytest.mark.parametrize("k1", [-0.12, 0.1])
def test_distortion_is_measured_and_bounded_in_turned_cameras_that_differ(v, k1):
    tracks, T = bent_scene(v, k1)
    found = remaining_distortion(tracks, T)
    assert found.k1 == pytest.approx(k1, abs=0.02) and 0 < abs(found.alone) <= abs(found.k1) <= abs(k1)
    assert abs(k1) < found.at_most < abs(k1) + 0.02


@VIEWS
def test_residuals_without_a_distortion_are_those_of_undistorted_pixels(v):
    tracks, T = bent_scene(v, -0.08, count=80, noise_px=2.0)
    k1s = np.array([-0.08, 0.05, 0.0])
    found = lens._residuals(lens._pair(tracks, T), k1s)
    for k1, off in zip(k1s, found, strict=True):
        left_px, right_px = (
            undistorted(px, K, k1) for px, K in ((tracks.left_px, K_LEFT), (tracks.right_px[0], K_RIGHTS[v]))
        )
        flat = replace(tracks, left_px=left_px, right_px=right_px[None])
        np.testing.assert_allclose(np.abs(off), np.abs(epipolar(flat, T).off_px), atol=1e-6)
        np.testing.assert_allclose(
            np.abs(off), off_lines(left_px, right_px, K_LEFT, K_RIGHTS[v], T), atol=1e-6
        )
    assert np.median(np.abs(found[0])) < 0.7 * np.median(np.abs(found[1]))
    signs = np.sign(found[2] * epipolar(tracks, T).off_px)
    assert abs(signs.sum()) == 80  # one sign convention for all


def test_rays_of_several_distortions_are_undone_each_by_its_own():
    rays = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 30))
    k1s = np.array([0.2, -0.15, 0.0])
    radius2 = (rays**2).sum(0)
    for k1, found in zip(k1s, undistorted_rays(rays, k1s), strict=True):
        again = found * (1 + k1 * (found**2).sum(1, keepdims=True))
        np.testing.assert_allclose(again, rays.T, atol=2e-3)
        assert (np.sign((rays.T**2).sum(1) - (found**2).sum(1)) == np.sign(k1 * radius2)).all()


@VIEWS
def test_derivatives_by_turns_of_the_right_camera_are_differences(v):
    scene = make_scene(50, noise_px=0.5)
    tracks, T = scene.tracks.alone(v), scene.Ts[v]
    found = lens._by_rotation(tracks, T)
    assert found.shape == (50, 3)
    for axis in range(3):
        step = np.zeros(6)
        step[axis] = 1e-5
        ahead, behind = (epipolar(tracks, moved(T, way)).off_px for way in (step, -step))
        np.testing.assert_allclose(found[:, axis], (ahead - behind) / 2e-5, rtol=1e-3, atol=1e-2)


@VIEWS
def test_other_explanations_of_the_residuals_do_not_change_the_estimate(v):
    tracks, T = bent_scene(v, -0.1, count=700, noise_px=0.05)
    right_px, normals = tracks.right_px[0], epipolar(tracks, T).normals
    x = (right_px - K_RIGHTS[v][:2, 2]) / K_RIGHTS[v][0, 0]
    explained = np.stack([x[:, 0], x[:, 1], x[:, 0] * x[:, 1]], axis=1)
    off = explained @ [9.0, -6.0, 12.0] + 1.5
    moved_tracks = replace(tracks, right_px=(right_px + off[:, None] * normals)[None])
    alone, _ = lens._fit_k1(tracks, T, np.zeros((700, 0)))
    found, error = lens._fit_k1(moved_tracks, T, explained)
    assert alone == pytest.approx(-0.1, abs=0.005) and found == pytest.approx(-0.1, abs=0.01)
    assert 0.0 < error < 0.01
    with_none, _ = lens._fit_k1(moved_tracks, T, np.zeros((700, 0)))
    assert abs(with_none + 0.1) > 1.5 * abs(found + 0.1)


@VIEWS
def test_wrong_matches_of_one_side_do_not_look_like_a_distortion(v):
    """Beside a constant shift across the lines, from which they are told apart."""
    tracks, T = bent_scene(v, -0.1, count=600, noise_px=0.05)
    off = np.full(600, 4.0)
    off[(tracks.left_px[:, 0] > 470) & (np.arange(600) % 3 > 0)] += 3.0
    assert 60 < (off > 5).sum() < 180
    shifted = tracks.right_px + off[:, None] * epipolar(tracks, T).normals
    found, error = lens._fit_k1(replace(tracks, right_px=shifted), T, np.zeros((600, 0)))
    assert found == pytest.approx(-0.1, abs=0.01) and error < 0.01


@VIEWS
@pytest.mark.parametrize("shared", [False, True], ids=["own noise", "noise of blocks"])
def test_the_standard_error_is_the_scatter_of_estimates(v, shared):
    scene, rng = make_scene(400), np.random.default_rng(v)
    tracks, T = scene.tracks.alone(v), scene.Ts[v]
    normals, block = epipolar(tracks, T).normals, blocks(tracks)
    estimates, errors = [], []
    for _ in range(16):
        off = rng.normal(size=block.max() + 1)[block] if shared else rng.normal(size=400)
        noisy = replace(tracks, right_px=tracks.right_px + 0.3 * off[:, None] * normals)
        estimate, error = lens._fit_k1(noisy, T, np.zeros((400, 0)))
        estimates.append(estimate)
        errors.append(error)
    assert 0.65 < np.median(errors) / np.std(estimates) < 1.6
    assert abs(np.mean(estimates)) < np.std(estimates)


def test_the_error_by_blocks_is_that_of_sums_of_alike_matches():
    """Copies of each match add their pulls: four copies in a block double the error of independent ones."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(300, 2))
    inverse, pulls = np.linalg.inv(A.T @ A), A * rng.normal(size=(300, 1))
    apart = lens._error_by_blocks(inverse, pulls, np.arange(300))
    expected = np.sqrt(sum((inverse[0] @ pull) ** 2 for pull in pulls))
    assert apart == pytest.approx(expected)
    copies = lens._error_by_blocks(inverse / 4, np.repeat(pulls, 4, axis=0), np.repeat(np.arange(300), 4))
    assert copies == pytest.approx(apart)


@pytest.mark.parametrize(
    ("fits", "expected"),
    [
        # Estimates and errors alone, beside turns, and beside a shear; four errors of each are not certain.
        (((0.1, 0.01), (0.08, 0.005), (0.05, 0.005)), Remaining(0.06, 0.03, 0.12)),
        (((-0.1, 0.01), (-0.08, 0.005), (-0.09, 0.005)), Remaining(-0.06, -0.06, 0.12)),
        (((0.1, 0.01), (0.08, 0.005), (-0.09, 0.005)), Remaining(0.06, 0.0, 0.12)),
        (((0.1, 0.01), (0.01, 0.005), (0.09, 0.005)), Remaining(0.06, 0.0, 0.12)),
        (((-0.03, 0.01),), Remaining(0.0, 0.0, 0.05)),
    ],
)
def test_what_remains_is_certain_alone_and_beside_every_other_explanation(fits, expected, monkeypatch):
    answers, asked = iter(fits), []

    def fit(tracks, T, explained):
        asked.append((tracks, explained))
        return next(answers)

    monkeypatch.setattr(lens, "_fit_k1", fit)
    scene = make_scene(60)
    tracks, T = scene.tracks.alone(1), scene.Ts[1]
    normals = epipolar(tracks, T).normals
    off = np.where(np.arange(60) < 10, 12.1, 11.9)
    assert remaining_distortion(replace(tracks, right_px=tracks.right_px + off[:, None] * normals), T) == (
        pytest.approx(expected)
    )
    assert all(len(each) == 50 for each, _ in asked) and asked[0][1].shape == (50, 0)
    if len(asked) > 1:
        kept = asked[0][0]
        np.testing.assert_allclose(asked[1][1], lens._by_rotation(kept, T))
        np.testing.assert_allclose(430.0 * asked[2][1] + (361.1, 202.4), kept.right_px[0])


@pytest.mark.parametrize(("count", "known"), [(40, True), (39, False)])
def test_forty_matches_are_needed(count, known):
    scene = make_scene(count, noise_px=0.2)
    found = remaining_distortion(scene.tracks.alone(0), scene.Ts[0])
    assert [math.isnan(each) for each in found] == [not known] * 3
