"""What is special in single formats: which cameras, which resolution, which names, which lens."""

from __future__ import annotations

import copy
import json
import re
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._checks import InputError
from geodiff_plugin.app.job import CAMERA_WAYS, Request
from geodiff_plugin.cli.inputs import read_rig
from geodiff_plugin.cli.options import DepthOptions
from geodiff_plugin.formats import read_calibration, rig_from_parameters
from tests.contracts import factory_calibrations as factory
from tests.contracts.test_formats_round_trip import rigid

K_TEXT = "[700 0 300; 0 700 200; 0 0 1]"
ZED_HD = {"image_size": (1280, 720)}


@pytest.fixture
def reading(tmp_path):
    """``reading(text, ..., **choice)`` reads texts as files, for a caller that undistorts."""
    return partial(factory.read_texts, tmp_path, distorted=True)


# Middlebury, KITTI, stereodemo, MVSNet, numbers


def test_depth_from_disparity_and_doffs(reading):
    """Z = baseline * f / (d + doffs), the data set's own formula, is what K, K_right and E give."""
    rig = reading(f"cam0={K_TEXT}\ncam1={K_TEXT.replace('300', '340')}\ndoffs=40\nbaseline=80\n")
    z = 0.08 * 700 / (16 + 40)
    x_right = 10 / 700 * z - rig.E[0, 3]
    assert 310 - (rig.K_right[0, 0] * x_right / z + rig.K_right[0, 2]) == pytest.approx(16)


@pytest.mark.parametrize("cam1", [f"cam1={K_TEXT}\n", ""])
def test_doffs_wins_over_cam1_with_a_warning(reading, cam1):
    with pytest.warns(UserWarning, match="file0: cam1 .* 331 px"):
        rig = reading(f"cam0={K_TEXT}\n{cam1}doffs=31\nbaseline=80\n")
    assert rig.K_right[0, 2] == 331 and rig.K_left[0, 2] == 300


KITTI = {
    camera: f"721.5 0 609.6 {offset} 0 721.5 172.9 {0.1 * camera} 0 0 1 {1e-4 * camera}"
    for camera, offset in ((0, 0.0), (1, -380.0), (2, 45.0), (3, -340.0))
}


@pytest.mark.parametrize("key", ["P{}", "P_rect_{:02d}"])
@pytest.mark.parametrize(
    ("cameras", "hint", "expected"),
    [
        ((0, 1), None, (0, 1)),
        ((2, 3), "image_0", (2, 3)),
        (None, "data/training/image_0/000000_10.png", (0, 1)),
        (None, "image_02/data", (2, 3)),
        (None, "image_3", (2, 3)),
        (None, "colored_0", (2, 3)),
        ((3, 2), None, (3, 2)),
    ],
)
def test_kitti_cameras(reading, key, cameras, hint, expected):
    text = "\n".join(f"{key.format(camera)}: {row}" for camera, row in KITTI.items())
    rig = reading(text, cameras=cameras, image_folder_hint=hint)
    P_left, P_right = (np.array(KITTI[camera].split(), float).reshape(3, 4) for camera in expected)
    # The file's frame is camera 0's; the rig's is the left camera's: the pixels must not know.
    point = np.array([1.0, -2.0, 8.0])
    left = point + np.linalg.inv(P_left[:, :3]) @ P_left[:, 3]
    np.testing.assert_allclose(rig.K_left @ left, P_left @ [*point, 1], atol=1e-9)
    right = rig.K_right @ (rig.T_right_from_left @ [*left, 1])[:3]
    np.testing.assert_allclose(right, P_right @ [*point, 1], atol=1e-8)


def test_kitti_pairs_that_nothing_chooses_between(reading):
    rows = [f"P{camera}: {row}" for camera, row in KITTI.items()]
    with pytest.warns(UserWarning, match="taking 2,3"):
        rig = reading("\n".join(rows), image_folder_hint="my/photos")
    assert rig.E[0, 3] == pytest.approx(385.0 / 721.5, rel=1e-3)
    grey = reading("\n".join(rows[:2]), image_folder_hint="image_2")
    assert grey.E[0, 3] == pytest.approx(380.0 / 721.5, rel=1e-3)
    driving = {101: 0.0, 103: -1093.1}
    text = "".join(f"P_rect_{c}: 1003.5 0 455.7 {b} 0 1003.5 197.7 0 0 0 1 0\n" for c, b in driving.items())
    assert reading(text).E[0, 3] == pytest.approx(1093.1 / 1003.5)


def test_one_principal_point_for_both_images(reading):
    text = '{"fx": 1003, "fy": 1002, "cx": 455, "cy": 197, "baseline_meters": 0.5}'
    assert reading(text).K_right[0, 2] == 455


def test_rotations_rigid_to_print_precision_become_rotations(reading):
    T = rigid([0.2, 0.4, 0.6], (0.3, -0.2, 1))
    sheared = T.copy()
    sheared[:3, :3] += 4e-4 * np.array([[1, -1, 1], [0, 1, -1], [1, 0, -1]])
    texts = (
        "extrinsic\n"
        + "\n".join(" ".join(map(str, row)) for row in pose)
        + "\n\nintrinsic\n7 0 3\n0 7 2\n0 0 1\n"
        for pose in (np.eye(4), sheared)
    )
    E = reading(*texts).E
    np.testing.assert_allclose(E[:3, :3] @ E[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(E, np.linalg.inv(T), atol=2e-3)


def test_rig_from_parameters():
    rig = rig_from_parameters(700, 701, 320, 240, 0.12, size=(640, 480))
    np.testing.assert_array_equal(rig.K_left, [[700, 0, 320], [0, 701, 240], [0, 0, 1]])
    assert rig.E[0, 3] == 0.12 and rig.size_right == (640, 480)
    assert rig_from_parameters(700, 701, 320, 240, 0.12, cx_right=350).K_right[0, 2] == 350


# OpenCV

K1 = np.array([[700.0, 0, 320], [0, 702, 240], [0, 0, 1]])
K2 = np.array([[710.0, 0, 330], [0, 709, 236], [0, 0, 1]])
D1, D2 = np.array([[-0.25, 0.125, 0.001, 0.0, 0.0]]), np.array([[-0.125, 0.25, 0.0, 0.0, 0.0]])
POSE = rigid([0.03, 0.2, 0.02], (-0.12, 0.02, 0.04))


def storage(path: Path, **entries) -> Path:
    """What OpenCV itself writes."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        file.write(name, value)
    file.release()
    return path


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_opencv_reads_what_opencv_rectified(tmp_path, suffix):
    *_, P1, P2, Q, _, _ = cv2.stereoRectify(K1, D1, K2, D2, (640, 480), POSE[:3, :3], POSE[:3, 3:], alpha=0)
    given = {"M1": K1, "D1": D1, "M2": K2, "D2": D2, "R": POSE[:3, :3], "T": POSE[:3, 3:], "P1": P1, "P2": P2}
    more = {"Q": Q, "image_width": 640, "image_height": 480, "note": "rectified"}
    path = storage(tmp_path / f"stereo.{suffix}", **given, **more, nothing=np.array([[np.nan, np.inf]]))
    rig = read_calibration(path)
    np.testing.assert_allclose(rig.K_left, P1[:, :3])
    assert rig.rectified and rig.size_left == (640, 480)
    assert rig.E[0, 3] == pytest.approx(np.linalg.norm(POSE[:3, 3]), rel=1e-6)
    if suffix == "json":  # older versions write 1. where JSON wants 1.0
        path.write_text(path.read_text().replace("0.0,", "0.,"))
        np.testing.assert_array_equal(read_calibration(path).E, rig.E)


@pytest.mark.parametrize("suffix", ["yml", "xml"])
def test_opencv_in_two_files(tmp_path, suffix):
    zero = np.zeros((1, 5))
    intrinsics = storage(tmp_path / f"intrinsics.{suffix}", M1=K1, D1=zero, M2=K2, D2=zero)
    extrinsics = storage(tmp_path / f"extrinsics.{suffix}", R=POSE[:3, :3], T=POSE[:3, 3:])
    for pair in ((intrinsics, extrinsics), (extrinsics, intrinsics)):
        np.testing.assert_allclose(read_calibration(pair).T_right_from_left, POSE, atol=1e-12)
    with pytest.raises(ValueError, match="no R, T.*give both"):
        read_calibration(intrinsics)


@pytest.mark.parametrize(
    "names",
    [
        "cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2 R T",
        "K1 D1 K2 D2 R T",
        "K_left dist_left K_right dist_right R T",
        "K_l D_l K_r D_r R t",
        "Ml dl Mr dr R T",
        "mtxL distL mtxR distR Rot Trans",
        "cameraMatrixL distCoeffsL cameraMatrixR distCoeffsR RotationMatrix TranslationVector",
        "camera_matrix_left dist_coeffs_left camera_matrix_right dist_coeffs_right rotation translation",
        "left_camera_matrix left_distortion_coeffs right_camera_matrix right_distortion_coefficients R T",
        "Camera_Matrix_1 Distortion_Coeffs_1 Camera_Matrix_2 Distortion_Coeffs_2 rotation Translation_Vector",
    ],
)
def test_opencv_by_the_names_of_tutorials(tmp_path, names):
    values = (K1, D1, K2, D2, POSE[:3, :3], POSE[:3, 3:])
    for suffix in ("yml", "xml"):
        path = storage(
            tmp_path / f"a.{suffix}", **dict(zip(names.split(), values, strict=True)), image_width=640
        )
        rig = read_calibration(path, distorted=True)
        np.testing.assert_array_equal(rig.K_right, K2)
        np.testing.assert_allclose(rig.T_right_from_left, POSE, atol=1e-12)
        assert [lens.coefficients[0] for lens in rig.distortion] == [-0.25, -0.125]


def test_projections_by_other_names_and_a_vertical_rig(tmp_path):
    P = K1 @ np.eye(3, 4), K1 @ np.hstack([np.eye(3), [[0], [-0.2], [0]]])
    sides = {"image_width": np.array([[640]]), "image_height": np.array([[480]])}
    settings = storage(tmp_path / "plain.yml", LEFT_P=P[0], RIGHT_P=P[1]).read_text()
    (tmp_path / "euroc.yaml").write_text(
        settings.replace("T_P", "T.P") + "Camera.k1: 0.1\nCamera.bf: 3.0\nLEFT.width: 640\nLEFT.height: 480\n"
    )
    storage(tmp_path / "a.yml", projMatrixL=P[0], projMatrixR=P[1], **sides)
    storage(tmp_path / "b.yml", PL=P[0], PR=P[1], k1=0.1, k2=0.2, p1=0.0, p2=0.3)
    for name, size in (("a.yml", (640, 480)), ("b.yml", None), ("euroc.yaml", (640, 480))):
        rig = read_calibration(tmp_path / name)
        assert rig.rectified and rig.size_left == size
        np.testing.assert_allclose(rig.E[:3, 3], (0, 0.2, 0), atol=1e-12)


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_opencv_arrays_of_one_axis_and_of_several_channels(tmp_path, suffix):
    """OpenCV 5 writes an array of shape (5,) as another kind of matrix; lists of points have two channels."""
    points, path = np.arange(8.0).reshape(4, 1, 2), tmp_path / f"s.{suffix}"
    storage(path, points=points, M1=K1, D1=D1[0], M2=K1, D2=D2[0], R=np.eye(3), T=POSE[:3, 3])
    rig = read_calibration(path, distorted=True)
    np.testing.assert_allclose(rig.E[:3, 3], -POSE[:3, 3], atol=1e-12)
    np.testing.assert_array_equal(rig.distortion[1].coefficients, D2[0])
    path.write_text(path.read_text().replace("-0.25,", "").replace("-0.25 ", ""))
    with pytest.raises(ValueError, match=r"d1 must be .* numbers; got 4 numbers\. Is the file cut off"):
        read_calibration(path, distorted=True)


@pytest.mark.parametrize(("missing", "there", "side"), [("D2", "D1", "right"), ("D1", "D2", "left")])
def test_distortion_of_one_camera_alone_is_told(tmp_path, missing, there, side):
    given = {"M1": K1, "D1": D1, "M2": K2, "D2": D2, "R": np.eye(3), "T": POSE[:3, 3:]}
    del given[missing]
    said = f"has the lens distortion {there} and no {missing}: the {side} image .* Add {missing} to the file"
    with pytest.warns(UserWarning, match=said):
        rig = read_calibration(storage(tmp_path / "s.yml", **given), distorted=True)
    assert [lens is None for lens in rig.distortion] == [missing == "D1", missing == "D2"]
    given[there] = np.zeros((1, 5))
    assert read_calibration(storage(tmp_path / "s.yml", **given)).distortion == (None, None)


@pytest.mark.parametrize("head", ["%YAML:1.0\n", "%YAML:1.0\n---\n", "%YAML 1.1\n---\n"])
def test_the_head_of_opencvs_yaml_and_comments_are_read_over(reading, head):
    kalibr = factory.KALIBR.replace("cam0:", "cam0:  # left").replace("cam1:", "cam1: # right")
    assert reading(head + kalibr).E[0, 3] == pytest.approx(0.12)
    assert reading(head + factory.ROS_LEFT, head + factory.ROS_RIGHT).E[0, 3] == pytest.approx(0.12)


# ZED, RealSense, OAK-D


@pytest.mark.parametrize(("size", "focal"), [((2208, 1242), 1400), ((1280, 720), 700)])
def test_zed_takes_the_section_of_the_image(reading, tmp_path, size, focal):
    rig = reading(factory.ZED, image_size=size)
    assert rig.K_left[0, 0] == focal and rig.size_left == size
    guidance = GeometryGuidance.from_calibration(np.zeros((*size[::-1], 3)), tmp_path / "file0")
    assert guidance.rigs[0].K_left[0, 0] == focal


def test_zed_rational_lens(reading):
    text = factory.ZED.replace("k1=0\nk2=0\np1=0\np2=0\nk3=0", "k1=1\nk2=2\nk3=5\np1=3\np2=4\nk4=6")
    assert reading(text, **ZED_HD).distortion[0].coefficients.tolist() == [1, 2, 3, 4, 5, 6, 0, 0]


def test_realsense_prints_many_resolutions(reading):
    other = factory.REALSENSE_PRINTED.replace("640x480", "1280x720").replace("640", "1280")
    text = other.replace("480", "720").replace("700", "1100") + factory.REALSENSE_PRINTED
    assert reading(text, image_size=(1280, 720)).K_right[1, 1] == 1100
    assert reading(text, image_size=(640, 480)).K_right[1, 1] == 700
    with pytest.raises(ValueError, match="640x480, 1280x720"):
        reading(text)


def test_realsense_json_the_other_way_round_is_inverted(reading):
    data = json.loads(factory.REALSENSE_JSON)
    data["extrinsics"] = {"right_to_left": {**factory.RS2_EXTRINSICS, "translation": [0.12, 0, 0]}}
    assert reading(json.dumps(data)).E[0, 3] == pytest.approx(0.12)


def test_realsense_models(reading):
    def of(model, coefficients):
        data = json.loads(factory.REALSENSE_JSON)
        for camera in data["intrinsics"].values():
            camera.update(model=model, coeffs=coefficients)
        return reading(json.dumps(data))

    five = [0.1, 0.2, 0.003, 0.004, 0.5]
    for model in ("distortion.brown_conrady", "RS2_DISTORTION_BROWN_CONRADY", 4):
        assert of(model, five).distortion[0].coefficients.tolist() == five
    lens = of("distortion.kannala_brandt4", [*five[:4], 0.0]).distortion[1]
    assert lens.model == "fisheye" and lens.coefficients.tolist() == five[:4]
    for model in ("distortion.inverse_brown_conrady", 2, "Inverse Brown Conrady"):
        assert of(model, [0.0] * 5).rectified, "zeros are no lens"
        with pytest.raises(InputError, match=r"lens model of the left .*inverse brown conrady.*rectify"):
            of(model, five)


def test_oak_scales_to_the_image_and_takes_the_right_cameras_intrinsics(reading):
    data = copy.deepcopy(factory.OAK_DATA)
    dict(data["cameraData"])[2]["intrinsicMatrix"][0][0] = 712.5
    rig = reading(json.dumps(data), image_size=(640, 400))
    assert rig.rectified and rig.size_left == (640, 400) and rig.distortion == (None, None)
    assert rig.K_left[0].tolist() == [356.25, 0, pytest.approx((640 + 0.5) / 2 - 0.5)]
    np.testing.assert_array_equal(rig.K_left, rig.K_right)


def test_oak_other_sockets_go_along_the_links(reading):
    data = json.dumps(factory.OAK_DATA)
    # 1 -> 2 is -0.12 m in x, 2 -> 0 is +0.04: socket 0 stands 0.08 m to the right of socket 1.
    assert reading(data, cameras=(1, 0)).E[0, 3] == pytest.approx(0.08)
    assert reading(data, cameras=(0, 1)).E[0, 3] == pytest.approx(-0.08)


def test_oak_lenses(reading):
    data = copy.deepcopy(factory.OAK_DATA)
    data["stereoRectificationData"]["rectifiedRotationLeft"] = []
    for _, camera in data["cameraData"]:
        camera.update(cameraType=1, distortionCoeff=[0.1, 0.2, 0.3, 0.4, *[0.0] * 10])
    lens = reading(json.dumps(data)).distortion[1]
    assert lens.model == "fisheye" and lens.coefficients.tolist() == [0.1, 0.2, 0.3, 0.4]
    for _, camera in data["cameraData"]:
        camera["cameraType"] = 3
    with pytest.raises(InputError, match="got 'cameraType 3'"):
        reading(json.dumps(data))


# ROS, Kalibr, EuRoC, ORB-SLAM


def test_ros_swapped_files_put_the_camera_on_the_other_side(reading):
    assert reading(factory.ROS_RIGHT, factory.ROS_LEFT).E[0, 3] == pytest.approx(-0.12)


def test_ros_sizes_are_whole_numbers(reading):
    def sized(width):
        texts = factory.ROS_LEFT, factory.ROS_RIGHT
        return reading(*(text.replace(": 640", f": {width}") for text in texts))

    assert sized("640.0").size_left == sized("640.").size_right == (640, 480)
    for width in ("640.5", "0", "-640", ".nan", ".inf", "true", "", "[640]"):
        with pytest.raises(ValueError, match="the width of the left image must be a .* number"):
            sized(width)
    echoed = (factory.ROS_ECHO_LEFT, factory.ROS_ECHO_RIGHT)
    without = [text.replace("width: 640\n", "").replace("height: 480\n", "") for text in echoed]
    assert reading(*without).size_left is None


def test_kalibr_chain_of_three_and_lenses(reading):
    third = factory.KALIBR[factory.KALIBR.index("cam1:") :].replace("cam1:", "cam2:")
    rig = reading(factory.KALIBR + third.replace("-0.12", "-0.3"), cameras=(0, 2))
    assert rig.E[0, 3] == pytest.approx(0.42)
    none = factory.KALIBR.replace("[0.0, 0.0, 0.0, 0.0]", "[]").replace("radtan", "none")
    assert reading(none).distortion == (None, None)
    # A fisheye without coefficients still is none of a pinhole.
    with pytest.raises(InputError, match="Lens distortion of the left camera .* got fisheye"):
        reading(factory.KALIBR.replace("radtan", "equidistant"), distorted=False)


def test_euroc_marked_as_opencv_needs_it(reading):
    right = factory.EUROC_RIGHT.replace("T_BS:", "T_BS: !!opencv-matrix")
    assert reading(factory.EUROC_LEFT, right).E[0, 3] == pytest.approx(0.12)


def test_orb_slam_of_all_ages(reading):
    old = reading(factory.ORB_SLAM_RECTIFIED)
    assert old.rectified and old.size_right == (640, 480)
    new = factory.ORB_SLAM_RECTIFIED.replace("Camera.bf: 84.0", 'Camera.type: "Rectified"\nStereo.b: 0.12')
    new = reading(re.sub(r"Camera\.([fc][xy])", r"Camera1.\1", new))
    np.testing.assert_allclose(new.E, old.E)
    posed = factory.ORB_SLAM.replace("Camera1.", "Camera.").replace("Stereo.T_c1_c2", "Tlr")
    posed = posed.replace("rows: 4", "rows: 3").replace(",\n         0.0, 0.0, 0.0, 1.0]", "]")
    assert reading(posed).E[0, 3] == pytest.approx(0.12)
    with pytest.raises(ValueError, match="Camera2.k1.*finite number; got none"):
        text = factory.ORB_SLAM.replace("PinHole", "KannalaBrandt8")
        reading(text.replace(".p1:", ".k3:").replace(".p2:", ".k4:"))


# COLMAP, nerfstudio


@pytest.mark.parametrize(
    ("camera", "model", "coefficients"),
    [
        ("SIMPLE_RADIAL 640 480 700 300.5 200.5 -0.1", "opencv", [-0.1, 0, 0, 0]),
        ("RADIAL 640 480 700 300.5 200.5 -0.1 0.02", "opencv", [-0.1, 0.02, 0, 0]),
        ("FULL_OPENCV 640 480 700 700 300.5 200.5 1 2 3 4 5 6 7 8", "opencv", [1, 2, 3, 4, 5, 6, 7, 8]),
        ("OPENCV_FISHEYE 640 480 700 700 300.5 200.5 1 2 3 4", "fisheye", [1, 2, 3, 4]),
        ("RADIAL_FISHEYE 640 480 700 300.5 200.5 1 2", "fisheye", [1, 2, 0, 0]),
    ],
)
def test_colmap_models(reading, camera, model, coefficients):
    cameras = factory.COLMAP_CAMERAS.replace("PINHOLE 640 480 700 700 300.5 200.5", camera)
    rig = reading(factory.COLMAP_IMAGES, cameras, **factory.COLMAP_CHOICE)  # in any order
    assert rig.K_left.tolist() == [[700, 0, 300], [0, 700, 200], [0, 0, 1]]
    for lens in rig.distortion:
        assert lens.model == model and lens.coefficients.tolist() == coefficients


@pytest.fixture
def nerf(reading):
    """``nerf(data, **choice)``: the sample with other entries, ``None`` for none."""

    def read(changes: dict, **choice):
        data = {
            key: value for key, value in (json.loads(factory.NERF) | changes).items() if value is not None
        }
        return reading(json.dumps(data), **factory.NERF_CHOICE | choice)

    return read


def test_nerf_angles_and_defaults(nerf):
    bare = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"))
    angle = {"camera_angle_x": 2 * np.arctan(320 / 700)}
    rig = nerf(bare | angle, image_size=(640, 480))
    np.testing.assert_allclose(rig.K_right, [[700, 0, 319.5], [0, 700, 239.5], [0, 0, 1]])
    rig = nerf(bare | angle | {"camera_angle_y": 2 * np.arctan(240 / 600), "w": 640.0, "h": 480.0})
    np.testing.assert_allclose(np.diag(rig.K_left), [700, 600, 1])
    assert np.diag(nerf({"fl_y": None, "camera_angle_x": 0.1}).K_left).tolist() == [700, 700, 1]
    for changes, choice, said in (
        (bare | angle, {}, r"entries 'w' and 'h'; got none\. Give image_size"),
        (bare | {"camera_angle_x": 50.0}, {"image_size": (640, 480)}, "in radians.*got 50.0. Is it in deg"),
        ({"fl_x": None, "fl_y": None}, {}, "'fl_x' or 'camera_angle_x'; got none"),
    ):
        with pytest.raises(InputError, match=said):
            nerf(changes, **choice)


def test_nerf_frames_and_matrices(nerf):
    frames = json.loads(factory.NERF)["frames"]
    frames[2] |= {"fl_x": 350, "fl_y": 351, "cx": 160.5, "cy": 120.5, "w": 320, "h": 240, "k1": 0.1}
    for frame in frames:
        del frame["transform_matrix"][3]  # the last row may be left out
    rig = nerf({"frames": frames})
    assert np.diag(rig.K_left).tolist() == [700, 700, 1] and rig.size_left == (640, 480)
    assert rig.K_right.tolist() == [[350, 0, 160], [0, 351, 120], [0, 0, 1]] and rig.size_right == (320, 240)
    assert rig.distortion[0] is None and rig.distortion[1].coefficients[0] == 0.1
    assert rig.E[0, 3] == pytest.approx(0.12)


@pytest.mark.parametrize(
    "said", [{"camera_model": "OPENCV_FISHEYE"}, {"camera_model": None, "is_fisheye": True}]
)
def test_nerf_lenses(nerf, said):
    given = {"distortion_params": [-0.2, 0.05, 0.01, 0, 0.003, -0.002]}
    assert nerf(given).distortion[0].coefficients.tolist() == [-0.2, 0.05, 0.003, -0.002, 0.01]
    k = {"k1": 0.1, "k2": -0.02, "k3": 0.003, "k4": 0.0004}
    for lens in nerf(said | k).distortion:
        assert lens.model == "fisheye" and lens.coefficients.tolist() == list(k.values())
    for model in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", None):
        assert nerf({"camera_model": model}, distorted=False).distortion == (None, None)


@pytest.mark.parametrize(
    ("in_file", "asked"),
    [
        (("./train/r_0", "./train/r_1", "./train/r_2"), ("train/r_0.png", "/data/lego/train/r_2.png")),
        (("images/a.png", "images/b.png", "images/c.png"), ("a.png", "c.png")),  # typed in their folder
        (("../images/a.png", "../images/b.png", "../images/c.png"), ("/x/images/a.png", "images/c.png")),
        (("images\\a.png", "images\\b.png", "images\\c.png"), ("images/a.png", "/x/images/c.png")),
        (("one/0.png", "one/1.png", "two/0.png"), ("/x/one/0.png", "two/0.png")),
        (("0.png", "1.png", "two/0.png"), ("one/0.png", "two/0.png")),
    ],
)
def test_images_are_found_by_the_ends_of_their_paths(nerf, in_file, asked):
    frames = json.loads(factory.NERF)["frames"]
    named = [frame | {"file_path": name} for frame, name in zip(frames, in_file, strict=True)]
    rig = nerf({"frames": named}, image_names=asked)
    assert rig.E[0, 3] == pytest.approx(0.12) and rig.E[0, 0] == pytest.approx(1)


# The doors


def test_a_measured_distance_replaces_that_of_any_file_and_gives_one_to_others(reading):
    assert reading(factory.KALIBR, baseline_m=0.24).E[0, 3] == pytest.approx(0.24)
    with pytest.warns(UserWarning, match="has no unit.*--baseline"):
        rig = reading(
            factory.COLMAP_CAMERAS, factory.COLMAP_IMAGES, image_names=("rig/left.jpg", "right.jpg")
        )
    assert rig.E[0, 3] == pytest.approx(0.5) and rig.unit is None


@pytest.mark.parametrize("kind", ["nerf", "colmap"])
def test_every_pair_of_a_folder_has_its_own_cameras(tmp_path, kind):
    texts = (factory.NERF,) if kind == "nerf" else (factory.COLMAP_CAMERAS, factory.COLMAP_IMAGES)
    calib = tuple(tmp_path / f"{number}.txt" for number in range(len(texts)))
    for path, text in zip(calib, texts, strict=True):
        path.write_text(text)
    folder, size = Path("images" if kind == "nerf" else "rig"), (640, 480)

    def read(right: str):
        given = DepthOptions(left=folder / "left.jpg", right=folder / right, calib=calib, baseline=0.12)
        return read_rig(given, size, size)

    first = read("right.jpg")
    assert np.abs(read("other.jpg").E - first.E).max() > 0.01
    assert read("right.jpg").E.tolist() == first.E.tolist()


def test_the_page_knows_photographs_by_their_names_alone(tmp_path):
    (tmp_path / "transforms.json").write_text(factory.NERF)
    image = np.random.default_rng(0).random((480, 640, 3)).astype(np.float32)
    photographs = ("/tmp/page/0f/left.jpg", "/tmp/page/3a/right.jpg")
    request = Request(*photographs, calibration=(str(tmp_path / "transforms.json"),), baseline_m=0.12)
    assert float(CAMERA_WAYS["file"][1](request, image, image).rigs[0].E[0, 3]) == pytest.approx(0.12)
