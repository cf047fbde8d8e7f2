"""The check of given poses: every field of its report, its decisions, and how images are straightened."""

import math
import re
import threading
from dataclasses import replace
from types import ModuleType

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.cameras import Camera, PosedViews, View, is_rectified
from geodiff_plugin.evidence import plan, prepare
from geodiff_plugin.evidence.pose_check import CheckedPoses, check_poses, image_facts
from geodiff_plugin.findings import Finding
from geodiff_plugin.matching.planes import Parallax
from geodiff_plugin.pose import fit as fit_module
from geodiff_plugin.pose import refine
from geodiff_plugin.pose import tracks as tracks_module
from geodiff_plugin.pose.refine import (
    CheckedViews,
    Displacement,
    depth_difference,
    fit_displacement,
    nearby_of,
    refine_by_flow,
    refine_views,
    refined_scale,
    report_as_given,
    warp_image,
)
from geodiff_plugin.pose.solve import PosePrior, regularized_poses, solve_poses
from geodiff_plugin.pose.tracks import (
    Tracks,
    _dense_matches,
    epipolar,
    grey_image,
    median_residuals,
    merge_tracks,
    residuals_px,
    solve_inverse_depth,
    sparse_tracks,
)
from geodiff_plugin.trust import Call, Epipolar, FactSheet, PoseErrors, PoseUncertainty
from geodiff_plugin.trust.distortion import Distortion, residual_distortion
from geodiff_plugin.trust.moving_objects import MovingObjects
from geodiff_plugin.trust.negative_disparity import NegativeDisparity
from geodiff_plugin.trust.order_ambiguity import OrderAmbiguity
from geodiff_plugin.trust.pose_errors import FoundErrors, PoseError
from geodiff_plugin.types import RejectedPose
from tests.scenes import render_pair
from tests.tiny import checked_views
from tests.unit.pose.posed_scene import (
    K_LEFT,
    K_RIGHTS,
    POSES,
    SIZES,
    make_scene,
    moved,
    pose,
    posed_fit,
    projected,
)
from tests.unit.pose.tracked_pair import SIZE, TRUE, K, angle_deg, camera_pose, make_tracks
from tests.views import grey_of, posed_of

END_TO_END = pytest.mark.end_to_end

TS = np.linalg.inv(POSES)
WRONG = np.stack(
    [moved(TS[0], np.radians([0.5, -0.4, 0.3, 0, 0, 0])), moved(TS[1], np.radians([-0.6, 0.3, 0.5, 0, 0, 0]))]
)
RIG = np.linalg.inv(np.stack([pose((0, 0, 0), (0.3, 0, 0)), pose((0, 0, 0), (-0.2, 0, 0))]))
K_RIG = (K_LEFT, np.stack([K_LEFT, K_LEFT]))


def inputs(tracks, given, images=None, is_rig=False):
    """The views of a scene with these poses, and how their matches fit."""
    posed, fit = posed_fit(tracks, given, images)
    assert fit.rig is is_rig
    return posed, fit


def with_dense(monkeypatch, dense) -> list:
    """Optical flow that finds these tracks; returns the arguments it is asked with."""
    asked = []

    def coarse(posed, size):
        asked.append((posed, size))
        return "depth"

    def flow(views, depth_m, Ts):
        asked.append((views, depth_m, Ts))
        return dense

    monkeypatch.setattr(refine, "coarse_depth", coarse)
    monkeypatch.setattr(refine, "dense_tracks", flow)
    return asked


def poses_in_use(views) -> np.ndarray:
    return np.linalg.inv(np.stack([view.T_right_from_left for view in views]))


def refined(posed, fit, measured=False, mistaken=False):
    """``refine_views`` from the poses near the given ones."""
    return refine_views(posed, fit, nearby_of(fit), measured, mistaken)


@pytest.mark.parametrize("measured", [False, True])
def test_every_field_of_the_report_of_poses_that_fit_is_the_one_that_was_measured(measured):
    scene = make_scene(120, noise_px=0.15, unseen=0.3)
    posed, fit = inputs(scene.tracks, TS)
    assert nearby_of(fit) is fit.greys.given, "the poses that fit best are the given ones"
    views, report, tracks, warps = refined(posed, fit, measured)
    assert views is posed.rights and report.status == "fits" and tracks is None and warps == ()
    np.testing.assert_allclose(report.E_given, POSES, atol=1e-6)
    np.testing.assert_allclose(report.E, POSES, atol=1e-6)
    assert report.residual_px == report.residual_px_given == pytest.approx(tuple(fit.residual_px))
    counts = scene.tracks.seen.sum(1)
    assert report.matches == tuple(counts) and counts[0] != counts[1]
    assert report.warp_rms_px == () and report.depth_spread == 0.0
    assert report.scale_rel_std == (None if measured else 0.05)
    assert report.features is None and report.rejected is None and report.rig is False


def test_poses_near_given_ones_that_do_not_fit_are_those_of_the_matches(monkeypatch):
    scene = make_scene(100, noise_px=0.15)
    _, fit = inputs(scene.tracks, WRONG)
    asked = []
    monkeypatch.setattr(refine, "nearby_poses", lambda *given: asked.append(given) or TS)
    assert nearby_of(fit) is TS
    ((tracks, given, before),) = asked
    assert tracks is fit.tracks and given is fit.greys.given and before is fit.residual_px


def test_a_report_of_poses_as_given_has_nothing_measured():
    rights = tuple(View(torch.zeros(3, 4, 5), Camera(np.eye(3)), T) for T in TS)
    report = report_as_given(rights)
    assert report.status == "given" and report.residual_px == () and report.features is None
    np.testing.assert_allclose(report.E, POSES)
    np.testing.assert_allclose(report.E_given, POSES)
    assert report_as_given(rights, "fits").status == "fits"


@pytest.mark.parametrize("measured", [False, True])
def test_poses_that_do_not_fit_are_refined_with_all_matches_of_all_views(measured, monkeypatch):
    sparse = make_scene(100, noise_px=0.15, outliers=0.05, unseen=0.2)
    dense = make_scene(150, noise_px=0.15, outliers=0.05, seed=5).tracks
    asked = with_dense(monkeypatch, dense)
    posed, fit = inputs(sparse.tracks, WRONG)
    assert (fit.residual_px > 1.0).all()
    views, report, used_tracks, warps = refined(posed, fit, measured)
    tracks = merge_tracks([sparse.tracks, dense])
    np.testing.assert_array_equal(used_tracks.right_px, tracks.right_px)
    before = median_residuals(tracks, WRONG)
    assert report.status == "refined"
    assert report.residual_px_given == pytest.approx(tuple(before), rel=1e-4)
    assert report.matches == tuple(sparse.tracks.seen.sum(1) + 150)
    np.testing.assert_allclose(report.E_given, np.linalg.inv(WRONG), atol=1e-5)
    np.testing.assert_allclose(report.E, poses_in_use(views), atol=1e-5)
    used = np.linalg.inv(np.stack(report.E))
    assert report.residual_px == pytest.approx(tuple(median_residuals(tracks, used)), rel=1e-6)
    assert max(report.residual_px) < 0.25
    for v in range(2):
        turn = np.linalg.norm(refine.pose_change(TS[v : v + 1], used[v : v + 1])[0])
        assert turn < 0.12, "degrees"
        assert views[v].image_01 is posed.rights[v].image_01 and views[v].camera is posed.rights[v].camera
    assert report.warp_rms_px == (0.0, 0.0) and warps == (None, None)
    lengths = np.linalg.norm(used[:, :3, 3], axis=1) / np.linalg.norm(WRONG[:, :3, 3], axis=1)
    if measured:
        assert report.scale_rel_std is None
        np.testing.assert_allclose(lengths, 1.0, atol=0.02)
    else:
        assert 0.04 < report.scale_rel_std < 0.2
        assert lengths[0] == pytest.approx(lengths[1], rel=0.02)
    assert 0.0 <= report.depth_spread < 0.1
    assert report.features is None and report.rejected is None
    (first_posed, size), (_, depth, near) = asked
    assert depth == "depth" and size == SIZES[0]
    np.testing.assert_allclose(poses_in_use(first_posed.rights), np.linalg.inv(near), atol=1e-5)
    assert not np.allclose(near, WRONG, atol=1e-3)


def misfit_of(scene, given=WRONG, **how):
    posed, fit = inputs(scene.tracks, given)
    how = {"rig": False, "measured": True, "fits_px": 0.3} | how
    sizes = [SIZES[1], SIZES[2]]
    misfit = refine._Misfit(posed.rights, sizes, scene.tracks, given, given, **how)
    return misfit, refine._as_given(posed, fit, how["measured"])


@pytest.mark.parametrize(
    ("turn_deg", "shift", "status"),
    [(7.9, 0.0, "refined"), (8.1, 0.0, "kept"), (0.0, 0.79, "refined"), (0.0, 0.81, "kept")],
)
@pytest.mark.parametrize("v", [0, 1])
def test_a_refined_pose_may_be_within_eight_degrees_and_four_fifths_of_the_baseline(
    v, turn_deg, shift, status, monkeypatch
):
    """The poses as given are that far from right ones, in one of the two views."""
    scene = make_scene(150)
    change = np.eye(4)
    change[:3, :3] = pose((turn_deg, 0, 0), (0, 0, 0))[:3, :3]
    given = TS.copy()
    given[v] = np.linalg.inv(change) @ TS[v]
    if shift:
        given[v, :3, 3] = TS[v, :3, 3] / (1 + shift)  # in shares of the given baseline
    misfit, report = misfit_of(scene, given)
    monkeypatch.setattr(refine, "regularized_poses", lambda *_: (TS, TS))
    if shift:  # along its lines such a shift is not seen, so that residuals are made up
        residuals = iter([np.array([1.5, 1.2]), np.array([0.1, 0.2])])
        monkeypatch.setattr(refine, "median_residuals", lambda *_: next(residuals))
        monkeypatch.setattr(
            refine, "_warped_views", lambda misfit, report, before, Ts: CheckedViews((), report)
        )
    checked = refine._refined(misfit, report)
    assert checked.report.status == status
    rejected = checked.report.rejected
    if status == "refined":
        assert rejected is None
        return
    assert checked.views is misfit.rights and checked.tracks is None and checked.warps == ()
    assert (rejected.view, rejected.degrees) == (v, pytest.approx(turn_deg, abs=1e-6))
    assert rejected.of_baseline == pytest.approx(shift, abs=1e-6)
    assert rejected.residual_px == ((0.1, 0.2)[v] if shift else pytest.approx(0.0, abs=1e-6))


def test_of_several_poses_that_are_too_far_the_worst_one_is_named(monkeypatch):
    scene = make_scene(60)
    given = np.stack([moved(T, np.radians([9.0 + v, 0, 0, 0, 0, 0])) for v, T in enumerate(TS)])
    for before, v in (((1.5, 1.2), 0), ((1.2, 1.5), 1)):
        misfit, report = misfit_of(scene, given)
        residuals = iter([np.array(before), np.array(before[::-1]) / 10])
        monkeypatch.setattr(refine, "median_residuals", lambda *_, left=residuals: next(left))
        monkeypatch.setattr(refine, "regularized_poses", lambda *_: (TS, TS))
        found = refine._refined(misfit, report).report
        assert found.residual_px_given == before and found.residual_px == before
        degrees = pytest.approx(9.0 + v)
        assert found.rejected == RejectedPose(v, degrees, pytest.approx(0.0, abs=1e-9), before[1 - v] / 10)


def test_a_pose_is_kept_unless_another_one_leaves_a_tenth_less(monkeypatch):
    scene = make_scene(150)
    for after, status in (((1.8, 1.78), "refined"), ((1.8, 1.82), "kept")):
        misfit, report = misfit_of(scene)
        residuals = iter([np.array([1.4, 2.6]), np.array(after)])
        monkeypatch.setattr(refine, "median_residuals", lambda *_, left=residuals: next(left))
        monkeypatch.setattr(refine, "regularized_poses", lambda *_: (TS, TS))
        monkeypatch.setattr(
            refine, "_warped_views", lambda misfit, report, before, Ts: CheckedViews((), report)
        )
        found = refine._refined(misfit, report).report
        assert found.status == status and found.residual_px_given == (1.4, 2.6)
        assert found.matches == (150.0, 150.0) and found.rejected is None


@pytest.mark.parametrize("rig", [False, True])
def test_depths_of_another_pose_that_fits_as_well_are_reported_unless_a_calibration_decides(rig, monkeypatch):
    scene = make_scene(150, unseen=0.2)
    misfit, report = misfit_of(scene, rig=rig)
    other = TS.copy()
    other[:, :3, 3] *= 1.3
    monkeypatch.setattr(refine, "regularized_poses", lambda *_: (TS, other))
    found = refine._refined(misfit, report).report
    assert found.depth_spread == (0.0 if rig else pytest.approx(math.log(1.3), rel=1e-6))
    assert found.status == "refined"


def test_the_depth_ratio_is_the_median_over_points_in_front_under_both_poses():
    scene = make_scene(80, unseen=0.3)
    other = np.stack([moved(T, np.r_[np.radians([0.4, 0.3, 0.1]), 0.03, 0, 0.01]) for T in TS])
    a, b = (solve_inverse_depth(scene.tracks, Ts) for Ts in (TS, other))
    front = (a > 0) & (b > 0)
    expected = np.median(np.abs(np.log(a[front]) - np.log(b[front])))
    assert expected > 0.01
    assert depth_difference(scene.tracks, TS, other) == pytest.approx(expected)
    behind = TS.copy()
    behind[:, :3, 3] *= -1
    assert depth_difference(scene.tracks, TS, behind) == 0.0


@pytest.mark.parametrize("misfit", [0.0, 0.08])
def test_a_refined_scale_is_the_mean_of_two_estimates_weighted_by_their_variances(misfit):
    rng = np.random.default_rng(0)
    given = rng.uniform(0.1, 0.5, 201)
    ratios = np.exp(0.12 + rng.normal(0, 0.06, 201))
    refined = given * ratios
    refined[:40] *= -1  # behind the camera: ignored
    given[:40] *= rng.choice([-1, 1], 40)
    logs = np.log(refined[40:] / given[40:])
    uneven = np.median(np.abs(logs - np.median(logs)))
    variances = np.array([0.15**2, 0.05**2 + misfit**2 + uneven**2])
    weights = (1 / variances) / (1 / variances).sum()
    mean = weights @ [0.0, np.median(logs)]
    spread = np.sqrt(1 / (1 / variances).sum() + weights @ (np.array([0.0, np.median(logs)]) - mean) ** 2)
    assert refined_scale(refined, given, misfit) == pytest.approx((np.exp(mean), spread))
    assert np.isnan(refined_scale(-np.abs(refined), given, misfit)).all()
    assert np.isnan(refined_scale(np.abs(refined), -np.abs(given), misfit)).all()


def test_a_tracker_is_rescaled_by_all_views_and_the_parallax_of_their_matches():
    scene = make_scene(120, noise_px=0.1, unseen=0.3)
    given = TS.copy()
    given[:, :3, 3] *= 0.8
    before = np.array([1.4, np.nan])
    w = solve_inverse_depth(scene.tracks, TS)
    parallax = [
        np.linalg.norm(projected(rays / w[seen][:, None], K, T) - projected(rays * 1e9, K, T), axis=1)
        for seen, K, T in zip(scene.tracks.seen, K_RIGHTS, TS, strict=True)
        for rays in [scene.tracks.rays[seen]]
    ]
    misfit = 1.4 / np.median(np.concatenate(parallax))
    factor, spread = refined_scale(w, solve_inverse_depth(scene.tracks, given), misfit)
    found, found_spread = refine._rescaled(scene.tracks, given, TS, before)
    assert 0.75 < factor < 0.95 and found_spread == pytest.approx(spread, rel=1e-4)
    np.testing.assert_allclose(found[:, :3, 3], factor * TS[:, :3, 3], rtol=1e-5)
    np.testing.assert_array_equal(found[:, :3, :3], TS[:, :3, :3])
    behind = TS.copy()
    behind[:, :3, 3] *= -1
    same, unknown = refine._rescaled(scene.tracks, given, behind, before)
    assert same is behind and unknown == math.inf


BEND = {(3, 0): 1.1, (1, 2): -2.0, (0, 2): 1.5, (2, 0): -1.0, (1, 1): 0.8, (0, 0): 0.3}


def bend(px: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A smooth displacement along y, and another one along x, of an image of this size."""
    half = max(size) / 2
    x, y = (px[:, 0] - (size[1] - 1) / 2) / half, (px[:, 1] - (size[0] - 1) / 2) / half
    up = sum(c * x**i * y**j for (i, j), c in BEND.items())
    return np.stack([0.7 * up, up], axis=1)


@pytest.mark.parametrize("v", [0, 1])
def test_a_smooth_displacement_across_the_lines_is_found_in_images_of_any_shape(v):
    scene, size = make_scene(500, noise_px=0.05), SIZES[v + 1]
    tracks, T = scene.tracks.alone(v), scene.Ts[v]
    inside = ((tracks.right_px[0] > 0) & (tracks.right_px[0] < np.array(size[::-1]))).all(1)
    tracks = tracks.kept(inside)
    # Moved so that the displacement brings each match back across its line.
    px = tracks.right_px[0] - bend(tracks.right_px[0], size)
    for _ in range(5):
        px = tracks.right_px[0] - bend(px, size)
    bent = replace(tracks, right_px=px[None])
    found = fit_displacement(bent, T, size)
    assert found is not None and found.size == size
    off, normals, _ = epipolar(bent, T)
    across = ((found.at(px) - bend(px, size)) * normals).sum(1)
    assert np.median(np.abs(across)) < 0.1 and np.median(np.abs(off)) > 0.2
    fixed = replace(bent, right_px=(px + found.at(px))[None])
    assert median_residuals(fixed, T[None])[0] < 0.1
    lengths = np.linalg.norm(refine._cubic(px, size) @ found.coefficients, axis=1)
    assert found.rms_px == pytest.approx(np.sqrt(np.mean(lengths**2)))
    assert found.max_px == pytest.approx(np.quantile(lengths, 0.98))
    at = np.linalg.norm(found.at(px), axis=1)
    np.testing.assert_allclose(at, np.minimum(lengths, found.max_px), atol=1e-9)


def test_a_cubic_holds_all_ten_products_over_the_longer_side():
    size, px = (200, 300), np.array([[149.5, 99.5], [299.5, 99.5], [149.5, 199.5], [74.5, 24.5]])
    x, y = np.array([[0, 0], [1, 0], [0, 2 / 3], [-0.5, -0.5]]).T
    found = refine._cubic(px, size)
    expected = {(i, j): x**i * y**j for i in range(4) for j in range(4) if i + j <= 3}
    assert found.shape == (4, 10)
    for column in expected.values():
        assert (np.abs(found - column[:, None]).max(0) < 1e-12).any()


def test_the_coefficients_of_a_displacement_minimise_its_stated_objective():
    """Residuals count less above half a pixel; each coefficient is pulled to 0 as by three matches."""
    rng = np.random.default_rng(0)
    basis = refine._cubic(rng.uniform(0, 500, (300, 2)), (500, 400))
    normals = rng.normal(size=(300, 2))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    off = ((basis @ rng.normal(size=(10, 2))) * normals).sum(1) + rng.standard_t(2, 300) * 0.3

    def objective(flat: np.ndarray) -> float:
        residuals = ((basis @ flat.reshape(10, 2)) * normals).sum(1) - off
        return float((0.5**2 * np.log1p((residuals / 0.5) ** 2)).sum() + 3.0 * (flat**2).sum())

    found = refine._fit_cubic(basis, normals, off).ravel()
    slopes = [(objective(found + step) - objective(found - step)) / 2e-6 for step in 1e-6 * np.eye(20)]
    assert np.abs(slopes).max() < 0.02 < 0.1 * np.abs(found).max()


def test_a_displacement_needs_matches_in_all_parts_that_agree_on_it():
    scene = make_scene(700, noise_px=0.05)
    tracks, T, size = scene.tracks.alone(0), scene.Ts[0], SIZES[1]
    bent = replace(tracks, right_px=tracks.right_px - bend(tracks.right_px[0], size))
    side = max(size) / 6
    even = np.floor(bent.left_px / side).sum(1) % 2 == 0
    assert fit_displacement(bent.kept(slice(80)), T, size) is not None
    assert fit_displacement(bent.kept(slice(79)), T, size) is None
    for part in (even, ~even):
        few = np.flatnonzero(part)
        assert fit_displacement(bent.kept(np.r_[few[:20], np.flatnonzero(~part)]), T, size) is not None
        assert fit_displacement(bent.kept(np.r_[few[:19], np.flatnonzero(~part)]), T, size) is None
    assert fit_displacement(tracks, T, size) is None
    # Both halves show a displacement, and opposite ones: each is wrong for the other.
    torn = tracks.right_px - np.where(even[:, None], 1.0, -1.0) * bend(tracks.right_px[0], size)
    assert fit_displacement(replace(tracks, right_px=torn), T, size) is None


@pytest.mark.parametrize("factors", [(1.0, 1.0), (2.0, 0.5), (0.5, 1.5)])
def test_an_image_of_another_size_is_warped_by_the_scaled_displacement(factors):
    """Its values are its pixels, so that the result shows where each came from."""
    size = (60, 90)
    coefficients = np.zeros((10, 2))
    coefficients[:4] = [[1.5, -0.8], [0.6, 1.0], [-0.5, 0.4], [0.3, 0.2]]
    displacement = Displacement(coefficients, size, 1.9, 1.0)
    height, width = round(60 * factors[1]), round(90 * factors[0])
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    image = torch.stack([u, v, u + v]).float() / 300
    found = 300 * warp_image(image, displacement).numpy()
    assert found.dtype == np.float32 and found.shape == (3, height, width)
    px = np.array([[width // 2, height // 3], [width // 3, height // 2]], float)
    on_grid = (px + 0.5) / np.array(factors) - 0.5
    source = px - displacement.at(on_grid) * np.array(factors)
    assert np.abs(displacement.at(on_grid)).min() > 0.1
    for (x, y), (from_x, from_y) in zip(px.astype(int), source, strict=True):
        assert found[:, y, x] == pytest.approx([from_x, from_y, from_x + from_y], abs=0.1)
    grey = warp_image(image[:1], displacement)
    assert grey.shape == (1, height, width) and torch.allclose(
        300 * grey[0], torch.from_numpy(found[0]), atol=1e-3
    )


def test_only_images_of_views_that_did_not_fit_are_warped():
    scene = make_scene(500, noise_px=0.05)
    right_px = scene.tracks.right_px - np.stack(
        [bend(px, s) for px, s in zip(scene.tracks.right_px, SIZES[1:], strict=True)]
    )
    scene.tracks = replace(scene.tracks, right_px=right_px)
    images = [torch.rand(3, 60, 56), torch.rand(3, 42, 70)]
    posed, _ = inputs(scene.tracks, TS, images)
    misfit = refine._Misfit(
        posed.rights, SIZES[1:], scene.tracks, WRONG, WRONG, fits_px=0.3, rig=False, measured=True
    )
    _, report = misfit_of(scene)
    for v, before in ((0, [0.31, 0.29]), (1, [0.29, 0.31])):
        views, found, tracks, warps = refine._warped_views(misfit, report, np.array(before), TS)
        assert tracks is misfit.tracks, "those of the images as they were"
        other = 1 - v
        displacement = fit_displacement(scene.tracks.alone(v), TS[v], SIZES[v + 1])
        assert found.warp_rms_px[v] == pytest.approx(displacement.rms_px) and found.warp_rms_px[other] == 0.0
        assert views[other].image_01 is images[other]
        assert torch.equal(views[v].image_01, warp_image(images[v], displacement))
        assert warps[other] is None and warps[v].size == displacement.size
        np.testing.assert_array_equal(warps[v].coefficients, displacement.coefficients)
        as_they_are = median_residuals(scene.tracks, TS)
        assert found.residual_px[other] == pytest.approx(as_they_are[other])
        assert found.residual_px[v] < 0.3 * as_they_are[v]
        np.testing.assert_allclose(found.E, POSES, atol=1e-9)


def test_a_wrong_pose_is_left_unchanged():
    scene = make_scene(100, noise_px=0.15)
    posed, fit = inputs(scene.tracks, np.linalg.inv(TS))
    views, report, tracks, warps = refined(posed, fit, mistaken=True)
    assert views is posed.rights and report.status == "mistaken" and tracks is None and warps == ()
    assert report.residual_px == report.residual_px_given == tuple(fit.residual_px)
    assert report.matches == (100.0, 100.0)


@pytest.mark.parametrize(("dense_px", "status"), [(0.44, "fits"), (0.9, "refined")])
def test_a_rig_is_refined_only_if_its_dense_matches_miss_it_too(dense_px, status, monkeypatch):
    def lifted(seed: int, count: int, by_px: float):
        scene = make_scene(count, noise_px=0.02, poses=np.linalg.inv(RIG), Ks=K_RIG, seed=seed)
        return replace(scene.tracks, right_px=scene.tracks.right_px + [0.0, by_px])

    sparse, dense = lifted(0, 50, 0.9), lifted(1, 200, dense_px)
    with_dense(monkeypatch, dense)
    posed, fit = inputs(sparse, RIG, is_rig=True)
    assert not fit.fits
    views, report, _, warps = refined(posed, fit)
    assert report.rig and len(warps) == (0 if status == "fits" else 2)
    by_all = median_residuals(merge_tracks([sparse, dense]), RIG)
    assert report.status == status and report.residual_px_given == pytest.approx(tuple(by_all), rel=1e-4)
    assert report.matches == (250.0, 250.0) and report.scale_rel_std is None
    assert (views is posed.rights) is (status == "fits")
    lengths = [np.linalg.norm(E[:3, 3]) for E in report.E]
    assert lengths == pytest.approx([0.3, 0.2], rel=0.02)


@pytest.mark.parametrize(
    ("given", "dense_count", "overlaps", "status", "features"),
    [
        (TS, 100, True, "fits", None),
        (WRONG, 100, True, "refined", 12),
        (WRONG, 10, True, "not checked", None),
        (WRONG, 100, False, "not checked", None),
    ],
)
@pytest.mark.parametrize("measured", [False, True])
def test_where_few_features_match_flow_is_asked_about_the_poses_as_given(
    given, dense_count, overlaps, status, features, measured, monkeypatch
):
    sparse = make_scene(12, noise_px=0.1).tracks
    sparse.seen[1, 5:] = False
    dense = make_scene(dense_count, noise_px=0.1, seed=4).tracks
    asked = with_dense(monkeypatch, dense)
    if not overlaps:

        def raise_input_error(*_):
            raise InputError("The views do not overlap.")

        monkeypatch.setattr(refine, "coarse_depth", raise_input_error)
    posed, fit = inputs(sparse, given)
    views, report, used_tracks, warps = refine_by_flow(posed, fit, measured)
    assert (report.status, report.features) == (status, features)
    assert (used_tracks is None) is (status != "refined")
    assert len(warps) == (2 if status == "refined" else 0)
    assert (views is posed.rights) is (status != "refined")
    count = dense_count if overlaps else 0
    assert report.matches == (12.0 + count, 5.0 + count)
    tracks = merge_tracks([sparse, dense]) if overlaps else sparse
    before = median_residuals(tracks, given)
    np.testing.assert_allclose(report.residual_px_given, before, rtol=1e-4)
    if status != "refined":
        np.testing.assert_allclose(report.residual_px, before, rtol=1e-4)
        assert report.scale_rel_std == (None if measured else 0.05)
    else:
        assert (report.scale_rel_std is None) is measured
        np.testing.assert_array_equal(used_tracks.right_px, tracks.right_px)
    if overlaps:
        assert asked[0][0] is posed and asked[0][1] == SIZES[0] and asked[1][2] is given


@pytest.mark.parametrize(("given", "status"), [(TS, "fits"), (WRONG, "refined")])
def test_flow_of_one_view_is_enough_where_another_view_shows_nothing(given, status, monkeypatch):
    sparse = make_scene(12, noise_px=0.1).tracks
    dense = make_scene(100, noise_px=0.1, seed=4).tracks
    for tracks in (sparse, dense):
        tracks.seen[1] = False
    with_dense(monkeypatch, dense)
    posed, fit = inputs(sparse, given)
    views, report, _, warps = refine_by_flow(posed, fit, measured=True)
    assert report.status == status and report.matches == (112.0, 0.0)
    assert warps == (() if status == "fits" else (None, None))
    assert math.isnan(report.residual_px_given[1]) and math.isnan(report.residual_px[1])
    assert report.residual_px[0] < 0.25
    np.testing.assert_allclose(views[1].T_right_from_left, given[1], atol=1e-5)


def test_a_rig_is_not_changed_for_what_flow_alone_shows(monkeypatch):
    scene = make_scene(10, poses=np.linalg.inv(RIG), Ks=K_RIG)
    dense = make_scene(200, noise_px=0.02, poses=np.linalg.inv(RIG), Ks=K_RIG, seed=1).tracks
    for by_px, status in ((0.44, "fits"), (0.46, "not checked")):
        with_dense(monkeypatch, replace(dense, right_px=dense.right_px + [0.0, by_px]))
        posed, fit = inputs(scene.tracks, RIG, is_rig=True)
        views, report, tracks, warps = refine_by_flow(posed, fit, measured=False)
        assert report.status == status and views is posed.rights and tracks is None and warps == ()
        assert report.rig and report.features is None


def depth_error(tracks: Tracks, Ts: np.ndarray, depth_m: np.ndarray) -> float:
    return float(np.median(np.abs(solve_inverse_depth(tracks, Ts) * depth_m - 1)))


@END_TO_END
def test_a_perturbed_pose_is_recovered_up_to_the_unobservable_part() -> None:
    tracks, Ts, depth_m = make_tracks([TRUE])
    wrong = TRUE @ camera_pose((0.7, -0.8, 0.5), (0, 0, 0))
    wrong[:3, 3] += np.cross(wrong[:3, 3], (0.5, 0.9, -0.4)) * 0.05  # across the baseline: its length stays
    given, prior = np.linalg.inv(wrong)[None], PosePrior(np.array([10.0]))
    solved = solve_poses(tracks, given, prior, start=solve_poses(tracks, given, prior, scale_px=8.0))
    assert angle_deg(solved[0, :3, :3] @ Ts[0, :3, :3].T) < 0.1
    assert depth_error(tracks, solved, depth_m) < 0.03 < depth_error(tracks, given, depth_m)
    longer = TRUE.copy()
    longer[:3, 3] *= 1.2
    solved = np.linalg.inv(solve_poses(tracks, np.linalg.inv(longer)[None], PosePrior(np.array([0.5])))[0])
    assert np.linalg.norm(solved[:3, 3]) == pytest.approx(np.linalg.norm(longer[:3, 3]), rel=0.01)


def regularised(tracks: Tracks, given: np.ndarray) -> np.ndarray:
    left, before = Camera(tracks.K_left), median_residuals(tracks, given)
    rig = all(is_rectified(left, Camera(K), T) for K, T in zip(tracks.K_rights, given, strict=True))
    return regularized_poses(tracks, given, given, before, rig)[0]


@END_TO_END
def test_a_shift_that_makes_up_for_a_turn_comes_back() -> None:
    """A tracker's error: matches lie near their lines and still far from where they should be along them."""
    tracks, Ts, depth_m = make_tracks([TRUE])
    wrong = TRUE @ camera_pose(
        (0.1, 0.5, 0.0), (-np.radians(0.5) * 4.0 * 0.8, np.radians(0.1) * 4.0 * 0.8, 0)
    )
    wrong[:3, 3] *= np.linalg.norm(TRUE[:3, 3]) / np.linalg.norm(wrong[:3, 3])
    given = np.linalg.inv(wrong)[None]
    assert np.median(residuals_px(tracks, given)) < 1.0
    found = regularised(tracks, given)
    assert depth_error(tracks, found, depth_m) < 0.5 * depth_error(tracks, given, depth_m)
    assert depth_difference(tracks, Ts, Ts) == 0.0
    longer = Ts.copy()
    longer[:, :3, 3] *= 1.2
    assert depth_difference(tracks, Ts, longer) == pytest.approx(np.log(1.2), rel=0.05)
    assert depth_difference(tracks, longer, Ts) == pytest.approx(np.log(1.2), rel=0.05)


@END_TO_END
@pytest.mark.parametrize("metre", [0.001, 100.0])
def test_a_refined_pose_does_not_depend_on_the_unit_of_length(metre: float) -> None:
    """Whatever the prior on rotations, translations and lengths is, for poses in any unit."""
    tracks, _, _ = make_tracks([TRUE, camera_pose((-2.0, 5.0, 0.0), (-0.3, 0.1, 0.05))], count=120)
    given = np.stack([np.linalg.inv(TRUE @ camera_pose((0.4, -0.3, 0.2), (0.02, 0.01, 0)))] * 2)
    given[1] = np.linalg.inv(camera_pose((-2.2, 5.3, 0.1), (-0.3, 0.1, 0.05)))
    longer = given.copy()
    longer[:, :3, 3] *= metre
    prior = PosePrior(np.array([0.5, 0.5]))
    in_metres, found = (solve_poses(tracks, each, prior) for each in (given, longer))
    assert angle_deg(in_metres[0, :3, :3] @ given[0, :3, :3].T) > 0.05
    np.testing.assert_allclose(found[:, :3, :3], in_metres[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(found[:, :3, 3], metre * in_metres[:, :3, 3], rtol=1e-4, atol=1e-6 * metre)


@END_TO_END
def test_the_refinement_is_joint_and_reaches_the_optimum() -> None:
    """Poses of both views and the points that both see, as SciPy's least squares finds them all at once."""
    poses = [TRUE, camera_pose((-2.0, 5.0, 0.0), (-0.3, 0.1, 0.05))]
    tracks, _, _ = make_tracks(poses, noise_px=0.4, count=40, outliers=0.0)
    given = np.stack([np.linalg.inv(E @ camera_pose((0.3, -0.4, 0.2), (0, 0, 0))) for E in poses])
    loose = PosePrior(np.full(2, 1e4), 1e3, 1e3, 1e3)
    solved = solve_poses(tracks, given, loose, scale_px=1e3)

    def offs(x: np.ndarray) -> np.ndarray:
        Ts = given.copy()
        for v, step in enumerate(x[:12].reshape(2, 6)):
            Ts[v, :3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ given[v, :3, :3]
            Ts[v, :3, 3] = given[v, :3, 3] + step[3:]
        points = np.exp(-x[12:])[:, None] * tracks.rays
        p = np.einsum("vij,nj->vni", K @ Ts[:, :3, :3], points) + (K @ Ts[:, :3, 3:])[:, None, :, 0]
        return (p[..., :2] / p[..., 2:] - tracks.right_px).reshape(-1)

    start = np.r_[np.zeros(12), np.log(np.clip(solve_inverse_depth(tracks, given), 0.05, None))]
    best = least_squares(offs, start).fun
    ours = np.nansum(residuals_px(tracks, solved) ** 2)
    alone = np.stack([solve_poses(tracks.view(v), given[v : v + 1], loose)[0] for v in range(2)])
    assert ours == pytest.approx((best**2).sum(), rel=0.02)
    assert np.nansum(residuals_px(tracks, alone) ** 2) > 2 * ours, "pair by pair they do not agree on points"


@END_TO_END
def test_a_grey_image_is_the_same_in_any_layout_and_rounded_to_the_nearest_level() -> None:
    planes = torch.rand(3, 40, 60, generator=torch.Generator().manual_seed(0))
    luma = np.array([0.299, 0.587, 0.114]) @ planes.double().numpy().reshape(3, -1)
    interleaved = planes.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    strided = torch.stack([planes, planes], dim=-1)[..., 0]
    for image in (planes, interleaved, strided):
        grey = grey_image(image, Camera(np.eye(3)), 1.0).grey
        assert grey.dtype == np.uint8
        assert np.abs(grey - 255.0 * luma.reshape(40, 60)).max() < 0.5 + 1e-3
    alone = grey_image(strided[:1], Camera(np.eye(3)), 1.0).grey
    np.testing.assert_array_equal(alone, np.rint(255.0 * planes[0].numpy()))


@END_TO_END
def test_the_threads_for_features_are_kept_for_the_next_images() -> None:
    rng = np.random.default_rng(0)
    views = [grey_of(rng.integers(0, 256, (60, 80), dtype=np.uint8), np.eye(3)) for _ in range(2)]

    def threads(scale: float) -> set[threading.Thread]:
        return {
            each for each in threading.enumerate() if each.name.startswith(f"geodiff-features-{scale:g}_")
        }

    for scale in (1.0, 0.5):  # small images wait for no whole ones
        sparse_tracks(views, scale)
        before = threads(scale)
        sparse_tracks(views, scale)
        assert before and before <= threads(scale) and len(threads(scale)) <= 4


def bent(tracks: Tracks, px: float) -> Tracks:
    moved = tracks.right_px.copy()
    moved[0, :, 1] += px * ((tracks.right_px[0, :, 0] - 255.5) / 256) ** 2
    return replace(tracks, right_px=moved)


@END_TO_END
def test_a_smooth_residual_is_warped_away_and_pixels_move_to_their_matches() -> None:
    tracks, Ts, _ = make_tracks([camera_pose((0, 0, 0), (0.3, 0, 0))])
    off = bent(tracks, 2.0)
    displacement = fit_displacement(off, Ts[0], SIZE)
    straight = replace(off, right_px=off.right_px + displacement.at(off.right_px[0]))
    before, after = (np.median(residuals_px(t, Ts)) for t in (off, straight))
    assert after < 0.3 * before
    assert fit_displacement(tracks, Ts[0], SIZE) is None, "there is nothing smooth in noise"
    ramp = torch.arange(SIZE[0], dtype=torch.float32).view(1, -1, 1).expand(3, *SIZE) / 1000
    moved = warp_image(ramp, displacement)[0, 200, 500] * 1000
    assert moved == pytest.approx(200 - displacement.at(np.array([[500.0, 200.0]]))[0, 1], abs=0.05)


@pytest.fixture(scope="module")
def pair():
    return render_pair(3, size=(240, 320), exposure=True, posed=True)


def posed(pair, E):
    right = pair.right.image_01.float(), pair.K_right, np.linalg.inv(E)
    return posed_of(pair.left.image_01.float(), pair.K_left, right)


@END_TO_END
def test_a_tracker_keeps_the_scene_and_a_measured_baseline_its_length(pair) -> None:
    """The camera has turned about a point of the scene: its depth is right, the baseline is not."""
    E = pair.E.numpy().astype(float)
    about = np.eye(4)
    about[2, 3] = float(pair.left.depth_m.median())
    wrong = about @ camera_pose((1.0, -1.2, 0.4), (0, 0, 0)) @ np.linalg.inv(about) @ E
    length, given_length = (np.linalg.norm(P[:3, 3]) for P in (E, wrong))
    assert abs(np.log(given_length / length)) > 0.1, "else nothing is tested"
    kept = checked_views(posed(pair, wrong), measured=True).report
    assert kept.status == "refined" and kept.scale_rel_std is None
    assert np.linalg.norm(kept.E[0][:3, 3]) == pytest.approx(given_length, rel=0.02)
    _, report, facts, _ = checked_views(posed(pair, wrong))
    moved = np.log(np.linalg.norm(report.E[0][:3, 3]) / given_length)
    assert 0.2 < moved / np.log(length / given_length) < 1.2
    assert report.scale_rel_std > 0.05  # even where both lengths agree
    assert PoseUncertainty.scale_rel_std(facts) == report.scale_rel_std
    assert PoseUncertainty.scale_rel_std(facts.of_call(Call(has_unit=False))) == 0.0


def findings_on_poses(checked: CheckedPoses) -> list[Finding]:
    """What the check reports of errors and residuals."""
    return [finding for check in (PoseErrors, Epipolar) for finding in check.findings(checked.facts, ())]


@END_TO_END
def test_views_are_used_as_given_where_no_better_pose_is_near(pair) -> None:
    E = pair.E.numpy()
    given = posed(pair, E)
    left, rights = given
    image = rights[0].image_01.permute(1, 2, 0).numpy()
    x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in image.shape[1::-1]))
    waves = cv2.remap(image, x, y + 4 * np.sin(x * np.float32(2 * np.pi / 40)), cv2.INTER_LINEAR)
    waved = rights[0]._replace(image_01=torch.from_numpy(waves.transpose(2, 0, 1).copy()))
    blank = torch.full_like(left.image_01, 0.5)
    nothing = PosedViews(left._replace(image_01=blank), (rights[0]._replace(image_01=blank),))
    inverse = np.linalg.inv(E)
    for inputs, status, said in (
        (given, "fits", None),
        (
            posed(pair, E @ camera_pose((0, 0, 10), (0, 0, 0))),
            "kept",
            "A better pose .* was rejected: it is 10 degrees and",
        ),
        (given._replace(rights=(waved,)), "kept", "no nearby pose is clearly better"),
        (posed(pair, inverse), "mistaken", "world-to-camera"),
        (nothing, "not checked", None),
    ):
        checked = checked_views(inputs)
        findings = findings_on_poses(checked)
        assert checked.report.status == status and bool(findings) == (said is not None)
        assert said is None or re.search(said, findings[0])
        assert checked.views == inputs.rights


@pytest.fixture(scope="module")
def plain():
    """Views in which SIFT finds too little."""
    return render_pair(9, size=(96, 128), posed=True, effects=True)


@END_TO_END
def test_where_features_are_few_optical_flow_shows_whether_a_pose_fits(plain) -> None:
    right, wrong = plain.E.numpy(), plain.E.numpy() @ camera_pose((1.0, -0.5, 0.5), (0, 0, 0))
    assert not fit_module.measure_fit(fit_module.posed_greys(posed(plain, right))).is_known, (
        "else nothing is tested"
    )
    given = posed(plain, right)
    checked = checked_views(given)
    report = checked.report
    assert checked.views == given.rights and not findings_on_poses(checked)
    assert report.status == "fits" and report.residual_px[0] < 0.3 and report.matches[0] > 50
    checked = checked_views(posed(plain, wrong))
    report = checked.report
    assert report.status == "refined" and report.residual_px[0] < 0.3 < report.residual_px_given[0]
    (few,) = (finding for finding in findings_on_poses(checked) if finding.code == "pose.few-matches")
    assert few.is_reason


@END_TO_END
def test_a_calibration_is_not_changed_for_what_flow_alone_shows() -> None:
    pair = render_pair(9, size=(96, 128), posed=False, effects=True)
    assert checked_views(posed(pair, pair.E.numpy())).report.status == "fits"
    raised = replace(pair, right=replace(pair.right, image_01=torch.roll(pair.right.image_01, 2, dims=-2)))
    given = posed(raised, pair.E.numpy())
    assert not fit_module.measure_fit(fit_module.posed_greys(given)).is_known, "else nothing is tested"
    used, report, _, warps = checked_views(given)
    assert (
        report.status == "not checked"
        and used == given.rights
        and warps == ()
        and report.residual_px[0] > 0.45
    )


@END_TO_END
def test_the_scale_of_a_pose_in_use_is_that_of_the_scene_unless_its_length_was_measured(pair) -> None:
    """A pair does not show how far its cameras are apart."""
    given = posed(pair, pair.E.numpy())
    assert checked_views(given).report.scale_rel_std == refine.DEPTH_SPREAD
    assert checked_views(given, measured=True).report.scale_rel_std is None
    rig = render_pair(0, size=(240, 320), posed=False)
    assert checked_views(posed(rig, rig.E.numpy())).report.scale_rel_std is None


@END_TO_END
def test_everything_downstream_sees_the_refined_pose(pair) -> None:
    true = pair.E.numpy()
    wrong = true @ camera_pose((0.8, -0.9, 0.5), (0, 0, 0))
    Ks = (pair.K_left.numpy(), pair.K_right.numpy())
    left = pair.left.image_01.float()[None]
    (refined,) = GeometryGuidance(pair.right.image_01, Ks, wrong).prepare(left)
    (given,) = GeometryGuidance(pair.right.image_01, Ks, wrong, pose="given").prepare(left)
    report, E = refined.report, np.linalg.inv(refined.native.rights[0].T_right_from_left)
    assert report.status == "refined" and report.residual_px[0] < 0.3 < 1.0 < report.residual_px_given[0]
    assert "median epipolar error of" in next(Epipolar.findings(refined.facts, ()))
    assert angle_deg(report.E[0][:3, :3].T @ true[:3, :3]) < 0.2
    assert np.allclose(E, report.E[0], atol=1e-5) and np.allclose(report.E_given[0], wrong, atol=1e-6)
    left, (right,) = refined.grid
    assert np.allclose(np.linalg.inv(right.T_right_from_left), E, atol=1e-6)
    as_refined = Parallax(left.camera, right, "E")
    found_px = refined.volume.parallax[0].median_shift(0.5)
    assert found_px == pytest.approx(as_refined.median_shift(0.5), rel=1e-5)
    assert given.report.status == "given"
    assert np.allclose(np.linalg.inv(given.native.rights[0].T_right_from_left), wrong, atol=1e-5)


def check_during_matching(monkeypatch) -> None:
    """As on CUDA: the poses are checked in threads next to the matching of the views."""
    for module in ("_internal.threads", "evidence.prepare"):
        monkeypatch.setattr(f"geodiff_plugin.{module}.leaves_cpu_free", lambda device: True)


def hold_until(asked: threading.Event, module: ModuleType, name: str, monkeypatch) -> None:
    """Let a function of the check wait for the event where evidence is made."""
    function = getattr(module, name)

    def patient(*args):
        assert asked.wait(60)
        return function(*args)

    monkeypatch.setattr(module, name, patient)


@END_TO_END
@pytest.mark.parametrize(
    ("turn_deg", "noise", "status"), [(0.0, 0.0, "fits"), (0.8, 0.0, "refined"), (0.0, 0.012, "kept")]
)
def test_evidence_made_next_to_the_check_of_the_poses_is_the_same(
    pair, monkeypatch, turn_deg, noise, status
) -> None:
    """As on CUDA: features are matched before it is known whether the images are clean, and again if
    not; the views are matched as given meanwhile, and again if a pose is refined."""
    E = pair.E.numpy() @ camera_pose((turn_deg, -turn_deg, 0), (0, 0, 0))
    generator = torch.Generator().manual_seed(0)
    left, right = (
        (image + noise * torch.randn(image.shape, generator=generator)).clamp(0.0, 1.0)
        for image in (pair.left.image_01.float(), pair.right.image_01.float())
    )
    guidance = GeometryGuidance(right, (pair.K_left.numpy(), pair.K_right.numpy()), E)
    (alone,) = guidance.prepare(left[None])
    assert torch.equal(alone.native.left.image_01, left) == (noise == 0.0)
    check_during_matching(monkeypatch)
    (beside,) = guidance.prepare(left[None])
    assert alone.report.status == beside.report.status == status
    assert alone.report.residual_px == beside.report.residual_px
    assert alone.facts == beside.facts and alone.facts[Epipolar] is not None
    assert torch.equal(alone.matches.inverse_depth, beside.matches.inverse_depth)
    assert torch.equal(alone.volume.levels, beside.volume.levels)


@END_TO_END
def test_flow_is_used_for_few_features_next_to_the_matching_as_well(pair, monkeypatch) -> None:
    """As on CUDA: too few features do not show that the poses fit, by which the views were matched."""
    E = pair.E.numpy() @ camera_pose((0.8, -0.8, 0), (0, 0, 0))
    left, right = pair.left.image_01.float(), pair.right.image_01.float()
    guidance = GeometryGuidance(right, (pair.K_left.numpy(), pair.K_right.numpy()), E)
    posed = guidance.inputs[0].posed_views(left)
    count = int(fit_module.measure_fit(fit_module.posed_greys(posed)).tracks.seen.sum())
    for module in (fit_module, tracks_module):
        monkeypatch.setattr(module, "MIN_MATCHES", count + 1)
    (alone,) = guidance.prepare(left[None])
    check_during_matching(monkeypatch)
    (beside,) = guidance.prepare(left[None])
    assert [each.report.status for each in (alone, beside)] == ["refined", "refined"]
    assert torch.equal(alone.volume.levels, beside.volume.levels)


@END_TO_END
def test_evidence_of_poses_that_fit_is_there_before_all_is_known_about_them(pair, monkeypatch) -> None:
    """As on CUDA: what else the check finds is for phase 3, so denoising does not wait for it."""
    asked = threading.Event()

    hold_until(asked, prepare, "check_poses", monkeypatch)
    check_during_matching(monkeypatch)
    guidance = GeometryGuidance(
        pair.right.image_01, (pair.K_left.numpy(), pair.K_right.numpy()), pair.E.numpy()
    )
    (made,) = guidance.plan_evidence(pair.left.image_01.float()[None])
    assert made.evidence.matches is not None and not asked.is_set()
    asked.set()
    assert made.complete().report.status == "fits"


def demo_views(turn_deg: float = 0.0) -> PosedViews:
    """The demo pair, whose right camera has turned up or down."""
    shown = read_demo_pair()
    left, right = (torch.from_numpy(each).permute(2, 0, 1) for each in (shown.left, shown.right))
    T = np.linalg.inv(shown.rig.E @ camera_pose((turn_deg, 0.0, 0.0), (0, 0, 0)))
    return posed_of(left, shown.rig.K_left, (right, shown.rig.K_right, T))


@END_TO_END
def test_reduced_images_that_show_that_poses_fit_suffice(monkeypatch) -> None:
    """As on CUDA: denoising does not wait for the features of the images themselves."""
    asked = threading.Event()

    hold_until(asked, plan, "measure_fit", monkeypatch)
    check_during_matching(monkeypatch)
    shown = read_demo_pair()
    guidance = GeometryGuidance(shown.right, (shown.rig.K_left, shown.rig.K_right), shown.rig.E)
    (made,) = guidance.plan_evidence(torch.from_numpy(shown.left).permute(2, 0, 1)[None])
    assert made.evidence.matches is not None and not asked.is_set()
    asked.set()
    assert made.complete().report.status == "fits"


@END_TO_END
@pytest.mark.parametrize(("turn_deg", "fits"), [(0.0, True), (0.1, False), (2.0, False)])
def test_reduced_images_are_conclusive_only_for_poses_that_fit(turn_deg: float, fits: bool) -> None:
    greys = fit_module.posed_greys(demo_views(turn_deg))
    assert fit_module.fit_of_small(greys).surely is fits
    few = replace(greys, views=[view._replace(grey=np.full_like(view.grey, 90)) for view in greys.views])
    assert not fit_module.fit_of_small(few).surely


@END_TO_END
@pytest.mark.parametrize("rig", [True, False])
def test_one_result_is_used_where_reduced_and_full_images_differ(rig: bool, monkeypatch) -> None:
    """On CUDA what comes first decides; elsewhere the same has to come out."""
    for name in ("FITS_PX", "POSED_FITS_PX"):
        monkeypatch.setattr(fit_module, name, 1e-3)
    monkeypatch.setattr(fit_module.PosedGreys, "rig", rig)
    posed = demo_views()
    greys = fit_module.posed_greys(posed)
    small = fit_module.fit_of_small(greys)
    assert not small.surely
    for surely in (False, True):
        fit = fit_module.measure_fit(greys, lambda answer=surely: replace(small, surely=answer))
        assert fit.fits is surely and (fit.residual_px > fit.limit_px).all()
        assert fit.is_small is (surely and rig)
    views, report, _, warps = check_poses(posed, fit, FactSheet())
    assert views is posed.rights and report.status == "fits" and warps == ()
    monkeypatch.setattr(fit_module, "SURELY", 1e9)
    assert fit_module.measure_fit(greys).fits


@END_TO_END
def test_reduced_images_of_a_rig_suffice_if_they_rule_out_all_problems(monkeypatch) -> None:
    posed = demo_views()
    greys = fit_module.posed_greys(posed)
    fit = fit_module.measure_fit(greys)
    assert fit.is_small and fit.rig
    whole = fit.at_full_resolution()
    assert not whole.is_small and len(whole.tracks) > 2 * len(fit.tracks)
    few, many = (len(each.tracks) for each in (fit, whole))
    assert check_poses(posed, fit, FactSheet()).report.matches == (few,)
    for check in (NegativeDisparity, Distortion, MovingObjects, OrderAmbiguity):
        with monkeypatch.context() as patched:
            patched.setattr(check, "MAX_RULED_OUT", -1.0)
            assert check_poses(posed, fit, FactSheet()).report.matches == (many,), check
    found = iter([FoundErrors((PoseError("camera.swapped"),)), FoundErrors(())])
    monkeypatch.setattr(PoseErrors, "of_tracks", lambda stage: next(found))
    checked = check_poses(posed, fit, FactSheet())
    assert checked.report.matches == (many,) and not findings_on_poses(checked)
    assert checked.views is posed.rights and checked.report.status == "fits"


@END_TO_END
def test_of_several_right_views_features_at_full_size_are_asked() -> None:
    """What only one of them shows could be hidden behind the others."""
    shown = demo_views()
    fit = fit_module.measure_fit(fit_module.posed_greys(shown._replace(rights=shown.rights * 2)))
    assert fit.rig and not fit.is_small and len(fit.residual_px) == 2


@END_TO_END
def test_few_features_do_not_hide_what_features_at_full_size_show() -> None:
    """Distortion that few matches show, but not for certain, is looked for in more of them."""
    shown = demo_views()
    K_left = shown.left.camera.K.astype(float)

    def distorted(view: View) -> View:
        image = view.image_01
        v, u = np.indices(image.shape[1:], dtype=np.float64)
        bent_px, lens = np.stack([u, v], -1).reshape(-1, 1, 2), np.array([-0.09, 0, 0, 0])
        px = cv2.undistortPoints(bent_px, K_left, lens, P=K_left).reshape(*u.shape, 2).astype(np.float32)
        made = cv2.remap(image.permute(1, 2, 0).numpy(), px, None, cv2.INTER_LINEAR)
        return view._replace(image_01=torch.from_numpy(made).permute(2, 0, 1))

    bent = PosedViews(distorted(shown.left), tuple(map(distorted, shown.rights)))
    fit = fit_module.measure_fit(fit_module.posed_greys(bent))
    certain = residual_distortion(fit.tracks, fit.greys.given[0]).k1
    assert fit.is_small and -0.08 < certain < 0.0, "else nothing is tested"
    _, report, facts, _ = check_poses(bent, fit, image_facts(fit.greys))
    of_small = len(fit_module.fit_of_small(fit.greys).tracks)
    assert facts[Distortion].k1 < certain and report.matches[0] > 1.5 * of_small


@END_TO_END
def test_matches_of_reduced_images_are_in_pixels_of_the_full_ones() -> None:
    rng = np.random.default_rng(0)
    whole = cv2.GaussianBlur(rng.integers(0, 256, (241, 330)).astype(np.uint8), (0, 0), 3.0)
    whole = cv2.normalize(whole, None, 0, 255, cv2.NORM_MINMAX)
    views = [grey_of(each.copy(), np.eye(3)) for each in (whole[3:, 10:], whole[:-3, :-10])]
    tracks = sparse_tracks(views, 0.5)
    assert len(tracks) > 40
    moved = np.median(tracks.right_px[0] - tracks.left_px, axis=0)
    assert moved == pytest.approx((10.0, 3.0), abs=0.1)
    at = np.median(tracks.left_px / np.array([320, 238]), axis=0)
    assert at == pytest.approx((0.5, 0.5), abs=0.15)  # all over the whole image


@END_TO_END
@pytest.mark.parametrize("seed", [pytest.param(2, marks=pytest.mark.slow), 6])
def test_the_rows_of_a_rig_that_has_drifted_agree_again(seed: int) -> None:
    """Its right camera has turned by 0.3 degrees, and its image has moved by 1.5 px."""
    rig = render_pair(seed, size=(240, 320))
    axis = np.random.default_rng(seed).normal(size=3)
    E, K_right = rig.E.numpy().copy(), rig.K_right.numpy().copy()
    E[:3, :3] = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(0.3)).as_matrix()
    K_right[1, 2] += 1.5
    drifted = render_pair(seed, size=(240, 320), E=E, K_right=K_right)
    right = drifted.right.image_01.float(), rig.K_right, np.linalg.inv(rig.E.numpy())
    views = posed_of(drifted.left.image_01.float(), rig.K_left, right)
    report = checked_views(views, measured=True).report
    assert report.status == "refined"
    assert report.residual_px[0] < 0.3 < 0.45 < report.residual_px_given[0]
    assert np.linalg.norm(report.E[0][:3, 3]) == pytest.approx(float(rig.E[0, 3]), rel=0.03)


@END_TO_END
def test_a_dense_match_holds_where_the_flow_from_its_place_leads_back(monkeypatch) -> None:
    """The flow leads 6 px to the right; back it leads from column 30 on."""
    there, back = (np.zeros((60, 80, 2), np.float32) for _ in range(2))
    there[..., 0], back[:, 30:, 0] = 6.0, -6.0
    flows = iter([there, back])
    monkeypatch.setattr(tracks_module, "_flow", lambda *_: next(flows))
    image = np.random.default_rng(0).integers(0, 255, (60, 80), np.uint8)
    v, u = np.mgrid[:60, :80].astype(np.float32)
    centres = np.stack(np.meshgrid(np.arange(5, 80, 10), np.arange(5, 60, 10)), -1).reshape(-1, 2)
    to_right = np.stack([u + 2.5, v], axis=-1)  # where the rough depth puts the pixels in the right view
    px, holds = _dense_matches(image, image, to_right, np.ones((60, 80), bool), centres)
    landed = centres[:, 0] + 6
    np.testing.assert_array_equal(holds, (landed >= 30) & (landed <= 79))
    np.testing.assert_allclose(px[holds], centres[holds] + [6.0 + 2.5, 0.0])


def test_the_mask_of_a_warped_image_moves_with_it():
    """A pixel is valid if all that it is made of is."""
    size = (60, 90)
    coefficients = np.zeros((10, 2))
    coefficients[0] = 3.0, 0.0
    displacement = Displacement(coefficients, size, 5.0, 3.0)
    valid = torch.ones(size, dtype=torch.bool)
    valid[:, 40:] = False
    found = refine._warp_mask(valid, displacement)
    assert found.dtype == torch.bool and found[:, :40].all() and not found[:, 45:].any()
    assert refine._warp_mask(None, displacement) is None
    content = torch.where(valid, 0.25, 1.0)[None]
    assert torch.allclose(warp_image(content, displacement)[0][found], torch.tensor(0.25), atol=0.01)
