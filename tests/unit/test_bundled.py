"""What ships with the package: the demo pair with its exact depth, and real pairs of one stereo camera."""

import numpy as np
import pytest

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, REAL_PAIRS_FOLDER, read_demo_pair
from geodiff_plugin.formats import read_calibration, read_image


def test_the_demo_pair_has_metric_depth_that_warps_right_to_left():
    pair = read_demo_pair()
    K, T = pair.rig.K_left, pair.rig.T_right_from_left
    height, width = pair.depth_m.shape
    assert pair.left.shape == pair.right.shape == (height, width, 3) and pair.valid.mean() > 0.9
    v, u = np.mgrid[:height, :width]
    disparity = -K[0, 0] * T[0, 3] / np.where(pair.valid, pair.depth_m, np.inf)
    column = np.rint(u - disparity).astype(int)
    inside = pair.valid & (column >= 0)
    error = np.abs(pair.left[v, u] - pair.right[v, column.clip(0)]).mean(-1)[inside]
    other = np.abs(pair.left[v, u] - pair.right[v, (column + 9).clip(0, width - 1)]).mean(-1)[inside]
    assert np.mean(error) < 0.6 * np.mean(other)
    assert (DEMO_PAIR_FOLDER / "calib.txt").is_file()


@pytest.mark.parametrize("name", ["cycles", "donkey_toy", "toy"])
def test_a_real_pair_is_rectified_by_a_camera_of_75_mm_baseline(name):
    folder = REAL_PAIRS_FOLDER / name
    rig = read_calibration(folder / "calib.txt")
    left, right = (read_image(folder / f"{side}.png")[0] for side in ("left", "right"))
    assert left.shape == right.shape and sorted(p.name for p in REAL_PAIRS_FOLDER.iterdir() if p.is_dir())
    assert rig.T_right_from_left[0, 3] == pytest.approx(-0.075, abs=0.005)
    np.testing.assert_allclose(rig.T_right_from_left[:3, :3], np.eye(3), atol=1e-12)
    assert (REAL_PAIRS_FOLDER / "LICENSE").read_text(encoding="utf-8").startswith("MIT")
