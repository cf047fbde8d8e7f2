"""Poses as given against matches: residuals, refinement, straightening, the usual mistakes."""

import re
import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._threads import BackgroundTask
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.evidence import prepare as prepare_module
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.geometry import is_rectified
from geodiff_plugin.matching.planes import Parallax
from geodiff_plugin.messages import Message
from geodiff_plugin.pose import fit as fit_module
from geodiff_plugin.pose import refine
from geodiff_plugin.pose import tracks as tracks_module
from geodiff_plugin.pose.lens import remaining_distortion, undistorted_rays
from geodiff_plugin.pose.mistakes import exchangeable, find_mistake
from geodiff_plugin.pose.moving import moved_share
from geodiff_plugin.pose.refine import depths_apart, fit_displacement, straightened
from geodiff_plugin.pose.solve import PosePrior, regularised_poses, solve_poses
from geodiff_plugin.pose.tracks import (
    Tracks,
    _dense_matches,
    behind_infinity,
    grey_image,
    median_residuals,
    residuals_px,
    solve_inverse_depth,
    sparse_tracks,
)
from geodiff_plugin.result import misfit, verdict
from geodiff_plugin.result.indicators import indicators_of
from geodiff_plugin.types import CameraView, PosedViews
from tests.scenes import render_pair
from tests.tiny import checked_views

K = np.array([[500.0, 0, 255.5], [0, 500.0, 191.5], [0, 0, 1]])
SIZE = (384, 512)
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def pose(turn_deg, centre) -> np.ndarray:
    """``E`` of a camera turned by a rotation vector in degrees, at a place."""
    E = np.eye(4)
    E[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix()
    E[:3, 3] = centre
    return E


def make_tracks(
    poses, noise_px=0.15, count=600, outliers=0.1, seed=0
) -> tuple[Tracks, np.ndarray, np.ndarray]:
    """Tracks of a cloud of points between 2 and 8 m, ``T_right_from_left`` of the poses, and the depths."""
    rng = np.random.default_rng(seed)
    left_px = rng.uniform((5, 5), (506, 378), (count, 2))
    depth_m = rng.uniform(2.0, 8.0, count)
    points = np.linalg.solve(K, np.c_[left_px, np.ones(count)].T) * depth_m
    Ts = np.stack([np.linalg.inv(E) for E in poses])
    right_px = []
    for T in Ts:
        p = K @ (T[:3, :3] @ points + T[:3, 3:])
        right_px.append((p[:2] / p[2]).T + noise_px * rng.normal(size=(count, 2)))
    right_px = np.stack(right_px)
    wild = rng.random(count) < outliers
    right_px[:, wild] += rng.uniform(-60, 60, (len(Ts), wild.sum(), 2))
    seen = np.ones(right_px.shape[:2], bool)
    return Tracks(left_px, right_px, seen, K, np.stack([K] * len(Ts))), Ts, depth_m


def angle_deg(R: np.ndarray) -> float:
    return float(np.degrees(np.linalg.norm(Rotation.from_matrix(R).as_rotvec())))


TRUE = pose((1.0, -6.0, 2.0), (0.3, 0.05, -0.08))


def depth_error(tracks: Tracks, Ts: np.ndarray, depth_m: np.ndarray) -> float:
    return float(np.median(np.abs(solve_inverse_depth(tracks, Ts) * depth_m - 1)))


def test_a_perturbed_pose_comes_back_but_for_what_the_views_cannot_tell() -> None:
    tracks, Ts, depth_m = make_tracks([TRUE])
    wrong = TRUE @ pose((0.7, -0.8, 0.5), (0, 0, 0))
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
    cameras = (torch.from_numpy(each) for each in (tracks.K_left, tracks.K_rights, given))
    before, rig = median_residuals(tracks, given), bool(is_rectified(*cameras).all())
    return regularised_poses(tracks, given, given, before, rig)[0]


def test_a_shift_that_makes_up_for_a_turn_comes_back() -> None:
    """A tracker's error: matches lie near their lines and still far from where they should be along them."""
    tracks, Ts, depth_m = make_tracks([TRUE])
    wrong = TRUE @ pose((0.1, 0.5, 0.0), (-np.radians(0.5) * 4.0 * 0.8, np.radians(0.1) * 4.0 * 0.8, 0))
    wrong[:3, 3] *= np.linalg.norm(TRUE[:3, 3]) / np.linalg.norm(wrong[:3, 3])
    given = np.linalg.inv(wrong)[None]
    assert np.median(residuals_px(tracks, given)) < 1.0
    found = regularised(tracks, given)
    assert depth_error(tracks, found, depth_m) < 0.5 * depth_error(tracks, given, depth_m)
    assert depths_apart(tracks, Ts, Ts) == 0.0
    longer = Ts.copy()
    longer[:, :3, 3] *= 1.2
    assert depths_apart(tracks, Ts, longer) == pytest.approx(np.log(1.2), rel=0.05)
    assert depths_apart(tracks, longer, Ts) == pytest.approx(np.log(1.2), rel=0.05)


@pytest.mark.parametrize(("apart", "told"), [(0.159, False), (0.161, True)])
def test_a_pose_is_undetermined_where_another_one_gives_other_depths(apart: float, told: bool) -> None:
    messages = refine._undetermined(apart)
    assert bool(messages) is told
    assert all(f"differ by {100 * np.expm1(apart):.0f} %" in each for each in messages)


@pytest.mark.parametrize("metre", [0.001, 100.0])
def test_a_refined_pose_does_not_depend_on_the_unit_of_length(metre: float) -> None:
    """Whatever the prior on turns, shifts and lengths says, of poses in metres or in any other unit."""
    tracks, _, _ = make_tracks([TRUE, pose((-2.0, 5.0, 0.0), (-0.3, 0.1, 0.05))], count=120)
    given = np.stack([np.linalg.inv(TRUE @ pose((0.4, -0.3, 0.2), (0.02, 0.01, 0)))] * 2)
    given[1] = np.linalg.inv(pose((-2.2, 5.3, 0.1), (-0.3, 0.1, 0.05)))
    longer = given.copy()
    longer[:, :3, 3] *= metre
    prior = PosePrior(np.array([0.5, 0.5]))
    in_metres, found = (solve_poses(tracks, each, prior) for each in (given, longer))
    assert angle_deg(in_metres[0, :3, :3] @ given[0, :3, :3].T) > 0.05
    np.testing.assert_allclose(found[:, :3, :3], in_metres[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(found[:, :3, 3], metre * in_metres[:, :3, 3], rtol=1e-4, atol=1e-6 * metre)


def test_the_refinement_is_joint_and_reaches_the_optimum() -> None:
    """Poses of both views and the points that both see, as SciPy's least squares finds them all at once."""
    poses = [TRUE, pose((-2.0, 5.0, 0.0), (-0.3, 0.1, 0.05))]
    tracks, _, _ = make_tracks(poses, noise_px=0.4, count=40, outliers=0.0)
    given = np.stack([np.linalg.inv(E @ pose((0.3, -0.4, 0.2), (0, 0, 0))) for E in poses])
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


NEAR = pose((0.5, 3.0, 0.2), (0.09, 0.003, 0.01))
"""Of cameras so close that other poses too leave matches near their lines."""


def scaled(factor: float, centred: bool) -> np.ndarray:
    other = K * np.array([[factor], [factor], [1.0]])
    if centred:
        other[:2, 2] = K[:2, 2]
    return other


TURNED = pose((4.0, -9.0, 6.0), (0.3, 0.05, -0.08))


@pytest.mark.parametrize(
    ("true", "given", "K_given", "words"),
    [
        (TRUE, np.linalg.inv(TRUE), K, "swapped"),
        (TRUE, FLIP @ TRUE @ FLIP, K, "OpenGL"),
        (TRUE, FLIP @ np.linalg.inv(TRUE) @ FLIP, K, "world-to-camera: invert"),
        (TRUE, pose((-1.0, 6.0, -2.0), TRUE[:3, 3]), K, "transposed"),
        (NEAR, np.linalg.inv(FLIP @ np.linalg.inv(NEAR) @ FLIP), K, "OpenGL"),
        (TURNED, TURNED, scaled(0.5, False), "images of 0.5 times the width and height of these. With"),
        (TURNED, TURNED, scaled(1.5, True), "1.5 times the width and height of these, its principal"),
        # Cameras this close leave matches near their lines with most factors; the best one is named.
        (NEAR, NEAR, scaled(2.0, True), "focal lengths times 0.5 and .* 2 times the width"),
    ],
)
def test_a_mistake_is_named(true, given, K_given, words: str) -> None:
    tracks, _, _ = make_tracks([true], outliers=0.02)
    T = np.linalg.inv(given)
    found = find_mistake(replace(tracks, K_left=K_given, K_rights=K_given[None]), T, T)
    assert found is not None and re.search(words, found)


@pytest.mark.parametrize(
    ("near", "degrees"),
    [
        (NEAR, 0.4),
        (NEAR, 1.5),
        # All matches lie within some pixels of many lines here, those of another K among them.
        (pose((0.2, -0.4, 0.1), (0.02, 0.004, 0.003)), 1.2),
        (TRUE, 2.0),
    ],
)
def test_right_and_inexact_poses_are_no_mistakes(near: np.ndarray, degrees: float) -> None:
    tracks, Ts, _ = make_tracks([near], noise_px=0.2, outliers=0.02)
    assert find_mistake(tracks, Ts[0], Ts[0]) is None
    for turn in np.random.default_rng(0).normal(size=(10, 3)):
        given = np.linalg.inv(near @ pose(degrees * turn / np.linalg.norm(turn), (0, 0, 0)))
        assert find_mistake(tracks, given, Ts[0]) is None


RIG = pose((0, 0, 0), (0.3, 0, 0))


def test_what_lies_behind_infinity_is_counted_on_its_own_side_alone() -> None:
    """Depths are uniform in 2 to 8 m: disparities of 18.75 px and more."""
    tracks, Ts, depth_m = make_tracks([RIG], outliers=0.0)
    assert behind_infinity(tracks, Ts) == (0.0, 0.0)
    for moved, share in ((-30.0, float((150.0 / depth_m < 29.0).mean())), (30.0, 0.0), (-17.0, 0.0)):
        K_off = K.copy()
        K_off[0, 2] += moved  # a cx too small by d takes d from every disparity
        off = replace(tracks, K_rights=K_off[None])
        found = behind_infinity(off, Ts)
        assert found.share == pytest.approx(share, abs=0.01)
        # The farthest lies 8 m away, at a disparity of 18.75 px.
        assert found.px == pytest.approx(max(0.0, -moved - 18.75), abs=0.6)
    up = tracks.right_px + [0.0, 3.0]  # off its lines a match says nothing
    assert np.isnan(behind_infinity(replace(tracks, right_px=up), Ts)).all()
    assert np.isnan(behind_infinity(tracks.kept(slice(39)), Ts)).all()
    assert behind_infinity(tracks.kept(slice(40)), Ts) == (0.0, 0.0)


@pytest.mark.parametrize(("count", "px"), [(8, 0.0), (20, 5.0)])
def test_single_matches_behind_infinity_say_nothing_of_how_far_it_goes(count: int, px: float) -> None:
    """Of 600 matches 8 are 1.3 %, as of right pairs; 20 are 3.3 %."""
    tracks, Ts, depth_m = make_tracks([RIG], noise_px=0.0, outliers=0.0)
    right_px = tracks.right_px.copy()
    right_px[0, :count, 0] += 150.0 / depth_m[:count] + 5.0
    found = behind_infinity(replace(tracks, right_px=right_px), Ts)
    assert found.share == pytest.approx(count / 600) and found.px == pytest.approx(px, abs=1e-6)


def test_a_principal_point_that_is_off_is_seen_in_pictures_of_far_things() -> None:
    rig = render_pair(0, size=(240, 320), posed=False)
    left, K_left, E = rig.left.image_01.float(), rig.K_left.float(), rig.E.numpy()
    disparity_px = float(K_left[0, 0]) * E[0, 3] / float(rig.left.depth_m.median())
    shares = []
    for off_px in (0.0, disparity_px):  # what is further than the median then lies behind infinity
        K_right = rig.K_right.float().clone()
        K_right[0, 2] -= off_px
        T = torch.from_numpy(np.linalg.inv(E)).float()
        rights = (CameraView(rig.right.image_01.float(), K_right, T),)
        shares.append(checked_views(PosedViews(left, rights, K_left)).report.behind_infinity)
    assert shares[0] < 0.02 and shares[1] > 0.2


@pytest.mark.parametrize(
    ("E", "centre_off_px", "share"),
    [(RIG, 0.0, 0.0), (TRUE, 0.0, 0.0), (RIG, 200.0, 1.0)],
    ids=["rig", "posed", "rig of other centres"],
)
def test_the_matches_show_whether_near_and_far_could_be_exchanged(E, centre_off_px, share) -> None:
    """A rig sees disparities of 19 to 75 px: with centres 200 px apart they are in front either way round."""
    tracks, Ts, _ = make_tracks([E], count=1500, noise_px=0.2, outliers=0.02)
    K_right = K.copy()
    K_right[0, 2] += centre_off_px
    tracks = replace(tracks, right_px=tracks.right_px + [centre_off_px, 0.0], K_rights=K_right[None])
    width, height = (round(2 * c + 1) for c in K[:2, 2])
    sizes = [(height, width), (height, width)]
    assert exchangeable(tracks, Ts, Ts, sizes) == pytest.approx(share, abs=0.25)
    mirrored_px = [width - 1.0, 0.0] + tracks.right_px * [-1.0, 1.0]
    mistaken = (
        replace(tracks, left_px=tracks.right_px[0], right_px=tracks.left_px[None]),
        replace(tracks, left_px=[width - 1.0, 0.0] + tracks.left_px * [-1.0, 1.0], right_px=mirrored_px),
    )
    assert [exchangeable(each, Ts, Ts, sizes) for each in mistaken] == [1.0, 1.0]
    assert np.isnan(exchangeable(tracks.kept(slice(39)), Ts, Ts, sizes))


@pytest.mark.parametrize(("part", "share"), [(0.0, 0.0), (0.3, 0.3), (0.45, 0.45)])
def test_a_part_that_moved_across_the_lines_is_seen_where_the_rest_fits(part: float, share: float) -> None:
    tracks, Ts, _ = make_tracks([RIG], count=1500, noise_px=0.2, outliers=0.05)
    moved = tracks.left_px[:, 0] < np.quantile(tracks.left_px[:, 0], part)
    shifted = replace(tracks, right_px=tracks.right_px + np.outer(moved, [3.0, 6.0]))
    assert moved_share(shifted, Ts[0]) == pytest.approx(share, abs=0.07)
    apart = np.random.default_rng(0).uniform(-25, 25, len(tracks))  # wrong matches, each by its own
    wrong = replace(tracks, right_px=tracks.right_px + np.outer(moved * apart, [0.0, 1.0]))
    assert moved_share(wrong, Ts[0]) == 0.0
    a_little = replace(tracks, right_px=tracks.right_px + np.outer(moved, [3.0, 1.7]))
    assert moved_share(a_little, Ts[0]) == 0.0
    assert np.isnan(moved_share(tracks.kept(slice(39)), Ts[0]))
    assert np.isnan(moved_share(tracks.kept(slice(0)), Ts[0]))


@pytest.mark.parametrize("k1", [-0.25, -0.1, 0.0, 0.2])
@pytest.mark.parametrize("E", [RIG, TRUE], ids=["rig", "posed"])
def test_distortion_of_both_pictures_is_measured(k1: float, E: np.ndarray) -> None:
    tracks, Ts, _ = make_tracks([E], count=1500, outliers=0.05)

    def distorted(px: np.ndarray) -> np.ndarray:  # OpenCV's model, written out
        x = (px - K[:2, 2]) / 500.0
        return 500.0 * x * (1.0 + k1 * (x**2).sum(-1, keepdims=True)) + K[:2, 2]

    bent = replace(tracks, left_px=distorted(tracks.left_px), right_px=distorted(tracks.right_px))
    found, alone, at_most = remaining_distortion(bent, Ts[0])
    assert found == pytest.approx(k1, abs=0.03) and abs(found) <= abs(k1) + 0.005
    assert abs(k1) < at_most < abs(k1) + 0.03
    assert remaining_distortion(bent.kept(slice(100)), Ts[0]).at_most > at_most, "fewer matches exclude less"
    assert alone == pytest.approx(k1, abs=0.06) and abs(alone) <= abs(found)
    assert np.isnan(remaining_distortion(bent.kept(slice(39)), Ts[0])).all()


def test_rays_without_a_distortion_are_those_of_opencv() -> None:
    """Also rays so far out that the model folds there, which OpenCV leaves as they are."""
    bent = np.random.default_rng(0).normal(0.0, 0.9, (2, 500))
    k1s = np.array([-0.6, -0.2, 0.0, 0.3])
    theirs = [cv2.undistortPoints(bent.T[:, None], np.eye(3), np.array([k1, 0, 0, 0])) for k1 in k1s]
    np.testing.assert_allclose(undistorted_rays(bent, k1s), np.stack(theirs)[:, :, 0], rtol=1e-9)
    assert (undistorted_rays(bent, k1s)[0] == bent.T).all(1).any()


def test_a_grey_picture_is_the_same_in_any_layout_and_rounded_to_the_nearest_level() -> None:
    planes = torch.rand(3, 40, 60, generator=torch.Generator().manual_seed(0))
    luma = np.array([0.299, 0.587, 0.114]) @ planes.double().numpy().reshape(3, -1)
    interleaved = planes.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    strided = torch.stack([planes, planes], dim=-1)[..., 0]
    for image in (planes, interleaved, strided):
        grey, _ = grey_image(image, torch.eye(3), 1.0)
        assert grey.dtype == np.uint8
        assert np.abs(grey - 255.0 * luma.reshape(40, 60)).max() < 0.5 + 1e-3
    alone, _ = grey_image(strided[:1], torch.eye(3), 1.0)
    np.testing.assert_array_equal(alone, np.rint(255.0 * planes[0].numpy()))


def test_the_threads_for_features_stay_for_the_next_pictures() -> None:
    rng = np.random.default_rng(0)
    views = [(rng.integers(0, 256, (60, 80), dtype=np.uint8), np.eye(3)) for _ in range(2)]

    def threads(scale: float) -> set[threading.Thread]:
        return {
            each for each in threading.enumerate() if each.name.startswith(f"geodiff-features-{scale:g}_")
        }

    for scale in (1.0, 0.5):  # small pictures wait for no whole ones
        sparse_tracks(views, scale)
        before = threads(scale)
        sparse_tracks(views, scale)
        assert before and before <= threads(scale) and len(threads(scale)) <= 4


@pytest.mark.parametrize("E", [RIG, TRUE], ids=["rig", "posed"])
def test_a_turn_or_a_shear_that_looks_like_a_distortion_is_not_called_one(E: np.ndarray) -> None:
    """Between parallel cameras a yaw bends residuals over the picture much as a distortion does."""
    tracks, Ts, _ = make_tracks([E], count=1500, outliers=0.05)
    yaw = np.eye(4)
    yaw[:3, :3] = Rotation.from_euler("y", 2.0, degrees=True).as_matrix()
    sheared = tracks.right_px + np.stack(
        [0 * tracks.right_px[..., 1], 0.02 * (tracks.right_px[..., 1] - 255.5)], axis=-1
    )
    found = [
        remaining_distortion(tracks, yaw @ Ts[0]),
        remaining_distortion(replace(tracks, right_px=sheared), Ts[0]),
    ]
    assert abs(found[0].k1) > 0.05  # of both cameras' lenses, if nothing else were thought of
    assert all(abs(each.alone) < 0.03 for each in found)


def test_errors_that_neighbours_share_are_no_distortion() -> None:
    """Tenths of the picture that lie .6 px beside their lines, as matches of single surfaces do."""
    tracks, Ts, _ = make_tracks([RIG], count=800, outliers=0.0, noise_px=0.05)
    part = (tracks.left_px // 51.1).astype(int)
    for seed in range(12):
        off_px = np.random.default_rng(seed).normal(0.0, 0.6, (20, 20))[part[:, 1], part[:, 0]]
        right_px = tracks.right_px + np.stack([np.zeros_like(off_px), off_px], axis=1)
        assert abs(remaining_distortion(replace(tracks, right_px=right_px), Ts[0]).k1) < 0.002


def bent(tracks: Tracks, px: float) -> Tracks:
    moved = tracks.right_px.copy()
    moved[0, :, 1] += px * ((tracks.right_px[0, :, 0] - 255.5) / 256) ** 2
    return replace(tracks, right_px=moved)


def test_a_smooth_residual_is_straightened_and_pixels_move_where_matches_go() -> None:
    tracks, Ts, _ = make_tracks([pose((0, 0, 0), (0.3, 0, 0))])
    off = bent(tracks, 2.0)
    displacement = fit_displacement(off, Ts[0], SIZE)
    straight = replace(off, right_px=off.right_px + displacement.at(off.right_px[0]))
    before, after = (np.median(residuals_px(t, Ts)) for t in (off, straight))
    assert after < 0.3 * before
    assert fit_displacement(tracks, Ts[0], SIZE) is None, "there is nothing smooth in noise"
    ramp = torch.arange(SIZE[0], dtype=torch.float32).view(1, -1, 1).expand(3, *SIZE) / 1000
    moved = straightened(ramp, displacement)[0, 200, 500] * 1000
    assert moved == pytest.approx(200 - displacement.at(np.array([[500.0, 200.0]]))[0, 1], abs=0.05)


@pytest.fixture(scope="module")
def pair():
    return render_pair(3, size=(240, 320), exposure=True, posed=True)


def posed(pair, E):
    T = torch.from_numpy(np.linalg.inv(E)).float()
    rights = (CameraView(pair.right.image_01.float(), pair.K_right.float(), T),)
    return PosedViews(pair.left.image_01.float(), rights, pair.K_left.float())


def test_a_tracker_keeps_the_scene_and_a_measured_baseline_its_length(pair) -> None:
    """The camera has turned about a point of the scene: its depth is right, the baseline is not."""
    E = pair.E.numpy().astype(float)
    about = np.eye(4)
    about[2, 3] = float(pair.left.depth_m.median())
    wrong = about @ pose((1.0, -1.2, 0.4), (0, 0, 0)) @ np.linalg.inv(about) @ E
    length, given_length = (np.linalg.norm(P[:3, 3]) for P in (E, wrong))
    assert abs(np.log(given_length / length)) > 0.1, "else nothing is tested"
    _, kept = checked_views(posed(pair, wrong), measured=True)
    assert kept.status == "refined" and kept.scale_spread is None
    assert np.linalg.norm(kept.E[0][:3, 3]) == pytest.approx(given_length, rel=0.02)
    _, report = checked_views(posed(pair, wrong))
    moved = np.log(np.linalg.norm(report.E[0][:3, 3]) / given_length)
    assert 0.2 < moved / np.log(length / given_length) < 1.2
    assert report.scale_spread > 0.05  # even where both lengths agree
    native = posed(pair, wrong)
    seen = Evidence(
        native,
        grid=native,
        volume=None,
        matches=None,
        report=BackgroundTask.known(report),
    )
    assert indicators_of(seen, {}).scale_spread == report.scale_spread
    assert np.isnan(indicators_of(seen, {}, has_unit=False).scale_spread)


def test_views_are_used_as_given_where_no_better_pose_is_near(pair) -> None:
    E = pair.E.numpy()
    given = posed(pair, E)
    left, rights, _ = given
    image = rights[0].image_01.permute(1, 2, 0).numpy()
    x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in image.shape[1::-1]))
    waves = cv2.remap(image, x, y + 4 * np.sin(x * np.float32(2 * np.pi / 40)), cv2.INTER_LINEAR)
    waved = rights[0]._replace(image_01=torch.from_numpy(waves.transpose(2, 0, 1).copy()))
    blank = torch.full_like(left, 0.5)
    nothing = given._replace(left_01=blank, views=(rights[0]._replace(image_01=blank),))
    inverse = np.linalg.inv(E)
    for inputs, status, said in (
        (given, "fits", None),
        (posed(pair, E @ pose((0, 0, 10), (0, 0, 0))), "kept", "A pose 10 degrees and .* was not used"),
        (given._replace(views=(waved,)), "kept", "no pose near it leaves clearly less"),
        (posed(pair, inverse), "mistaken", "world-to-camera"),
        (nothing, "not checked", None),
    ):
        used, report = checked_views(inputs)
        assert report.status == status and bool(report.warnings) == (said is not None)
        assert said is None or re.search(said, report.warnings[0])
        assert used == inputs.views


@pytest.fixture(scope="module")
def plain():
    """Views in which SIFT finds too little."""
    return render_pair(9, size=(96, 128), posed=True, effects=True)


def test_where_features_are_few_optical_flow_shows_whether_a_pose_fits(plain) -> None:
    right, wrong = plain.E.numpy(), plain.E.numpy() @ pose((1.0, -0.5, 0.5), (0, 0, 0))
    assert not fit_module.measure_fit(fit_module.posed_greys(posed(plain, right))).is_known, (
        "else nothing is tested"
    )
    given = posed(plain, right)
    used, report = checked_views(given)
    assert used == given.views and not report.warnings
    assert report.status == "fits" and report.residual_px[0] < 0.3 and report.matches[0] > 50
    _, report = checked_views(posed(plain, wrong))
    assert report.status == "refined" and report.residual_px[0] < 0.3 < report.residual_px_given[0]
    assert "pose.few-matches" in [message.code for message in report.warnings]
    assert all(message.forbids_trust for message in report.warnings if message.code == "pose.few-matches")


def test_a_calibration_is_not_changed_for_what_flow_alone_shows() -> None:
    pair = render_pair(9, size=(96, 128), posed=False, effects=True)
    assert checked_views(posed(pair, pair.E.numpy())).report.status == "fits"
    raised = replace(pair, right=replace(pair.right, image_01=torch.roll(pair.right.image_01, 2, dims=-2)))
    given = posed(raised, pair.E.numpy())
    assert not fit_module.measure_fit(fit_module.posed_greys(given)).is_known, "else nothing is tested"
    used, report = checked_views(given)
    assert report.status == "not checked" and used == given.views and report.residual_px[0] > 0.45


def test_the_scale_of_a_pose_in_use_is_that_of_the_scene_unless_its_length_was_measured(pair) -> None:
    """A pair does not show how far its cameras are apart."""
    given = posed(pair, pair.E.numpy())
    assert checked_views(given).report.scale_spread == refine.DEPTH_SPREAD
    assert checked_views(given, measured=True).report.scale_spread is None
    rig = render_pair(0, size=(240, 320), posed=False)
    assert checked_views(posed(rig, rig.E.numpy())).report.scale_spread is None


def test_everything_downstream_sees_the_refined_pose(pair) -> None:
    true = pair.E.numpy()
    wrong = true @ pose((0.8, -0.9, 0.5), (0, 0, 0))
    Ks = (pair.K_left.numpy(), pair.K_right.numpy())
    left = pair.left.image_01.float()[None]
    (refined,) = GeometryGuidance(pair.right.image_01, Ks, wrong).prepare(left)
    (given,) = GeometryGuidance(pair.right.image_01, Ks, wrong, pose="given").prepare(left)
    report, E = refined.report.result(), np.linalg.inv(refined.native.views[0][2].numpy())
    assert report.status == "refined" and report.residual_px[0] < 0.3 < 1.0 < report.residual_px_given[0]
    assert "px off their epipolar lines" in report.warnings[0]
    assert angle_deg(report.E[0][:3, :3].T @ true[:3, :3]) < 0.2
    assert np.allclose(E, report.E[0], atol=1e-5) and np.allclose(report.E_given[0], wrong, atol=1e-6)
    _, K_right, T = refined.grid.views[0]
    assert np.allclose(np.linalg.inv(T.numpy()), E, atol=1e-6)
    as_refined = Parallax(refined.grid.K_left, K_right, T, refined.grid.size, "E")
    found_px = refined.volume.parallax[0].median_shift(0.5)
    assert found_px == pytest.approx(as_refined.median_shift(0.5), rel=1e-5)
    assert given.report.result().status == "given"
    assert np.allclose(np.linalg.inv(given.native.views[0][2].numpy()), wrong, atol=1e-5)


def check_during_matching(monkeypatch) -> None:
    """As on CUDA: the poses are checked in threads beside the matching of the views."""
    for module in ("_threads", "evidence.prepare"):
        monkeypatch.setattr(f"geodiff_plugin.{module}.leaves_cpu_free", lambda device: True)


def hold_until(asked: threading.Event, name: str, monkeypatch) -> None:
    """Let a function of the check wait for the event where evidence is made."""
    function = getattr(prepare_module, name)

    def patient(*args):
        assert asked.wait(60)
        return function(*args)

    monkeypatch.setattr(f"geodiff_plugin.evidence.prepare.{name}", patient)


@pytest.mark.parametrize(
    ("turn_deg", "noise", "status"), [(0.0, 0.0, "fits"), (0.8, 0.0, "refined"), (0.0, 0.012, "kept")]
)
def test_evidence_made_beside_the_check_of_the_poses_is_the_same(
    pair, monkeypatch, turn_deg, noise, status
) -> None:
    """As on CUDA: features are matched before it is known whether the photographs are clean, and again if
    not; the views are matched as given meanwhile, and again if a pose is refined."""
    E = pair.E.numpy() @ pose((turn_deg, -turn_deg, 0), (0, 0, 0))
    generator = torch.Generator().manual_seed(0)
    left, right = (
        (image + noise * torch.randn(image.shape, generator=generator)).clamp(0.0, 1.0)
        for image in (pair.left.image_01.float(), pair.right.image_01.float())
    )
    guidance = GeometryGuidance(right, (pair.K_left.numpy(), pair.K_right.numpy()), E)
    (alone,) = guidance.prepare(left[None])
    assert torch.equal(alone.native.left_01, left) == (noise == 0.0)
    check_during_matching(monkeypatch)
    (beside,) = guidance.prepare(left[None])
    reports = [each.report.result() for each in (alone, beside)]
    assert all(report.status == status for report in reports)
    assert reports[0].residual_px == reports[1].residual_px
    assert reports[0].warnings == reports[1].warnings and alone.noticed == beside.noticed
    assert torch.equal(alone.matches.inverse_depth, beside.matches.inverse_depth)
    assert torch.equal(alone.volume.levels, beside.volume.levels)


def test_flow_is_asked_about_few_features_beside_the_matching_as_well(pair, monkeypatch) -> None:
    """As on CUDA: too few features do not show that the poses fit, by which the views were matched."""
    E = pair.E.numpy() @ pose((0.8, -0.8, 0), (0, 0, 0))
    left, right = pair.left.image_01.float(), pair.right.image_01.float()
    guidance = GeometryGuidance(right, (pair.K_left.numpy(), pair.K_right.numpy()), E)
    posed = guidance.inputs[0].posed_views(left)
    count = int(fit_module.measure_fit(fit_module.posed_greys(posed)).tracks.seen.sum())
    for module in (fit_module, refine, tracks_module):
        monkeypatch.setattr(module, "FEWEST", count + 1)
    (alone,) = guidance.prepare(left[None])
    check_during_matching(monkeypatch)
    (beside,) = guidance.prepare(left[None])
    assert [each.report.result().status for each in (alone, beside)] == ["refined", "refined"]
    assert torch.equal(alone.volume.levels, beside.volume.levels)


def test_evidence_of_poses_that_fit_is_there_before_all_is_known_about_them(pair, monkeypatch) -> None:
    """As on CUDA: what else the check finds is for act 3, so denoising does not wait for it."""
    asked = threading.Event()

    hold_until(asked, "refine_views", monkeypatch)
    check_during_matching(monkeypatch)
    guidance = GeometryGuidance(
        pair.right.image_01, (pair.K_left.numpy(), pair.K_right.numpy()), pair.E.numpy()
    )
    (made,) = guidance.prepare(pair.left.image_01.float()[None])
    assert made.matches is not None and not asked.is_set()
    asked.set()
    assert made.report.result().status == "fits"


def demo_views(turn_deg: float = 0.0) -> PosedViews:
    """The demo pair, whose right camera has turned up or down."""
    shown = read_demo_pair()
    left, right = (torch.from_numpy(each).permute(2, 0, 1) for each in (shown.left, shown.right))
    T = np.linalg.inv(shown.rig.E @ pose((turn_deg, 0.0, 0.0), (0, 0, 0)))
    K_left, K_right, T_right = (torch.from_numpy(m).float() for m in (shown.rig.K_left, shown.rig.K_right, T))
    return PosedViews(left, (CameraView(right, K_right, T_right),), K_left)


def test_small_pictures_that_show_that_poses_fit_are_enough(monkeypatch) -> None:
    """As on CUDA: denoising does not wait for the features of the pictures themselves."""
    asked = threading.Event()

    hold_until(asked, "measure_fit", monkeypatch)
    check_during_matching(monkeypatch)
    shown = read_demo_pair()
    guidance = GeometryGuidance(shown.right, (shown.rig.K_left, shown.rig.K_right), shown.rig.E)
    (made,) = guidance.prepare(torch.from_numpy(shown.left).permute(2, 0, 1)[None])
    assert made.matches is not None and not asked.is_set()
    asked.set()
    assert made.report.result().status == "fits"


@pytest.mark.parametrize(("turn_deg", "fits"), [(0.0, True), (0.1, False), (2.0, False)])
def test_small_pictures_say_surely_only_of_poses_that_fit(turn_deg: float, fits: bool) -> None:
    greys = fit_module.posed_greys(demo_views(turn_deg))
    assert fit_module.fit_of_small(greys).surely is fits
    few = replace(greys, views=[(np.full_like(grey, 90), K) for grey, K in greys.views])
    assert not fit_module.fit_of_small(few).surely


@pytest.mark.parametrize("rig", [True, False])
def test_one_answer_holds_where_small_and_whole_pictures_differ(rig: bool, monkeypatch) -> None:
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
    views, report = refine.refine_views(posed, fit)
    assert views is posed.views and report.status == "fits"
    monkeypatch.setattr(fit_module, "SURELY", 1e9)
    assert fit_module.measure_fit(greys).fits


def test_small_pictures_of_a_rig_say_all_where_they_exclude_what_is_unusual(monkeypatch) -> None:
    posed = demo_views()
    greys = fit_module.posed_greys(posed)
    fit = fit_module.measure_fit(greys)
    assert fit.is_small and fit.rig
    whole = fit.of_whole_pictures()
    assert not whole.is_small and len(whole.tracks) > 2 * len(fit.tracks)
    few, many = (len(each.tracks) for each in (fit, whole))
    assert refine.refine_views(posed, fit).report.matches == (few,)
    for name in ("LITTLE_BEHIND", "LITTLE_DISTORTION", "LITTLE_MOVED", "LITTLE_EXCHANGED"):
        with monkeypatch.context() as patched:
            patched.setattr(refine, name, -1.0)
            assert refine.refine_views(posed, fit).report.matches == (many,), name
    mistake = Message("camera.other-centre", "Something is wrong.")
    found = iter([(mistake,), ()])
    monkeypatch.setattr(refine, "_messages", lambda *_: next(found))
    views, report = refine.refine_views(posed, fit)
    assert report.matches == (many,) and not report.warnings and views is posed.views


def test_of_several_right_views_features_at_full_size_are_asked() -> None:
    """What only one of them shows could be hidden behind the others."""
    shown = demo_views()
    fit = fit_module.measure_fit(fit_module.posed_greys(shown._replace(views=shown.views * 2)))
    assert fit.rig and not fit.is_small and len(fit.residual_px) == 2


def test_few_features_do_not_hide_what_features_at_full_size_show() -> None:
    """Distortion that few matches show, but not for certain, is looked for in more of them."""
    shown = demo_views()
    K_left = shown.K_left.double().numpy()

    def distorted(image: torch.Tensor) -> torch.Tensor:
        v, u = np.indices(image.shape[1:], dtype=np.float64)
        bent_px, lens = np.stack([u, v], -1).reshape(-1, 1, 2), np.array([-0.09, 0, 0, 0])
        px = cv2.undistortPoints(bent_px, K_left, lens, P=K_left).reshape(*u.shape, 2).astype(np.float32)
        made = cv2.remap(image.permute(1, 2, 0).numpy(), px, None, cv2.INTER_LINEAR)
        return torch.from_numpy(made).permute(2, 0, 1)

    (view,) = shown.views
    bent = shown._replace(
        left_01=distorted(shown.left_01), views=(view._replace(image_01=distorted(view.image_01)),)
    )
    fit = fit_module.measure_fit(fit_module.posed_greys(bent))
    certain = refine._signs_of(fit, fit.greys.given).distortion.k1
    assert fit.is_small and -0.08 < certain < 0.0, "else nothing is tested"
    report = refine.refine_views(bent, fit).report
    of_small = len(fit_module.fit_of_small(fit.greys).tracks)
    assert report.distortion < certain and report.matches[0] > 1.5 * of_small


def test_limits_for_small_pictures_are_stricter_than_those_of_a_result() -> None:
    """That of the distortion is one for its upper bound, which has two standard errors in it."""
    assert min(misfit.USUAL_BEHIND, verdict.MOST_BEHIND) >= 2.0 * refine.LITTLE_BEHIND
    assert min(misfit.USUAL_DISTORTION, verdict.MOST_DISTORTION) >= refine.LITTLE_DISTORTION
    assert 2.0 * refine.LITTLE_MOVED <= verdict.MOST_MOVED
    assert 2.0 * refine.LITTLE_EXCHANGED <= verdict.EXCHANGEABLE


def test_matches_of_small_pictures_are_in_pixels_of_the_whole_ones() -> None:
    rng = np.random.default_rng(0)
    whole = cv2.GaussianBlur(rng.integers(0, 256, (241, 330)).astype(np.uint8), (0, 0), 3.0)
    whole = cv2.normalize(whole, None, 0, 255, cv2.NORM_MINMAX)
    views = [(whole[3:, 10:].copy(), np.eye(3)), (whole[:-3, :-10].copy(), np.eye(3))]
    tracks = sparse_tracks(views, 0.5)
    assert len(tracks) > 40
    moved = np.median(tracks.right_px[0] - tracks.left_px, axis=0)
    assert moved == pytest.approx((10.0, 3.0), abs=0.1)
    at = np.median(tracks.left_px / np.array([320, 238]), axis=0)
    assert at == pytest.approx((0.5, 0.5), abs=0.15)  # all over the whole picture


@pytest.mark.parametrize("seed", [pytest.param(2, marks=pytest.mark.slow), 6])
def test_the_rows_of_a_rig_that_has_drifted_agree_again(seed: int) -> None:
    """Its right camera has turned by 0.3 degrees, and its image has moved by 1.5 px."""
    rig = render_pair(seed, size=(240, 320))
    axis = np.random.default_rng(seed).normal(size=3)
    E, K_right = rig.E.numpy().copy(), rig.K_right.numpy().copy()
    E[:3, :3] = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(0.3)).as_matrix()
    K_right[1, 2] += 1.5
    drifted = render_pair(seed, size=(240, 320), E=E, K_right=K_right)
    T = torch.from_numpy(np.linalg.inv(rig.E.numpy())).float()
    rights = (CameraView(drifted.right.image_01.float(), rig.K_right.float(), T),)
    views = PosedViews(drifted.left.image_01.float(), rights, rig.K_left.float())
    _, report = checked_views(views, measured=True)
    assert report.status == "refined"
    assert report.residual_px[0] < 0.3 < 0.45 < report.residual_px_given[0]
    assert np.linalg.norm(report.E[0][:3, 3]) == pytest.approx(float(rig.E[0, 3]), rel=0.03)


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
