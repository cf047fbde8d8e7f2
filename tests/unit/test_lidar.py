"""KITTI's lidar beside the left camera, by the formula of its development kits: ``P2 R0_rect Tr X``."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import read_lidar, read_points
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import read_pair
from tests.fuzz.test_fuzz import EXAMPLES, damaged, survives

RNG = np.random.default_rng(0)
R_RECT = Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix()
#: The lidar looks along x with z up.
TR = np.column_stack([[[0.02, -1, -0.01], [0.01, 0.01, -1], [1, 0.02, 0.01]], [-0.004, -0.076, -0.272]])
TR[:, :3] = Rotation.from_matrix(TR[:, :3]).as_matrix()
K = np.array([[721.5, 0, 609.6], [0, 721.5, 172.9], [0, 0, 1]])
P = {0: K @ np.eye(3, 4), 1: K @ np.eye(3, 4), 2: K @ np.eye(3, 4), 3: K @ np.eye(3, 4)}
for number, place in ((1, -0.54), (2, 0.06), (3, -0.47)):
    P[number][:, 3] = K @ [place, 0.0003, 0.0027]
SCAN = np.c_[RNG.uniform(-30, 60, 200), RNG.uniform(-20, 20, 200), RNG.uniform(-2, 2, 200), RNG.random(200)]
SCAN = SCAN.astype("<f4")


def words(values) -> str:
    return " ".join(f"{v:.12e}" for v in np.ravel(values))


def raw(folder):
    lines = [f"S_rect_0{n}: 1242 375\nR_rect_0{n}: {words(R_RECT)}\nP_rect_0{n}: {words(P[n])}" for n in P]
    (folder / "calib_cam_to_cam.txt").write_text("calib_time: 09-Jan-2012 13:57:47\n" + "\n".join(lines))
    pose = f"calib_time: 15-Mar-2012 11:37:16\nR: {words(TR[:, :3])}\nT: {words(TR[:, 3])}\n"
    (folder / "calib_velo_to_cam.txt").write_text(pose + "delta_f: 0 0\ndelta_c: 0 0\n")
    return folder / "calib_cam_to_cam.txt"


def in_one(folder, more):
    text = "".join(f"P{n}: {words(P[n])}\n" for n in P)
    (folder / "000007.txt").write_text(text + more)
    return folder / "000007.txt"


def of_objects(folder):
    return in_one(folder, f"R0_rect: {words(R_RECT)}\nTr_velo_to_cam: {words(TR)}\nTr_imu_to_velo: 1 0\n")


def of_tracking(folder):
    return in_one(folder, f"R_rect {words(R_RECT)}\nTr_velo_cam {words(TR)}\nTr_imu_velo 1 0\n")


def of_odometry(folder):
    return in_one(folder, f"Tr: {words(R_RECT @ TR)}\n")


WRITERS = (raw, of_objects, of_tracking, of_odometry)


@pytest.mark.parametrize("write", WRITERS, ids=lambda write: write.__name__)
@pytest.mark.parametrize("left", [2, 0])
def test_a_scan_lies_where_the_development_kit_projects_it(write, left, tmp_path):
    SCAN.tofile(tmp_path / "scan.bin")
    calib = write(tmp_path)
    points = read_lidar(tmp_path / "scan.bin", [calib], (left, left + 1))
    X = np.c_[SCAN[:, :3].astype(float), np.ones(len(SCAN))]
    rectified = np.eye(4)
    rectified[:3, :3] = R_RECT
    expected = X @ (P[left] @ rectified @ np.vstack([TR, (0, 0, 0, 1)])).T  # u w, v w, w
    expected = expected[expected[:, 2] > 0]
    assert 20 < len(expected) < len(SCAN)
    np.testing.assert_allclose(points @ K.T, expected, rtol=2e-4, atol=1e-3)
    by_folder = read_lidar(tmp_path / "scan.bin", [calib], None, f"x/image_0{left}/data/1.png")
    np.testing.assert_array_equal(by_folder, points)


@pytest.mark.parametrize(
    ("change", "words_of"),
    [
        (lambda folder: (folder / "calib_velo_to_cam.txt").unlink(), "calib_velo_to_cam.txt beside it"),
        (lambda folder: (folder / "scan.bin").write_bytes(b"123"), "float32; got .* of 3 bytes"),
        (lambda folder: (folder / "scan.bin").write_bytes(b""), "empty|of 0 bytes"),
        (lambda folder: np.full((8, 5), 3.0, "<f4").tofile(folder / "scan.bin"), "reflectance"),
        (lambda folder: np.full((8, 4), np.nan, "<f4").tofile(folder / "scan.bin"), "reflectance"),
        (lambda folder: (folder / "calib_cam_to_cam.txt").write_text("fx: 1\n"), "one of KITTI"),
        (
            lambda folder: (folder / "calib_velo_to_cam.txt").write_text("R: 1 2\nT: 0 0 0\n"),
            "9 finite numbers",
        ),
    ],
)
def test_other_points_and_calibrations_are_refused_with_the_cure(change, words_of, tmp_path):
    SCAN.tofile(tmp_path / "scan.bin")
    calib = raw(tmp_path)
    change(tmp_path)
    with pytest.raises(InputError, match=words_of):
        read_lidar(tmp_path / "scan.bin", [calib], (2, 3))


def test_without_a_calibration_the_cure_is_named(tmp_path):
    SCAN.tofile(tmp_path / "scan.bin")
    with pytest.raises(InputError, match="Give KITTI's calibration"):
        read_lidar(tmp_path / "scan.bin", [])
    with pytest.raises(InputError, match="geodiff depth reads them with KITTI's --calib"):
        read_points(tmp_path / "scan.bin")


@pytest.mark.parametrize("file", ["scan.bin", "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"])
def test_damaged_files_of_a_lidar_get_a_sentence(file, tmp_path):
    SCAN.tofile(tmp_path / "scan.bin")
    calib = raw(tmp_path)
    whole = (tmp_path / file).read_bytes()

    @EXAMPLES
    @given(data=damaged(whole) | st.binary(max_size=64))
    def check(data):
        (tmp_path / file).write_bytes(data)
        survives(lambda: read_lidar(tmp_path / "scan.bin", [calib], (2, 3)))

    check()


def test_the_command_takes_a_scan_beside_its_calibration(tmp_path):
    SCAN.tofile(tmp_path / "scan.bin")
    calib = raw(tmp_path)
    for camera in ("image_02", "image_03"):
        (tmp_path / camera).mkdir()
        picture = np.random.default_rng(0).integers(0, 255, (375, 1242, 3), dtype=np.uint8)
        Image.fromarray(picture).save(tmp_path / camera / "7.png")
    views = {"left": tmp_path / "image_02/7.png", "right": tmp_path / "image_03/7.png", "calib": (calib,)}
    pair = read_pair(DepthOptions(**views, points=tmp_path / "scan.bin"))
    points = np.asarray(pair.guidance.inputs[0].points)
    np.testing.assert_allclose(points, read_lidar(tmp_path / "scan.bin", [calib], (2, 3)), rtol=1e-5)
    with pytest.raises(InputError, match="--points-scale must be left out"):
        read_pair(DepthOptions(**views, points=tmp_path / "scan.bin", points_scale=1000.0))
