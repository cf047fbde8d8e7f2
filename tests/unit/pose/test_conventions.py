"""Residuals of a capture whose cameras all differ, and the convention that its poses were written in."""

import math

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.pose import conventions
from geodiff_plugin.pose.conventions import (
    Convention,
    find_convention,
    median_px,
    reported_convention,
    residuals_px,
)
from geodiff_plugin.pose.multiview import _combine, _Estimate
from geodiff_plugin.pose.reconstruction import Match
from tests.unit.pose.posed_scene import camera, pose, projected

KS = np.stack(
    [
        camera(400.0, 430.0, 300.0, 250.0),
        camera(520.0, 500.0, 340.0, 222.0),
        camera(460.0, 410.0, 310.0, 260.0),
        camera(610.0, 640.0, 420.0, 300.0),
    ]
)
E = np.stack(
    [
        pose((4.0, -3.0, 5.0), (1.0, 2.0, -1.0)),
        pose((-2.0, 6.0, -4.0), (1.3, 1.9, -0.95)),
        pose((6.0, 2.0, 7.0), (1.1, 2.35, -1.1)),
        pose((-5.0, -6.0, 3.0), (0.7, 2.1, -0.8)),
    ]
)
PAIRS = ((0, 1), (0, 2), (1, 3), (2, 3))


def matches(noise_px: float = 0.5, count: int = 60, pairs=PAIRS, seed: int = 0) -> list[Match]:
    rng = np.random.default_rng(seed)
    points = np.c_[rng.uniform(-1, 3, count), rng.uniform(0, 4, count), rng.uniform(2.5, 7, count)]
    px = [projected(points, K, np.linalg.inv(each)) for K, each in zip(KS, E, strict=True)]
    return [Match(i, j, *(px[k] + noise_px * rng.normal(size=(count, 2)) for k in (i, j))) for i, j in pairs]


def fundamental(i: int, j: int) -> np.ndarray:
    """From both projection matrices, by the epipole and the pseudoinverse (Hartley and Zisserman)."""
    P, Q = (KS[k] @ np.linalg.inv(E[k])[:3] for k in (i, j))
    e = Q @ np.r_[E[i][:3, 3], 1.0]
    return np.array([[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]]) @ Q @ np.linalg.pinv(P)


def test_distances_are_opencvs_sampson_distances_under_the_cameras_of_each_pair():
    some = matches(noise_px=2.0)
    for (i, j, px_i, px_j), found in zip(some, residuals_px(E, KS, some), strict=True):
        F = fundamental(i, j)
        expected = [
            cv2.sampsonDistance(np.array([[*a, 1.0]]), np.array([[*b, 1.0]]), F)
            for a, b in zip(px_i, px_j, strict=True)
        ]
        np.testing.assert_allclose(found**2, expected, rtol=1e-5, atol=1e-9)
    together = np.concatenate(residuals_px(E, KS, some))
    assert median_px(residuals_px(E, KS, some)) == pytest.approx(np.median(together))
    assert math.isnan(median_px([]))


@pytest.mark.parametrize(("count", "step"), [(99, 1), (199, 1), (251, 2), (429, 4)])
def test_about_a_hundred_matches_of_a_pair_are_enough(count, step):
    (all_of_them,) = matches(count=count, pairs=[(0, 3)])
    (found,) = residuals_px(E, KS, [all_of_them])
    kept = Match(0, 3, all_of_them.px_i[::step], all_of_them.px_j[::step])
    assert len(found) == len(kept.px_i) < 200
    for k in (0, 1, -1):
        alone = Match(0, 3, kept.px_i[k][None], kept.px_j[k][None])
        assert found[k] == pytest.approx(residuals_px(E, KS, [alone])[0][0])


def front_fraction(some: list[Match], poses: np.ndarray) -> float:
    """Fraction of matches whose depths along both rays are positive, by least squares of each."""
    front = []
    for i, j, px_i, px_j in some:
        for a, b in zip(px_i, px_j, strict=True):
            rays = [poses[k][:3, :3] @ np.linalg.solve(KS[k], [*px, 1.0]) for k, px in ((i, a), (j, b))]
            baseline = poses[j][:3, 3] - poses[i][:3, 3]
            depths = np.linalg.lstsq(np.stack([rays[0], -rays[1]], axis=1), baseline)[0]
            front.append((depths > 0).all())
    return float(np.mean(front))


def test_a_misfit_grows_with_the_matches_that_are_behind_a_camera():
    some = matches(noise_px=1.0, count=20)
    reference = {name: poses for name, poses in (("right", E), ("inverse", np.linalg.inv(E)))}
    back = E.copy()
    back[:, :3, 3] *= -1.0  # the same epipolar lines, all points behind
    reference |= {"behind": back}
    turned = E.copy()
    turned[3, :3, :3] = E[3, :3, :3] @ np.diag([-1.0, 1.0, -1.0])  # one of four frames looks back
    reference |= {"one turned": turned}
    for name, poses in reference.items():
        expected = median_px(residuals_px(poses, KS, some)) / max(front_fraction(some, poses), 0.05)
        assert conventions._misfit(poses, KS, some) == pytest.approx(expected, rel=1e-6), name
    assert front_fraction(some, E) == 1.0 and front_fraction(some, back) == 0.0


WRITTEN = {
    "as given": lambda E: E,
    "with OpenGL's axes (y up, z backward)": lambda E: E @ OPENGL_FROM_OPENCV,
    "world-to-camera": np.linalg.inv,
    "world-to-camera with OpenGL's axes": lambda E: np.linalg.inv(E @ OPENGL_FROM_OPENCV),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_every_convention_is_found_with_cameras_that_differ(name):
    some = matches()
    found = find_convention(WRITTEN[name](E), KS, some)
    assert (found.name, found.quarters, found.turned_deg) == (name, 0, 0)
    apart = np.linalg.inv(found.E[0]) @ found.E[1:]
    np.testing.assert_allclose(apart, np.linalg.inv(E[0]) @ E[1:], atol=1e-9)
    off_px = np.median(np.concatenate(residuals_px(E, KS, some)))
    assert found.off_px == pytest.approx(off_px) and found.off == pytest.approx(off_px / 490.0)


def test_of_many_pairs_every_second_is_asked(monkeypatch):
    """The others are wrong here; fewer than twice the limit are asked all."""
    monkeypatch.setattr(conventions, "MAX_PAIRS", 4)
    few, wrong = matches(count=12), matches(noise_px=40.0, count=12)
    many = [pair for both in zip(few, wrong, strict=True) for pair in both]
    off_px = find_convention(E, KS, few).off_px
    assert find_convention(E, KS, many).off_px == pytest.approx(off_px)
    assert find_convention(E, KS, many[:7]).off_px > 1.3 * off_px


@pytest.mark.parametrize(("gain", "turned"), [(0.49, True), (0.51, False)])
def test_another_convention_must_halve_the_misfit(gain, turned, monkeypatch):
    """First among upright images, then of turned ones against the one of these that is chosen."""
    misfits = dict.fromkeys(range(16), 9.0) | {0: 4.0, 2: 4.0 * gain}
    for values, expected in (
        (misfits, ("world-to-camera", 0) if turned else ("as given", 0)),
        (
            misfits | {2: 9.0, 7: 4.0 * gain},
            ("world-to-camera with OpenGL's axes", 1) if turned else ("as given", 0),
        ),
        (
            misfits | {2: 1.0, 9: gain},
            ("with OpenGL's axes (y up, z backward)", 2) if turned else ("world-to-camera", 0),
        ),
        (
            misfits | {2: 3.0, 9: 4.0 * gain},
            ("with OpenGL's axes (y up, z backward)", 2) if turned else ("as given", 0),
        ),
    ):
        answers = iter(values.values())
        monkeypatch.setattr(conventions, "_misfit", lambda *_, left=answers: next(left))
        found = find_convention(E, KS, matches(count=20))
        assert (found.name, found.quarters, found.turned_deg) == (*expected, (0, 90, 180)[expected[1]])


def test_poses_read_as_they_are_written_are_not_turned():
    assert Convention("as written", np.eye(4)[None]).turned_deg == 0


K = np.array([[400.0, 0, 319.5], [0, 400.0, 239.5], [0, 0, 1]])
COUNT = 4


def poses(step=(0.2, 0.05, 0.02), turn_deg=(2.0, 5.0, 3.0)):
    """``(COUNT, 4, 4)`` camera-to-world: every next camera steps and turns by as much."""
    one, E = np.eye(4), [np.eye(4)]
    one[:3, 3], one[:3, :3] = step, Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    for _ in range(COUNT - 1):
        E.append(E[-1] @ one)
    return np.stack(E)


def matches_of_pose_conventions(E, quarters=0, noise_px=0.3):
    """Matches of neighbouring frames, of images turned counter-clockwise by so many quarters."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-3, 3, (300, 2)), rng.uniform(3, 9, 300)]
    pixels = []
    for from_world in E:
        T = np.linalg.inv(from_world)
        p = (points @ T[:3, :3].T + T[:3, 3]) @ K.T
        px = p[:, :2] / p[:, 2:] - K[:2, 2]
        for _ in range(quarters):  # what was on the right is then on top
            px = np.c_[px[:, 1], -px[:, 0]]
        pixels.append(px + K[:2, 2] + rng.normal(0, noise_px, px.shape))
    return [Match(i, i + 1, pixels[i], pixels[i + 1]) for i in range(len(E) - 1)]


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
@pytest.mark.parametrize("name", WRITTEN)
def test_every_convention_is_found_with_upright_and_with_rotated_images(name, quarters):
    E, Ks = poses(), np.tile(K, (COUNT, 1, 1))
    found = find_convention(WRITTEN[name](E), Ks, matches_of_pose_conventions(E, quarters))
    assert found.name == name and found.turned_deg == 90 * quarters
    # The world may be turned, but every camera now is as its image is.
    off_px = np.median(np.concatenate(residuals_px(found.E, Ks, matches_of_pose_conventions(E, quarters))))
    assert found.off_px == pytest.approx(off_px) and off_px < 0.5 and found.off == pytest.approx(off_px / 400)
    notes = reported_convention(found)
    if quarters:
        (note,) = notes
        assert note.code == "capture.rotated" and note.is_reason and f"{90 * quarters} degrees" in note
    elif name == "as given":
        assert notes == []
    else:
        (note,) = notes
        assert note.code == "capture.convention" and not note.is_reason and name in note


@pytest.mark.parametrize("turn_deg", [0.3, 1.0])
def test_inexact_poses_are_read_as_given(turn_deg):
    E, Ks, rng = poses(), np.tile(K, (COUNT, 1, 1)), np.random.default_rng(1)
    inexact = E.copy()
    inexact[:, :3, :3] = (
        E[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, turn_deg, (COUNT, 3)), True).as_matrix()
    )
    assert find_convention(inexact, Ks, matches_of_pose_conventions(E)).name == "as given"


@pytest.mark.parametrize(
    ("name", "quarters", "off", "unsure"),
    [
        ("world-to-camera", 0, 0.0069, False),
        ("world-to-camera", 0, 0.0071, True),
        ("as given", 2, 0.0071, True),
        ("as given", 0, 0.02, False),  # inexact, and no guess
    ],
)
def test_a_guess_under_which_matches_lie_off_their_lines_is_not_trusted(name, quarters, off, unsure):
    notes = reported_convention(Convention(name, poses(), quarters, off_px=400 * off, off=off))
    found = [note for note in notes if note.code == "capture.unknown-convention"]
    assert bool(found) is unsure and all(note.is_reason and "2.8 px" in note for note in found)


def test_forward_motion_does_not_reveal_whether_images_are_rotated():
    E, Ks = poses((0.0, 0.0, 0.2), (0.0, 0.0, 0.0)), np.tile(K, (COUNT, 1, 1))
    assert find_convention(E, Ks, matches_of_pose_conventions(E, 2)).quarters == 0


def test_two_scales_that_disagree_leave_their_mean_uncertain():
    alike = _combine(_Estimate(0.1, 0.03), _Estimate(0.1, 0.04))
    assert alike.value == pytest.approx(0.1) and alike.spread == pytest.approx(0.024)
    apart = _combine(_Estimate(0.0, 0.02), _Estimate(math.log(1.41), 0.02))
    assert apart.value == pytest.approx(math.log(1.41) / 2)
    assert apart.spread == pytest.approx(math.log(1.41) / 2, rel=0.02)
    assert _combine(_Estimate(0.0, math.inf), _Estimate(0.3, 0.02)).spread == pytest.approx(0.02)
