"""Known depths and lengths of a pair, in the image without lens distortion."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera, Distortion
from geodiff_plugin.formats import read_lidar
from geodiff_plugin.jobs.cameras import ViewCameras
from geodiff_plugin.jobs.known import read_known
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import read_pair
from tests.unit.formats.test_lidar import raw
from tests.unit.jobs.pair_files import KS, NUMBERS, SIZES, lens, options

LENS = "-0.2,0.05,0.001,0"


def camera(of: Distortion | None = None, size: tuple[int, int] = SIZES[0]) -> ViewCameras:
    """That of the left image."""
    return ViewCameras((Camera(KS[0], size, of),))


def test_disparities_become_depths_by_the_rig(files, tmp_path):
    width, height = SIZES[0]
    disparity = np.full((height, width), 4.0, np.float32)
    disparity[3, 5] = 8.0
    np.save(tmp_path / "disparity.npy", disparity * 16)
    more = {
        "right": None,
        "disparity": tmp_path / "disparity.npy",
        "points_scale": 16.0,
        "cx": 26.0,
        "cy": 19.0,
    }
    pair = read_pair(options(files, **NUMBERS | more, fy=50.0, cx_right=29.0))
    known = pair.guidance.inputs[0].points.numpy()
    assert known.shape == (height, width)
    np.testing.assert_allclose(known[3, 5], 50 * 0.12 / (8 + 3), rtol=1e-5)
    np.testing.assert_allclose(known[20, 30], 50 * 0.12 / (4 + 3), rtol=1e-5)
    with pytest.raises(InputError, match="--disparity needs a calibrated rectified rig"):
        read_known(options(files, **NUMBERS | more), camera())


def test_a_map_of_known_depths_becomes_points_behind_a_lens(files, tmp_path):
    (width, height), rng = SIZES[0], np.random.default_rng(3)
    depth_m = np.where(rng.random((height, width)) < 0.2, rng.uniform(1, 3, (height, width)), 0.0)
    np.save(tmp_path / "map.npy", depth_m.astype(np.float32))
    given = options(files, points=tmp_path / "map.npy")
    np.testing.assert_allclose(read_known(given, camera()).points, depth_m, rtol=1e-6)
    points = read_known(given, camera(lens(LENS))).points
    pixels, _ = cv2.projectPoints(
        points.astype(float), np.zeros(3), np.zeros(3), KS[0], lens(LENS).coefficients.astype(float)
    )
    v, u = np.nonzero(depth_m)
    np.testing.assert_allclose(pixels[:, 0], np.stack([u, v], 1), atol=0.01)
    np.testing.assert_allclose(points[:, 2], depth_m[v, u], rtol=1e-5)
    with pytest.raises(InputError, match="a map of the left image's 40x54 pixels; got 54x40"):
        read_known(given, camera(lens(LENS), SIZES[0][::-1]))
    cloud = np.array([[0.1, 0.2, 2.0]])
    np.save(tmp_path / "cloud.npy", cloud)
    np.testing.assert_allclose(
        read_known(options(files, points=tmp_path / "cloud.npy"), camera(lens(LENS))).points, cloud
    )
    assert read_known(options(files), camera()).points is None
    with pytest.raises(InputError, match="--points-scale must be omitted"):
        read_known(options(files, points=Path("a.BIN"), points_scale=2.0), camera())


def test_a_known_length_is_moved_to_the_undistorted_image(files):
    given = options(files, known_length="10,7, 44,31,1.5")
    assert read_known(given, camera()).length == (10.0, 7.0, 44.0, 31.0, 1.5)
    taken, coefficients = np.array([[[10.0, 7.0]], [[44.0, 31.0]]]), lens(LENS).coefficients
    expected = cv2.undistortPoints(taken, KS[0], coefficients, P=KS[0])
    found = read_known(given, camera(lens(LENS))).length
    np.testing.assert_allclose(found, [*expected.ravel(), 1.5], atol=1e-3)
    assert read_known(options(files), camera()).length is None
    for wrong in ("1,2,3,4", "1,2,3,4,x", "1,2,3,4,5,6"):
        with pytest.raises(InputError, match="--known-length must be X1,Y1,X2,Y2,METRES"):
            read_known(options(files, known_length=wrong), camera())


def test_a_scan_of_kittis_lidar_is_taken_with_its_calibration(tmp_path):
    scan, calib = raw(tmp_path)
    for camera_folder in ("image_02", "image_03"):
        (tmp_path / camera_folder).mkdir()
        image = np.random.default_rng(0).integers(0, 255, (700, 1100, 3), np.uint8)
        Image.fromarray(image).save(tmp_path / camera_folder / "7.png")
    views = {"left": tmp_path / "image_02/7.png", "right": tmp_path / "image_03/7.png", "calib": (calib,)}
    pair = read_pair(DepthOptions(**views, points=scan))
    points = np.asarray(pair.guidance.inputs[0].points)
    np.testing.assert_allclose(points, read_lidar(scan, [calib], (2, 3)), rtol=1e-5)
    with pytest.raises(InputError, match="--points-scale must be omitted"):
        read_pair(DepthOptions(**views, points=scan, points_scale=1000.0))
