"""Kapture: three images from three cameras, one of which is mounted on a rig."""

import numpy as np
import pytest

from geodiff_plugin.formats import kapture
from tests.unit.formats.calibrated_pair import pose, quaternion, words
from tests.unit.formats.posed_images import POSES, SIZES, assert_is_read, numbers, write_images

#: k1 k2 p1 p2 per camera.
LENSES = [(0.1 + n, -0.2, 0.003 * n, 0.004) for n in range(3)]
CAMERA_FROM_RIG = pose((15, 25, -35), (0.3, 0.1, -0.2))


def line(T) -> str:
    x, y, z, w = quaternion(T)
    return words([w, x, y, z, *T[:3, 3]], ", ")


def write_kapture(folder, rows=None):
    cameras = []
    for n, (width, height) in enumerate(SIZES):
        parameters = words([*numbers(n, 0.5), *LENSES[n]], ", ")
        cameras.append(f"c{n}, , camera, OPENCV, {width}, {height}.0, {parameters}")
    T = [np.linalg.inv(E) for E in POSES]
    rig = np.linalg.inv(CAMERA_FROM_RIG) @ T[1]
    rows = rows or [
        f"3, c0, {line(T[0])}",
        f"3, rig, {line(rig)}",
        f"4, c2, {line(T[2])}",
        f"3, c2, {line(T[0])}",
    ]
    texts = {
        "sensors": [
            *cameras,
            "wifi, , wifi, x",
            "u, , camera, UNKNOWN_CAMERA, 3, 4",
            "bad, , camera, FISHY, 3, 4, 1, 2, 3",
        ],
        "records_camera": ["3, c0, set/a.png", "3, c1, set/b.png", "4, c2, set/c.png"],
        "trajectories": rows,
        "rigs": [f"rig, c1, {line(CAMERA_FROM_RIG)}", "rig2, c0, 1, 0, 0, 0"],
    }
    for name, lines in texts.items():
        (folder / f"{name}.txt").write_text("# kapture format: 1.1\n\n" + "\n".join(lines) + "\n")


@pytest.fixture(params=["sensors", ""])
def scan(request, tmp_path):
    folder = tmp_path / "far below" / "scan" / request.param
    folder.mkdir(parents=True)
    return folder


@pytest.mark.parametrize("below", ["records_data", ""])
def test_kapture_images_use_their_own_pose_or_the_rigs(scan, below):
    files = write_images(scan / below / "set", ["a.png", "b.png", "c.png"])
    write_kapture(scan)
    path = scan.parent if scan.name == "sensors" else scan
    layout = kapture.read_kapture(path)
    assert_is_read(layout, "kapture", None, files, lenses=LENSES)
    moved = write_images(path / "elsewhere" / "set", ["a.png", "b.png", "c.png"])
    given = kapture.read_kapture(path, path / "elsewhere")
    assert [each.frame.image for each in given.candidates] == moved
    for name in ("trajectories", "rigs"):
        (scan / f"{name}.txt").unlink()
    assert [each.frame.E for each in kapture.read_kapture(path).candidates] == [None] * 3
    (scan / "sensors.txt").unlink()
    assert kapture.read_kapture(path) is None


def test_kapture_poses_with_missing_numbers_are_ignored(scan):
    write_images(scan / "set", ["a.png", "b.png", "c.png"])
    T = np.linalg.inv(POSES[0])
    rows = [f"3, c0, {line(T)}, 9", "3, rig, 1, 0, 0, 0, 1, 2", "4, c2, 1, 0, 0, 0, , 1, 2"]
    write_kapture(scan, rows)
    candidates = kapture.read_kapture(scan).candidates
    np.testing.assert_allclose(candidates[0].frame.E, POSES[0], atol=1e-9)
    assert candidates[1].frame.E is None and candidates[2].frame.E is None


def test_unusable_kapture_cameras_exclude_their_images(scan):
    write_images(scan / "set", ["a.png", "b.png", "c.png"])
    write_kapture(scan)
    (scan / "records_camera.txt").write_text("3, u, set/a.png\n3, bad, set/b.png\n4, none, set/c.png\n")
    candidates = kapture.read_kapture(scan).candidates
    assert candidates[0].camera is None and not candidates[0].problem
    assert "model of camera bad" in candidates[1].problem
    assert candidates[2].problem == "sensor none is not in sensors.txt"
