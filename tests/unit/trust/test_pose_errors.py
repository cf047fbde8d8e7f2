"""Usual errors in poses and cameras: each is undone exactly, and distinguished from an inexact pose."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin.trust import pose_errors
from geodiff_plugin.trust.inverse_pose import Preference
from geodiff_plugin.trust.pose_errors import (
    FoundErrors,
    PoseError,
    PoseErrors,
    find_pose_error,
    fine_fraction,
    inverted_order,
)
from tests.unit.pose.posed_scene import K_LEFT, K_RIGHTS, POSES, make_scene, moved, pose
from tests.unit.trust.made_stages import tracks_stage
from tests.unit.trust.sheets import codes, good, judged

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
VIEWS = pytest.mark.parametrize("v", [0, 1])
FACTORS = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 2, 2.0, 3.0, 4.0)


def transposed(E: np.ndarray) -> np.ndarray:
    out = E.copy()
    out[:3, :3] = E[:3, :3].T
    return out


def mixed(E: np.ndarray) -> np.ndarray:
    """The rotation of the pose, with the translation of its inverse."""
    out = E.copy()
    out[:3, 3] = np.linalg.inv(E)[:3, 3]
    return out


#: What a person does to a right pose, by the error's code.
OF_POSES = {
    "depth.inverted-order": np.linalg.inv,
    "pose.opengl": lambda E: FLIP @ E @ FLIP,
    "pose.opengl-inverse": lambda E: FLIP @ np.linalg.inv(E) @ FLIP,
    "pose.transposed": transposed,
    "pose.mixed": mixed,
}


def explains_all(undone) -> bool:
    fractions, median_px = pose_errors._support(undone.tracks, undone.T)
    return fractions == (1.0, 1.0) and median_px < 1e-6


@VIEWS
@pytest.mark.parametrize("code", OF_POSES)
def test_a_pose_error_is_undone_exactly_and_reported(v, code):
    scene = make_scene(300)
    tracks = scene.tracks.alone(v)
    T = np.linalg.inv(OF_POSES[code](POSES[v]))
    undone = {each.error.code: each for each in pose_errors._undone(tracks, T)}
    np.testing.assert_allclose(undone[code].T, scene.Ts[v], atol=1e-12)
    assert explains_all(undone[code])
    noisy = make_scene(300, noise_px=0.2, outliers=0.05).tracks.alone(v)
    assert find_pose_error(noisy, T, T).code == code


@VIEWS
@pytest.mark.parametrize("zoom", [0.5, 1.0, 2.0])
def test_swapped_images_of_different_cameras_are_swapped_and_no_cameras_of_another_size(v, zoom):
    """Their matches also have each other's K, so the inverse pose alone does not explain them."""
    scene = make_scene(300)
    tracks = scene.tracks.alone(v)
    K_right = tracks.K_rights[0].copy()
    K_right[:2, :2] *= zoom
    depth_m = 1 / pose_errors.epipolar(tracks, scene.Ts[v]).inverse_depth
    points = (tracks.rays * depth_m[:, None]) @ scene.Ts[v][:3, :3].T + scene.Ts[v][:3, 3]
    seen = points @ K_right.T
    right_px = seen[:, :2] / seen[:, 2:]
    given = replace(tracks, K_rights=K_right[None], right_px=right_px[None])
    assert find_pose_error(given, scene.Ts[v], scene.Ts[v]) is None
    swapped = replace(given, left_px=right_px, right_px=tracks.left_px[None])
    assert find_pose_error(swapped, scene.Ts[v], scene.Ts[v]) == PoseError("depth.inverted-order")


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_vertical_rig_given_as_a_horizontal_one_is_named_with_its_axis(way):
    scene = make_scene(300, noise_px=0.1)
    tracks = scene.tracks.alone(0)
    true, horizontal = np.eye(4), np.eye(4)
    true[1, 3], horizontal[0, 3] = -0.2 * way, -0.2
    inverse_depth = pose_errors.epipolar(tracks, scene.Ts[0]).inverse_depth
    points = tracks.rays / inverse_depth[:, None] @ true[:3, :3].T + true[:3, 3]
    seen = points @ tracks.K_rights[0].T
    moved_tracks = replace(tracks, right_px=(seen[:, :2] / seen[:, 2:])[None])
    found = find_pose_error(moved_tracks, horizontal, horizontal)
    assert found == PoseError("pose.vertical", way)
    assert find_pose_error(moved_tracks, true, true) is None
    said = judged(good(FoundErrors((found,))), "pose.vertical")
    assert "along the y axis" in said and f"(0, {way:+g} * baseline, 0)" in said
    tilted = scene.Ts[0].copy()
    assert not any(each.error.code == "pose.vertical" for each in pose_errors._undone(tracks, tilted))


def cameras_of(tracks, factor: float, keeps_centre: bool):
    """The tracks with cameras of images that are ``factor`` times as large."""
    Ks = np.stack([tracks.K_left, *tracks.K_rights])
    size = np.diag([factor, factor, 1.0])
    size[:2, 2] = 0.5 * factor - 0.5  # the first pixel's corner stays the corner
    other = size @ Ks
    if keeps_centre:
        other[:, :2, 2] = Ks[:, :2, 2]
    return replace(tracks, K_left=other[0], K_rights=other[1:])


@VIEWS
@pytest.mark.parametrize("keeps_centre", [False, True])
@pytest.mark.parametrize("factor", FACTORS)
def test_cameras_of_another_image_size_are_undone_exactly_and_named_with_both_factors(
    v, factor, keeps_centre
):
    scene = make_scene(300, noise_px=0.1)
    tracks = cameras_of(scene.tracks.alone(v), 1 / factor, keeps_centre)
    code = "camera.focal-scaled" if keeps_centre else "camera.scaled"
    found = find_pose_error(tracks, scene.Ts[v], scene.Ts[v])
    assert found == PoseError(code, factor)
    by_code = [each for each in pose_errors._undone(tracks, scene.Ts[v]) if each.error == found]
    (undone,) = by_code
    np.testing.assert_allclose(undone.tracks.K_left, K_LEFT, atol=1e-9)
    np.testing.assert_allclose(undone.tracks.K_rights, K_RIGHTS[v : v + 1], atol=1e-9)


@VIEWS
def test_swapped_cameras_are_reported_if_they_differ(v):
    scene = make_scene(300, noise_px=0.1)
    tracks = scene.tracks.alone(v)
    swapped = replace(tracks, K_left=K_RIGHTS[v], K_rights=K_LEFT[None])
    assert find_pose_error(swapped, scene.Ts[v], scene.Ts[v]).code == "camera.swapped"
    for factor, tried in ((1.03, True), (1.01, False)):
        nearly = replace(tracks, K_rights=(K_LEFT * [[factor], [factor], [1.0]])[None])
        codes = [each.error.code for each in pose_errors._undone(nearly, scene.Ts[v])]
        assert ("camera.swapped" in codes) is tried


def test_a_match_supports_a_pose_near_its_line_and_in_front_of_both_cameras():
    scene = make_scene(100)
    tracks, T = scene.tracks.alone(0), scene.Ts[0]
    normals = pose_errors.epipolar(tracks, T).normals
    off = np.repeat([0.5, 1.4, 1.6, 3.9, 4.1], [30, 20, 20, 20, 10])
    tracks = replace(tracks, right_px=tracks.right_px + off[:, None] * normals)
    found = pose_errors._support(tracks, T)
    assert found.fractions == (0.9, 0.5) and found.median_px == pytest.approx(1.5)
    assert fine_fraction(tracks, T) == 0.5
    behind = T @ np.diag([-1.0, -1.0, -1.0, 1.0])  # the same lines; every point is behind a camera
    behind[:3, :3] = T[:3, :3]
    behind[:3, 3] = -T[:3, 3]
    assert pose_errors._support(tracks, behind).fractions == (0.0, 0.0)
    assert pose_errors._support(tracks, behind).median_px == pytest.approx(1.5)
    # Rays that meet in front of the left camera, and behind the right one.
    turned = pose((0.0, 180.0, 0.0), (0.0, 0.0, 0.0)) @ T
    px = (turned[:3, :3] @ scene.points.T + turned[:3, 3:]).T @ K_RIGHTS[0].T
    seen = replace(tracks, right_px=(px[:, :2] / px[:, 2:])[None])
    assert pose_errors._support(seen, turned).fractions == (0.0, 0.0)


MISTAKE = PoseError("pose.mixed")


@pytest.mark.parametrize(
    ("given", "nearby", "candidate", "far", "named"),
    [
        # Coarse fraction, fine fraction and median residual of each pose.
        ((0.2, 0.1, 9.0), (0.9, 0.9, 0.5), (0.9, 0.9, 0.5), False, True),
        (
            (0.5, 0.5, 4.0),
            (0.9, 0.9, 0.5),
            (0.9, 0.9, 0.5),
            True,
            False,
        ),  # no error could explain twice as many
        ((0.5, 0.4, 4.0), (0.9, 0.9, 0.5), (0.9, 0.9, 0.5), True, True),  # but twice as many finely
        ((0.4, 0.5, 4.0), (0.9, 0.9, 0.5), (0.9, 0.9, 0.5), True, True),
        ((0.2, 0.1, 9.0), (0.9, 0.9, 0.5), (0.9, 0.75, 0.5), False, False),  # the nearby pose explains more
        ((0.2, 0.1, 9.0), (0.9, 0.9, 0.5), (0.75, 0.9, 0.5), False, False),
        ((0.2, 0.1, 9.0), (0.9, 0.9, 0.5), (0.78, 0.78, 0.5), False, True),
        ((0.2, 0.1, 9.0), (0.5, 0.5, 0.5), (0.49, 0.49, 0.5), False, False),  # less than half of all
        ((0.2, 0.1, 9.0), (0.59, 0.59, 0.5), (0.51, 0.51, 0.5), False, True),
        (
            (0.3, 0.1, 9.0),
            (0.6, 0.6, 0.5),
            (0.59, 0.59, 0.5),
            False,
            False,
        ),  # less than twice as many coarsely
        ((0.3, 0.1, 9.0), (0.6, 0.6, 0.5), (0.59, 0.59, 0.5), True, True),
        ((0.2, 0.1, 9.0), (0.9, 0.9, 0.5), (0.9, 0.9, 0.59), False, True),  # as exact as the nearby pose
        ((0.2, 0.1, 9.0), (0.9, 0.9, 0.5), (0.9, 0.9, 0.61), False, False),
        ((0.2, 0.1, 9.0), (0.9, 0.9, 0.5), (0.9, 0.9, 0.61), True, True),  # or far from the given one
        ((0.5, 0.4, 4.0), (0.9, 0.9, 0.5), (0.9, 0.9, 0.61), True, False),  # if only finely better, both
        ((0.5, 0.4, 4.0), (0.9, 0.9, 0.5), (0.9, 0.9, 0.5), False, False),
        ((0.2, 0.4, 4.0), (0.9, 0.9, 0.5), (0.9, 0.79, 0.5), False, True),  # coarsely is enough
    ],
)
def test_an_error_is_reported_if_it_explains_clearly_more_than_an_inaccurate_pose(
    given, nearby, candidate, far, named, monkeypatch
):
    T, near = np.eye(4), np.eye(4)
    given, nearby, candidate = (
        pose_errors._Support(support[:2], support[2]) for support in (given, nearby, candidate)
    )
    supports = {id(T): given, id(near): nearby}
    monkeypatch.setattr(pose_errors, "_support", lambda tracks, at: supports[id(at)])
    likeliest = pose_errors._Candidate(MISTAKE, candidate, far)
    monkeypatch.setattr(pose_errors, "_likeliest", lambda tracks, at: likeliest)
    assert find_pose_error(make_scene(3).tracks, T, near) is (MISTAKE if named else None)


@pytest.mark.parametrize(
    ("fits", "chosen"),
    [
        (((0.9, 0.3, 1.0), (0.5, 0.5, 0.2)), 0),  # coarsely first
        (((0.9, 0.3, 1.0), (0.86, 0.5, 2.0)), 1),  # finely among alike ones
        (((0.9, 0.49, 1.0), (0.89, 0.5, 0.9), (0.4, 0.9, 0.1)), 1),  # then by the residual
        (((0.9, 0.5, 0.8), (0.89, 0.49, 0.9)), 0),
        (((0.9, 0.5, 0.8), (0.86, 0.477, 0.7)), 1),
        (((0.9, 0.5, 0.8), (0.86, 0.473, 0.7)), 0),
    ],
)
def test_the_most_likely_error_explains_the_most_coarsely_then_finely_then_exactly(fits, chosen, monkeypatch):
    scene = make_scene(50)
    tracks = scene.tracks.alone(0)
    undone = [
        pose_errors._Undone(
            PoseError("pose.mixed", number), tracks, moved(scene.Ts[0], np.full(6, 1e-3 * number))
        )
        for number in range(len(fits))
    ]
    answers = iter(pose_errors._Support(fit[:2], fit[2]) for fit in fits)
    monkeypatch.setattr(pose_errors, "_undone", lambda *_: undone)
    monkeypatch.setattr(pose_errors, "_support", lambda *_: next(answers))
    found = pose_errors._likeliest(tracks, scene.Ts[0])
    assert found.error == PoseError("pose.mixed", chosen) and not found.far
    assert (*found.support.fractions, found.support.median_px) == fits[chosen]


@pytest.mark.parametrize(
    ("turn_deg", "shift", "other_K", "far"),
    [
        (4.9, 0.0, False, False),
        (5.1, 0.0, False, True),
        (0.0, 0.79, False, False),
        (0.0, 0.81, False, True),
        (0.0, 0.0, True, True),
    ],
)
def test_an_error_is_far_by_its_rotation_or_shift_or_camera(turn_deg, shift, other_K, far, monkeypatch):
    scene = make_scene(50)
    tracks, T = scene.tracks.alone(0), scene.Ts[0]
    step = np.r_[np.radians(turn_deg) * np.array([0.6, 0.0, 0.8]), shift * np.linalg.norm(T[:3, 3]), 0.0, 0.0]
    other = T.copy()
    other[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ T[:3, :3]
    # The camera's centre as the given right camera sees it moves by the step alone.
    change = np.eye(4)
    change[:3, :3], change[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]
    undone = pose_errors._Undone(MISTAKE, replace(tracks) if other_K else tracks, change @ T)
    monkeypatch.setattr(pose_errors, "_undone", lambda *_: [undone])
    assert pose_errors._likeliest(tracks, T).far is far


#: Cameras so close that other poses too leave matches near their lines.
CLOSE = pose((0.5, 3.0, 0.2), (0.09, 0.003, 0.01))
#: So close that all matches are within some pixels of many lines, those of another K among them.
CLOSER = pose((0.2, -0.4, 0.1), (0.02, 0.004, 0.003))
APART = pose((1.0, -6.0, 2.0), (0.3, 0.05, -0.08))


@pytest.mark.parametrize(("E", "degrees"), [(CLOSE, 0.4), (CLOSE, 1.5), (CLOSER, 1.2), (APART, 2.0)])
def test_correct_and_inaccurate_poses_are_no_pose_errors(E, degrees):
    Ks = K_LEFT, K_LEFT[None]
    scene = make_scene(600, noise_px=0.2, outliers=0.02, poses=E[None], Ks=Ks)
    (T,) = scene.Ts
    assert find_pose_error(scene.tracks, T, T) is None
    for turn in np.random.default_rng(0).normal(size=(10, 3)):
        inexact = np.linalg.inv(E @ pose(degrees * turn / np.linalg.norm(turn), (0, 0, 0)))
        assert find_pose_error(scene.tracks, inexact, T) is None


@pytest.mark.parametrize(
    ("error", "factor"),
    [("pose.opengl", None), ("pose.opengl-inverse", None), ("camera.focal-scaled", 0.5)],
)
def test_an_error_is_reported_even_if_other_poses_leave_matches_near_their_lines(error, factor):
    scene = make_scene(600, noise_px=0.15, outliers=0.02, poses=CLOSE[None], Ks=(K_LEFT, K_LEFT[None]))
    tracks, given = scene.tracks, CLOSE
    if factor is None:
        given = OF_POSES[error](CLOSE)
    else:
        tracks = cameras_of(tracks, 1 / factor, keeps_centre=True)
    T = np.linalg.inv(given)
    assert find_pose_error(tracks, T, T) == PoseError(error, factor)


def test_the_errors_of_all_views_with_enough_matches_are_found_once(monkeypatch):
    scene = make_scene(60)
    asked = []

    def find(tracks, T, near):
        asked.append((len(tracks), T, near))
        return MISTAKE

    monkeypatch.setattr(pose_errors, "find_pose_error", find)
    given, nearby = scene.Ts, scene.Ts + 0.1
    assert PoseErrors.of_tracks(tracks_stage(scene.tracks, given, nearby)) == FoundErrors((MISTAKE,))
    for v, (count, T, near) in enumerate(asked):
        assert count == 60
        np.testing.assert_array_equal(T, given[v])
        np.testing.assert_array_equal(near, nearby[v])
    asked.clear()
    seen = scene.tracks.seen.copy()
    seen[0, 39:] = False
    few = replace(scene.tracks, seen=seen)
    assert PoseErrors.of_tracks(tracks_stage(few, given, nearby)) == FoundErrors((MISTAKE,))
    assert [count for count, _, _ in asked] == [60]
    monkeypatch.setattr(pose_errors, "find_pose_error", lambda *_: None)
    assert PoseErrors.of_tracks(tracks_stage(scene.tracks, given, nearby)) == FoundErrors(())


def test_an_error_is_not_ruled_out():
    assert PoseErrors.rules_out(None) and PoseErrors.rules_out(FoundErrors(()))
    assert not PoseErrors.rules_out(FoundErrors((MISTAKE,)))


#: PoseError -> words of its finding.
WORDS = {
    PoseError("pose.opengl"): "OpenGL or Blender axes (y up, z backward), so depth is wrong. "
    "Pass diag(1, -1, -1, 1) @ E @ diag(1, -1, -1, 1).",
    PoseError("pose.opengl-inverse"): "It also seems to be world-to-camera: invert it as well.",
    PoseError("pose.transposed"): "The rotation in E seems to be transposed",
    PoseError("pose.mixed"): "E seems to mix a camera-to-world rotation with a world-to-camera translation",
    PoseError("camera.swapped"): "K seems to be passed as (K_right, K_left)",
    PoseError("camera.scaled", 2.0): "K seems to be for images of 0.5 times this width and height",
    PoseError("camera.scaled", 2 / 3): "With s = 0.666667 use fx * s and (cx + 0.5) * s - 0.5",
    PoseError("camera.focal-scaled", 1 / 3): "The focal lengths seem to be for images of 3 times this "
    "width and height, so depth is wrong. Multiply fx and fy by 0.333; the principal point fits.",
}


@pytest.mark.parametrize("error", WORDS, ids=[error.code for error in WORDS])
def test_each_error_has_a_sentence(error):
    assert WORDS[error] in judged(good(FoundErrors((error,))), error.code)
    assert codes(good(FoundErrors((error,)))) == [error.code]


@pytest.mark.parametrize(
    ("facts", "expected"),
    [
        ([FoundErrors((PoseError("depth.inverted-order"),))], ["depth.inverted-order"]),
        ([Preference(True)], ["depth.inverted-order"]),
        (
            [Preference(True), FoundErrors((PoseError("depth.inverted-order"), MISTAKE))],
            ["depth.inverted-order", "pose.mixed"],
        ),
        ([Preference(False), FoundErrors(())], []),
    ],
)
def test_inverse_poses_are_one_finding_whether_sparse_or_dense_matches_show_them(facts, expected):
    assert codes(good(*facts)) == expected
    if expected:
        assert judged(good(*facts), "depth.inverted-order") == inverted_order()
