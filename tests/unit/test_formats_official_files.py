"""Files of the data sets themselves, where this machine has them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin.formats import read_calibration, read_depth_png, read_image, read_pfm

DATA = Path(__file__).parents[2].parent / "shared" / "data"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not DATA.is_dir(), reason="the data sets are not on this machine"),
]


def size_of(path):
    image, notes = read_image(path)
    assert notes == []
    return image.shape[1], image.shape[0]


def test_adirondack_doffs_and_baseline():
    folder = DATA / "middlebury2014" / "Adirondack-perfect"
    rig = read_calibration(folder / "calib.txt")
    assert rig.K_right[0, 2] - rig.K_left[0, 2] == pytest.approx(52.265, abs=0.01)
    assert rig.E[0, 3] == pytest.approx(0.176252)
    assert rig.size_left == size_of(folder / "im0.png") == size_of(folder / "im1.png")
    disparity = read_pfm(folder / "disp0.pfm")
    assert disparity.shape == rig.size_left[::-1] and np.isinf(disparity).any()


def test_eth3d_two_view():
    folder = DATA / "eth3d" / "terrace_2s"
    rig = read_calibration(folder / "calib.txt")
    assert rig.E[0, 3] == pytest.approx(0.0599432)
    np.testing.assert_array_equal(rig.K_left, rig.K_right)
    assert rig.size_left == size_of(folder / "im0.png")


def test_kitti2015_colour_pair():
    folder = DATA / "kitti2015" / "training"
    calibration = folder / "calib_cam_to_cam" / "000000.txt"
    rig = read_calibration(calibration, image_folder_hint=str(folder / "image_2"))
    assert 0.532 <= rig.E[0, 3] <= 0.54
    assert rig.size_left == size_of(folder / "image_2" / "000000_10.png")
    disparity, known = read_depth_png(folder / "disp_occ_0" / "000000_10.png", 256.0)
    depth = rig.E[0, 3] * rig.K_left[0, 0] / disparity[known]
    assert 1.0 < depth.min() < 10.0 and 20.0 < depth.max() < 250.0


@pytest.mark.parametrize("number", ["000000", "000013", "000061", "000084", "000092"])
def test_kitti2012_grey_pairs(number):
    folder = DATA / "kitti2012" / "training"
    rig = read_calibration(folder / "calib" / f"{number}.txt", image_folder_hint="image_0")
    assert 0.53 <= rig.E[0, 3] <= 0.54
    width, height = size_of(folder / "image_0" / f"{number}_10.png")
    assert 0 < rig.K_left[0, 2] < width and 0 < rig.K_left[1, 2] < height


@pytest.mark.parametrize(
    "group", ["7scenes_f050", "7scenes_f250", "7scenes_f600", "hololens_mvs_g020", "hololens_mvs_g100"]
)
def test_mvsnet_poses_put_left_depth_onto_right_depth(group):
    """The left truth, carried over by E and both K, agrees with the right truth: sign and order of E."""
    folder = DATA / "mvsnet" / group
    rig = read_calibration(tuple(folder / "cams" / f"0000000{i}_cam.txt" for i in (0, 1)))
    R = rig.E[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    left, right = (read_pfm(folder / "depths" / f"0000000{i}.pfm") for i in (0, 1))
    v, u = np.nonzero(left > 0)
    p_left = np.linalg.inv(rig.K_left) @ np.stack([u, v, np.ones_like(u)]) * left[v, u]
    p_right = (np.linalg.inv(rig.E) @ np.vstack([p_left, np.ones(len(u))]))[:3]
    uv = np.rint((rig.K_right @ p_right)[:2] / p_right[2]).astype(int)
    height, width = right.shape
    inside = (p_right[2] > 0) & (uv[0] >= 0) & (uv[0] < width) & (uv[1] >= 0) & (uv[1] < height)
    seen = right[uv[1, inside], uv[0, inside]]
    ratio = p_right[2, inside][seen > 0] / seen[seen > 0]
    assert inside.mean() > 0.2
    assert np.median(np.abs(ratio - 1)) < 0.02
