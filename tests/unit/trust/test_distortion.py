"""Distortion that both images still have, of cameras that differ and are turned against each other."""

from dataclasses import astuple, replace

import cv2
import numpy as np
import pytest

from geodiff_plugin.pose.tracks import blocks, epipolar
from geodiff_plugin.trust import MatchError, distortion
from geodiff_plugin.trust.distortion import (
    Distortion,
    ResidualDistortion,
    residual_distortion,
    undistorted_rays,
)
from tests.unit.pose.posed_scene import K_LEFT, K_RIGHTS, POSES, make_scene, moved, off_lines, pose
from tests.unit.trust.made_stages import tracks_stage
from tests.unit.trust.sheets import codes, good, judged, sheet

VIEWS = pytest.mark.parametrize("v", [0, 1])
PARALLEL = pose((0, 0, 0), (0.3, 0, 0))[None]
NEARLY_PARALLEL = pose((1.0, -6.0, 2.0), (0.3, 0.05, -0.08))[None]


def distorted(px: np.ndarray, K: np.ndarray, k1: float) -> np.ndarray:
    """OpenCV's radial model."""
    rays = np.c_[(px - K[:2, 2]) / np.diag(K)[:2], np.ones(len(px))]
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array([k1, 0, 0, 0]))[0][:, 0]


def undistorted(px: np.ndarray, K: np.ndarray, k1: float) -> np.ndarray:
    return cv2.undistortPoints(px[:, None], K, np.array([k1, 0, 0, 0]), P=K)[:, 0]


def bent_scene(v: int, k1: float, count: int = 500, noise_px: float = 0.1, **changes):
    scene = make_scene(count, noise_px=noise_px, **changes)
    tracks = scene.tracks.alone(v)
    left_px = distorted(tracks.left_px, K_LEFT, k1)
    right_px = distorted(tracks.right_px[0], K_RIGHTS[v], k1)[None]
    return replace(tracks, left_px=left_px, right_px=right_px), scene.Ts[v]


@VIEWS
@pytest.mark.parametrize("k1", [-0.12, 0.1])
def test_distortion_is_measured_and_bounded_in_turned_cameras_that_differ(v, k1):
    tracks, T = bent_scene(v, k1)
    found = residual_distortion(tracks, T)
    assert found.k1 == pytest.approx(k1, abs=0.02) and 0 < abs(found.unexplained_k1) <= abs(found.k1) <= abs(
        k1
    )
    assert abs(k1) < found.k1_bound < abs(k1) + 0.02


@pytest.mark.parametrize("k1", [-0.25, -0.1, 0.0, 0.2])
@pytest.mark.parametrize("poses", [PARALLEL, POSES], ids=["parallel", "posed"])
def test_distortion_is_measured_among_wrong_matches(poses, k1):
    tracks, T = bent_scene(0, k1, count=1500, noise_px=0.15, outliers=0.05, poses=poses)
    found = residual_distortion(tracks, T)
    assert found.k1 == pytest.approx(k1, abs=0.03) and abs(found.k1) <= abs(k1) + 0.005
    assert found.unexplained_k1 == pytest.approx(k1, abs=0.06) and abs(found.unexplained_k1) <= abs(found.k1)
    assert abs(k1) < found.k1_bound < abs(k1) + 0.03
    few = residual_distortion(tracks.kept(slice(100)), T)
    assert few.k1_bound > found.k1_bound, "fewer matches exclude less"


@pytest.mark.parametrize("poses", [PARALLEL, NEARLY_PARALLEL], ids=["parallel", "nearly parallel"])
def test_neither_a_rotation_nor_a_shear_is_a_distortion_alone(poses):
    """Between parallel cameras a yaw bends residuals over the image much as a distortion does."""
    scene = make_scene(1500, noise_px=0.15, outliers=0.05, poses=poses)
    tracks, T = scene.tracks.alone(0), scene.Ts[0]
    yaw = pose((0.0, 2.0, 0.0), (0, 0, 0))
    rows = tracks.right_px[..., 1] - K_RIGHTS[0][1, 2]
    sheared = tracks.right_px + np.stack([np.zeros_like(rows), 0.02 * rows], axis=-1)
    by_yaw = residual_distortion(tracks, yaw @ T)
    by_shear = residual_distortion(replace(tracks, right_px=sheared), T)
    assert abs(by_yaw.k1) > 0.05
    assert abs(by_yaw.unexplained_k1) < 0.03 and abs(by_shear.unexplained_k1) < 0.03


def test_errors_that_neighbours_share_are_no_distortion():
    """Tenths of the image that lie .6 px off their lines, as matches of single surfaces do."""
    scene = make_scene(800, noise_px=0.05, poses=PARALLEL)
    tracks, T = scene.tracks, scene.Ts[0]
    normals, block = epipolar(tracks, T).normals, blocks(tracks)
    for seed in range(12):
        off_px = np.random.default_rng(seed).normal(0.0, 0.6, block.max() + 1)[block]
        shifted = replace(tracks, right_px=tracks.right_px + off_px[:, None] * normals)
        assert abs(residual_distortion(shifted, T).k1) < 0.002


@VIEWS
def test_residuals_without_a_distortion_are_those_of_undistorted_pixels(v):
    tracks, T = bent_scene(v, -0.08, count=80, noise_px=2.0)
    k1s = np.array([-0.08, 0.05, 0.0])
    found = distortion._residuals(distortion._pair(tracks, T), k1s)
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


def test_rays_are_undistorted_as_by_opencv():
    """Also rays so far out that the model folds there, which OpenCV leaves as they are."""
    bent = np.random.default_rng(0).normal(0.0, 0.9, (2, 500))
    k1s = np.array([-0.6, -0.2, 0.0, 0.3])
    theirs = [cv2.undistortPoints(bent.T[:, None], np.eye(3), np.array([k1, 0, 0, 0])) for k1 in k1s]
    np.testing.assert_allclose(undistorted_rays(bent, k1s), np.stack(theirs)[:, :, 0], rtol=1e-9)
    assert (undistorted_rays(bent, k1s)[0] == bent.T).all(1).any()


@VIEWS
def test_derivatives_by_turns_of_the_right_camera_are_differences(v):
    scene = make_scene(50, noise_px=0.5)
    tracks, T = scene.tracks.alone(v), scene.Ts[v]
    found = distortion._by_rotation(tracks, T)
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
    alone, _ = distortion._fit_k1(tracks, T, np.zeros((700, 0)))
    found, error = distortion._fit_k1(moved_tracks, T, explained)
    assert alone == pytest.approx(-0.1, abs=0.005) and found == pytest.approx(-0.1, abs=0.01)
    assert 0.0 < error < 0.01
    with_none, _ = distortion._fit_k1(moved_tracks, T, np.zeros((700, 0)))
    assert abs(with_none + 0.1) > 1.5 * abs(found + 0.1)


@VIEWS
def test_wrong_matches_of_one_side_do_not_look_like_a_distortion(v):
    """Next to a constant shift across the lines, from which they differ."""
    tracks, T = bent_scene(v, -0.1, count=600, noise_px=0.05)
    off = np.full(600, 4.0)
    off[(tracks.left_px[:, 0] > 470) & (np.arange(600) % 3 > 0)] += 3.0
    assert 60 < (off > 5).sum() < 180
    shifted = tracks.right_px + off[:, None] * epipolar(tracks, T).normals
    found, error = distortion._fit_k1(replace(tracks, right_px=shifted), T, np.zeros((600, 0)))
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
        estimate, error = distortion._fit_k1(noisy, T, np.zeros((400, 0)))
        estimates.append(estimate)
        errors.append(error)
    assert 0.65 < np.median(errors) / np.std(estimates) < 1.6
    assert abs(np.mean(estimates)) < np.std(estimates)


def test_the_error_by_blocks_is_that_of_sums_of_alike_matches():
    """Copies of each match add their pulls: four copies in a block double the error of independent ones."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(300, 2))
    inverse, pulls = np.linalg.inv(A.T @ A), A * rng.normal(size=(300, 1))
    apart = distortion._error_by_blocks(inverse, pulls, np.arange(300))
    expected = np.sqrt(sum((inverse[0] @ pull) ** 2 for pull in pulls))
    assert apart == pytest.approx(expected)
    copies = distortion._error_by_blocks(
        inverse / 4, np.repeat(pulls, 4, axis=0), np.repeat(np.arange(300), 4)
    )
    assert copies == pytest.approx(apart)


@pytest.mark.parametrize(
    ("fits", "expected"),
    [
        # Estimates and errors alone, next to rotations, and next to a shear, less four of these errors.
        (((0.1, 0.01), (0.08, 0.005), (0.05, 0.005)), ResidualDistortion(0.06, 0.03, 0.12)),
        (((-0.1, 0.01), (-0.08, 0.005), (-0.09, 0.005)), ResidualDistortion(-0.06, -0.06, 0.12)),
        (((0.1, 0.01), (0.08, 0.005), (-0.09, 0.005)), ResidualDistortion(0.06, 0.0, 0.12)),
        (((0.1, 0.01), (0.01, 0.005), (0.09, 0.005)), ResidualDistortion(0.06, 0.0, 0.12)),
        (((-0.03, 0.01),), ResidualDistortion(0.0, 0.0, 0.05)),
    ],
)
def test_what_remains_is_certain_alone_and_next_to_every_other_explanation(fits, expected, monkeypatch):
    answers, asked = iter(fits), []

    def fit(tracks, T, explained):
        asked.append((tracks, explained))
        return next(answers)

    monkeypatch.setattr(distortion, "_fit_k1", fit)
    scene = make_scene(60)
    tracks, T = scene.tracks.alone(1), scene.Ts[1]
    normals = epipolar(tracks, T).normals
    off = np.where(np.arange(60) < 10, 12.1, 11.9)
    shifted = replace(tracks, right_px=tracks.right_px + off[:, None] * normals)
    assert astuple(residual_distortion(shifted, T)) == pytest.approx(astuple(expected))
    assert all(len(each) == 50 for each, _ in asked) and asked[0][1].shape == (50, 0)
    if len(asked) > 1:
        kept = asked[0][0]
        np.testing.assert_allclose(asked[1][1], distortion._by_rotation(kept, T))
        np.testing.assert_allclose(430.0 * asked[2][1] + (361.1, 202.4), kept.right_px[0])


@pytest.mark.parametrize(("count", "known"), [(40, True), (39, False)])
def test_forty_matches_are_needed(count, known):
    scene = make_scene(count, noise_px=0.2)
    found = residual_distortion(scene.tracks.alone(0), scene.Ts[0])
    assert (found is not None) is known


def test_the_first_view_under_the_pose_as_given_is_measured():
    tracks, T = bent_scene(0, -0.2)
    both = replace(
        tracks,
        right_px=np.concatenate([tracks.right_px, tracks.right_px + 3.0]),
        seen=np.ones((2, 500), bool),
        K_rights=np.concatenate([tracks.K_rights, tracks.K_rights]),
    )
    given = np.stack([T, np.eye(4)])
    assert Distortion.of_tracks(tracks_stage(both, given, given[::-1])) == residual_distortion(tracks, T)


def test_an_unknown_distortion_is_not_ruled_out():
    assert Distortion.rules_out(ResidualDistortion(0.2, 0.2, 0.05)) and not Distortion.rules_out(None)


@pytest.mark.parametrize(
    ("found", "code"),
    [
        (ResidualDistortion(-0.111, -0.111, 0.2), "views.distorted"),
        (ResidualDistortion(0.3, 0.111, 0.4), "views.distorted"),
        (ResidualDistortion(-0.3, -0.109, 0.4), "views.residual-trend"),
        (ResidualDistortion(0.3, 0.0, 0.4), "views.residual-trend"),
        (ResidualDistortion(-0.109, 0.0, 0.4), None),
        (ResidualDistortion(0.109, 0.109, 0.4), None),
    ],
)
def test_residuals_that_a_rotation_or_a_shear_explains_are_a_trend(found, code):
    assert codes(good(found)) == ([] if code is None else [code])


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (
            ResidualDistortion(-0.3456, -0.3, 0.4),
            "k1 = -0.35 in both images makes depth wrong away from the centre. Rectify",
        ),
        (
            ResidualDistortion(0.3456, 0.3, 0.4),
            "k1 = +0.35 in both images makes depth wrong away from the centre. "
            "The images may be undistorted twice",
        ),
        (ResidualDistortion(0.3456, 0.0, 0.4), "(as for k1 = +0.35)"),
    ],
)
def test_the_finding_states_the_coefficient_and_what_happened(found, words):
    assert words in judged(good(found), "views.distorted" if found.unexplained_k1 else "views.residual-trend")


@pytest.mark.parametrize(("k1", "expected"), [(0.08, 0.0), (-0.08, 0.0), (0.081, 0.001), (-0.25, 0.17)])
def test_distortion_beyond_that_of_correct_pairs_is_an_error_of_matches(k1, expected):
    error = Distortion.match_error(sheet(ResidualDistortion(k1, 0.0, 0.4)))
    assert error == pytest.approx(MatchError(distortion=expected), abs=1e-12)
