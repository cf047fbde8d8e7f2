"""KITTI's lidar: the transform to the left camera, and rejected files."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import lidar
from tests.fuzz.test_fuzz import EXAMPLES, damaged, is_recoverable
from tests.unit.formats.calibrated_pair import K_LEFT, K_RIGHT, pose, words

LIDAR = pose((91, -3, -88), (0.27, -0.08, -0.3))  # maps lidar points to unrectified camera 0
RECTIFYING = pose((1, -2, 3), (0, 0, 0))
PLACES = {0: (0, 0, 0), 1: (0.54, 0.01, -0.02), 2: (-0.06, 0.03, 0.01), 3: (0.48, -0.02, 0.03)}
KS = {0: K_LEFT, 1: K_RIGHT, 2: 1.1 * K_LEFT * [[1], [1], [1 / 1.1]], 3: K_RIGHT}
SCAN = np.random.default_rng(0).uniform(-20, 20, (60, 4)).astype("<f4")
SCAN[:, 3] = np.linspace(0, 1, 60)


def projections(key="P{}") -> str:
    return "".join(
        f"{key.format(n)}: {words(KS[n] @ np.column_stack([np.eye(3), -np.array(PLACES[n])]))}\n"
        for n in PLACES
    )


def expected(left: int) -> np.ndarray:
    """Transform step by step: lidar, camera 0, rectified camera 0, left camera."""
    in_0 = np.column_stack([SCAN[:, :3], np.ones(60)]).astype(float) @ (RECTIFYING @ LIDAR).T
    in_left = in_0[:, :3] - PLACES[left]
    return in_left[in_left[:, 2] > 0]


def texts():
    R, Tr = RECTIFYING[:3, :3], LIDAR[:3]
    return {
        "odometry": projections() + f"Tr: {words((RECTIFYING @ LIDAR)[:3])}\nR0_rect: {words(np.eye(3))}\n",
        "object": projections() + f"R0_rect: {words(R)}\nTr_velo_to_cam: {words(Tr)}\n",
        "tracking": projections() + f"R_rect {words(R)}\nTr_velo_cam {words(Tr)}\n",
        "raw": projections("P_rect_0{}") + f"R_rect_01: 1\nR_rect_00: {words(R)}\n",
    }


def raw(folder) -> tuple[Path, Path]:
    """A scan and the calibration of raw data, with that of the lidar next to it."""
    SCAN.tofile(folder / "s.bin")
    (folder / "calib.txt").write_text(texts()["raw"])
    pose_text = f"R: {words(LIDAR[:3, :3])}\nT: {words(LIDAR[:3, 3])}\n"
    (folder / "calib_velo_to_cam.txt").write_text(pose_text)
    return folder / "s.bin", folder / "calib.txt"


@pytest.mark.parametrize(
    ("kind", "left"),
    [("odometry", 1), ("object", 0), ("object", 3), ("tracking", 2), ("raw", 2), ("raw", 0)],
)
def test_scans_are_transformed_to_the_left_camera(tmp_path, kind, left):
    raw(tmp_path)
    (tmp_path / "calib.txt").write_text(texts()[kind])
    points = lidar.read_lidar(tmp_path / "s.bin", [tmp_path / "calib.txt"], (left, (left + 1) % 4))
    assert points.dtype == np.float32
    np.testing.assert_allclose(points, expected(left), atol=2e-5)
    if left in (0, 2):
        by_folder = lidar.read_lidar(tmp_path / "s.bin", (tmp_path / "calib.txt",), None, f"image_{left}")
        np.testing.assert_array_equal(by_folder, points)


@pytest.mark.parametrize(
    ("data", "got"),
    [
        (SCAN.tobytes()[:-4], r"s\.bin of 956 bytes"),
        (np.where(np.arange(4) == 3, 1.001, SCAN).astype("<f4").tobytes(), r"s\.bin with other numbers"),
        (np.where(np.arange(4) == 3, -0.001, SCAN).astype("<f4").tobytes(), r"s\.bin with other numbers"),
        (np.full((2, 4), np.inf, "<f4").tobytes(), r"s\.bin with other numbers"),
    ],
)
def test_files_with_other_content_are_rejected(tmp_path, data, got):
    (tmp_path / "s.bin").write_bytes(data)
    sentence = (
        r"\Alidar must be points of KITTI's lidar: x, y, z and a reflectance in \[0, 1\] as float32; got "
    )
    with pytest.raises(InputError, match=rf"{sentence}.*{got}\. For other points, save them"):
        lidar.read_lidar(tmp_path / "s.bin", [tmp_path / "calib.txt"], name="lidar")


def test_the_calibration_must_contain_the_lidar_pose(tmp_path):
    SCAN.tofile(tmp_path / "s.bin")
    calib = tmp_path / "calib.txt"
    for calibrations in ([], [calib, calib]):
        with pytest.raises(
            InputError,
            match=r"\Apoints must be points of the left camera, or KITTI's lidar with its "
            r"calibration; got .*s\.bin\. Pass KITTI's",
        ):
            lidar.read_lidar(tmp_path / "s.bin", calibrations)
    text = texts()["object"]
    for content, words_ in (
        (
            projections() + "R0_rect: 1\n",
            r"calibration must be a calibration with the lidar's pose; got .*calib\.txt alone\. "
            r"Pass KITTI's",
        ),
        (
            text.replace("R0_rect", "R1_rect"),
            r"calibration must be a file with R_rect_00 or R0_rect; got .*calib\.txt "
            r"without\. Pass KITTI's",
        ),
        (text.replace("R0_rect: ", "R0_rect: 1 "), r"R0_rect must be 9 finite numbers; got 10"),
        (
            text.replace("Tr_velo_to_cam: ", "Tr_velo_to_cam: 1 "),
            r"Tr_velo_to_cam must be 16 finite numbers; got 13",
        ),
    ):
        calib.write_text(content)
        with pytest.raises(InputError, match=words_):
            lidar.read_lidar(tmp_path / "s.bin", [calib], (0, 1))


@pytest.mark.parametrize("file", ["s.bin", "calib.txt", "calib_velo_to_cam.txt"])
def test_damaged_files_of_a_lidar_get_a_sentence(file, tmp_path):
    scan, calib = raw(tmp_path)
    whole = (tmp_path / file).read_bytes()

    @EXAMPLES
    @given(data=damaged(whole) | st.binary(max_size=64))
    def check(data):
        (tmp_path / file).write_bytes(data)
        is_recoverable(lambda: lidar.read_lidar(scan, [calib], (2, 3)))

    check()
