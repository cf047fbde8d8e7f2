"""Estimated poses of different cameras, their scale from known lengths, and what is rejected or reported."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats.images import intrinsics_from_exif, intrinsics_from_fov
from geodiff_plugin.pose import estimate
from geodiff_plugin.pose.estimate import (
    EstimatedPose,
    Scale,
    _same_unit,
    estimate_pose,
    estimate_poses,
    find_scale,
    polished,
)
from geodiff_plugin.pose.solve import (
    MAX_DEPTH_REL_STD,
    SCALE_PX,
    PosePrior,
    depth_spread,
    solve_poses,
    unconstrained_pose,
)
from geodiff_plugin.pose.tracks import Tracks, epipolar, match_features, solve_inverse_depth
from tests.scenes import render_pair
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
from tests.unit.pose.tracked_pair import TRUE, angle_deg, camera_pose, make_tracks
from tests.unit.pose.tracked_pair import K as TRACK_K

END_TO_END = pytest.mark.end_to_end

pytest.importorskip("poselib")
VIEWS = pytest.mark.parametrize("v", [0, 1])
TS = np.linalg.inv(POSES)
LENGTHS = np.linalg.norm(POSES[:, :3, 3], axis=1)


def in_baselines(Ts: np.ndarray) -> np.ndarray:
    """The poses in units of the first baseline."""
    out = Ts.copy()
    out[:, :3, 3] /= np.linalg.norm(Ts[0, :3, 3])
    return out


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
    assert not found.rectified and found.findings == ()


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
    with pytest.raises(
        InputError, match=r"PoseLib must be installed.*; got no module poselib\. Run pip install"
    ):
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


def test_a_camera_that_only_turned_is_rejected_and_its_residuals_are_those_of_a_rotation():
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
            turned = f"got a purely rotating camera .{count / 2:.0f}% of matches fit one"
            with pytest.raises(InputError, match=f"{turned}, parallax {parallax:.2f} degrees"):
                estimate._check_parallax(tracks, near, parallax, "the images")
        else:
            estimate._check_parallax(tracks, near, parallax, "the images")
    only = np.arange(200) < 60  # of those near the pose; here all are
    with pytest.raises(InputError, match="got a purely rotating camera .100% of matches"):
        estimate._check_parallax(scene.tracks, only, 5.0, "the images")


@pytest.mark.parametrize(("count", "wrong", "enough"), [(29, 0, False), (100, 70, True), (100, 71, False)])
def test_thirty_matches_and_three_tenths_of_them_make_a_pose(count, wrong, enough, monkeypatch):
    scene = make_scene(count)
    tracks = scene.tracks.alone(0)
    monkeypatch.setattr(estimate, "_five_points", lambda _: in_baselines(TS[:1])[0])
    monkeypatch.setattr(estimate, "_second_motion", lambda *_: [])
    right_px = tracks.right_px.copy()
    right_px[0, :wrong] += 50.0 * epipolar(tracks, TS[0]).normals[:wrong]
    if enough:
        assert estimate_pose(replace(tracks, right_px=right_px)).inliers.sum() == pytest.approx(
            count - wrong, abs=4
        )
    else:
        with pytest.raises(
            InputError,
            match=r"got 29\. " if count < 30 else r"got \d+ of 100 matches consistent with one pose\. ",
        ):
            estimate_pose(replace(tracks, right_px=right_px))
    # Behind the cameras no match counts.
    back = in_baselines(TS[:1])[0]
    back[:3, 3] *= -1
    monkeypatch.setattr(estimate, "_five_points", lambda _: back)
    if count > 30:
        with pytest.raises(InputError, match="got 0 of 100 matches"):
            estimate_pose(tracks)


@pytest.mark.parametrize("sideways_m", [0.04, 0.07])
def test_little_parallax_is_reported_with_its_angle(sideways_m):
    scene = make_scene(
        300, noise_px=0.05, poses=pose((1.0, -2.0, 0.5), (sideways_m, 0.3 * sideways_m, 0.0))[None]
    )
    found = estimate_pose(scene.tracks, "these two")
    ground_truth = np.median(parallax_deg(scene.points, np.linalg.inv(scene.Ts[0])))
    codes = {message.code: str(message) for message in found.findings}
    assert bool(0.3 < ground_truth < 0.6) is (sideways_m < 0.05)
    assert ("estimate.parallax" in codes) is (sideways_m < 0.05)
    if ground_truth < 0.6:
        assert "between these two is" in codes["estimate.parallax"]
        assert f"{found.parallax_deg:.2f} degrees" in codes["estimate.parallax"]
    assert found.parallax_deg == pytest.approx(ground_truth, rel=0.15)


def second_motion(fraction: float, count: int = 300, wild: int = 0, noise_px: float = 0.1) -> Tracks:
    """A fraction of the tracks as another pose has them, and some that no pose explains."""
    scene = make_scene(count, noise_px=noise_px)
    tracks = scene.tracks.alone(0)
    other = moved(scene.Ts[0], np.r_[np.radians([4.0, -6.0, 9.0]), 0.1, 0.3, -0.1])
    right_px = tracks.right_px.copy()
    apart = np.arange(count) < round(fraction * count)
    right_px[0, apart] = projected(scene.points, K_RIGHTS[0], other)[apart]
    end = round(fraction * count) + wild
    right_px[0, round(fraction * count) : end] += np.random.default_rng(1).uniform(-150, 150, (wild, 2))
    return replace(tracks, right_px=right_px)


@pytest.mark.parametrize(
    ("fraction", "wild", "inliers", "outcome"),
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
def test_a_second_motion_is_reported_or_rejected_by_how_many_matches_follow_it(
    fraction, wild, inliers, outcome
):
    tracks = second_motion(fraction, wild=wild)
    mask = np.arange(300) < inliers
    if outcome == "refused":
        with pytest.raises(InputError, match=r"got two motions, with 100 and (5\d|60) of 300 matches"):
            estimate._second_motion(tracks, in_baselines(TS)[0], mask, "these")
        return
    found = estimate._second_motion(tracks, in_baselines(TS)[0], mask, "these")
    assert [message.code for message in found] == (["estimate.second-motion"] if outcome else [])
    if outcome:
        percent = round(100 * fraction)
        assert any(
            f"{each} % of the matches of these" in found[0] for each in (percent - 1, percent, percent + 1)
        )


def test_one_tenth_of_many_matches_has_to_follow_a_second_motion():
    for fraction, reported in ((0.085, False), (0.12, True)):
        tracks = second_motion(fraction, count=600)
        found = estimate._second_motion(tracks, in_baselines(TS)[0], np.ones(600, bool), "these")
        assert bool(found) is reported  # 51 and 72 of 600 matches


@pytest.mark.parametrize(("depth", "flat"), [(0.0, True), (1.5, False)])
def test_matches_on_one_plane_are_reported(depth, flat):
    rng = np.random.default_rng(0)
    scene = make_scene(300)
    z = 4.0 + depth * rng.uniform(-1, 1, 300)
    points = scene.tracks.rays * z[:, None]
    right_px = projected(points, K_RIGHTS[0], TS[0]) + 0.1 * rng.normal(size=(300, 2))
    found = estimate_pose(replace(scene.tracks.alone(0), right_px=right_px[None]))
    assert ("estimate.plane" in [message.code for message in found.findings]) is flat


def test_several_views_keep_their_inliers_and_share_the_unit_of_the_first(monkeypatch):
    scene = make_scene(220, noise_px=0.1, outliers=0.08, unseen=0.2)
    monkeypatch.setattr(estimate, "sparse_tracks", lambda views: scene.tracks)
    asked = []
    original = estimate.estimate_pose

    def recording(tracks, name, needed):
        asked.append((len(tracks), name))
        assert needed == estimate.OF_SIFT
        return original(tracks, name, needed)

    monkeypatch.setattr(estimate, "estimate_pose", recording)
    tracks, found = estimate_poses([None, None, None])
    counts = scene.tracks.seen.sum(1)
    assert asked == [
        (counts[0], "the left and right image 1"),
        (counts[1], "the left and right image 2"),
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
    assert asked[-1][1] == "the two images" and np.linalg.norm(one.T[:3, 3]) == pytest.approx(1.0)


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
        with pytest.raises(InputError, match=r"got 14 of them also in view 2\."):
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
        assert (prior.rotation_rad, prior.shift_fraction) == (pytest.approx(np.radians(3.0)), 0.3)
        assert (prior.displacement_px == 1e3).all() and prior.length_fraction == (0.02 if views == 1 else 0.2)
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
    with pytest.raises(InputError, match=r"got baseline and known length\. Remove one"):
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
    """Pixels are of the image, ``factor`` times as few as of the matches' grid."""
    tracks, Ts, _ = on_tilted_plane()
    rays = np.linalg.solve(K_LEFT, np.c_[ENDS_ON_GRID, [1, 1]].T).T
    ends_m = rays * (3.0 / (1.0 - 0.5 * rays[:, :1]))
    typed = (ENDS_ON_GRID + 0.5) / factor - 0.5
    found = find_scale(tracks, Ts, factor, None, (*typed.ravel(), math.dist(*ends_m)), None)
    assert found.source == "known length" and found.factor == pytest.approx(0.37, rel=0.004)
    assert 0 < found.spread < 0.01 and found.findings == ()
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
    with pytest.raises(InputError, match=r"got the same point twice\."):
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
    with pytest.raises(InputError, match=r"got \(100, 74\) with 2 nearby\. Choose end points"):
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
                with pytest.raises(InputError, match="5 of them close to matched points"):
                    find_scale(some, Ts, 1.0, None, None, points[:5])


def estimate_normals(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Unit vectors across the epipolar lines of the second view."""
    first, second = (projected(tracks.rays * z, K_RIGHTS[1], Ts[1]) for z in (3.0, 6.0))
    along = (second - first) / np.linalg.norm(second - first, axis=1, keepdims=True)
    return np.stack([-along[:, 1], along[:, 0]], axis=1)


@END_TO_END
def test_rotation_and_direction_come_back() -> None:
    tracks, Ts, _ = make_tracks([TRUE], outliers=0.3)
    found = estimate_pose(tracks)
    assert angle_deg(found.T[:3, :3] @ Ts[0, :3, :3].T) < 0.3
    assert found.T[:3, 3] @ Ts[0, :3, 3] / np.linalg.norm(Ts[0, :3, 3]) > 0.999
    assert 0.6 < found.inliers.mean() < 0.8 and found.residual_px < 0.5 and not found.findings
    assert not found.rectified
    by = np.array([[1.0, 0.08, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # a skew changes nothing
    pixels, Ks = (
        (tracks.left_px @ by[:2, :2].T, tracks.right_px @ by[:2, :2].T),
        (by @ TRACK_K, (by @ TRACK_K)[None]),
    )
    np.testing.assert_allclose(estimate_pose(Tracks(*pixels, tracks.seen, *Ks)).T, found.T, atol=1e-6)


@END_TO_END
def test_a_rectified_pair_is_taken_for_one() -> None:
    tracks, _, _ = make_tracks([camera_pose((0, 0, 0), (0.2, 0, 0))], noise_px=0.3)
    found = estimate_pose(tracks)
    assert found.rectified
    np.testing.assert_array_equal(found.T, [[1, 0, 0, -1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@END_TO_END
def test_what_carries_no_depth_is_rejected() -> None:
    turned, _, _ = make_tracks([camera_pose((1, -6, 2), (1e-5, 0, 0))])
    unrelated, _, _ = make_tracks([TRUE], outliers=1.0, seed=3)
    unrelated.right_px[0] = np.random.default_rng(0).uniform(0, 380, (len(unrelated), 2))
    for tracks, said in (
        (turned, "purely rotating camera"),
        (unrelated, "one static scene"),
        (unrelated.kept(slice(12)), "at least 30 matches; got 12"),
        (two_motions(0.45), "two motions"),
    ):
        with pytest.raises(ValueError, match=said):
            estimate_pose(tracks)


def flattened(tracks: Tracks, T: np.ndarray) -> Tracks:
    """The tracks as they would be of a plane 4 m away, parallel to the left image."""
    p = (tracks.rays * 4.0 @ T[:3, :3].T + T[:3, 3]) @ TRACK_K.T
    return replace(tracks, right_px=(p[:, :2] / p[:, 2:])[None])


def two_motions(fraction: float) -> Tracks:
    """Tracks of which this fraction moves independently, as if seen by another camera."""
    tracks, _, _ = make_tracks([TRUE, camera_pose((4.0, 3.0, -2.0), (-0.1, 0.25, 0.05))], outliers=0.05)
    apart = np.random.default_rng(0).random(len(tracks)) < fraction
    right_px = np.where(apart[:, None], tracks.right_px[1], tracks.right_px[0])
    return Tracks(tracks.left_px, right_px[None], tracks.seen[:1], TRACK_K, tracks.K_rights[:1])


@END_TO_END
def test_a_plane_little_parallax_and_a_moving_part_are_reported() -> None:
    tracks, Ts, _ = make_tracks([TRUE], noise_px=0.2, outliers=0.0)
    near, _, _ = make_tracks([camera_pose((1, -2, 0.5), (0.05, 0.01, 0))], noise_px=0.05, outliers=0.0)
    moved = estimate_pose(two_motions(0.25))
    assert angle_deg(moved.T[:3, :3] @ np.linalg.inv(TRUE)[:3, :3].T) < 0.3, "the larger part decides"
    for findings, said in (
        (estimate_pose(flattened(tracks, Ts[0])).findings, "are on one plane"),
        (estimate_pose(near).findings, "parallax"),
        (moved.findings, "second motion"),
    ):
        assert any(said in sentence for sentence in findings)
    assert not any("second motion" in sentence for sentence in estimate_pose(two_motions(0.0)).findings)


@END_TO_END
def test_each_known_length_gives_the_scale() -> None:
    tracks, Ts, depth_m = make_tracks([TRUE], noise_px=0.05, outliers=0.0, count=900)
    true = float(np.linalg.norm(Ts[0, :3, 3]))
    units = Ts.copy()
    units[0, :3, 3] /= true
    assert find_scale(tracks, units, 1.0, 0.25, None, None).factor == pytest.approx(0.25)
    by_points = find_scale(tracks, units, 1.0, None, None, (tracks.rays * depth_m[:, None])[::10])
    assert by_points.factor == pytest.approx(true, rel=0.02) and by_points.spread < 0.02
    # 200 px of a plane 4 m away and parallel to the image are 200 / 500 * 4 m.
    length = find_scale(flattened(tracks, Ts[0]), units, 1.0, None, (150, 190, 350, 190, 1.6), None)
    assert length.factor == pytest.approx(true, rel=0.01) and length.unit == "m"
    nothing = find_scale(tracks, units, 1.0, None, None, None)
    assert nothing.unit is None and "no unit" in nothing.findings[0]
    with pytest.raises(ValueError, match=r"got \(9000, 150\) with 0 nearby"):  # as it was typed
        find_scale(tracks, units, 0.5, None, (9000, 150, 350, 190, 1.6), None)
    with pytest.raises(ValueError, match="specified once"):
        find_scale(tracks, units, 1.0, 0.25, (0, 0, 1, 1, 1), None)


@pytest.fixture(scope="module")
def pair():
    return render_pair(3, size=(240, 320), exposure=True, posed=True)


def as_pil(view) -> Image.Image:
    return Image.fromarray(np.rint(view.image_01.permute(1, 2, 0).numpy() * 255).astype(np.uint8))


@END_TO_END
def test_unposed_images_become_a_guidance(pair) -> None:
    E = pair.E.numpy()
    baseline = float(np.linalg.norm(E[:3, 3]))
    photos = as_pil(pair.left), as_pil(pair.right)
    guidance = GeometryGuidance.from_unposed_images(*photos, baseline_m=baseline, K=pair.K_left.numpy())
    found = guidance.rigs[0].E
    assert angle_deg(found[:3, :3].T @ E[:3, :3]) < 0.3
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(baseline, rel=1e-6)
    assert found[:3, 3] @ E[:3, 3] / baseline**2 > 0.995
    assert guidance.unit == "m" and guidance.estimated.inliers[0] > 30
    with pytest.raises(ValueError, match="320x240"):
        guidance.prepare(torch.rand(1, 3, 120, 160))


@END_TO_END
def test_without_a_length_there_is_no_unit_and_without_K_no_pose(pair) -> None:
    fov = math.degrees(2 * math.atan(160 / float(pair.K_left[0, 0])))
    photos = as_pil(pair.left), as_pil(pair.right)
    guidance = GeometryGuidance.from_unposed_images(*photos, fov=fov)
    assert guidance.unit is None and np.linalg.norm(guidance.rigs[0].E[:3, 3]) == pytest.approx(1.0)
    assert any("no unit" in sentence for sentence in guidance.findings)
    assert unconstrained_pose(MAX_DEPTH_REL_STD) == ()
    assert "do not constrain the estimated pose" in unconstrained_pose(1.1 * MAX_DEPTH_REL_STD)[0]
    with pytest.raises(ValueError, match="field of view"):
        GeometryGuidance.from_unposed_images(*photos, baseline_m=0.1)


THIRD = camera_pose((2.0, 5.0, -1.0), (-0.25, 0.1, 0.05))


def fitted(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Poses that nothing but the matches holds, the first baseline as long as it was."""
    free = PosePrior(np.full(len(Ts), 1e3), rotation_rad=1.0, shift_fraction=10.0, length_fraction=1.0)
    solved = solve_poses(tracks, Ts, free, scale_px=SCALE_PX)
    solved[:, :3, 3] *= np.linalg.norm(Ts[0, :3, 3]) / np.linalg.norm(solved[0, :3, 3])
    return solved


@END_TO_END
@pytest.mark.parametrize(("poses", "noise_px"), [([TRUE], 0.1), ([TRUE, THIRD], 0.4)])
def test_the_spread_is_the_scatter_of_depths_over_images(poses, noise_px: float) -> None:
    clean, Ts, _ = make_tracks(poses, 0.0, count=300, outliers=0.0)
    rng = np.random.default_rng(0)
    noise = noise_px * rng.normal(size=(30, *clean.right_px.shape))
    drawn = [replace(clean, right_px=clean.right_px + by_px) for by_px in noise]
    solved = [fitted(tracks, Ts) for tracks in drawn]
    # Depths of the clean matches: what differs is the pose alone.
    inverse = np.stack([solve_inverse_depth(clean, Ts) for Ts in solved])
    scatter = float(np.median((inverse / inverse.mean(0)).std(0)))
    said = np.median([depth_spread(tracks, Ts) for tracks, Ts in zip(drawn, solved, strict=True)])
    assert 0.6 * scatter < said < 1.7 * scatter


def with_exif(size, focal35=None, taken=None) -> Image.Image:
    """An image whose EXIF has a focal length in 35 mm equivalent, and the size that it was taken at."""
    image = Image.new("RGB", size)
    entries = image.getexif().get_ifd(0x8769)
    if focal35 is not None:
        entries[0xA405] = focal35
    if taken is not None:
        entries[0xA002], entries[0xA003] = taken
    return image


@END_TO_END
def test_focal_lengths_of_images(tmp_path) -> None:
    found, notes = intrinsics_from_exif(with_exif((2000, 1500), 26, (4000, 3000)), "left")
    assert found[0, 0] == pytest.approx(13 * 5000 / math.hypot(36, 24)) and "26 mm" in notes[0]
    with pytest.raises(ValueError, match="cropped"):
        intrinsics_from_exif(with_exif((3000, 3000), 26, (4000, 3000)), "left")
    with pytest.raises(ValueError, match="no focal length.*--fov"):
        intrinsics_from_exif(with_exif((400, 300)), "left")
    image = with_exif((400, 300), 30)
    exif = image.getexif()
    exif[0x0112] = 6
    image.save(tmp_path / "turned.jpg", exif=exif)
    found, _ = intrinsics_from_exif(tmp_path / "turned.jpg", "left")
    assert (found[0, 2], found[1, 2]) == (149.5, 199.5)
    found = intrinsics_from_fov(90.0, (640, 480))
    assert found[0, 0] == pytest.approx(320.0) and found[1, 2] == 239.5
    with pytest.raises(ValueError, match="fov"):
        intrinsics_from_fov(0.1, (640, 480))


@END_TO_END
@pytest.mark.parametrize(("ratio", "kept"), [(0.79, True), (0.81, False)])
def test_a_match_is_nearer_than_four_fifths_of_the_next_nearest(ratio: float, kept: bool) -> None:
    """Lowe's test, of distances between unit vectors and not of their squares."""

    def at_distance(distance: float, up: float = 0.0) -> np.ndarray:
        angle = 2 * np.arcsin(distance / 2)
        return np.array([np.cos(angle), np.sin(angle), up], np.float32)

    none = np.zeros((2, 4))
    left = none, np.stack([at_distance(0.0), np.array([0, 0, 1], np.float32)])
    right = none, np.stack([at_distance(0.5), at_distance(0.5 * ratio)])
    assert match_features(left, right).tolist() == ([[0, 1]] if kept else [])


@END_TO_END
def test_baselines_of_several_views_are_in_units_of_the_first() -> None:
    """Of cameras 0.3 m and 0.75 m away, both estimated with a baseline of 1."""
    at_m = (0.3, 0.75)
    tracks, Ts, _ = make_tracks([camera_pose((0, 2.0 * x, 0), (x, 0.0, 0.1 * x)) for x in at_m], outliers=0.0)
    lengths = np.linalg.norm(Ts[:, :3, 3], axis=1)
    estimated = []
    for T, length in zip(Ts, lengths, strict=True):
        T = T.copy()
        T[:3, 3] /= length
        estimated.append(EstimatedPose(T, np.ones(len(tracks), bool), 1.0, 0.1, False, ()))
    found = _same_unit(tracks, estimated, 1).T
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(lengths[1] / lengths[0], rel=0.01)
    np.testing.assert_allclose(found[:3, :3], Ts[1, :3, :3])


def test_learned_matches_are_used_only_if_sift_gives_no_pose_and_must_be_more(monkeypatch):
    """A matcher answers with the matches of a scene; SIFT with them, too, or with none."""
    asked = []

    def matcher(views):
        asked.append(len(views))
        return tracks

    def learned(count: int, outliers: float):
        return make_scene(count, noise_px=0.1, outliers=outliers).tracks.alone(0)

    tracks = learned(200, 0.1)
    monkeypatch.setattr(estimate, "sparse_tracks", lambda views: tracks)
    _, (by_sift,) = estimate_poses([None, None], matcher)
    assert not asked and not by_sift.findings
    monkeypatch.setattr(estimate, "sparse_tracks", lambda views: tracks.kept(slice(0)))
    _, (by_network,) = estimate_poses([None, None], matcher)
    assert asked == [2] and [finding.code for finding in by_network.findings] == ["estimate.learned"]
    np.testing.assert_array_equal(by_network.T, by_sift.T)
    with pytest.raises(InputError, match="at least 30 matches; got 0"):
        estimate_poses([None, None])
    for count, outliers, reported in (
        (50, 0.0, "at least 60 matches; got 50"),
        (300, 0.62, "of one static scene"),
    ):
        tracks = learned(count, outliers)
        assert estimate_pose(tracks).inliers.sum() >= estimate.MIN_INLIERS  # enough for SIFT
        with pytest.raises(InputError, match=reported):
            estimate_poses([None, None], matcher)
