"""The check of given poses: every field of its report, its decisions, and how images are straightened."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from geodiff_plugin._checks import InputError
from geodiff_plugin.messages import Message
from geodiff_plugin.pose import refine
from geodiff_plugin.pose.fit import PosedGreys, PoseFit
from geodiff_plugin.pose.lens import Remaining
from geodiff_plugin.pose.refine import (
    Displacement,
    depths_apart,
    fit_displacement,
    refine_views,
    refined_scale,
    report_as_given,
    straightened,
)
from geodiff_plugin.pose.tracks import Behind, epipolar, median_residuals, merge_tracks, solve_inverse_depth
from geodiff_plugin.types import CameraView, PosedViews, Tear
from tests.unit.pose.posed_scene import (
    K_LEFT,
    K_RIGHTS,
    POSES,
    SIZES,
    make_scene,
    moved,
    pose,
    projected,
)

TS = np.linalg.inv(POSES)
WRONG = np.stack(
    [moved(TS[0], np.radians([0.5, -0.4, 0.3, 0, 0, 0])), moved(TS[1], np.radians([-0.6, 0.3, 0.5, 0, 0, 0]))]
)
RIG = np.linalg.inv(np.stack([pose((0, 0, 0), (0.3, 0, 0)), pose((0, 0, 0), (-0.2, 0, 0))]))
K_RIG = (K_LEFT, np.stack([K_LEFT, K_LEFT]))


def inputs(tracks, given, images=None, is_rig=False):
    """The views of a scene with these poses, and how their matches fit."""
    images = images or [torch.zeros(3, 30, 28), torch.zeros(3, 21, 35)]
    Ks = [tracks.K_left, *tracks.K_rights]
    greys = [(np.zeros(size, np.uint8), K) for size, K in zip(SIZES, Ks, strict=False)]
    rights = tuple(
        CameraView(image, torch.from_numpy(K), torch.from_numpy(T).float())
        for image, K, T in zip(images, tracks.K_rights, given, strict=False)
    )
    posed = PosedViews(torch.zeros(3, 25, 32), rights, torch.from_numpy(K_LEFT))
    fit = PoseFit(PosedGreys(greys, given, [500, 600, 420]), tracks, median_residuals(tracks, given))
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
    return np.linalg.inv(np.stack([view.T_right_from_left.numpy() for view in views]))


@pytest.mark.parametrize("measured", [False, True])
def test_every_field_of_the_report_of_poses_that_fit_is_the_one_that_was_measured(measured, monkeypatch):
    scene = make_scene(120, noise_px=0.15, unseen=0.3)
    posed, fit = inputs(scene.tracks, TS)
    fit.greys.__dict__["signs"] = refine_signs = type("Signs", (), {"tear": Tear(1, 2, 3), "bars": 0.07})()
    asked = []
    shares = {1: 0.02, 2: 0.05}

    def moved_share(tracks, T):
        v = 0 if np.array_equal(T, TS[0]) else 1
        asked.append((len(tracks), v))
        return shares[v + 1]

    def distortion(tracks, T):
        asked.append((len(tracks), np.array_equal(T, TS[0])))
        return Remaining(0.021, 0.013, 0.04)

    def exchangeable(tracks, given, near, sizes):
        asked.append((given is near, list(sizes)))
        return 0.077

    monkeypatch.setattr(refine, "moved_share", moved_share)
    monkeypatch.setattr(refine, "behind_infinity", lambda tracks, Ts: Behind(0.011, 3.5))
    monkeypatch.setattr(refine, "remaining_distortion", distortion)
    monkeypatch.setattr(refine, "exchangeable", exchangeable)
    views, report = refine_views(posed, fit, measured)
    assert views is posed.views and report.status == "fits" and report.warnings == ()
    np.testing.assert_allclose(report.E_given, POSES, atol=1e-6)
    np.testing.assert_allclose(report.E, POSES, atol=1e-6)
    assert report.residual_px == report.residual_px_given == pytest.approx(tuple(fit.residual_px))
    counts = scene.tracks.seen.sum(1)
    assert report.matches == tuple(counts) and counts[0] != counts[1]
    assert report.straightened_px == () and report.depth_spread == 0.0
    assert report.scale_spread == (None if measured else 0.05)
    assert (report.behind_infinity, report.behind_px) == (0.011, 3.5)
    assert (report.distortion, report.distortion_alone) == (0.021, 0.013)
    assert (report.exchangeable, report.moved) == (0.077, 0.05)
    assert (report.tear, report.bars) == (refine_signs.tear, 0.07)
    assert asked == [(counts[0], 0), (counts[1], 1), (counts[0], True), (True, list(SIZES))]
    for both, worst in (((0.06, math.nan), 0.06), ((math.nan, 0.01), 0.01)):
        shares.update({1: both[0], 2: both[1]})
        assert refine_views(posed, fit).report.moved == worst
    shares.update({1: math.nan, 2: math.nan})
    assert math.isnan(refine_views(posed, fit).report.moved)


def test_a_report_of_poses_as_given_has_nothing_measured():
    rights = tuple(CameraView(torch.zeros(3, 4, 5), torch.eye(3), torch.from_numpy(T)) for T in TS)
    report = report_as_given(rights)
    assert report.status == "given" and report.residual_px == () and math.isnan(report.behind_infinity)
    np.testing.assert_allclose(report.E, POSES)
    np.testing.assert_allclose(report.E_given, POSES)
    assert report_as_given(rights, "fits").status == "fits"


USUAL = {"moved": 0.07, "share": 0.019, "at_most": 0.079, "exchangeable": 0.149}


@pytest.mark.parametrize(
    ("change", "usual"),
    [
        ({}, True),
        ({"moved": 0.08}, False),
        ({"moved": math.nan}, False),
        ({"share": 0.021}, False),
        ({"share": math.nan}, False),
        ({"at_most": 0.081}, False),
        ({"at_most": math.nan}, False),
        ({"exchangeable": 0.151}, False),
        ({"exchangeable": math.nan}, False),
    ],
)
def test_signs_of_small_images_are_usual_if_each_is_known_and_small(change, usual):
    values = USUAL | change
    behind, distortion = Behind(values["share"], 90.0), Remaining(0.5, 0.5, values["at_most"])
    signs = refine._Signs(values["moved"], behind, distortion, values["exchangeable"], ())
    assert signs.are_usual is usual
    assert not signs._replace(mistakes=(Message("pose.mixed", "Wrong."),)).are_usual


@pytest.mark.parametrize("measured", [False, True])
def test_poses_that_do_not_fit_are_refined_with_all_matches_of_all_views(measured, monkeypatch):
    sparse = make_scene(100, noise_px=0.15, outliers=0.05, unseen=0.2)
    dense = make_scene(150, noise_px=0.15, outliers=0.05, seed=5).tracks
    asked = with_dense(monkeypatch, dense)
    posed, fit = inputs(sparse.tracks, WRONG)
    assert (fit.residual_px > 1.0).all()
    views, report = refine_views(posed, fit, measured)
    tracks = merge_tracks([sparse.tracks, dense])
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
        assert views[v].image_01 is posed.views[v].image_01 and views[v].K is posed.views[v].K
    assert report.straightened_px == (0.0, 0.0)
    lengths = np.linalg.norm(used[:, :3, 3], axis=1) / np.linalg.norm(WRONG[:, :3, 3], axis=1)
    if measured:
        assert report.scale_spread is None
        np.testing.assert_allclose(lengths, 1.0, atol=0.02)
    else:
        assert 0.04 < report.scale_spread < 0.2
        assert lengths[0] == pytest.approx(lengths[1], rel=0.02)
    assert 0.0 <= report.depth_spread < 0.1
    (message,) = report.warnings
    worst = int(np.argmax(before))
    assert message.code == "pose.refined"
    assert f"right view {worst + 1} as given leaves matches {before[worst]:.1f} px" in message
    (first_posed, size), (_, depth, near) = asked
    assert depth == "depth" and size == SIZES[0]
    np.testing.assert_allclose(poses_in_use(first_posed.views), np.linalg.inv(near), atol=1e-5)
    assert not np.allclose(near, WRONG, atol=1e-3)


def misfit_of(scene, given=WRONG, **how):
    posed, fit = inputs(scene.tracks, given)
    how = {"rig": False, "measured": True, "fits_px": 0.3} | how
    sizes = [SIZES[1], SIZES[2]]
    misfit = refine._Misfit(posed.views, sizes, scene.tracks, given, given, **how)
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
    monkeypatch.setattr(refine, "regularised_poses", lambda *_: (TS, TS))
    if shift:  # along its lines such a shift is not seen, so that residuals are made up
        residuals = iter([np.array([1.5, 1.2]), np.array([0.1, 0.2])])
        monkeypatch.setattr(refine, "median_residuals", lambda *_: next(residuals))
        monkeypatch.setattr(
            refine, "_straightened_views", lambda misfit, report, before, Ts: (misfit.rights, report)
        )
    views, found = refine._refined(misfit, report)
    assert found.status == status
    if status == "kept":
        (message,) = found.warnings
        assert views is misfit.rights and message.code == "pose.too-far"
        assert f"A pose {turn_deg:.0f} degrees and {100 * shift:.0f} % of the baseline away" in message
        assert f"right view {v + 1} as given" in message


def test_of_several_poses_that_are_too_far_the_worst_one_is_named(monkeypatch):
    scene = make_scene(60)
    given = np.stack([moved(T, np.radians([9.0 + v, 0, 0, 0, 0, 0])) for v, T in enumerate(TS)])
    for before, v in (((1.5, 1.2), 0), ((1.2, 1.5), 1)):
        misfit, report = misfit_of(scene, given)
        residuals = iter([np.array(before), np.array(before[::-1]) / 10])
        monkeypatch.setattr(refine, "median_residuals", lambda *_, left=residuals: next(left))
        monkeypatch.setattr(refine, "regularised_poses", lambda *_: (TS, TS))
        (message,) = refine._refined(misfit, report)[1].warnings
        assert f"right view {v + 1} as given leaves matches 1.5 px" in message
        assert f"A pose {9 + v} degrees" in message and "fits to 0.1 px" in message


def test_a_pose_is_kept_unless_another_one_leaves_a_tenth_less(monkeypatch):
    scene = make_scene(150)
    for after, status in (((1.8, 1.78), "refined"), ((1.8, 1.82), "kept")):
        misfit, report = misfit_of(scene)
        residuals = iter([np.array([1.4, 2.6]), np.array(after)])
        monkeypatch.setattr(refine, "median_residuals", lambda *_, left=residuals: next(left))
        monkeypatch.setattr(refine, "regularised_poses", lambda *_: (TS, TS))
        monkeypatch.setattr(
            refine, "_straightened_views", lambda misfit, report, before, Ts: (misfit.rights, report)
        )
        _, found = refine._refined(misfit, report)
        assert found.status == status and found.residual_px_given == (1.4, 2.6)
        assert found.matches == (150.0, 150.0)
        (message,) = found.warnings
        assert "right view 2 as given leaves matches 2.6 px" in message
        if status == "refined":
            assert "a refined one 1.8 px" in message


@pytest.mark.parametrize("rig", [False, True])
def test_depths_of_another_pose_that_fits_as_well_are_reported_unless_a_calibration_decides(rig, monkeypatch):
    scene = make_scene(150, unseen=0.2)
    misfit, report = misfit_of(scene, rig=rig)
    other = TS.copy()
    other[:, :3, 3] *= 1.3
    monkeypatch.setattr(refine, "regularised_poses", lambda *_: (TS, other))
    _, found = refine._refined(misfit, report)
    assert found.depth_spread == (0.0 if rig else pytest.approx(math.log(1.3), rel=1e-6))
    codes = [message.code for message in found.warnings]
    assert codes == (["pose.refined"] if rig else ["pose.refined", "pose.undetermined"])
    if not rig:
        assert "differ by 30 %" in found.warnings[1]


def test_depths_apart_are_the_median_ratio_of_those_in_front_under_both_poses():
    scene = make_scene(80, unseen=0.3)
    other = np.stack([moved(T, np.r_[np.radians([0.4, 0.3, 0.1]), 0.03, 0, 0.01]) for T in TS])
    a, b = (solve_inverse_depth(scene.tracks, Ts) for Ts in (TS, other))
    front = (a > 0) & (b > 0)
    expected = np.median(np.abs(np.log(a[front]) - np.log(b[front])))
    assert expected > 0.01
    assert depths_apart(scene.tracks, TS, other) == pytest.approx(expected)
    behind = TS.copy()
    behind[:, :3, 3] *= -1
    assert depths_apart(scene.tracks, TS, behind) == 0.0


@pytest.mark.parametrize("misfit", [0.0, 0.08])
def test_a_refined_scale_is_the_mean_of_two_estimates_weighted_by_their_variances(misfit):
    rng = np.random.default_rng(0)
    given = rng.uniform(0.1, 0.5, 201)
    ratios = np.exp(0.12 + rng.normal(0, 0.06, 201))
    refined = given * ratios
    refined[:40] *= -1  # behind the camera: says nothing
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
    assert found.most_px == pytest.approx(np.quantile(lengths, 0.98))
    at = np.linalg.norm(found.at(px), axis=1)
    np.testing.assert_allclose(at, np.minimum(lengths, found.most_px), atol=1e-9)


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
    # Both halves show a displacement, and opposite ones: what one says is wrong in the other.
    torn = tracks.right_px - np.where(even[:, None], 1.0, -1.0) * bend(tracks.right_px[0], size)
    assert fit_displacement(replace(tracks, right_px=torn), T, size) is None


@pytest.mark.parametrize("factors", [(1.0, 1.0), (2.0, 0.5), (0.5, 1.5)])
def test_an_image_of_another_size_is_straightened_by_the_scaled_displacement(factors):
    """Its values are its pixels, so that the result shows where each came from."""
    size = (60, 90)
    coefficients = np.zeros((10, 2))
    coefficients[:4] = [[1.5, -0.8], [0.6, 1.0], [-0.5, 0.4], [0.3, 0.2]]
    displacement = Displacement(coefficients, size, 1.9, 1.0)
    height, width = round(60 * factors[1]), round(90 * factors[0])
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    image = torch.stack([u, v, u + v]).float() / 300
    found = 300 * straightened(image, displacement).numpy()
    assert found.dtype == np.float32 and found.shape == (3, height, width)
    px = np.array([[width // 2, height // 3], [width // 3, height // 2]], float)
    on_grid = (px + 0.5) / np.array(factors) - 0.5
    source = px - displacement.at(on_grid) * np.array(factors)
    assert np.abs(displacement.at(on_grid)).min() > 0.1
    for (x, y), (from_x, from_y) in zip(px.astype(int), source, strict=True):
        assert found[:, y, x] == pytest.approx([from_x, from_y, from_x + from_y], abs=0.1)
    grey = straightened(image[:1], displacement)
    assert grey.shape == (1, height, width) and torch.allclose(
        300 * grey[0], torch.from_numpy(found[0]), atol=1e-3
    )


def test_only_images_of_views_that_did_not_fit_are_straightened(monkeypatch):
    scene = make_scene(500, noise_px=0.05)
    right_px = scene.tracks.right_px - np.stack(
        [bend(px, s) for px, s in zip(scene.tracks.right_px, SIZES[1:], strict=True)]
    )
    scene.tracks = replace(scene.tracks, right_px=right_px)
    images = [torch.rand(3, 60, 56), torch.rand(3, 42, 70)]
    posed, _ = inputs(scene.tracks, TS, images)
    monkeypatch.setattr(
        refine, "behind_infinity", lambda tracks, Ts: Behind(0.02, 4.0) if Ts is TS else Behind(0.5, 9.0)
    )
    misfit = refine._Misfit(
        posed.views, SIZES[1:], scene.tracks, WRONG, WRONG, fits_px=0.3, rig=False, measured=True
    )
    _, report = misfit_of(scene)
    for v, before in ((0, [0.31, 0.29]), (1, [0.29, 0.31])):
        views, found = refine._straightened_views(misfit, report, np.array(before), TS)
        other = 1 - v
        displacement = fit_displacement(scene.tracks.alone(v), TS[v], SIZES[v + 1])
        assert (
            found.straightened_px[v] == pytest.approx(displacement.rms_px)
            and found.straightened_px[other] == 0.0
        )
        assert views[other].image_01 is images[other]
        assert torch.equal(views[v].image_01, straightened(images[v], displacement))
        as_they_are = median_residuals(scene.tracks, TS)
        assert found.residual_px[other] == pytest.approx(as_they_are[other])
        assert found.residual_px[v] < 0.3 * as_they_are[v]
        np.testing.assert_allclose(found.E, POSES, atol=1e-9)
        assert (found.behind_infinity, found.behind_px) == (0.02, 4.0)


def test_a_mistaken_pose_is_named_once_and_left_as_it_is(monkeypatch):
    scene = make_scene(100, noise_px=0.15)
    inverse = np.linalg.inv(TS)
    posed, fit = inputs(scene.tracks, inverse)
    views, report = refine_views(posed, fit)
    assert views is posed.views and report.status == "mistaken"
    assert [message.code for message in report.warnings] == ["pose.inverse"]
    assert report.residual_px == report.residual_px_given
    few = replace(scene.tracks, seen=scene.tracks.seen & (np.arange(100) < [[100], [39]]))
    asked = []
    assert refine._messages(few, lambda *view: asked.append(view), inverse, TS) == ()
    ((tracks, first, second),) = asked
    assert len(tracks) == 100 and np.array_equal(first, inverse[0]) and np.array_equal(second, TS[0])


@pytest.mark.parametrize(("dense_px", "status"), [(0.44, "fits"), (0.9, "refined")])
def test_a_rig_is_refined_only_if_its_dense_matches_miss_it_too(dense_px, status, monkeypatch):
    def lifted(seed: int, count: int, by_px: float):
        scene = make_scene(count, noise_px=0.02, poses=np.linalg.inv(RIG), Ks=K_RIG, seed=seed)
        return replace(scene.tracks, right_px=scene.tracks.right_px + [0.0, by_px])

    sparse, dense = lifted(0, 50, 0.9), lifted(1, 200, dense_px)
    with_dense(monkeypatch, dense)
    posed, fit = inputs(sparse, RIG, is_rig=True)
    assert not fit.fits
    views, report = refine_views(posed, fit)
    by_all = median_residuals(merge_tracks([sparse, dense]), RIG)
    assert report.status == status and report.residual_px_given == pytest.approx(tuple(by_all), rel=1e-4)
    assert report.matches == (250.0, 250.0) and report.scale_spread is None
    assert (views is posed.views) is (status == "fits")
    lengths = [np.linalg.norm(E[:3, 3]) for E in report.E]
    assert lengths == pytest.approx([0.3, 0.2], rel=0.02)


@pytest.mark.parametrize(
    ("given", "dense_count", "overlaps", "status", "codes"),
    [
        (TS, 100, True, "fits", []),
        (WRONG, 100, True, "refined", ["pose.refined", "pose.few-matches"]),
        (WRONG, 10, True, "not checked", []),
        (WRONG, 100, False, "not checked", []),
    ],
)
@pytest.mark.parametrize("measured", [False, True])
def test_where_few_features_match_flow_is_asked_about_the_poses_as_given(
    given, dense_count, overlaps, status, codes, measured, monkeypatch
):
    sparse = make_scene(12, noise_px=0.1).tracks
    sparse.seen[1, 5:] = False
    dense = make_scene(dense_count, noise_px=0.1, seed=4).tracks
    asked = with_dense(monkeypatch, dense)
    if not overlaps:

        def refuse(*_):
            raise InputError("The views do not overlap.")

        monkeypatch.setattr(refine, "coarse_depth", refuse)
    posed, fit = inputs(sparse, given)
    views, report = refine_views(posed, fit, measured)
    assert report.status == status and [message.code for message in report.warnings] == codes
    assert (views is posed.views) is (status != "refined")
    count = dense_count if overlaps else 0
    assert report.matches == (12.0 + count, 5.0 + count)
    tracks = merge_tracks([sparse, dense]) if overlaps else sparse
    before = median_residuals(tracks, given)
    np.testing.assert_allclose(report.residual_px_given, before, rtol=1e-4)
    if status != "refined":
        np.testing.assert_allclose(report.residual_px, before, rtol=1e-4)
        assert report.scale_spread == (None if measured else 0.05)
    else:
        assert (report.scale_spread is None) is measured
        assert "12 features match where 40 are needed" in report.warnings[-1]
        assert f"lie {before.max():.1f} px off" in report.warnings[-1]
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
    views, report = refine_views(posed, fit, measured=True)
    assert report.status == status and report.matches == (112.0, 0.0)
    assert math.isnan(report.residual_px_given[1]) and math.isnan(report.residual_px[1])
    assert report.residual_px[0] < 0.25
    np.testing.assert_allclose(views[1].T_right_from_left.numpy(), given[1], atol=1e-5)


def test_a_rig_is_not_changed_for_what_flow_alone_shows(monkeypatch):
    scene = make_scene(10, poses=np.linalg.inv(RIG), Ks=K_RIG)
    dense = make_scene(200, noise_px=0.02, poses=np.linalg.inv(RIG), Ks=K_RIG, seed=1).tracks
    for by_px, status in ((0.44, "fits"), (0.46, "not checked")):
        with_dense(monkeypatch, replace(dense, right_px=dense.right_px + [0.0, by_px]))
        posed, fit = inputs(scene.tracks, RIG, is_rig=True)
        views, report = refine_views(posed, fit)
        assert report.status == status and views is posed.views and report.warnings == ()


@pytest.mark.parametrize(
    ("before", "rig", "said", "drift"),
    [
        ((0.9, 0.4), False, False, None),
        ((1.1, 0.4), False, True, False),
        ((0.44, 0.4), True, False, None),
        ((0.46, 0.4), True, True, True),
        ((1.1, np.nan), True, True, False),
    ],
)
def test_a_misfit_is_reported_above_a_pixel_and_for_a_rig_above_its_limit(before, rig, said, drift):
    before, after = np.array(before), np.array([0.21, 0.32])
    messages = refine._refined_misfit(before, after, 0, rig)
    assert bool(messages) is said
    if said:
        assert f"right view 1 as given leaves matches {before[0]:.1f} px" in messages[0]
        assert "a refined one 0.2 px" in messages[0] and ("drifted since" in messages[0]) is drift
    assert bool(refine._kept_misfit(before, 0)) is bool(np.nanmax(before) > 1.0)
    assert bool(refine._too_far(before, after, 0, 9.0, 0.2)) is bool(np.nanmax(before) > 1.0)
    alone = refine._misses(np.array([1.26]), 0)
    assert alone.startswith("The pose as given leaves matches 1.3 px")
    assert refine._misses(np.array([1.26, 3.0]), 1).startswith(
        "The pose of right view 2 as given leaves matches 3.0"
    )


def test_small_images_with_an_unusual_sign_are_followed_by_whole_ones(monkeypatch):
    scene, whole = make_scene(60, noise_px=0.02), make_scene(150, noise_px=0.02)
    posed, fit = inputs(scene.tracks, TS)
    small = replace(fit, is_small=True, surely=True)
    asked = []

    def of_whole(self):
        asked.append(self)
        return replace(inputs(whole.tracks, TS)[1], surely=self.surely)

    monkeypatch.setattr(PoseFit, "of_whole_pictures", of_whole)
    usual = refine._Signs(0.0, Behind(0.0, 0.0), Remaining(0.0, 0.0, 0.01), 0.1, ())
    for signs, count in ((usual, 60.0), (usual._replace(moved=0.2), 150.0)):
        monkeypatch.setattr(refine, "_signs_of", lambda *_, found=signs: found)
        assert refine_views(posed, small, measured=True).report.matches == (count, count)
    assert len(asked) == 1
