"""Usual mistakes of poses and cameras: each is undone exactly, named, and told from an inexact pose."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin.messages import Message
from geodiff_plugin.pose import mistakes
from geodiff_plugin.pose.mistakes import exchangeable, find_mistake, pose_change
from tests.unit.pose.posed_scene import K_LEFT, K_RIGHTS, POSES, SIZES, make_scene, moved, pose

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


#: What a person does to a right pose, by the mistake's code.
OF_POSES = {
    "pose.inverse": np.linalg.inv,
    "pose.opengl": lambda E: FLIP @ E @ FLIP,
    "pose.opengl-inverse": lambda E: FLIP @ np.linalg.inv(E) @ FLIP,
    "pose.transposed": transposed,
    "pose.mixed": mixed,
}


def explains_all(undone) -> bool:
    shares, median_px = mistakes._fit(undone.tracks, undone.T)
    return shares == (1.0, 1.0) and median_px < 1e-6


@VIEWS
@pytest.mark.parametrize("code", OF_POSES)
def test_a_mistaken_pose_is_undone_exactly_and_named(v, code):
    scene = make_scene(300)
    tracks = scene.tracks.alone(v)
    T = np.linalg.inv(OF_POSES[code](POSES[v]))
    undone = {each.mistake.code: each for each in mistakes._undone(tracks, T)}
    np.testing.assert_allclose(undone[code].T, scene.Ts[v], atol=1e-12)
    assert explains_all(undone[code])
    noisy = make_scene(300, noise_px=0.2, outliers=0.05).tracks.alone(v)
    assert find_mistake(noisy, T, T).code == code


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
    found = find_mistake(tracks, scene.Ts[v], scene.Ts[v])
    assert found.code == code
    assert f"times {factor:g}"[:10] in found
    assert f"images of {1 / factor:.3g} times" in found
    by_code = [each for each in mistakes._undone(tracks, scene.Ts[v]) if each.mistake == found]
    (undone,) = by_code
    np.testing.assert_allclose(undone.tracks.K_left, K_LEFT, atol=1e-9)
    np.testing.assert_allclose(undone.tracks.K_rights, K_RIGHTS[v : v + 1], atol=1e-9)


@VIEWS
def test_exchanged_cameras_are_named_if_they_differ(v):
    scene = make_scene(300, noise_px=0.1)
    tracks = scene.tracks.alone(v)
    swapped = replace(tracks, K_left=K_RIGHTS[v], K_rights=K_LEFT[None])
    assert find_mistake(swapped, scene.Ts[v], scene.Ts[v]).code == "camera.swapped"
    for factor, tried in ((1.03, True), (1.01, False)):
        nearly = replace(tracks, K_rights=(K_LEFT * [[factor], [factor], [1.0]])[None])
        codes = [each.mistake.code for each in mistakes._undone(nearly, scene.Ts[v])]
        assert ("camera.swapped" in codes) is tried


def test_a_change_of_pose_is_its_angle_and_its_shift_in_baselines():
    Ts = np.linalg.inv(POSES)
    steps = np.array([[0.02, -0.01, 0.03, 0.0, 0.0, 0.0], [0.0, 0.3, -0.1, 0.05, -0.08, 0.02]])
    turned_deg, shifts = pose_change(
        Ts, np.stack([moved(T, step) for T, step in zip(Ts, steps, strict=True)])
    )
    np.testing.assert_allclose(turned_deg, np.degrees(np.linalg.norm(steps[:, :3], axis=1)))
    for T, step, shift in zip(Ts, steps, shifts, strict=True):
        # In the frame of the given right camera: the place that the change moves its centre to.
        R = Rotation.from_rotvec(step[:3]).as_matrix()
        place = R @ T[:3, 3] + step[3:] - R @ T[:3, :3] @ T[:3, :3].T @ T[:3, 3]
        assert shift == pytest.approx(np.linalg.norm(place) / np.linalg.norm(T[:3, 3]))
    same = pose_change(Ts, Ts)
    np.testing.assert_allclose(same, np.zeros((2, 2)), atol=1e-5)


def test_a_match_supports_a_pose_near_its_line_and_in_front_of_both_cameras():
    scene = make_scene(100)
    tracks, T = scene.tracks.alone(0), scene.Ts[0]
    normals = mistakes.epipolar(tracks, T).normals
    off = np.repeat([0.5, 1.4, 1.6, 3.9, 4.1], [30, 20, 20, 20, 10])
    tracks = replace(tracks, right_px=tracks.right_px + off[:, None] * normals)
    found = mistakes._fit(tracks, T)
    assert found.shares == (0.9, 0.5) and found.median_px == pytest.approx(1.5)
    assert mistakes._fine_share(tracks, T) == 0.5
    behind = T @ np.diag([-1.0, -1.0, -1.0, 1.0])  # the same lines; every point is behind a camera
    behind[:3, :3] = T[:3, :3]
    behind[:3, 3] = -T[:3, 3]
    assert mistakes._fit(tracks, behind).shares == (0.0, 0.0)
    assert mistakes._fit(tracks, behind).median_px == pytest.approx(1.5)
    # Rays that meet in front of the left camera, and behind the right one.
    turned = pose((0.0, 180.0, 0.0), (0.0, 0.0, 0.0)) @ T
    px = (turned[:3, :3] @ scene.points.T + turned[:3, 3:]).T @ K_RIGHTS[0].T
    seen = replace(tracks, right_px=(px[:, :2] / px[:, 2:])[None])
    assert mistakes._fit(seen, turned).shares == (0.0, 0.0)


MISTAKE = Message("pose.mixed", "Something is wrong.")


@pytest.mark.parametrize(
    ("given", "nearby", "candidate", "far", "named"),
    [
        # (coarse share, fine share, median residual) of each pose.
        ((0.2, 0.1, 9.0), (0.9, 0.9, 0.5), (0.9, 0.9, 0.5), False, True),
        (
            (0.5, 0.5, 4.0),
            (0.9, 0.9, 0.5),
            (0.9, 0.9, 0.5),
            True,
            False,
        ),  # no mistake could explain twice as many
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
def test_a_mistake_is_named_if_it_explains_clearly_more_than_an_inexact_pose(
    given, nearby, candidate, far, named, monkeypatch
):
    T, near = np.eye(4), np.eye(4)
    fits = {id(T): mistakes._Fit(given[:2], given[2]), id(near): mistakes._Fit(nearby[:2], nearby[2])}
    monkeypatch.setattr(mistakes, "_fit", lambda tracks, at: fits[id(at)])
    likeliest = mistakes._Candidate(MISTAKE, mistakes._Fit(candidate[:2], candidate[2]), far)
    monkeypatch.setattr(mistakes, "_likeliest", lambda tracks, at: likeliest)
    assert find_mistake(make_scene(3).tracks, T, near) is (MISTAKE if named else None)


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
def test_the_likeliest_mistake_explains_the_most_coarsely_then_finely_then_exactly(fits, chosen, monkeypatch):
    scene = make_scene(50)
    tracks = scene.tracks.alone(0)
    undone = [
        mistakes._Undone(
            Message("pose.mixed", f"Wrong {number}."), tracks, moved(scene.Ts[0], np.full(6, 1e-3 * number))
        )
        for number in range(len(fits))
    ]
    answers = iter(mistakes._Fit(fit[:2], fit[2]) for fit in fits)
    monkeypatch.setattr(mistakes, "_undone", lambda *_: undone)
    monkeypatch.setattr(mistakes, "_fit", lambda *_: next(answers))
    found = mistakes._likeliest(tracks, scene.Ts[0])
    assert found.mistake == f"Wrong {chosen}." and not found.far
    assert (*found.fit.shares, found.fit.median_px) == fits[chosen]


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
def test_a_mistake_is_far_by_its_turn_or_shift_or_camera(turn_deg, shift, other_K, far, monkeypatch):
    scene = make_scene(50)
    tracks, T = scene.tracks.alone(0), scene.Ts[0]
    step = np.r_[np.radians(turn_deg) * np.array([0.6, 0.0, 0.8]), shift * np.linalg.norm(T[:3, 3]), 0.0, 0.0]
    other = T.copy()
    other[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ T[:3, :3]
    # The camera's centre as the given right camera sees it moves by the step alone.
    change = np.eye(4)
    change[:3, :3], change[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]
    undone = mistakes._Undone(MISTAKE, replace(tracks) if other_K else tracks, change @ T)
    monkeypatch.setattr(mistakes, "_undone", lambda *_: [undone])
    assert mistakes._likeliest(tracks, T).far is far


def mirrored(px: np.ndarray, size: tuple[int, int], upside_down: bool = False) -> np.ndarray:
    out = px.copy()
    out[..., 0] = size[1] - 1.0 - px[..., 0]
    if upside_down:
        out[..., 1] = size[0] - 1.0 - px[..., 1]
    return out


def test_matches_of_exchanged_mirrored_and_turned_images_are_put_back():
    scene = make_scene(20)
    tracks = scene.tracks.alone(1)
    left, right = SIZES[0], SIZES[2]
    exchanged, mirror, turned = mistakes._exchanged(tracks, left, right)
    np.testing.assert_array_equal(exchanged.left_px, tracks.right_px[0])
    np.testing.assert_array_equal(exchanged.right_px[0], tracks.left_px)
    for each in (exchanged, mirror, turned):  # the cameras are as given
        assert each.K_left is tracks.K_left and each.K_rights is tracks.K_rights
    for each, upside_down in ((mirror, False), (turned, True)):
        np.testing.assert_allclose(each.left_px, mirrored(tracks.left_px, left, upside_down))
        np.testing.assert_allclose(each.right_px, mirrored(tracks.right_px, right, upside_down))


@pytest.mark.parametrize("kind", ["as it is", "exchanged", "mirrored", "upside down"])
def test_images_in_another_order_or_mirrored_could_have_near_and_far_exchanged(kind):
    """Of images whose sizes differ; by the given poses, and if these are inexact by the nearby ones."""
    scene = make_scene(300, noise_px=0.1, poses=POSES[1:], Ks=(K_LEFT, K_RIGHTS[1:]))
    tracks, sizes = scene.tracks, (SIZES[0], SIZES[2])
    mistaken = {
        "as it is": tracks,
        "exchanged": replace(tracks, left_px=tracks.right_px[0], right_px=tracks.left_px[None]),
        "mirrored": replace(
            tracks,
            left_px=mirrored(tracks.left_px, SIZES[0]),
            right_px=mirrored(tracks.right_px, SIZES[2]),
        ),
        "upside down": replace(
            tracks,
            left_px=mirrored(tracks.left_px, SIZES[0], True),
            right_px=mirrored(tracks.right_px, SIZES[2], True),
        ),
    }[kind]
    inexact = np.stack([moved(scene.Ts[0], np.array([0.1, -0.1, 0.1, 0, 0, 0]))])
    share = exchangeable(mistaken, scene.Ts, scene.Ts, sizes)
    assert share == 1.0 if kind != "as it is" else share < 0.3
    if kind != "as it is":
        assert exchangeable(mistaken, scene.Ts, inexact, sizes) == 1.0
        assert exchangeable(mistaken, inexact, scene.Ts, sizes) == 1.0
    else:
        assert exchangeable(mistaken, inexact, inexact, sizes) <= 1.0


def perturbed_a_little(Ts: np.ndarray) -> np.ndarray:
    return np.stack([moved(T, np.full(6, 1e-4)) for T in Ts])


def test_the_view_that_excludes_an_exchange_best_decides_and_few_matches_do_not(monkeypatch):
    scene = make_scene(60)
    scene.tracks.seen[1, 40:] = False
    # Fine shares: three exchanged variants under the given and the nearby poses, then as it is, by view.
    shares = {0: ((0.1, 0.2, 0.3), (0.05, 0.4, 0.1), 0.8), 1: ((0.15, 0.1, 0.05), (0.2, 0.1, 0.1), 0.5)}

    def expected() -> float:
        return min(max(*given, *near) / as_it_is for given, near, as_it_is in shares.values())

    given, near = scene.Ts, perturbed_a_little(scene.Ts)
    calls = []

    def fine_share(tracks, T):
        (v,) = {v for v in range(2) if any(np.array_equal(T, Ts[v]) for Ts in (given, near))}
        kind = int(np.array_equal(T, near[v]))
        if np.array_equal(tracks.left_px, scene.tracks.view(v).left_px) and np.array_equal(
            tracks.right_px, scene.tracks.view(v).right_px
        ):
            assert kind == 1  # the nearby pose explains the matches as they are
            return shares[v][2]
        calls.append((v, kind))
        return shares[v][kind][calls.count((v, kind)) - 1]

    monkeypatch.setattr(mistakes, "_fine_share", fine_share)
    assert exchangeable(scene.tracks, given, near, SIZES) == pytest.approx(expected()) == pytest.approx(0.4)
    calls.clear()
    scene.tracks.seen[1, 39:] = False
    assert exchangeable(replace(scene.tracks), given, near, SIZES) == pytest.approx(0.5)
    monkeypatch.setattr(mistakes, "_fine_share", lambda *_: 0.0)
    assert exchangeable(scene.tracks, given, near, SIZES) == 1.0
    scene.tracks.seen[:, 30:] = False
    assert math.isnan(exchangeable(replace(scene.tracks), given, near, SIZES))
