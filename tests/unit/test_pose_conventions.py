"""The convention that poses were written in, from matches of a made-up scene; its scale, by two estimates."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.pose.conventions import Convention, find_convention, noted_convention, residuals_px
from geodiff_plugin.pose.multiview import _combined, _Estimate
from geodiff_plugin.pose.reconstruction import Match

K = np.array([[400.0, 0, 319.5], [0, 400.0, 239.5], [0, 0, 1]])
COUNT = 4


def poses(step=(0.2, 0.05, 0.02), turn_deg=(2.0, 5.0, 3.0)):
    """``(COUNT, 4, 4)`` camera-to-world: every next camera steps and turns by as much."""
    one, E = np.eye(4), [np.eye(4)]
    one[:3, 3], one[:3, :3] = step, Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    for _ in range(COUNT - 1):
        E.append(E[-1] @ one)
    return np.stack(E)


def matches(E, quarters=0, noise_px=0.3):
    """Matches of neighbouring frames, of pictures turned counter-clockwise by so many quarters."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-3, 3, (300, 2)), rng.uniform(3, 9, 300)]
    pixels = []
    for pose in E:
        T = np.linalg.inv(pose)
        p = (points @ T[:3, :3].T + T[:3, 3]) @ K.T
        px = p[:, :2] / p[:, 2:] - K[:2, 2]
        for _ in range(quarters):  # what was on the right is then on top
            px = np.c_[px[:, 1], -px[:, 0]]
        pixels.append(px + K[:2, 2] + rng.normal(0, noise_px, px.shape))
    return [Match(i, i + 1, pixels[i], pixels[i + 1]) for i in range(len(E) - 1)]


WRITTEN = {
    "as given": lambda E: E,
    "with OpenGL's axes (y up, z backward)": lambda E: E @ OPENGL_FROM_OPENCV,
    "world-to-camera": np.linalg.inv,
    "world-to-camera with OpenGL's axes": lambda E: np.linalg.inv(E @ OPENGL_FROM_OPENCV),
}


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
@pytest.mark.parametrize("name", WRITTEN)
def test_every_convention_is_found_with_upright_and_with_turned_pictures(name, quarters):
    E, Ks = poses(), np.tile(K, (COUNT, 1, 1))
    found = find_convention(WRITTEN[name](E), Ks, matches(E, quarters))
    assert found.name == name and found.turned_deg == 90 * quarters
    # The world may be turned, but every camera now is as its picture is.
    off_px = np.median(np.concatenate(residuals_px(found.E, Ks, matches(E, quarters))))
    assert found.off_px == pytest.approx(off_px) and off_px < 0.5 and found.off == pytest.approx(off_px / 400)
    notes = noted_convention(found)
    if quarters:
        (note,) = notes
        assert note.code == "capture.turned" and note.forbids_trust and f"{90 * quarters} degrees" in note
    elif name == "as given":
        assert notes == []
    else:
        (note,) = notes
        assert note.code == "capture.convention" and not note.forbids_trust and name in note


@pytest.mark.parametrize("turn_deg", [0.3, 1.0])
def test_inexact_poses_are_read_as_given(turn_deg):
    E, Ks, rng = poses(), np.tile(K, (COUNT, 1, 1)), np.random.default_rng(1)
    inexact = E.copy()
    inexact[:, :3, :3] = (
        E[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, turn_deg, (COUNT, 3)), True).as_matrix()
    )
    assert find_convention(inexact, Ks, matches(E)).name == "as given"


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
    notes = noted_convention(Convention(name, poses(), quarters, off_px=400 * off, off=off))
    found = [note for note in notes if note.code == "capture.convention-unsure"]
    assert bool(found) is unsure and all(note.forbids_trust and "2.8 px" in note for note in found)


def test_a_drive_straight_ahead_does_not_tell_whether_pictures_are_turned():
    E, Ks = poses((0.0, 0.0, 0.2), (0.0, 0.0, 0.0)), np.tile(K, (COUNT, 1, 1))
    assert find_convention(E, Ks, matches(E, 2)).quarters == 0


def test_two_scales_that_disagree_leave_their_mean_uncertain():
    alike = _combined(_Estimate(0.1, 0.03), _Estimate(0.1, 0.04))
    assert alike.value == pytest.approx(0.1) and alike.spread == pytest.approx(0.024)
    apart = _combined(_Estimate(0.0, 0.02), _Estimate(math.log(1.41), 0.02))
    assert apart.value == pytest.approx(math.log(1.41) / 2)
    assert apart.spread == pytest.approx(math.log(1.41) / 2, rel=0.02)
    assert _combined(_Estimate(0.0, math.inf), _Estimate(0.3, 0.02)).spread == pytest.approx(0.02)
