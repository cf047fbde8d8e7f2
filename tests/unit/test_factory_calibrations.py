"""Readers of the calibrations of rigs that people own: directions, units, resolutions, lenses, names."""

from __future__ import annotations

import copy
import json
import re
import struct
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.colmap import read_colmap_cameras, read_colmap_images, read_colmap_points
from tests.contracts import factory_calibrations as factory


@pytest.fixture
def reading(tmp_path):
    """``reading(text, ..., **choice)`` writes the texts to files and reads them."""
    return partial(factory.read_texts, tmp_path)


# ZED


@pytest.mark.parametrize(("size", "focal"), [((2208, 1242), 1400), ((1280, 720), 700)])
def test_zed_takes_the_section_of_the_image(reading, size, focal):
    rig = reading(factory.ZED, image_size=size)
    assert rig.K_left[0, 0] == focal and rig.size_left == size


def test_zed_rotation_and_offsets_point_from_left_to_right(reading):
    text = factory.ZED.replace("TY=0", "TY=0.5").replace("TZ=0", "TZ=-2").replace("CV_HD=0", "CV_HD=0.01")
    rig = reading(text, image_size=(1280, 720))
    R = Rotation.from_rotvec([0, 0.01, 0]).as_matrix()
    np.testing.assert_allclose(rig.E[:3, :3], R.T, atol=1e-12)
    np.testing.assert_allclose(rig.E[:3, 3], R.T @ [0.12, 0.0005, -0.002], atol=1e-12)


# RealSense


def test_realsense_prints_many_resolutions(reading):
    other = factory.REALSENSE_PRINTED.replace("640x480", "1280x720").replace("640", "1280")
    text = other.replace("480", "720").replace("700", "1100") + factory.REALSENSE_PRINTED
    assert reading(text, image_size=(1280, 720)).K_right[1, 1] == 1100
    assert reading(text, image_size=(640, 480)).K_right[1, 1] == 700
    with pytest.raises(ValueError, match="640x480, 1280x720"):
        reading(text)


def test_realsense_json_rotation_is_column_by_column(reading):
    data = json.loads(factory.REALSENSE_JSON)
    R = Rotation.from_rotvec([0.01, -0.02, 0.03]).as_matrix()
    data["extrinsics"]["infra1_to_infra2"]["rotation"] = R.T.ravel().tolist()
    rig = reading(json.dumps(data))
    np.testing.assert_allclose(rig.T_right_from_left[:3, :3], R, atol=1e-9)


def test_realsense_json_the_other_way_round_is_inverted(reading):
    data = json.loads(factory.REALSENSE_JSON)
    data["extrinsics"] = {"right_to_left": {**factory.RS2_EXTRINSICS, "translation": [0.12, 0, 0]}}
    assert reading(json.dumps(data)).E[0, 3] == pytest.approx(0.12)


# OAK-D


def test_oak_scales_to_the_image_and_refuses_a_crop(reading):
    rig = reading(factory.OAK, image_size=(640, 400))
    assert rig.size_left == (640, 400)
    assert rig.K_left[0].tolist() == [350, 0, pytest.approx((640 + 0.5) / 2 - 0.5)]
    with pytest.raises(ValueError, match="1280x800 pixels.*crop"):
        reading(factory.OAK, image_size=(1280, 720))


def test_oak_rectified_images_have_the_right_cameras_intrinsics(reading):
    data = copy.deepcopy(factory.OAK_DATA)
    dict(data["cameraData"])[2]["intrinsicMatrix"][0][0] = 712.5
    rig = reading(json.dumps(data))
    assert rig.K_left[0, 0] == rig.K_right[0, 0] == 712.5


def test_oak_other_sockets_go_along_the_links(reading):
    data = copy.deepcopy(factory.OAK_DATA)
    for _, camera in data["cameraData"]:
        camera["distortionCoeff"] = [0.0] * 14
    # 1 -> 2 is -0.12 m in x, 2 -> 0 is +0.04: socket 0 stands 0.08 m to the right of socket 1.
    assert reading(json.dumps(data), cameras=(1, 0)).E[0, 3] == pytest.approx(0.08)
    assert reading(json.dumps(data), cameras=(0, 1)).E[0, 3] == pytest.approx(-0.08)
    with pytest.raises(ValueError, match=r"sockets of .* \(0, 1, 2\)"):
        reading(json.dumps(data), cameras=(1, 5))


# ROS, Kalibr


def test_ros_swapped_files_put_the_camera_on_the_other_side(reading):
    assert reading(factory.ROS_RIGHT, factory.ROS_LEFT).E[0, 3] == pytest.approx(-0.12)


def test_ros_sizes_are_whole_numbers(reading):
    def sized(width):
        return reading(
            *(text.replace(": 640", f": {width}") for text in (factory.ROS_LEFT, factory.ROS_RIGHT))
        )

    assert sized("640.0").size_left == sized("640.").size_right == (640, 480)
    for width in ("640.5", "0", "-640", ".nan", ".inf", "true", "", "[640]"):
        with pytest.raises(ValueError, match="the width of the left image must be a .* number"):
            sized(width)
    echoed = (factory.ROS_ECHO_LEFT, factory.ROS_ECHO_RIGHT)
    without = [text.replace("width: 640\n", "").replace("height: 480\n", "") for text in echoed]
    assert reading(*without).size_left is None
    with pytest.raises(ValueError, match="the height of the .* got none"):
        reading(*(text.replace("height: 480\n", "") for text in echoed))


def test_kalibr_chain_of_three(reading):
    third = factory.KALIBR[factory.KALIBR.index("cam1:") :].replace("cam1:", "cam2:")
    rig = reading(factory.KALIBR + third.replace("-0.12", "-0.3"), cameras=(0, 2))
    assert rig.E[0, 3] == pytest.approx(0.42)


# EuRoC


def test_euroc_pose_is_between_the_cameras_whatever_the_body(reading):
    R = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    turned = np.eye(4)
    turned[:3, :3], turned[:3, 3] = R, (0.12, 0.01, -0.02)
    body_left = np.array([[0, 0, 1, 0.3], [-1, 0, 0, 0.06], [0, -1, 0, 0.2], [0, 0, 0, 1.0]])
    numbers = ", ".join(map(repr, (body_left @ turned).ravel().tolist()))
    head, tail = factory.EUROC_RIGHT.split("  data: [")
    right = f"{head}  data: [{numbers}{tail[tail.index(']') :]}"
    np.testing.assert_allclose(reading(factory.EUROC_LEFT, right).E, turned, atol=1e-12)
    marked = right.replace("T_BS:", "T_BS: !!opencv-matrix")  # as OpenCV needs it
    np.testing.assert_allclose(reading(factory.EUROC_LEFT, marked).E, turned, atol=1e-12)


# ORB-SLAM


def test_orb_slam_lenses_are_those_of_its_camera_type(reading):
    text = factory.ORB_SLAM.replace("Camera1.k1: 0.0", "Camera1.k1: -0.28 # radial")
    left, right = reading(text, distorted=True).distortion
    assert left.model == "opencv" and left.coefficients.tolist() == [-0.28, 0, 0, 0] and right is None
    fish = text.replace("PinHole", "KannalaBrandt8").replace(".p1:", ".k3:").replace(".p2:", ".k4:")
    with pytest.raises(ValueError, match="Camera2.k1.*finite number; got none"):
        reading(fish, distorted=True)
    fish += "".join(f"Camera2.k{n}: 0.00{n}\n" for n in range(1, 5))
    left, right = reading(fish, distorted=True).distortion
    assert left.model == right.model == "fisheye"
    assert right.coefficients.tolist() == [0.001, 0.002, 0.003, 0.004]


def test_orb_slam_pose_is_of_the_right_camera_in_the_left_ones_frame(reading):
    R = Rotation.from_rotvec([0.0, 0.0, 0.1]).as_matrix()
    numbers = ", ".join(map(repr, np.c_[R, [0.1, 0.02, 0.03]].ravel().tolist()))
    head = factory.ORB_SLAM[: factory.ORB_SLAM.index("  data: [")]
    E = reading(f"{head}  data: [{numbers}, 0, 0, 0, 1]\n").E
    np.testing.assert_allclose(E[:3], np.c_[R, [0.1, 0.02, 0.03]], atol=1e-12)
    old = f"{head}  data: [{numbers}]\n".replace("Camera1.", "Camera.").replace("Stereo.T_c1_c2", "Tlr")
    np.testing.assert_array_equal(reading(old.replace("rows: 4", "rows: 3")).E, E)


def test_orb_slam_baseline_of_rectified_images(reading):
    old = reading(factory.ORB_SLAM_RECTIFIED)
    assert old.rectified and old.size_right == (640, 480)
    new = factory.ORB_SLAM_RECTIFIED.replace("Camera.bf: 84.0", 'Camera.type: "Rectified"\nStereo.b: 0.12')
    new = reading(re.sub(r"Camera\.([fc][xy])", r"Camera1.\1", new))
    np.testing.assert_allclose(new.E, old.E)
    np.testing.assert_array_equal(new.K_right, old.K_left)


# COLMAP


def test_colmap_pixel_centres_and_size(reading):
    rig = reading(factory.COLMAP_IMAGES, factory.COLMAP_CAMERAS, **factory.COLMAP_CHOICE)  # in any order
    assert rig.K_left[:2, 2].tolist() == [300, 200] and rig.size_left == (640, 480)


def test_colmap_without_a_measured_distance_warns_and_keeps_its_unit(reading):
    with pytest.warns(UserWarning, match="has no unit.*--baseline"):
        rig = reading(
            factory.COLMAP_CAMERAS,
            factory.COLMAP_IMAGES,
            image_names=("/home/x/rig/left.jpg", "rig/right.jpg"),
        )
    assert rig.E[0, 3] == pytest.approx(0.5) and rig.unit is None
    assert reading(factory.COLMAP_CAMERAS, factory.COLMAP_IMAGES, **factory.COLMAP_CHOICE).unit == "m"


def test_colmap_rotation_is_world_to_camera(reading):
    q = Rotation.from_rotvec([0.1, 0.2, -0.3]).as_quat()
    turned = "3 {3} {0} {1} {2} -0.25 1 -2 1 rig/right.jpg".format(*q)
    text = factory.COLMAP_IMAGES.replace("3 1 0 0 0 -0.25 1 -2 1 rig/right.jpg", turned)
    rig = reading(factory.COLMAP_CAMERAS, text, image_names=("rig/left.jpg", "rig/right.jpg"), baseline_m=1)
    np.testing.assert_allclose(
        rig.T_right_from_left[:3, :3], Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix()
    )


def test_colmap_folder(tmp_path):
    (tmp_path / "images.bin").write_bytes(b"\0")
    with pytest.raises(IsADirectoryError, match="a COLMAP model with its cameras and images"):
        read_calibration(tmp_path)
    (tmp_path / "cameras.txt").write_text(factory.COLMAP_CAMERAS)
    (tmp_path / "images.txt").write_text(factory.COLMAP_IMAGES)
    assert read_calibration(tmp_path, **factory.COLMAP_CHOICE).E[0, 3] == pytest.approx(0.12)


def test_colmap_model_of_many_images_with_all_their_points(tmp_path, monkeypatch):
    """The points of a hundred images exceed what any other calibration has, and no pair needs them."""
    monkeypatch.setattr("geodiff_plugin.formats.files.LARGEST_TEXT_BYTES", 20_000)
    points = " ".join(["512.25 40.5 7", "3 200 -1"] * 3000)
    (tmp_path / "cameras.txt").write_text(factory.COLMAP_CAMERAS)
    (tmp_path / "images.txt").write_text(factory.COLMAP_IMAGES.replace("320.5 240.25 17", points))
    assert read_calibration(tmp_path, **factory.COLMAP_CHOICE).E[0, 3] == pytest.approx(0.12)
    moved = (tmp_path / "images.txt").read_text().replace("rig/right.jpg", "rig/renamed.jpg")
    (tmp_path / "images.txt").write_text(moved)  # what is remembered is that of the old file
    with pytest.raises(ValueError, match="one of the 3 in"):
        read_calibration(tmp_path, **factory.COLMAP_CHOICE)
    (tmp_path / "images.txt").write_text(points)
    with pytest.raises(ValueError, match="calibration must be a calibration file; got .* bytes"):
        read_calibration(tmp_path, **factory.COLMAP_CHOICE)


def binary_model(folder) -> None:
    """The sample's model as COLMAP writes it in binary, with two points."""
    folder.mkdir()
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, 640, 480, 700, 700, 300.5, 200.5)
    (folder / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", 3)
    for number, words in enumerate(
        re.findall(r"^\d+ (.*) 1 (rig/.*)$", factory.COLMAP_IMAGES, re.MULTILINE), 1
    ):
        images += struct.pack("<I7dI", number, *map(float, words[0].split()), 1) + words[1].encode() + b"\0"
        images += struct.pack("<Qddq", 1, 320.5, 240.25, -1)
    (folder / "images.bin").write_bytes(images)
    points = struct.pack("<Q", 2)
    for number, track in ((7, (1, 0, 3, 5)), (9, (2, 4))):
        points += struct.pack("<Q3d3BdQ", number, 1.0, -2.0, 0.5 * number, 10, 20, 255, 0.25, len(track) // 2)
        points += struct.pack(f"<{len(track)}I", *track)
    (folder / "points3D.bin").write_bytes(points)


def test_colmap_binary_models_are_those_in_text(tmp_path):
    binary_model(tmp_path / "bin")
    (tmp_path / "txt").mkdir()
    (tmp_path / "txt" / "cameras.txt").write_text(factory.COLMAP_CAMERAS)
    (tmp_path / "txt" / "images.txt").write_text(factory.COLMAP_IMAGES)
    (tmp_path / "txt" / "points3D.txt").write_text(
        "# 3D point list\n7 1 -2 3.5 10 20 255 0.25 1 0 3 5\n9 1 -2 4.5 10 20 255 0.25 2 4\n"
    )
    rigs = [read_calibration(tmp_path / kind, **factory.COLMAP_CHOICE) for kind in ("bin", "txt")]
    for name in ("K_left", "K_right", "E"):
        np.testing.assert_array_equal(getattr(rigs[0], name), getattr(rigs[1], name))
    assert rigs[0].size_left == rigs[1].size_left == (640, 480)
    cameras, images, points = (
        [read(tmp_path / kind) for kind in ("bin", "txt")]
        for read in (read_colmap_cameras, read_colmap_images, read_colmap_points)
    )
    assert cameras[0].keys() == cameras[1].keys() == {1} and images[0].keys() == images[1].keys()
    for name, (number, T, camera) in images[0].items():
        assert (number, camera) == (images[1][name][0], 1)
        np.testing.assert_array_equal(T, images[1][name][1])
    for ours, theirs in zip(points[0][:3], points[1][:3], strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert [track.tolist() for track in points[0][3]] == [[1, 3], [2]] == [t.tolist() for t in points[1][3]]
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        path = tmp_path / "bin" / name
        path.write_bytes(path.read_bytes()[:-3])
        with pytest.raises(InputError, match=rf"{name} must be a binary COLMAP file; got less.*cut off"):
            (read_colmap_points if name.startswith("p") else read_calibration)(
                tmp_path / "bin", **({} if name.startswith("p") else factory.COLMAP_CHOICE)
            )
        binary_model(tmp_path / name)
        path.write_bytes((tmp_path / name / name).read_bytes())


# The doors


def test_a_measured_distance_replaces_that_of_any_file(reading):
    assert reading(factory.KALIBR, baseline_m=0.24).E[0, 3] == pytest.approx(0.24)
    with pytest.raises(ValueError, match="baseline_m"):
        reading(factory.KALIBR, baseline_m=-1.0)


def test_from_calibration_knows_the_resolution_by_the_image(tmp_path):
    (tmp_path / "SN1.conf").write_text(factory.ZED)
    guidance = GeometryGuidance.from_calibration(np.zeros((720, 1280, 3)), tmp_path / "SN1.conf")
    assert guidance.rigs[0].K_left[0, 0] == 700
