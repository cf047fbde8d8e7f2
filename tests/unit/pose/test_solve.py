"""The solver of poses against numerical derivatives, the objective written out, and its symmetries."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin.pose import solve
from geodiff_plugin.pose.solve import (
    PosePrior,
    depth_spread,
    nearby_poses,
    regularized_poses,
    solve_poses,
    unconstrained_pose,
)
from geodiff_plugin.pose.tracks import (
    blocks,
    epipolar,
    median_residuals,
    project_tracks,
    solve_inverse_depth,
    split_residuals,
)
from tests.unit.pose.posed_scene import K_RIGHTS, POSES, make_scene, moved, pose, projected

#: Standard deviations that differ between views and between kinds of change.
PRIOR = PosePrior(np.array([0.8, 1.7]), rotation_rad=0.03, shift_fraction=0.2, length_fraction=0.07)


def angles_deg(found: np.ndarray, Ts: np.ndarray) -> np.ndarray:
    return np.degrees(Rotation.from_matrix(found[:, :3, :3] @ Ts[:, :3, :3].transpose(0, 2, 1)).magnitude())


def perturbed(Ts: np.ndarray, turn_deg: float, seed: int = 0) -> np.ndarray:
    steps = (
        np.radians(turn_deg)
        * np.random.default_rng(seed).normal(size=(len(Ts), 6))
        * [1, 1, 1, 0.3, 0.3, 0.3]
    )
    return np.stack([moved(T, step) for T, step in zip(Ts, steps, strict=True)])


@pytest.mark.parametrize("v", [0, 1])
def test_derivatives_by_a_step_of_the_camera_are_differences(v):
    scene = make_scene(40)
    T, K, w = scene.Ts[v], K_RIGHTS[v], scene.inverse_depth
    found = solve._jacobian(project_tracks(scene.tracks.rays, w, K, T), w)
    for axis, step in enumerate(1e-6 * np.eye(6)):
        np.testing.assert_allclose(solve._apply_step(T, 1e3 * step), moved(T, 1e3 * step), atol=1e-12)
        ahead, behind = (projected(scene.points, K, moved(T, way)) for way in (step, -step))
        np.testing.assert_allclose(found[..., axis], (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-4)


def prior_cost(scene, Ts, given, w, prior) -> float:
    """The cost of a change of poses, as the module states it."""
    total = 0.0
    for v, (T, before) in enumerate(zip(Ts, given, strict=True)):
        seen = scene.tracks.seen[v]
        points = (scene.tracks.rays / w[:, None])[seen]
        px, px_before = (projected(points, K_RIGHTS[v], P) for P in (T, before))
        total += ((px - px_before) ** 2).sum() / (seen.sum() * prior.displacement_px[v] ** 2)
        change = T @ np.linalg.inv(before)
        total += (Rotation.from_matrix(change[:3, :3]).magnitude() / prior.rotation_rad) ** 2
        length, longer = np.linalg.norm(before[:3, 3]), np.linalg.norm(T[:3, 3])
        total += (change[:3, 3] ** 2).sum() / (prior.shift_fraction * length) ** 2
        total += (np.log(longer / length) / prior.length_fraction) ** 2
    return total


def discontinuity(Ts: np.ndarray, step: np.ndarray) -> np.ndarray:
    return np.stack([moved(T, step[6 * v : 6 * v + 6]) for v, T in enumerate(Ts)])


def test_the_cost_of_the_prior_has_the_stated_value_slope_and_curvature():
    scene = make_scene(60, unseen=0.3)
    given, w = scene.Ts, scene.inverse_depth
    Ts = perturbed(given, 0.05)
    found = solve._prior_terms(scene.tracks, Ts, given, w, PRIOR)
    assert found.cost == pytest.approx(prior_cost(scene, Ts, given, w, PRIOR), rel=1e-6)
    slopes = []
    for step in 1e-5 * np.eye(12):
        ahead, behind = (prior_cost(scene, discontinuity(Ts, way), given, w, PRIOR) for way in (step, -step))
        slopes.append((ahead - behind) / 2e-5)
    # Half the slope, since the cost is a sum of squares.
    np.testing.assert_allclose(
        found.gradient, np.array(slopes) / 2, rtol=0.02, atol=0.02 * np.abs(slopes).max()
    )
    at_given = solve._prior_terms(scene.tracks, given, given, w, PRIOR)
    assert at_given.cost == pytest.approx(0.0, abs=1e-12)
    unseen = replace(scene.tracks, seen=np.zeros_like(scene.tracks.seen))
    alone = solve._prior_terms(unseen, given, given, w, PRIOR).normal.reshape(2, 6, 2, 6)
    for v in (0, 1):  # without tracks neither views nor rotation and centre depend on each other
        assert not alone[v, :, 1 - v].any() and not alone[v, :3, v, 3:].any()
        assert np.count_nonzero(alone[v, :3, v, :3]) == 3
    for step in 1e-4 * np.random.default_rng(0).normal(size=(8, 12)):
        cost = prior_cost(scene, discontinuity(given, step), given, w, PRIOR)
        assert step @ at_given.normal @ step == pytest.approx(cost, rel=0.02)


def data_cost(scene, Ts, scale_px: float) -> float:
    """Sum of ``log(1 + (r / scale)^2)`` at the inverse depth of each track that minimises it."""
    tracks = scene.tracks
    w = solve_inverse_depth(tracks, Ts)
    for _ in range(6 if len(Ts) > 1 else 0):
        weights = []
        for v, T in enumerate(Ts):
            off = projected(tracks.rays / w[:, None], tracks.K_rights[v], T) - tracks.right_px[v]
            weights.append(1.0 / (scale_px**2 + (off**2).sum(1)))
        w = solve_inverse_depth(tracks, Ts, np.stack(weights))
    total = 0.0
    for v, T in enumerate(Ts):
        off = projected(tracks.rays / w[:, None], tracks.K_rights[v], T) - tracks.right_px[v]
        total += np.log1p((off**2).sum(1) / scale_px**2)[tracks.seen[v]].sum()
    return total


@pytest.mark.parametrize("views", [1, 2])
@pytest.mark.parametrize("scale_px", [1.5, 1e3])
def test_residuals_and_their_derivatives_describe_the_cost_near_a_pose(views, scale_px):
    scene = make_scene(50, noise_px=0.4, poses=POSES[:views], unseen=0.3)
    Ts = perturbed(scene.Ts, 0.03)
    at = solve._whitened(scene.tracks, Ts, scale_px)
    assert at.cost == pytest.approx(data_cost(scene, Ts, scale_px), rel=0.015)
    slopes = []
    for step in 1e-5 * np.eye(6 * views):
        ahead, behind = (data_cost(scene, discontinuity(Ts, way), scale_px) for way in (step, -step))
        slopes.append((ahead - behind) / 2e-5)
    gradient = np.einsum("nkp,nk->p", at.left_by_pose, at.residuals)
    np.testing.assert_allclose(gradient, np.array(slopes) / 2, atol=0.02 * np.abs(slopes).max())
    # Of tracks without noise, a step moves inverse depth as predicted.
    clean = make_scene(80, poses=POSES[:views])
    exact = solve._whitened(clean.tracks, clean.Ts, 1e3)
    for step in 1e-5 * np.random.default_rng(0).normal(size=(3, 6 * views)):
        change = solve_inverse_depth(clean.tracks, discontinuity(clean.Ts, step)) - clean.inverse_depth
        np.testing.assert_allclose(-(exact.depth_by_pose @ step) / exact.slopes, change, atol=2e-7)


def test_depths_of_several_views_are_those_that_most_of_them_agree_on():
    """Not those of least squares, which one view with a wrong match moves."""
    scene = make_scene(120, noise_px=0.1, outliers=0.5)
    scale_px = 0.5
    at = solve._whitened(scene.tracks, scene.Ts, scale_px)
    plain = solve_inverse_depth(scene.tracks, scene.Ts)
    cost = 0.0
    for K, T, px in zip(K_RIGHTS, scene.Ts, scene.tracks.right_px, strict=True):
        off = projected(scene.tracks.rays / plain[:, None], K, T) - px
        cost += np.log1p((off**2).sum(1) / scale_px**2).sum()
    assert at.cost < 0.97 * cost


@pytest.mark.parametrize("views", [1, 2])
def test_solved_poses_are_a_minimum_of_the_stated_objective(views):
    scene = make_scene(70, noise_px=0.4, poses=POSES[:views], outliers=0.1, unseen=0.2)
    prior = replace(PRIOR, displacement_px=PRIOR.displacement_px[:views])
    given, trust, scale_px = perturbed(scene.Ts, 0.4), 0.6, 0.8
    w_start = np.clip(solve_inverse_depth(scene.tracks, given), 1e-9, None)

    def objective(Ts: np.ndarray) -> float:
        return trust * data_cost(scene, Ts, scale_px) + prior_cost(scene, Ts, given, w_start, prior)

    found = solve_poses(scene.tracks, given, prior, scale_px=scale_px, trust=trust)
    least = objective(found)
    assert least < objective(given) and least < objective(scene.Ts)
    for axis, way in itertools.product(range(6 * views), (1, -1)):
        size = 2e-3 if axis % 6 < 3 else 2e-3
        assert objective(discontinuity(found, way * size * np.eye(6 * views)[axis])) > least


def test_several_views_are_solved_alike_in_any_order_and_unit():
    scene = make_scene(120, noise_px=0.3, unseen=0.2)
    given, start = perturbed(scene.Ts, 0.4), perturbed(scene.Ts, 0.3, seed=2)
    found = solve_poses(scene.tracks, given, PRIOR, start=start)
    assert (angles_deg(found, scene.Ts) < 0.6 * angles_deg(given, scene.Ts)).all()
    flipped = replace(
        scene.tracks,
        right_px=scene.tracks.right_px[::-1],
        seen=scene.tracks.seen[::-1],
        K_rights=K_RIGHTS[::-1],
    )
    other = replace(PRIOR, displacement_px=PRIOR.displacement_px[::-1])
    again = solve_poses(flipped, given[::-1], other, start=start[::-1])
    np.testing.assert_allclose(again[::-1], found, atol=1e-4)
    feet = [T.copy() for T in (given, start)]
    for Ts in feet:
        Ts[:, :3, 3] *= 3.28
    in_feet = solve_poses(scene.tracks, feet[0], PRIOR, start=feet[1])
    np.testing.assert_allclose(in_feet[:, :3, :3], found[:, :3, :3], atol=1e-4)
    np.testing.assert_allclose(in_feet[:, :3, 3], 3.28 * found[:, :3, 3], atol=1e-3)


def recorded(monkeypatch, answer=None) -> list[dict]:
    """Every call of the solver from now on, in the order of its arguments."""
    calls, original = [], solve.solve_poses

    def solver(tracks, given, prior, *, start=None, scale_px=1.0, trust=1.0):
        calls.append({"given": given, "prior": prior, "start": start, "scale_px": scale_px, "trust": trust})
        solved = (
            answer
            if answer is not None
            else original(tracks, given, prior, start=start, scale_px=scale_px, trust=trust)
        )
        calls[-1]["solved"] = solved
        return solved

    monkeypatch.setattr(solve, "solve_poses", solver)
    return calls


def test_poses_near_the_given_ones_are_sought_from_far_and_then_from_near(monkeypatch):
    scene = make_scene(100, noise_px=0.3, outliers=0.1)
    given = perturbed(scene.Ts, 1.5)
    before = median_residuals(scene.tracks, given)
    assert before.max() > 3.0 > 0.0
    calls = recorded(monkeypatch)
    found = nearby_poses(scene.tracks, given, np.array([before[0], np.nan]))
    first, second = calls
    assert (first["scale_px"], second["scale_px"]) == (pytest.approx(max(before[0], 1.0)), 1.0)
    assert first["start"] is given and second["start"] is first["solved"] and found is second["solved"]
    for call in calls:
        assert call["given"] is given
        np.testing.assert_allclose(
            call["prior"].displacement_px, [1.5 * before[0] + 0.05, 1.55]
        )  # unknown counts as 1 px
    calls.clear()
    nearby_poses(scene.tracks, given, np.array([0.2, 0.4]))
    assert [call["scale_px"] for call in calls] == [1.0, 1.0]
    found = nearby_poses(scene.tracks, given, before)
    assert (angles_deg(found, scene.Ts) < 0.3 * angles_deg(given, scene.Ts)).all()


@pytest.mark.parametrize("rig", [False, True])
@pytest.mark.parametrize(("turn_deg", "shared_px"), [(1.2, 0.0), (0.05, 0.5)])
def test_poses_are_held_by_how_much_of_the_residual_they_explain(rig, turn_deg, shared_px, monkeypatch):
    scene, rng = make_scene(500, noise_px=0.2, seed=1), np.random.default_rng(0)
    tracks = scene.tracks
    common = shared_px * rng.normal(size=(2, blocks(tracks).max() + 1))[:, blocks(tracks)]
    normals = [epipolar(tracks.alone(v), T).normals for v, T in enumerate(scene.Ts)]
    tracks = replace(tracks, right_px=tracks.right_px + common[..., None] * np.stack(normals))
    given = perturbed(scene.Ts, turn_deg, seed=3)
    near = perturbed(scene.Ts, 0.5 * turn_deg, seed=4)
    before = median_residuals(tracks, given)
    calls = recorded(monkeypatch)
    found, fitted = regularized_poses(tracks, given, near, before, rig)
    free, *held = calls
    assert fitted is free["solved"] and found is held[-1]["solved"]
    assert free["start"] is near and free["scale_px"] == solve.SCALE_PX and free["trust"] == 1.0
    assert (free["prior"].displacement_px == solve.FREE_PX).all()
    assert (free["prior"].rotation_rad, free["prior"].length_fraction) == (PosePrior(0).rotation_rad, 0.02)
    left = np.maximum(median_residuals(tracks, fitted), 0.05)
    explained = np.sqrt(np.maximum(before**2 - left**2, 0.0))
    parts = [split_residuals(tracks.alone(v), T) for v, T in enumerate(fitted)]
    times = explained / (5.6 * np.maximum([part.faults_px for part in parts], 0.03))
    fraction = np.clip(times**4, 0.2, 40.0)
    wrong = not rig and (times > 1).any()
    assert (times > 1).any() == (turn_deg > 1)
    scales = np.maximum(np.mean(left) * np.array([2.0, 1.0, 0.5] if wrong else [2.0]), 0.1)
    assert [call["scale_px"] for call in held] == pytest.approx(scales)
    starts = [fitted, *(call["solved"] for call in held)]
    for call, start in zip(held, starts, strict=False):
        assert call["given"] is given and call["start"] is start
        assert call["trust"] == pytest.approx(0.5 * np.mean([part.trust for part in parts]))
        prior, expected = call["prior"], np.maximum(explained * (0.4 if rig else fraction), 0.05)
        np.testing.assert_allclose(prior.displacement_px, expected, rtol=1e-6)
        spreads = (np.radians(0.3), 0.01) if rig else (np.radians(1.5), 0.1)
        assert (prior.rotation_rad, prior.shift_fraction) == pytest.approx(spreads)
        assert prior.length_fraction == 0.05


def test_a_view_without_matches_keeps_its_pose_if_another_is_refined():
    scene = make_scene(120, noise_px=0.2)
    scene.tracks.seen[1] = False
    given = perturbed(scene.Ts, 0.8)
    before = median_residuals(scene.tracks, given)
    found, _ = regularized_poses(scene.tracks, given, given, before, False)
    assert angles_deg(found, scene.Ts)[0] < 0.15 < 0.5 < angles_deg(given, scene.Ts)[0]
    np.testing.assert_allclose(found[1], given[1], atol=1e-9)


@pytest.mark.parametrize("views", [1, 2])
def test_the_spread_of_depth_follows_noise_and_not_unit_or_order(views):
    scene = make_scene(400, poses=POSES[:views])
    noise = np.random.default_rng(0).normal(size=scene.tracks.right_px.shape)

    def spread(noise_px: float, factor: float = 1.0, order: int = 1, tracks=scene.tracks) -> float:
        Ts = scene.Ts.copy()
        Ts[:, :3, 3] *= factor
        tracks = replace(
            tracks,
            right_px=(scene.tracks.right_px + noise_px * noise)[::order],
            K_rights=tracks.K_rights[::order],
        )
        return depth_spread(tracks, Ts[::order])

    little = spread(0.02)
    assert spread(0.04) == pytest.approx(2 * little, rel=0.05)
    assert spread(0.02, factor=7.0) == pytest.approx(little, rel=0.02)
    assert spread(0.02, order=-1) == pytest.approx(little, rel=0.25)
    assert 1e-4 < little < 0.02
    behind = replace(scene.tracks, right_px=2 * K_RIGHTS[:views, None, :2, 2] - scene.tracks.right_px)
    turned = np.linalg.inv(pose((0, 0, 180.0), (0.3, 0.1, 0.0)))[None].repeat(views, 0)
    assert depth_spread(behind, turned) > 0.05


@pytest.mark.parametrize("views", [1, 2])
def test_the_spread_of_depth_is_the_sandwich_over_blocks_with_the_unit_held(views):
    """Solved with a Lagrange multiplier that holds the change of all baselines together at zero."""
    scene = make_scene(300, noise_px=0.2, poses=POSES[:views])
    scene.Ts[:, :3, 3] *= 3.0  # so that a metre is no baseline
    tracks = scene.tracks
    at = solve._whitened(tracks, scene.Ts, solve.SCALE_PX)
    lengths = np.tile(np.repeat([1.0, np.linalg.norm(scene.Ts[0, :3, 3])], 3), views)  # of a step's axes
    longer = np.concatenate([np.r_[np.zeros(3), T[:3, 3]] for T in scene.Ts]) / lengths
    J = at.left_by_pose * lengths
    normal = np.einsum("nkp,nkq->pq", J, J)
    held = np.block([[normal, longer[:, None]], [longer[None], np.zeros((1, 1))]])
    inverse = np.linalg.inv(held)[:-1, :-1]
    cells = np.floor(tracks.left_px / (2 * tracks.K_left[0, 2] / 10)) @ [1, 100]
    pulls = np.einsum("nkp,nk->np", J, at.residuals)
    sums = np.stack([pulls[cells == cell].sum(0) for cell in np.unique(cells)])
    covariance = inverse @ sums.T @ sums @ inverse
    front = at.inverse_depth > 0
    by_step = (at.depth_by_pose * lengths / (at.slopes * at.inverse_depth)[:, None])[front]
    variances = [row @ covariance @ row for row in by_step]
    assert depth_spread(tracks, scene.Ts) == pytest.approx(np.sqrt(np.median(variances)), rel=1e-3)


def test_a_spread_of_more_than_six_per_cent_is_reported_with_its_size():
    assert (
        unconstrained_pose(None) == () and unconstrained_pose(0.0599) == () and unconstrained_pose(0.06) == ()
    )
    (message,) = unconstrained_pose(0.0712)
    assert message.code == "estimate.unconstrained" and "7 %" in message
