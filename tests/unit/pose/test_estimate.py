"""Estimated poses of cameras that differ, their scale from known lengths, and what is refused or reported."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import InputError
from geodiff_plugin.pose import estimate
from geodiff_plugin.pose.estimate import (
    EstimatedPose,
    Scale,
    estimate_pose,
    estimate_poses,
    find_scale,
    polished,
)
from geodiff_plugin.pose.tracks import Tracks, epipolar, solve_inverse_depth
from tests.unit.pose.posed_scene import (
    K_LEFT,
    K_RIGHTS,
    POSES,
    make_scene,
    moved,
    off_lines,
    pose,
    projected,
)

pytest.importorskip("poselib")
VIEWS = pytest.mark.parametrize("v", [0, 1])
TS = np.linalg.inv(POSES)
LENGTHS = np.linalg.norm(POSES[:, :3, 3], axis=1)


def in_baselines(Ts: np.ndarray) -> np.ndarray:
    """The poses in units of the first baseline."""
    out = Ts.copy()
    out[:, :3, 3] /= np.linalg.norm(Ts[0, :3, 3])
    return out


def angle_deg(R: np.ndarray) -> float:
    return float(np.degrees(Rotation.from_matrix(R).magnitude()))


def parallax_deg(points: np.ndarray, E: np.ndarray) -> np.ndarray:
    """Angles at the points between the directions to both cameras."""
    to_left, to_right = -points, E[:3, 3] - points
    cosines = (to_left * to_right).sum(1) / np.linalg.norm(to_left, axis=1) / np.linalg.norm(to_right, axis=1)
    return np.degrees(np.arccos(cosines))


@VIEWS
def test_a_pose_between_cameras_that_differ_is_found_with_what_it_explains(v):
    skewed = (K_LEFT + [[0, 9.0, 0], [0, 0, 0], [0, 0, 0]], K_RIGHTS + [[0, -12.0, 0], [0, 0, 0], [0, 0, 0]])
    scene = make_scene(200, noise_px=0.2, outliers=0.1, Ks=skewed)
    tracks = scene.tracks.alone(v)
    np.testing.assert_allclose(estimate._parallax_deg(tracks.kept(slice(0)), np.eye(3)), [])
    clean = make_scene(40, Ks=skewed)
    found_deg = estimate._parallax_deg(clean.tracks.alone(v), TS[v, :3, :3])
    np.testing.assert_allclose(found_deg, parallax_deg(clean.points, POSES[v]), rtol=1e-6)
    found = estimate_pose(tracks)
    assert angle_deg(found.T[:3, :3] @ TS[v, :3, :3].T) < 0.15
    direction = TS[v, :3, 3] / LENGTHS[v]
    assert np.linalg.norm(found.T[:3, 3] - direction) < 0.03
    assert np.linalg.norm(found.T[:3, 3]) == pytest.approx(1.0) and found.T[3].tolist() == [0, 0, 0, 1]
    off = off_lines(tracks.left_px, tracks.right_px[0], *skewed[:1], skewed[1][v], found.T)
    front = solve_inverse_depth(tracks, found.T[None]) > 0
    np.testing.assert_array_equal(found.inliers, (off < 2.0) & front)
    assert 0.85 < found.inliers.mean() < 0.97
    assert found.residual_px == pytest.approx(np.median(off[found.inliers]))
    expected = np.median(parallax_deg(scene.points, POSES[v])[found.inliers])
    assert found.parallax_deg == pytest.approx(expected, rel=0.02)
    assert not found.rectified and found.warnings == ()


def test_poselib_gets_both_cameras_and_pixels_without_their_skew(monkeypatch):
    skewed = (K_LEFT + [[0, 9.0, 0], [0, 0, 0], [0, 0, 0]], K_RIGHTS + [[0, -12.0, 0], [0, 0, 0], [0, 0, 0]])
    tracks = make_scene(20, Ks=skewed).tracks.alone(1)
    asked = []

    class PoseLib:
        @staticmethod
        def estimate_relative_pose(left, right, K_left, K_right, options, bundle):
            asked.append(((left, K_left, options), (right, K_right, options)))
            return type("Pose", (), {"Rt": 3.0 * TS[1, :3]})(), {}

    monkeypatch.setattr(estimate.importlib, "import_module", lambda name: PoseLib)
    found = estimate._five_points(tracks)
    np.testing.assert_allclose(found[:3, 3], TS[1, :3, 3] / LENGTHS[1])
    (both,) = asked
    for (px, given, options), K, seen, size in zip(
        both,
        (skewed[0], skewed[1][1]),
        (tracks.left_px, tracks.right_px[0]),
        ((621, 516), (723, 405)),
        strict=True,
    ):
        assert (given["width"], given["height"]) == size and given["model"] == "PINHOLE"
        assert given["params"] == [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        fx, fy, cx, cy = given["params"]
        rays = np.c_[(px[:, 0] - cx) / fx, (px[:, 1] - cy) / fy, np.ones(20)]
        np.testing.assert_allclose(rays, np.linalg.solve(K, np.c_[seen, np.ones(20)].T).T, atol=1e-12)
        assert options == {"max_epipolar_error": 1.0, "seed": 0, "min_iterations": 1000}
    monkeypatch.setattr(estimate.importlib, "import_module", lambda name: __import__("no_such_module"))
    with pytest.raises(InputError, match=r"PoseLib must be installed.*; got no module poselib\. pip install"):
        estimate._five_points(tracks)


@pytest.mark.parametrize("x", [0.2, -0.2])
@pytest.mark.parametrize(("by_px", "rectified"), [(0.4, True), (0.55, False)])
def test_a_rectified_pair_has_its_right_camera_at_either_side(x, by_px, rectified):
    """Rows that agree by less than 0.45 px in the median; both cameras have the same K."""
    scene = make_scene(250, poses=pose((0, 0, 0), (x, 0, 0))[None], Ks=(K_LEFT, K_LEFT[None]))
    off = np.array([0.0, by_px]) * np.resize([1, -1], 250)[:, None]
    tracks = replace(scene.tracks, right_px=scene.tracks.right_px + off)
    found = estimate_pose(tracks)
    assert found.rectified is rectified
    if rectified:
        expected = np.eye(4)
        expected[0, 3] = -np.sign(x)
        np.testing.assert_array_equal(found.T, expected)
        assert found.residual_px == pytest.approx(by_px)
        assert not estimate._rectified(tracks, np.arange(250) < 29)
        assert estimate._rectified(tracks, np.arange(250) < 30) is not None
    few_behind = tracks.right_px.copy()
    for count, fits in ((24, True), (26, False)):  # a tenth of the matches may be behind the cameras
        few_behind[0, :count, 0] = tracks.left_px[:count, 0] + np.sign(x) * 5.0
        made = estimate._rectified(replace(tracks, right_px=few_behind), np.ones(250, bool))
        if by_px < 0.45:
            assert (made is not None) is fits


def test_a_camera_that_only_turned_is_refused_and_its_residuals_are_those_of_a_rotation():
    turned = np.linalg.inv(pose((3.0, -6.0, 4.0), (0.0, 0.0, 0.0)))
    scene = make_scene(200, poses=np.linalg.inv(turned)[None], Ks=(K_LEFT, K_RIGHTS[:1]))
    off = np.zeros((200, 2))
    off[:60] = np.random.default_rng(0).uniform(5, 40, (60, 2))
    tracks = replace(scene.tracks, right_px=scene.tracks.right_px + off)
    found = estimate._rotation_residuals(tracks)
    np.testing.assert_allclose(found, np.linalg.norm(off, axis=1), atol=1.0)
    near = np.ones(200, bool)
    estimate._check_parallax(tracks, near, 0.5, "the images")  # 70 % are not enough
    for count, parallax, refused in (
        (182, 0.5, True),
        (178, 0.5, False),
        (150, 0.31, False),
        (150, 0.29, True),
    ):
        few = np.zeros((200, 2))
        few[count:] = np.random.default_rng(1).uniform(20, 90, (200 - count, 2))
        few[count::2] *= -1
        tracks = replace(scene.tracks, right_px=scene.tracks.right_px + few)
        if refused:
            turned = f"got a camera that only turned .{count / 2:.0f}% of matches say so"
            with pytest.raises(InputError, match=f"{turned}, parallax {parallax:.2f} degrees"):
                estimate._check_parallax(tracks, near, parallax, "the images")
        else:
            estimate._check_parallax(tracks, near, parallax, "the images")
    only = np.arange(200) < 60  # of those near the pose; here all are
    with pytest.raises(InputError, match="got a camera that only turned .100% of matches"):
        estimate._check_parallax(scene.tracks, only, 5.0, "the images")


@pytest.mark.parametrize(("count", "wrong", "enough"), [(29, 0, False), (100, 70, True), (100, 71, False)])
def test_thirty_matches_and_three_tenths_of_them_make_a_pose(count, wrong, enough, monkeypatch):
    scene = make_scene(count)
    tracks = scene.tracks.alone(0)
    monkeypatch.setattr(estimate, "_five_points", lambda _: in_baselines(TS[:1])[0])
    monkeypatch.setattr(estimate, "_of_second_motion", lambda *_: [])
    right_px = tracks.right_px.copy()
    right_px[0, :wrong] += 50.0 * epipolar(tracks, TS[0]).normals[:wrong]
    if enough:
        assert estimate_pose(replace(tracks, right_px=right_px)).inliers.sum() == pytest.approx(
            count - wrong, abs=4
        )
    else:
        with pytest.raises(
            InputError,
            match=r"got 29\. " if count < 30 else r"got \d+ matches of 100 that one pose explains\. ",
        ):
            estimate_pose(replace(tracks, right_px=right_px))
    # Behind the cameras no match counts.
    back = in_baselines(TS[:1])[0]
    back[:3, 3] *= -1
    monkeypatch.setattr(estimate, "_five_points", lambda _: back)
    if count > 30:
        with pytest.raises(InputError, match="got 0 matches of 100"):
            estimate_pose(tracks)


@pytest.mark.parametrize("sideways_m", [0.04, 0.07])
def test_little_parallax_is_reported_with_its_angle(sideways_m):
    scene = make_scene(
        300, noise_px=0.05, poses=pose((1.0, -2.0, 0.5), (sideways_m, 0.3 * sideways_m, 0.0))[None]
    )
    found = estimate_pose(scene.tracks, "these two")
    truth = np.median(parallax_deg(scene.points, np.linalg.inv(scene.Ts[0])))
    codes = {message.code: str(message) for message in found.warnings}
    assert bool(0.3 < truth < 0.6) is (sideways_m < 0.05)
    assert ("estimate.parallax" in codes) is (sideways_m < 0.05)
    if truth < 0.6:
        assert "between these two is" in codes["estimate.parallax"]
        assert f"{found.parallax_deg:.2f} degrees" in codes["estimate.parallax"]
    assert found.parallax_deg == pytest.approx(truth, rel=0.15)


def second_motion(share: float, count: int = 300, wild: int = 0, noise_px: float = 0.1) -> Tracks:
    """A fraction of the tracks as another pose has them, and some that no pose explains."""
    scene = make_scene(count, noise_px=noise_px)
    tracks = scene.tracks.alone(0)
    other = moved(scene.Ts[0], np.r_[np.radians([4.0, -6.0, 9.0]), 0.1, 0.3, -0.1])
    right_px = tracks.right_px.copy()
    apart = np.arange(count) < round(share * count)
    right_px[0, apart] = projected(scene.points, K_RIGHTS[0], other)[apart]
    end = round(share * count) + wild
    right_px[0, round(share * count) : end] += np.random.default_rng(1).uniform(-150, 150, (wild, 2))
    return replace(tracks, right_px=right_px)


@pytest.mark.parametrize(
    ("share", "wild", "inliers", "outcome"),
    [
        (0.0, 0, 300, None),
        (0.09, 0, 300, None),  # 27 matches are less than 30
        (0.12, 0, 300, "reported"),
        (0.12, 60, 300, None),  # less than half of what the first motion leaves
        (0.2, 0, 300, "reported"),
        (0.2, 0, 100, "refused"),  # more than 0.45 of the first motion's matches
        (0.2, 0, 150, "reported"),
    ],
)
def test_a_second_motion_is_reported_or_refused_by_how_many_matches_follow_it(share, wild, inliers, outcome):
    tracks = second_motion(share, wild=wild)
    mask = np.arange(300) < inliers
    if outcome == "refused":
        with pytest.raises(InputError, match=r"got two motions, of 100 and (5\d|60) of its 300 matches"):
            estimate._of_second_motion(tracks, in_baselines(TS)[0], mask, "these")
        return
    found = estimate._of_second_motion(tracks, in_baselines(TS)[0], mask, "these")
    assert [message.code for message in found] == (["estimate.second-motion"] if outcome else [])
    if outcome:
        percent = round(100 * share)
        assert any(
            f"{each} % of the matches of these" in found[0] for each in (percent - 1, percent, percent + 1)
        )


def test_one_tenth_of_many_matches_has_to_follow_a_second_motion():
    for share, reported in ((0.085, False), (0.12, True)):
        tracks = second_motion(share, count=600)
        found = estimate._of_second_motion(tracks, in_baselines(TS)[0], np.ones(600, bool), "these")
        assert bool(found) is reported  # 51 and 72 of 600 matches


@pytest.mark.parametrize(("depth", "flat"), [(0.0, True), (1.5, False)])
def test_matches_on_one_plane_are_reported(depth, flat):
    rng = np.random.default_rng(0)
    scene = make_scene(300)
    z = 4.0 + depth * rng.uniform(-1, 1, 300)
    points = scene.tracks.rays * z[:, None]
    right_px = projected(points, K_RIGHTS[0], TS[0]) + 0.1 * rng.normal(size=(300, 2))
    found = estimate_pose(replace(scene.tracks.alone(0), right_px=right_px[None]))
    assert ("estimate.plane" in [message.code for message in found.warnings]) is flat


def test_several_views_keep_their_inliers_and_share_the_unit_of_the_first(monkeypatch):
    scene = make_scene(220, noise_px=0.1, outliers=0.08, unseen=0.2)
    monkeypatch.setattr(estimate, "sparse_tracks", lambda views: scene.tracks)
    asked = []
    original = estimate.estimate_pose

    def recording(tracks, name):
        asked.append((len(tracks), name))
        return original(tracks, name)

    monkeypatch.setattr(estimate, "estimate_pose", recording)
    tracks, found = estimate_poses([None, None, None])
    counts = scene.tracks.seen.sum(1)
    assert asked == [
        (counts[0], "the left and right photograph 1"),
        (counts[1], "the left and right photograph 2"),
    ]
    for v, each in enumerate(found):
        assert angle_deg(each.T[:3, :3] @ TS[v, :3, :3].T) < 0.2
        expected = np.zeros(220, bool)
        expected[scene.tracks.seen[v]] = each.inliers
        np.testing.assert_array_equal(tracks.seen[v], expected)
    lengths = [np.linalg.norm(each.T[:3, 3]) for each in found]
    assert lengths == pytest.approx([1.0, LENGTHS[1] / LENGTHS[0]], rel=0.03)
    alone = replace(
        scene.tracks, right_px=scene.tracks.right_px[1:], seen=scene.tracks.seen[1:], K_rights=K_RIGHTS[1:]
    )
    monkeypatch.setattr(estimate, "sparse_tracks", lambda views: alone)
    _, (one,) = estimate_poses([None, None])
    assert asked[-1][1] == "the two photographs" and np.linalg.norm(one.T[:3, 3]) == pytest.approx(1.0)


@pytest.mark.parametrize(("shared", "enough"), [(15, True), (14, False)])
def test_fifteen_points_that_both_views_see_relate_their_baselines(shared, enough):
    scene = make_scene(60)
    scene.tracks.seen[:] = np.stack([np.arange(60) < 40, np.arange(60) >= 40 - shared])
    estimated = []
    for v in range(2):
        T = TS[v].copy()
        T[:3, 3] /= LENGTHS[v]
        estimated.append(EstimatedPose(T, np.ones(60, bool), 1.0 + v, 0.1 + v, bool(v), ()))
    if enough:
        found = estimate._same_unit(scene.tracks, estimated, 1)
        assert np.linalg.norm(found.T[:3, 3]) == pytest.approx(LENGTHS[1] / LENGTHS[0])
        np.testing.assert_allclose(found.T[:3, 3] / LENGTHS[1] * LENGTHS[0], TS[1, :3, 3] / LENGTHS[1])
        assert (found.parallax_deg, found.residual_px, found.rectified) == (2.0, 1.1, True)
        assert np.linalg.norm(estimated[1].T[:3, 3]) == pytest.approx(1.0)  # the estimate itself stays
    else:
        with pytest.raises(InputError, match=r"got 14 of them in view 2 too\."):
            estimate._same_unit(scene.tracks, estimated, 1)


@pytest.mark.parametrize("views", [1, 2])
def test_estimated_poses_are_polished_by_all_matches_and_keep_the_first_baseline(views, monkeypatch):
    sparse = make_scene(60, noise_px=0.1, poses=POSES[:views], Ks=(K_LEFT, K_RIGHTS[:views]))
    dense = make_scene(190, noise_px=0.1, poses=POSES[:views], Ks=(K_LEFT, K_RIGHTS[:views]), seed=3)
    given = in_baselines(TS[:views])
    rough = np.stack([moved(T, np.radians([0.4, -0.5, 0.6, 2.0, -1.0, 1.0])) for T in given])
    rough[1:, :3, 3] *= 1.1
    asked = []

    def flow(views, depth_m, Ts):
        asked.append((views, depth_m, Ts))
        return dense.tracks

    monkeypatch.setattr(estimate, "dense_tracks", flow)
    depth = torch.ones(1, 1, 2, 2)
    fits, solver = [], estimate.solve_poses

    def recording(tracks, given, prior, *, start, scale_px):
        fits.append(
            (given, prior, start, scale_px, solver(tracks, given, prior, start=start, scale_px=scale_px))
        )
        return fits[-1][-1]

    monkeypatch.setattr(estimate, "solve_poses", recording)
    found, tracks = polished("views", rough, depth, sparse.tracks)
    assert len(tracks) == 250 and asked[0][0] == "views" and asked[0][1] is depth
    np.testing.assert_array_equal(asked[0][2], rough.astype(np.float32))
    np.testing.assert_array_equal(tracks.left_px[60:], dense.tracks.left_px)
    assert np.linalg.norm(found[0, :3, 3]) == pytest.approx(np.linalg.norm(rough[0, :3, 3]), rel=1e-6)
    for v in range(views):
        assert (
            angle_deg(found[v, :3, :3] @ TS[v, :3, :3].T)
            < 0.06
            < angle_deg(rough[v, :3, :3] @ TS[v, :3, :3].T)
        )
        direction = found[v, :3, 3] / np.linalg.norm(found[v, :3, 3])
        assert np.linalg.norm(direction - TS[v, :3, 3] / LENGTHS[v]) < 0.02
    assert [fit[3] for fit in fits] == [0.7, 0.3, 0.15, 0.08]
    for (given, prior, start, _, _), before in zip(fits, [None, *fits], strict=False):
        assert start is (given if before is None else before[-1])
        np.testing.assert_array_equal(given, rough.astype(np.float32))
        assert (prior.turned_rad, prior.shifted_share) == (pytest.approx(np.radians(3.0)), 0.3)
        assert (prior.moved_px == 1e3).all() and prior.longer_share == (0.02 if views == 1 else 0.2)
    if views == 2:
        ratio = np.linalg.norm(found[1, :3, 3]) / np.linalg.norm(found[0, :3, 3])
        assert ratio == pytest.approx(LENGTHS[1] / LENGTHS[0], rel=0.01)


def test_a_measured_baseline_is_that_of_the_first_right_camera():
    scene = make_scene(30)
    units = 0.4 * TS
    found = find_scale(scene.tracks, units, 1.0, 0.9, None, None)
    assert found == Scale("baseline", pytest.approx(0.9 / (0.4 * LENGTHS[0]))) and found.unit == "m"
    assert find_scale(scene.tracks, TS, 1.0, 0.9, None, scene.points).source == "baseline"
    assert Scale("none", 1.0).unit is None and Scale("points", 1.0).unit == "m"
    with pytest.raises(InputError, match=r"got baseline and known length\. Drop one"):
        find_scale(scene.tracks, TS, 1.0, 0.9, (0, 0, 1, 1, 1), None)


ENDS_ON_GRID = np.array([[120.0, 150.0], [510.0, 380.0]])


def on_tilted_plane(count: int = 900):
    """Points of a plane that is further away to the right, in metres, and poses in units of 0.37 m."""
    scene = make_scene(count)
    left_px = scene.tracks.left_px
    around = np.random.default_rng(0).uniform(-2, 2, (10, 2))
    left_px[-20:-10], left_px[-10:] = ENDS_ON_GRID[0] + around, ENDS_ON_GRID[1] - around
    rays = scene.tracks.rays
    points = rays * (3.0 / (1.0 - 0.5 * rays[:, :1]))
    right_px = np.stack([projected(points, K, T) for K, T in zip(K_RIGHTS, TS, strict=True)])
    Ts = TS.copy()
    Ts[:, :3, 3] /= 0.37
    return replace(scene.tracks, right_px=right_px), Ts, points


@pytest.mark.parametrize("factor", [1.0, 2.5])
def test_a_known_length_between_two_pixels_gives_the_metres_of_a_unit(factor):
    """Pixels are of the photograph, ``factor`` times as few as of the matches' grid."""
    tracks, Ts, _ = on_tilted_plane()
    rays = np.linalg.solve(K_LEFT, np.c_[ENDS_ON_GRID, [1, 1]].T).T
    ends_m = rays * (3.0 / (1.0 - 0.5 * rays[:, :1]))
    typed = (ENDS_ON_GRID + 0.5) / factor - 0.5
    found = find_scale(tracks, Ts, factor, None, (*typed.ravel(), math.dist(*ends_m)), None)
    assert found.source == "known length" and found.factor == pytest.approx(0.37, rel=0.004)
    assert 0 < found.spread < 0.01 and found.warnings == ()
    larger = Ts.copy()
    larger[:, :3, 3] *= 0.05  # the length is then less than one unit
    in_larger = find_scale(tracks, larger, factor, None, (*typed.ravel(), math.dist(*ends_m)), None)
    assert in_larger.factor == pytest.approx(0.37 / 0.05, rel=0.004)
    # Wrong matches and those behind the cameras do not count.
    wrong = tracks.right_px.copy()
    near = np.linalg.norm(tracks.left_px - ENDS_ON_GRID[0], axis=1).argsort()[:5]
    wrong[:, near] += [[30.0, -20.0]]
    again = find_scale(
        replace(tracks, right_px=wrong), Ts, factor, None, (*typed.ravel(), math.dist(*ends_m)), None
    )
    assert again.factor == pytest.approx(0.37, rel=0.006)
    behind = tracks.right_px.copy()
    for v, (K, T) in enumerate(zip(K_RIGHTS, Ts, strict=True)):
        behind[v, near] = projected(tracks.rays[near] * -9.0, K, T)
    again = find_scale(
        replace(tracks, right_px=behind), Ts, factor, None, (*typed.ravel(), math.dist(*ends_m)), None
    )
    assert again.factor == pytest.approx(0.37, rel=0.006)
    with pytest.raises(InputError, match=r"got the same place twice\."):
        find_scale(tracks, Ts, factor, None, (*typed[0], *typed[0], 1.0), None)
    with pytest.raises(InputError, match="known length"):
        find_scale(tracks, Ts, factor, None, (*typed.ravel(), 0.0), None)


def test_the_point_of_a_pixel_is_the_median_of_up_to_eight_matches_within_forty_pixels():
    around = np.array(
        [[3.0, 0], [0, 5], [-7, 0], [0, -9], [12, 0], [0, 15], [-18, 0], [0, -21], [24, 0], [0, 39]]
    )
    depth = np.array([2.0, 2.1, 2.2, 2.3, 2.4, 2.5, 2.6, 2.7, 9.0, 9.0])
    centre = np.array([301.0, 222.0])

    def at(offsets, depths):
        left_px = centre + offsets
        tracks = Tracks(left_px, left_px[None], np.ones((1, len(left_px)), bool), K_LEFT, K_RIGHTS[:1])
        return estimate._point_at((centre + 0.5) / 3 - 0.5, 3.0, tracks, 1 / depths)

    point, spread = at(around, depth)
    w = 1 / depth[:8]
    ray = np.linalg.solve(K_LEFT, [*centre, 1.0])
    np.testing.assert_allclose(point, ray / np.median(w))
    assert spread == pytest.approx(1.4826 * np.median(np.abs(w / np.median(w) - 1)))
    three = np.array([[39.9, 0.0], [0.0, -39.9], [1.0, 1.0]])
    assert at(three, depth[:3])[0] == pytest.approx(ray * 2.1)
    three[0, 0] = 40.1
    with pytest.raises(InputError, match=r"got \(100, 74\) with 2 nearby\. Choose ends"):
        at(three, depth[:3])


def test_known_points_give_the_metres_of_a_unit_and_how_far_they_agree():
    tracks, Ts, points = on_tilted_plane()
    rng = np.random.default_rng(0)
    known = points[::20] * np.exp(0.05 * rng.normal(size=45))[:, None]
    behind = -points[5::20]  # seen at the same pixels
    apart = np.array([[5.0, 5.0, 1.0]])  # far outside the image
    found = find_scale(tracks, Ts, 1.0, None, None, np.concatenate([known, behind, apart]))
    ratios = known[:, 2] / (points[::20, 2] / 0.37)
    assert found.source == "points" and found.factor == pytest.approx(np.median(ratios), rel=1e-3)
    spread = 1.4826 * np.median(np.abs(ratios / np.median(ratios) - 1)) / math.sqrt(45)
    assert found.spread == pytest.approx(spread, rel=0.01)
    for count in (5, 4):
        if count == 5:
            assert find_scale(tracks, Ts, 1.0, None, None, points[:5]).factor == pytest.approx(0.37)
        else:
            with pytest.raises(InputError, match=r"got 4\."):
                find_scale(tracks, Ts, 1.0, None, None, points[:4])
    rays = tracks.rays
    alone = replace(tracks.kept(slice(6)))
    off_px = np.array([9.9, 9.9, 9.9, 9.9, 9.9, 10.1])
    shifted = rays[:6] + off_px[:, None] / 520.0 * [1.0, 0.0, 0.0]
    scale = estimate._by_points(alone, np.full(6, 0.5), shifted * np.array([2, 2, 2, 2, 2, 20.0])[:, None])
    assert scale.factor == pytest.approx(1.0) and scale.spread == 0.0


def test_only_matches_that_all_views_explain_measure_a_length():
    tracks, Ts, points = on_tilted_plane(300)
    for off_px, counts in ((1.4, True), (1.7, False)):
        right_px = tracks.right_px.copy()
        normals = estimate_normals(tracks, Ts)
        right_px[1, :280] += off_px * normals[:280]
        seen = tracks.seen.copy()
        seen[0, :280] = False
        some = replace(tracks, right_px=right_px, seen=seen)
        if counts:
            assert find_scale(some, Ts, 1.0, None, None, points[:5]).source == "points"
        else:
            w = solve_inverse_depth(some, Ts)
            off = [
                np.linalg.norm(projected(some.rays / w[:, None], K, T) - px, axis=1)
                for K, T, px in zip(K_RIGHTS, Ts, right_px, strict=True)
            ]
            if (off[1][:5] > 1.5).all():
                with pytest.raises(InputError, match="5 near matched points"):
                    find_scale(some, Ts, 1.0, None, None, points[:5])


def estimate_normals(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Unit vectors across the epipolar lines of the second view."""
    first, second = (projected(tracks.rays * z, K_RIGHTS[1], Ts[1]) for z in (3.0, 6.0))
    along = (second - first) / np.linalg.norm(second - first, axis=1, keepdims=True)
    return np.stack([-along[:, 1], along[:, 0]], axis=1)
