"""What is wrong in a calibration is told in one sentence: the file, the entry, what it holds, the cure."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import read_calibration, rig_from_parameters
from tests.contracts import factory_calibrations as factory
from tests.contracts.test_formats_table import CHOICES, SAMPLES, written

K9 = "700.0, 0.0, 300.0, 0.0, 700.0, 200.0, 0.0, 0.0, 1.0"
MATRIX = "{}: !!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: [{}]\n"
OPENCV = "%YAML:1.0\n---\n" + "".join(
    MATRIX.format(*row)
    for row in (
        ("M1", 3, 3, K9),
        ("D1", 1, 5, "-0.1, 0., 0., 0., 0."),
        ("M2", 3, 3, K9),
        ("D2", 1, 5, "0., 0., 0., 0., 0."),
        ("R", 3, 3, "1, 0, 0, 0, 1, 0, 0, 0, 1"),
        ("T", 3, 1, "-0.12, 0, 0"),
    )
)
#: A sample, what is replaced in its last file (or in all, for "all:"), by what, and what is said.
REFUSALS = [
    ("middlebury", "baseline=120\n", "", "no 'baseline'.*cut off"),
    ("middlebury", "baseline=120", "baseline=0", "baseline must be above 0"),
    ("middlebury", "cam1=[1000.5 0 340.25; 0 1000.5 200.5; 0 0 1]\ndoffs=40\n", "", "no 'doffs'"),
    ("middlebury", "340.25; 0 1000.5 200.5; 0 0 1]", "340.25; 0 1000.5", "cam1 must be"),
    ("middlebury", "doffs=40", "doffs=", "doffs must be a finite number"),
    ("middlebury", "width=640", "width=x", "the width of the left image must be a finite number; got 'x'"),
    ("middlebury", "1000.5", "0", "K of the left camera.*positive focal lengths"),
    ("kitti_projections", "P1:", "X1:", "a calibration with two cameras; got cameras 0"),
    ("kitti_projections", "-8.4e+01 0 7.0e+02", "-8.4e+01 0", "P1 must be 12 numbers; got 11"),
    ("foundation_stereo", "0.12", "", "9 numbers of K and the baseline in metres; got 9 numbers.*--K"),
    ("foundation_stereo", "0.12", "0.12 5", "got 11 numbers"),
    ("foundation_stereo", "0.12", "-0.12", "the baseline must be above 0; got -0.12"),
    ("stereodemo", '"baseline_meters": 0.12, ', "", "no 'baseline_meters'"),
    ("stereodemo", '"fx": 700.0', '"fx": "a"', "fx must be a finite number; got 'a'"),
    ("stereodemo", '"fx": 700.0', '"fx": NaN', "fx must be a finite number"),
    ("stereodemo", '"fx": 700.0', '"fx": true', "fx must be a finite number; got True"),
    ("stereodemo", "0.12", "-1", "the baseline must be above 0"),
    ("stereodemo", "700.0", "9" * 400, "fx must be a finite number"),
    ("stereodemo", "700.0", "9" * 5000, "thousands of digits"),
    ("opencv", "data: [1, 0, 0, 0, 1, 0, 0, 0, 1]", "data: [1.5, 0, 0, 0, 1.5, 0, 0, 0, 1.5]",
     "R, T must be rigid.*rotation"),
    ("opencv", "data: [1, 0, 0, 0, 1, 0, 0, 0, 1]", "data: [1, 0, 0, 0, 1, 0, 0, 0, -1]",
     "R, T must be rigid.*rotation"),
    ("opencv", "rows: 3\n   cols: 1\n   dt: d\n   data: [-0.12, 0, 0]",
     "rows: 2\n   cols: 1\n   dt: d\n   data: [0, 0]", r"T must be of shape \(3, 1\); got \(2, 1\)"),
    ("opencv", "rows: 3\n   cols: 3", "rows: 1\n   cols: 9", r"M1 must be of shape \(3, 3\)"),
    ("opencv", "rows: 3\n   cols: 3", "rows: 3\n   cols: 4",
     "m1 must be 3x4 numbers; got 9 numbers.*cut off"),
    ("opencv", "rows: 3\n   cols: 3", "rows: 900000\n   cols: 900000", "m1 must be 900000x900000 numbers"),
    ("opencv", "D2:", "dist_of_right:", "must be called D1, D2; got dist_of_right. Rename"),
    ("opencv", "D2:", "mtxL:", "M1 must be there once; got m1, mtxl, which differ"),
    ("opencv", "T:", "X:", "no T. Where intrinsics and extrinsics are two files, give both"),
    ("opencv", "0., 0., 0., 0., 0.", "0.1, 0., 0., 0., 0., 0.", "d2 must be 1x5 numbers; got 6"),
    ("opencv", "cols: 5\n   dt: d\n   data: [0., 0., 0., 0., 0.",
     "cols: 6\n   dt: d\n   data: [1., 0., 0., 0., 0., 0.",
     "right camera must be 4, 5, 8, 12, 14 coefficients .* got 6: "),
    ("opencv", "-0.1, 0.", ".Nan, 0.", "Lens distortion of the left camera must be numbers, all finite"),
    ("opencv", "", "", r"Lens distortion of the left camera in .*file0.* must be zero .*-0\.1.*rectify"),
    ("opencv_xml", "<opencv_storage>", '<!DOCTYPE x [<!ENTITY a "b">]><opencv_storage>', "entities"),
    ("opencv_yaml", "[ 7.0000000000000000e+02, 0., 3.0000000000000000e+02, 0., 0.,", "[ 1, 0, 0, 0, 1,",
     "K of the left camera"),
    ("booster", "<baselineLR>120.</baselineLR>", "", "no 'baselinelr'"),
    ("mvsnet", "1 0 0 -0.12\n", "1.1 0 0 -0.12\n", "extrinsic must be rigid: .*scale"),
    ("mvsnet", "0 0 1 0\n0 0 0 1", "0 0 -1 0\n0 0 0 1", "extrinsic must be rigid: "),
    ("mvsnet", "0 0 0 1", "1 0 0 1", r"last row \(0, 0, 0, 1\); got .*transposed"),
    ("mvsnet", "intrinsic\n700 0 300\n0 700 200\n0 0 1", "", "no intrinsic"),
    ("zed", "Baseline=120", "Baseline=-120", r"Baseline of \[STEREO\] must be above 0"),
    ("zed", "fx=700", "fx=x", r"fx of \[LEFT_CAM_HD\] must be a finite number; got 'x'"),
    ("zed", "k1=0", "k1=-0.17", "Lens distortion of the left camera .* Undistort"),
    ("realsense_json", '"translation"', '"moved"', "their extrinsics; got 2 and 0"),
    ("realsense_printed", 'To      "Infrared 2"', 'To      "Depth"', "with .Infrared 1.*less.*cut off"),
    ("oak", '"rectifiedRotationLeft": [', '"other": [', "Lens distortion of the left camera"),
    ("oak", '"toCameraSocket": 2', '"toCameraSocket": -1', "a way from socket 1 to 2"),
    ("ros", "-84.", "0.", "the same in both. These are of single cameras"),
    ("all:ros", "00.", "00. x", "projection_matrix must be 12 numbers"),
    ("ros", "projection_matrix:", "projektion:", r"camera_info with projection_matrix \(or P\)"),
    ("kalibr", "distortion_coeffs: [0.0", "distortion_coeffs: [-0.28", "Lens distortion of the left camera"),
    ("kalibr", "camera_model: pinhole", "camera_model: omni", "camera_model must be pinhole; got 'omni'"),
    ("kalibr", "cam1:", "cam3:", "no 'cam1'"),
    ("kalibr", "distortion_model: radtan", "distortion_model: fov", "lens model.*got 'fov'.*undistort"),
    ("kalibr", "distortion_coeffs: [0.0, ", "distortion_coeffs: [",
     "distortion_coeffs must be 4 numbers; got 3"),
    ("kalibr", "intrinsics: [700.0", "intrinsics: [.nan", "intrinsics must be 4 numbers, all finite"),
    ("euroc", "distortion_coefficients: [0.0", "distortion_coefficients: [-0.28", "of the right camera"),
    ("euroc", "camera_model: pinhole", "camera_model: omni", "camera_model must be pinhole"),
    ("euroc", "radial-tangential", "fov", "lens model of the right camera.*'fov'"),
    ("euroc", "resolution: [640", "resolution: [640.5", "width of the right image must be a whole number"),
    ("euroc", "  data: [0.0, 0.0, 1.0, 0.3,", "  data: [0.0, 0.0, 1.0,", "T_BS must be 16 numbers; got 15"),
    ("orb_slam_rectified", "ThDepth: 35", "DepthMapFactor: 5000", "got of .* with a depth sensor"),
    ("orb_slam_rectified", "Camera.bf: 84.0", "", "with Stereo.T_c1_c2, or Camera.bf of rectified"),
    ("orb_slam_rectified", "Camera.bf: 84.0", "Camera.bf: -84.0", "the baseline must be above 0"),
    ("orb_slam_rectified", "Camera.k1: 0.0", "Camera.k1: 0.2", "Lens distortion of Camera must be zero"),
    ("orb_slam_rectified", "Camera.cx: 300.0", "", "Camera.cx must be a finite number; got none"),
    ("orb_slam_rectified", "Camera.height: 480", "", "Camera.height must be a finite number; got none"),
    ("orb_slam_rectified", "Camera.width: 640", "Camera.width: 640.5", "width .* whole number of pixels"),
    ("orb_slam_rectified", "%YAML:1.0", '%YAML:1.0\nCamera.type: "KannalaBrandt8"', "of type KannalaBrandt8"),
    ("orb_slam", "PinHole", "Rectified", "Camera.type must be PinHole or KannalaBrandt8 beside Stereo"),
    ("orb_slam", "Camera2.fx: 700.0\n", "", "Camera2.fx must be a finite number; got none"),
    ("orb_slam", "  rows: 4\n  cols: 4", "  rows: 2\n  cols: 8", r"Stereo.T_c1_c2 must be of shape \(4, 4\)"),
    ("orb_slam", "0.0, 0.0, 1.0, 0.0,\n", "0.0, 0.0, 3.0, 0.0,\n",
     "Stereo.T_c1_c2 must be rigid: .*rotation"),
    ("all:colmap", "PINHOLE 640", "OPENCV 640", "parameters of camera 1 must be 8 numbers; got 4"),
    ("all:colmap", "PINHOLE 640 480 700 700 300.5 200.5", "FOV 640 480 700 700 300.5 200.5 1",
     "got 'FOV'.*undist"),
    ("all:colmap", "PINHOLE 640", "FISHY 640",
     "the model of camera 1 must be one of SIMPLE_PINHOLE.*Undistort"),
    ("colmap", "rig/right.jpg", "rig/elsewhere.jpg",
     "one of the 3 in the file .*rig/elsewhere.jpg.*got rig/right"),
    ("colmap", "-2 1 rig/right", "-2 7 rig/right", "with camera 7; got only 1"),
    ("colmap", "3 1 0 0 0", "3 0 0 0 0", "the rotation of rig/right.jpg must be a quaternion; got zeros"),
    ("nerf", '"camera_model"', '"from_mitsuba": true, "camera_model"', "y up and z backward"),
    ("nerf", '"OPENCV"', '"EQUIRECTANGULAR"', "lens model of the left camera .* got 'EQUIRECTANGULAR'"),
    ("nerf", '"OPENCV"', "null", "got 'None'"),
    ("nerf", '"k1"', '"ftheta_p0": 0.1, "k1"', "got 'ftheta_p0'. OpenCV does not have this model"),
    ("nerf", '"k1"', '"k4": 0.1, "k1"', "k4 must be zero for OPENCV; got 0.1"),
    ("nerf", '"OPENCV",', '"OPENCV_FISHEYE", "distortion_params": [0, 0, 0, 0, 0, 0.1],',
     "p2 must be zero for OPENCV_F"),
    ("nerf", '"k1": 0.0', '"k1": "little"', "k1 must be a finite number; got 'little'"),
    ("nerf", '"k1"', '"distortion_params": [0.1], "k1"', "distortion_params must be 6 numbers; got 1"),
    ("nerf", '"fl_x": 700.0', '"fl_x": -700', "positive focal lengths in pixels; got -700"),
    ("nerf", '"cx": 300.5', '"cx": [1]', "cx must be a finite number"),
    ("nerf", '"frames": [', '"frames": {"0": [', "must be JSON"),
    ("nerf", '"./images/other.jpg"', "3", "file_path of frame 1 must be a name; got 3"),
    ("nerf", '"file_path": "./images/other.jpg", ', "", "file_path of frame 1 must be a name; got None"),
    ("nerf", '"transform_matrix": [[1, 0, 0, 3.75]', '"matrix": [[1, 0, 0, 3.75]', "no 'transform_matrix'"),
    ("nerf", "[[1, 0, 0, 3.75], [0, 0, -1, 4]", "[[2, 0, 0, 3.75], [0, 0, -1, 4]", "rigid: .*no scale"),
    ("nerf", "[[1, 0, 0, 3.75]", "[[-1, 0, 0, 3.75]", "rigid: .*determinant -1"),
    ("nerf", "[[1, 0, 0, 3.75], [0, 0, -1, 4], [0, 1, 0, 5], [0, 0, 0, 1]]", "[[1, 0, 0, 3.75]]",
     "16 numbers; got 4"),
    ("nerf", "[[1, 0, 0, 3.75], [0, 0, -1, 4], [0, 1, 0, 5], [0, 0, 0, 1]]", '"one"',
     "all finite; got 'one'"),
    ("nerf", "3.75], [0, 0, -1, 4], [0, 1, 0, 5], [0, 0, 0, 1]]",
     "3.75], [0, 0, -1, 4], [0, 1, 0, 5], [1, 0, 0, 1]]",
     "last row .* Is it transposed"),
]  # fmt: skip


@pytest.mark.parametrize(("sample", "old", "new", "said"), REFUSALS)
def test_a_wrong_entry_is_named(tmp_path, sample, old, new, said):
    everywhere, name = sample.startswith("all:"), sample.removeprefix("all:")
    texts = (OPENCV,) if name == "opencv" else SAMPLES[name][1]
    changed = [
        text.replace(old, new) if everywhere or number == len(texts) - 1 else text
        for number, text in enumerate(texts)
    ]
    assert changed != list(texts) or old == new, "the sample has nothing of that kind"
    with pytest.raises(InputError, match=f"(?s){said}") as caught:
        read_calibration(written(tmp_path, tuple(changed)), **CHOICES.get(name, {}))
    assert "file0.dat" in str(caught.value) and len(str(caught.value)) < 900


@pytest.mark.parametrize(
    ("sample", "choice", "said"),
    [
        ("kitti_projections", {"cameras": (2, 3)}, r"two different cameras of the file \(0, 1\); got 2,3"),
        ("kitti_projections", {"cameras": (0, 0)}, "two different cameras"),
        ("foundation_stereo", {"cameras": (0, 1)}, "cameras must be left out"),
        ("kalibr", {"cameras": (0, 2)}, r"two different cameras of the file \(0, 1\); got 0,2"),
        ("kalibr", {"cameras": (1, 1)}, "two different cameras"),
        ("kalibr", {"cameras": ("a", 1)}, "a pair of camera numbers"),
        ("oak", {"cameras": (1, 5)}, r"sockets of the file \(0, 1, 2\); got 5"),
        ("oak", {"image_size": (1280, 720)}, "1280x800 pixels.*crop"),
        ("zed", {"image_size": None}, "1280x720, 2208x1242.*got no image"),
        ("zed", {"image_size": (2560, 720)}, "1280x720, 2208x1242"),
        ("kalibr", {"baseline_m": -1.0}, "baseline_m"),
        ("nerf", {"image_names": ("left.jpg", "d.png")}, r"one of the 3.*got d\.png"),
        ("nerf", {"image_names": ("left.jpg", "left.jpg")}, "two of those.* got ./images/left.jpg for both"),
        ("nerf", {"image_names": None}, "image_names must be given"),
    ],
)
def test_a_wrong_choice_is_named(tmp_path, sample, choice, said):
    with pytest.raises(InputError, match=said):
        read_calibration(written(tmp_path, SAMPLES[sample][1]), **(CHOICES.get(sample, {}) | choice))


def test_ambiguous_names_ask_for_the_folder(tmp_path):
    data = json.loads(factory.NERF)
    for frame, name in zip(data["frames"], ("one/a.png", "b.png", "two/a.png"), strict=True):
        frame["file_path"] = name
    with pytest.raises(InputError, match="may be one/a.png and two/a.png. Add its"):
        read_calibration(written(tmp_path, (json.dumps(data),)), image_names=("a.png", "b.png"))


def test_the_door(tmp_path):
    (tmp_path / "folder").mkdir()
    for name, content in (
        ("empty", b""),
        ("blank", b" \n\n"),
        ("binary", b"\x89PNG\0\0\0"),
        ("other", b"hi: you\n"),
    ):
        (tmp_path / name).write_bytes(content)
    for name, error, said in (
        (
            "nope.txt",
            FileNotFoundError,
            "calibration must be a calibration file; got .*nope.txt, which does",
        ),
        ("folder", IsADirectoryError, "folder"),
        ("empty", InputError, "empty"),
        ("blank", InputError, "blanks"),
        ("binary", InputError, "binary"),
        ("other", InputError, r"known format \(Middlebury.*MVSNet.*which is none of them.*fx, fy"),
    ):
        with pytest.raises(error, match=said):
            read_calibration(tmp_path / name)
    for wrong in (3, (1, 2), None):
        with pytest.raises(TypeError, match="calibration must be a path"):
            read_calibration(wrong)
    with pytest.raises(InputError, match="3 files"):
        read_calibration(("a", "b", "c"))


def test_how_many_files_a_format_needs(tmp_path):
    def two(left: str, right: str):
        return written(tmp_path, (left, right))

    K, other = "700 0 300 0 700 200 0 0 1\n0.1\n", "700 0 300 0 700 200 0 0 1\n0.2\n"
    path = two(K, other)[0]
    assert read_calibration((path, path)).E[0, 3] == 0.1  # the same file twice is that file
    with pytest.raises(InputError, match="describes both cameras"):
        read_calibration(two(K, other))
    with pytest.raises(InputError, match="different m1, m2"):
        read_calibration(two(OPENCV, OPENCV.replace("700.0", "701.0")))
    with pytest.raises(InputError, match="two files of one format; got foundation_stereo and middlebury"):
        read_calibration(two(K, SAMPLES["middlebury"][1][0]))
    for sample in ("mvsnet", "ros", "euroc", "colmap"):
        paths = written(tmp_path, SAMPLES[sample][1])
        for single in (paths[0], (paths[0], paths[0])):
            with pytest.raises(InputError, match=r"two files .*got .*file0.*Give --calib twice"):
                read_calibration(single)


@pytest.mark.parametrize(
    ("position", "value", "name"),
    [
        (0, 0, "fx"),
        (1, -5.0, "fy"),
        (2, math.nan, "cx"),
        (4, 0, "baseline"),
        (4, math.inf, "baseline"),
    ],
)
def test_parameters(position, value, name):
    arguments = [700, 701, 320, 240, 0.12]
    arguments[position] = value
    with pytest.raises(ValueError, match=name):
        rig_from_parameters(*arguments)


def test_ros_of_no_calibration(tmp_path):
    zeros = re.sub(r"(projection_matrix.*data: )\[[^\]]*\]", r"\1[" + ", ".join(["0."] * 12) + "]",
                   factory.ROS_LEFT, flags=re.DOTALL)  # fmt: skip
    assert np.array_equal(zeros == factory.ROS_LEFT, False)
    with pytest.raises(InputError, match=r"the camera is not calibrated: .* all zeros\."):
        read_calibration(written(tmp_path, (zeros, zeros.replace("/left", "/right"))))
