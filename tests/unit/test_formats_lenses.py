"""Lenses of calibration files: one model and one order whatever wrote the file, and what is no lens."""

from __future__ import annotations

import copy
import json
import re
from functools import partial

import cv2
import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.cli.inputs import lenses_of, pinhole
from geodiff_plugin.cli.options import DepthOptions
from geodiff_plugin.config import GuidanceConfig
from tests.contracts import factory_calibrations as factory
from tests.contracts import test_formats_table as table

LEFT, RIGHT = [-0.28, 0.07, 0.0002, 0.001], [-0.25, 0.06, 0.0, -0.0003]
MATRIX = "{}: !!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: {}\n"
#: Undistorts photographs as they are.
PLAIN = GuidanceConfig(clean_photographs=False)


@pytest.fixture
def reading(tmp_path):
    """``reading(text, ..., **choice)`` reads texts as files, for a caller that undistorts."""
    return partial(factory.read_texts, tmp_path, distorted=True)


def opencv(left, right) -> str:
    """The rig of ``factory.KALIBR`` as OpenCV writes it."""
    K = [700.0, 0, 300.0, 0, 700.0, 200.0, 0, 0, 1.0]
    R = [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0]
    rows = [("M1", 3, 3, K), ("D1", 1, len(left), left), ("M2", 3, 3, K), ("D2", 1, len(right), right)]
    rows += [("R", 3, 3, R), ("T", 3, 1, [-0.12, 0.0, 0.0]), ("image_size", 1, 2, [640, 480])]
    return "%YAML:1.0\n---\n" + "".join(MATRIX.format(*row) for row in rows)


def without(text: str, name: str) -> str:
    """A calibration of OpenCV that lacks one matrix."""
    return "".join(part for part in re.split(r"(?m)^(?=\w)", text) if not part.startswith(f"{name}:"))


@pytest.mark.parametrize(("missing", "there", "side"), [("D2", "D1", "right"), ("D1", "D2", "left")])
def test_distortion_of_one_camera_alone_is_told(reading, missing, there, side) -> None:
    said = f"has the lens distortion {there} and no {missing}: the {side} image .* Add {missing} to the file"
    with pytest.warns(UserWarning, match=said):
        rig = reading(without(opencv(LEFT, RIGHT), missing))
    assert [lens is None for lens in rig.distortion] == [missing == "D1", missing == "D2"]
    zeros = [0.0] * 5
    assert reading(without(opencv(zeros, zeros), missing)).distortion == (None, None)


def kalibr(left=LEFT, right=RIGHT, model="radtan") -> str:
    """``factory.KALIBR`` with lenses."""
    text = factory.KALIBR.replace("distortion_model: radtan", f"distortion_model: {model}")
    for numbers in (left, right):
        text = text.replace("distortion_coeffs: [0.0, 0.0, 0.0, 0.0]", f"distortion_coeffs: {numbers}", 1)
    return text


def straight_pair(rig, arguments):
    """Both images of a chessboard of noise as the command makes them straight."""
    noise = np.random.default_rng(0).random((48, 64, 3)).astype(np.float32)
    image = cv2.resize(noise, (640, 480), interpolation=cv2.INTER_NEAREST)
    lenses = lenses_of(arguments, rig)
    return [pinhole(image, K, lens, PLAIN) for K, lens in zip((rig.K_left, rig.K_right), lenses, strict=True)]


def test_a_pair_is_undistorted_by_kalibr_as_by_opencv(reading, tmp_path) -> None:
    arguments = DepthOptions(left=tmp_path / "l.png", right=tmp_path / "r.png")
    ours, theirs = reading(kalibr()), reading(opencv(LEFT, RIGHT))
    np.testing.assert_array_equal(ours.K_left, theirs.K_left)
    np.testing.assert_allclose(ours.E, theirs.E, atol=1e-12)
    pairs = [straight_pair(rig, arguments) for rig in (ours, theirs)]
    for mine, other in zip(*pairs, strict=True):
        np.testing.assert_array_equal(mine, other)
    assert np.abs(pairs[0][0] - pairs[0][1]).max() > 0.1, "each camera has coefficients of its own"


def test_kalibrs_equidistant_is_opencvs_fisheye(reading) -> None:
    left, right = reading(kalibr(model="equidistant")).distortion
    assert (left.model, right.model) == ("fisheye", "fisheye")
    assert left.coefficients.tolist() == LEFT and right.coefficients.tolist() == RIGHT
    straight = [0.0] * 4
    assert reading(kalibr(straight, straight)).distortion == (None, None)
    assert reading(kalibr([], [], "none")).distortion == (None, None)
    # A fisheye without coefficients still is none of a pinhole.
    with pytest.raises(InputError, match="Lens distortion of the left camera .* got fisheye"):
        reading(kalibr(straight, straight, "equidistant"), distorted=False)


def test_zed_coefficients_are_in_opencvs_order(reading) -> None:
    text = factory.ZED.replace("k1=0\nk2=0\np1=0\np2=0\nk3=0", "k1=1\nk2=2\nk3=5\np1=3\np2=4")
    for lens in reading(text, image_size=(1280, 720)).distortion:
        assert lens.model == "opencv" and lens.coefficients.tolist() == [1, 2, 3, 4, 5]
    rational = text.replace("k3=5", "k3=5\nk4=6")
    lens = reading(rational, image_size=(1280, 720)).distortion[0]
    assert lens.coefficients.tolist() == [1, 2, 3, 4, 5, 6, 0, 0]


def realsense(model, coefficients) -> str:
    data = json.loads(factory.REALSENSE_JSON)
    for camera in data["intrinsics"].values():
        camera.update(model=model, coeffs=coefficients)
    return json.dumps(data)


def test_realsense_models(reading) -> None:
    five = [0.1, 0.2, 0.003, 0.004, 0.5]
    for model in ("distortion.brown_conrady", "RS2_DISTORTION_BROWN_CONRADY", 4):
        lens = reading(realsense(model, five)).distortion[0]
        assert lens.model == "opencv" and lens.coefficients.tolist() == five
    lens = reading(realsense("distortion.kannala_brandt4", [*five[:4], 0.0])).distortion[1]
    assert lens.model == "fisheye" and lens.coefficients.tolist() == five[:4]
    printed = factory.REALSENSE_PRINTED.replace("0       0       0       0       0", "0.1 0.2 0 0 0")
    assert reading(printed).distortion[0].coefficients.tolist() == [0.1, 0.2, 0, 0, 0]
    for model in ("distortion.inverse_brown_conrady", 2, "Inverse Brown Conrady"):
        assert reading(realsense(model, [0.0] * 5)).rectified, "zeros are no lens"
        with pytest.raises(InputError, match=r"lens model of the left .*inverse brown conrady.*rectify"):
            reading(realsense(model, five))


def test_oak_as_taken_has_its_lenses(reading) -> None:
    data = copy.deepcopy(factory.OAK_DATA)
    assert reading(json.dumps(data)).rectified and reading(json.dumps(data)).distortion == (None, None)
    data["stereoRectificationData"]["rectifiedRotationLeft"] = []
    rig = reading(json.dumps(data))
    assert not rig.rectified
    assert rig.distortion[0].model == "opencv" and rig.distortion[0].coefficients[0] == 8.1
    for _, camera in data["cameraData"]:
        camera.update(cameraType=1, distortionCoeff=[*LEFT, *[0.0] * 10])
    lens = reading(json.dumps(data)).distortion[1]
    assert lens.model == "fisheye" and lens.coefficients.tolist() == LEFT
    for _, camera in data["cameraData"]:
        camera["cameraType"] = 3
    with pytest.raises(InputError, match="got 'cameraType 3'"):
        reading(json.dumps(data))


@pytest.mark.parametrize(
    ("camera", "model", "coefficients"),
    [
        ("SIMPLE_RADIAL 640 480 700 300.5 200.5 -0.1", "opencv", [-0.1, 0, 0, 0]),
        ("RADIAL 640 480 700 300.5 200.5 -0.1 0.02", "opencv", [-0.1, 0.02, 0, 0]),
        ("OPENCV 640 480 700 700 300.5 200.5 1 2 3 4", "opencv", [1, 2, 3, 4]),
        ("FULL_OPENCV 640 480 700 700 300.5 200.5 1 2 3 4 5 6 7 8", "opencv", [1, 2, 3, 4, 5, 6, 7, 8]),
        ("OPENCV_FISHEYE 640 480 700 700 300.5 200.5 1 2 3 4", "fisheye", [1, 2, 3, 4]),
        ("RADIAL_FISHEYE 640 480 700 300.5 200.5 1 2", "fisheye", [1, 2, 0, 0]),
    ],
)
def test_colmap_models(reading, camera, model, coefficients) -> None:
    cameras = factory.COLMAP_CAMERAS.replace("PINHOLE 640 480 700 700 300.5 200.5", camera)
    rig = reading(cameras, factory.COLMAP_IMAGES, **factory.COLMAP_CHOICE)
    assert rig.K_left.tolist() == [[700, 0, 300], [0, 700, 200], [0, 0, 1]]
    for lens in rig.distortion:
        assert lens.model == model and lens.coefficients.tolist() == coefficients


@pytest.mark.parametrize("sample", ["middlebury", "kitti_cam_to_cam", "kitti_projections", "opencv_yaml"])
def test_files_of_rectified_images_say_so(reading, sample) -> None:
    assert reading(*table.SAMPLES[sample][1]).rectified
    assert not reading(kalibr()).rectified and not reading(opencv(LEFT, RIGHT)).rectified


# What else users write into such files


@pytest.mark.parametrize("head", ["%YAML:1.0\n", "%YAML:1.0\n---\n", "%YAML 1.1\n---\n"])
def test_the_head_of_opencvs_yaml_is_read_over(reading, head) -> None:
    assert reading(head + factory.KALIBR).E[0, 3] == pytest.approx(0.12)
    assert reading(head + factory.ROS_LEFT, head + factory.ROS_RIGHT).E[0, 3] == pytest.approx(0.12)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_kalibr_keys_may_have_comments(reading, end) -> None:
    text = factory.KALIBR.replace("cam0:", "cam0:  # left").replace("cam1:", "cam1: # right")
    assert reading(text.replace("\n", end)).E[0, 3] == pytest.approx(0.12)
