"""Calibrations of robotics: Kalibr and OpenVINS, EuRoC, ROS, ORB-SLAM, basalt, VINS-Fusion.

Source: ``config/euroc_mav/kalibr_imucam_chain.yaml`` of rpng/open_vins; ``data/euroc_ds_calib.json`` of
VladyslavUsenko/basalt; ``config/euroc`` and ``vins_estimator/src/estimator/parameters.cpp`` of
HKUST-Aerial-Robotics/VINS-Fusion.
"""

from __future__ import annotations

import json
import re
from contextlib import suppress
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    array_of,
    intrinsics,
    make_rig,
    pose_of,
    projected,
    rectified_from,
    rigid,
    two_cameras,
)
from geodiff_plugin.formats.storage import read_storage, read_yaml
from geodiff_plugin.types import Rig

Entries = dict[str, Any]
ORB_LENSES = {"PinHole": ("k1", "k2", "p1", "p2", "k3"), "KannalaBrandt8": ("k1", "k2", "k3", "k4")}
#: The right camera's pose in the left one's frame, in settings of version 1.0 and in older ones.
ORB_POSES = ("Stereo.T_c1_c2", "Tlr")
#: The baseline of rectified images and their types, by the left camera's name: settings of version 1.0 say
#: that they are rectified, older ones call them a pinhole's.
ORB_RECTIFIED = {"Camera1": ("Stereo.b", ("Rectified",)), "Camera": ("Camera.bf", ("Rectified", "PinHole"))}


def _pinhole(entries: Entries, coefficients: str) -> Camera:
    """A camera of Kalibr or EuRoC; ``coefficients`` names the entry with those of its lens.

    MINS, which has OpenVINS' chain, leaves ``camera_model`` out.
    """
    model = entries.get("camera_model", "pinhole")  # of another one the lens is refused
    model = str(entries["distortion_model"] if model == "pinhole" else model)
    return Camera(
        intrinsics(*entries["intrinsics"][-4:]), entries["resolution"], entries[coefficients], model
    )


def read_kalibr(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Two cameras of a chain, cam0 and cam1 unless chosen, in metres.

    D-Robotics' stereo cameras have the chain below a name of its own.
    """
    content = read_yaml(texts[0])
    below = (each for each in content.values() if isinstance(each, dict) and "cam0" in each)
    chain = content if "cam0" in content else next(below, content)
    pair = two_cameras(choice, [n for n in range(len(chain)) if f"cam{n}" in chain], (0, 1))
    left, right = (_pinhole(chain[f"cam{n}"], "distortion_coeffs") for n in pair)
    poses = _poses_of_chain(chain, max(pair) + 1)
    return make_rig(left, right, np.linalg.inv(poses[pair[0]]) @ poses[pair[1]])


def _poses_of_chain(chain: Entries, count: int) -> list[np.ndarray]:
    """The poses of the first cameras in one frame, ``(4, 4)`` each.

    ``T_cn_cnm1`` takes points to a camera from the one before. OpenVINS has none, but every camera's pose in
    the frame of the IMU, ``T_imu_cam``, or that of its inverse, ``T_cam_imu``, as Kalibr's own files.
    """
    cameras = [chain[f"cam{n}"] for n in range(count)]
    if not all("T_cn_cnm1" in camera for camera in cameras[1:]):
        if all("T_imu_cam" in camera for camera in cameras):
            return [rigid(camera["T_imu_cam"], f"T_imu_cam of cam{n}") for n, camera in enumerate(cameras)]
        if all("T_cam_imu" in camera for camera in cameras):
            from_imu = [camera["T_cam_imu"] for camera in cameras]
            return [np.linalg.inv(rigid(T, f"T_cam_imu of cam{n}")) for n, T in enumerate(from_imu)]
    poses = [np.eye(4)]
    for n, camera in enumerate(cameras[1:], 1):
        poses.append(poses[-1] @ np.linalg.inv(rigid(camera["T_cn_cnm1"], f"T_cn_cnm1 of cam{n}")))
    return poses


#: basalt's camera types by OpenCV's model, and the order of their coefficients.
BASALT_LENSES = {
    "pinhole": ("opencv", ()),
    "pinhole-radtan8": ("opencv", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "kb4": ("fisheye", ("k1", "k2", "k3", "k4")),
}


def read_basalt(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Basalt's ``calibration.json``: poses of the cameras in the frame of the IMU, in metres."""
    data = json.loads(texts[0])
    data = data.get("value0", data)
    pair = two_cameras(choice, range(len(data["T_imu_cam"])), (0, 1))
    poses = []
    for n in pair:
        x, y, z, w = array_of([data["T_imu_cam"][n][f"q{axis}"] for axis in "xyzw"], (4,), "a rotation")
        turn = Rotation.from_quat([x, y, z, w])
        poses.append(pose_of(turn, [data["T_imu_cam"][n][f"p{axis}"] for axis in "xyz"]))
    left, right = (_basalt_camera(data["intrinsics"][n], data["resolution"][n]) for n in pair)
    return make_rig(left, right, np.linalg.inv(poses[0]) @ poses[1])


def _basalt_camera(entries: Entries, size: Any) -> Camera:
    kind, values = entries["camera_type"], entries["intrinsics"]
    if kind not in BASALT_LENSES:
        cure = "Calibrate with basalt_calibrate --cam-types kb4 kb4."
        bad_value("camera_type", f"one of {', '.join(BASALT_LENSES)}", kind, cure)
    model, names = BASALT_LENSES[kind]
    K = intrinsics(*(values[key] for key in ("fx", "fy", "cx", "cy")))
    return Camera(K, size, [values[name] for name in names], model)


#: VINS-Fusion's camera types: OpenCV's model, entries with K and the lens, in its order.
VINS_LENSES = {
    "PINHOLE": ("opencv", ("fx", "fy", "cx", "cy"), ("k1", "k2", "p1", "p2")),
    "KANNALA_BRANDT": ("fisheye", ("mu", "mv", "u0", "v0"), ("k2", "k3", "k4", "k5")),
}


def vins_cameras(text: str) -> list[str]:
    """The names of the files of both cameras, which lie beside a configuration."""
    return [str(read_yaml(text)[f"cam{n}_calib"]) for n in (0, 1)]


def read_vins(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """VINS-Fusion's configuration and the two files that it names; ``body_T_cam`` are poses in metres."""
    config, *files = (read_yaml(text) for text in texts)
    poses = [rigid(config[f"body_T_cam{n}"]["data"], f"body_T_cam{n}") for n in (0, 1)]
    left, right = map(_vins_camera, files)
    return make_rig(left, right, np.linalg.inv(poses[0]) @ poses[1])


def _vins_camera(entries: Entries) -> Camera:
    kind = str(entries["model_type"]).upper()
    if kind not in VINS_LENSES:
        cure = "Calibrate with --camera-model pinhole or kannala-brandt, or give Kalibr's camchain.yaml."
        bad_value("model_type", f"one of {', '.join(VINS_LENSES)}", kind, cure)
    model, of_K, of_lens = VINS_LENSES[kind]
    values = {**(entries.get("distortion_parameters") or {}), **entries["projection_parameters"]}
    size = entries["image_width"], entries["image_height"]
    return Camera(intrinsics(*(values[key] for key in of_K)), size, [values[key] for key in of_lens], model)


def euroc_camera(sensor: Entries) -> Camera:
    """The camera of a ``sensor.yaml``."""
    return _pinhole(sensor, "distortion_coefficients")


def body_from_camera(sensor: Entries) -> np.ndarray:
    """``(4, 4)`` pose of a camera in the body's frame; Kimera and others write it as a plain list."""
    pose = sensor["T_BS"]
    return rigid(pose["data"] if isinstance(pose, dict) else pose, "T_BS")


def read_euroc(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The images as taken, left file first; ``T_BS`` is a camera's pose in the body's frame, in metres."""
    sensors = [read_yaml(text) for text in texts]
    T_body_left, T_body_right = map(body_from_camera, sensors)
    left, right = map(euroc_camera, sensors)
    return make_rig(left, right, np.linalg.inv(T_body_left) @ T_body_right)


#: What to do with files that have no pose of one camera beside the other.
ROS_ALONE = "These are of single cameras. Calibrate the pair (camera_calibration with two topics)."
#: Names of a matrix in a file of ``camera_calibration``, and in the message as ROS 1 and ROS 2 print it.
ROS_NAMES = {
    "P": ("projection_matrix", "P", "p"),
    "K": ("camera_matrix", "K", "k"),
    "D": ("distortion_coefficients", "D", "d"),
    "R": ("rectification_matrix", "R", "r"),
}


def _of_ros(info: Entries, name: str) -> Any:
    """The numbers of a matrix, or ``None``."""
    matrix = next((info[key] for key in ROS_NAMES[name] if key in info), None)
    return matrix.get("data") if isinstance(matrix, dict) else matrix


def _projection(info: Entries) -> np.ndarray:
    return _of_window(info) @ array_of(_of_ros(info, "P"), (3, 4), "projection_matrix")


def _of_window(info: Entries) -> np.ndarray:
    """``(3, 3)`` from pixels of the whole sensor, which K and P are in, to those of the region of interest.

    Source: ``fromCameraInfo`` of ``image_geometry/pinhole_camera_model.cpp`` (ros-perception/vision_opencv).
    """
    roi = info.get("roi") or {}
    shift = np.eye(3)
    shift[:2, 2] = array_of([-roi.get("x_offset", 0), -roi.get("y_offset", 0)], (2,), "roi")
    return shift


def _window_size(info: Entries) -> tuple[Any, Any]:
    """Width and height of the images before binning: of the region of interest, where one is set."""
    roi = info.get("roi") or {}
    sides = (("width", "image_width"), ("height", "image_height"))
    width, height = (roi.get(side) or info.get(whole, info.get(side)) for side, whole in sides)
    return width, height


def read_ros(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Files of ``camera_calibration``, or the message as ``echo`` prints it: the rectified images, by ``P``.

    Those that say ``rectified: false`` (``recordings.stereo_calibration``) stand for the images as taken.
    """
    return _rig_of_infos([read_yaml(text) for text in texts])


#: Headings of a file of ``camera_calibration`` in its older form, and the entries of the newer one.
INI_NAMES = {
    "camera matrix": "camera_matrix",
    "distortion": "distortion_coefficients",
    "rectification": "rectification_matrix",
    "projection": "projection_matrix",
    "width": "image_width",
    "height": "image_height",
}


def read_ros_ini(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``left.ini`` and ``right.ini``, or both in one file, as ``camera_calibration`` prints them."""
    blocks = [block for text in texts for block in re.split(r"(?m)^\[image\][ \t]*$", text)[1:]]
    if len(blocks) != 2:
        cure = "Give left.ini and right.ini, or the file that holds both, left one first."
        bad_value("the file", "of two cameras, [image] before each", f"{len(blocks)} of them", cure)
    return _rig_of_infos([_ini_entries(block) for block in blocks])


def _ini_entries(block: str) -> Entries:
    """The entries of a camera by their names in the newer form."""
    entries: Entries = {"distortion_model": "plumb_bob"}
    heading = r"(?m)^(" + "|".join(INI_NAMES) + r")[ \t]*\n((?:[ \t]*[-+.\deE \t]+\n?)+)"
    for name, numbers in re.findall(heading, block):
        words = numbers.split()
        entries[INI_NAMES[name]] = words[0] if len(words) == 1 else {"data": words}
    return entries


def _rig_of_infos(infos: list[Entries]) -> Rig:
    """The rectified images by ``P``, and the images as taken where the entries say so."""
    sizes = [_window_size(info) for info in infos]
    if any(_of_ros(info, "P") is None for info in infos):
        bad_value("projection_matrix", "in both files", "none", ROS_ALONE)
    rig = projected(*map(_projection, infos), *sizes)
    if not rig.E[:3, 3].any():
        expected = "-fx * baseline in the right camera's file"
        bad_value("projection_matrix[0, 3]", expected, "the same in both", ROS_ALONE)
    if not all(info.get("rectified", True) for info in infos):
        return _taken_by_ros(rig, infos, sizes).as_taken or rig
    with suppress(InputError, KeyError):  # a file of rectified images may leave out what they were
        return _taken_by_ros(rig, infos, sizes)
    return rig


def _taken_by_ros(rig: Rig, infos: list[Entries], sizes: list[tuple[Any, Any]]) -> Rig:
    """The rectified rig with the cameras as they stand."""
    cameras = [
        Camera(
            _of_window(info) @ array_of(_of_ros(info, "K"), (3, 3), "K"),
            size,
            _of_ros(info, "D"),
            str(info["distortion_model"]),
        )
        for info, size in zip(infos, sizes, strict=True)
    ]
    R_left, R_right = (_of_ros(info, "R") for info in infos)
    return rectified_from(rig, cameras[0], cameras[1], (R_left, R_right))


def _orb_camera(entries: Entries, name: str, kind: str) -> Camera:
    """The camera of a name; a pinhole may leave coefficients out, which are 0 then."""
    keys, default = ("fx", "fy", "cx", "cy", *ORB_LENSES.get(kind, ())), 0.0 if kind == "PinHole" else None
    given = {key: entries.get(f"{name}.{key}".lower(), default if key[0] in "kp" else None) for key in keys}
    numbers = [array_of(value, (), f"{name}.{key}") for key, value in given.items()]
    size = [entries.get(f"camera.{side}", [None])[0] for side in ("width", "height")]
    return Camera(intrinsics(*numbers[:4]), size, numbers[4:], kind)


def read_orb_slam(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The images as taken, by ``Stereo.T_c1_c2`` (or ``Tlr``), else rectified images of one K, in metres."""
    entries = read_storage(texts[0])
    kind = entries.get("camera.type", "PinHole")
    left = "Camera1" if "camera1.fx" in entries else "Camera"
    pose = next((name for name in ORB_POSES if name.lower() in entries), None)
    if pose is not None:
        first, second = (_orb_camera(entries, name, kind) for name in (left, "Camera2"))
        return make_rig(first, second, rigid(entries[pose.lower()], pose))
    baseline, types = ORB_RECTIFIED[left]
    # Of a single camera with a depth sensor, the baseline is made up.
    depth_sensor = any(key.endswith("depthmapfactor") for key in entries)
    if depth_sensor or baseline.lower() not in entries or kind not in types:
        expected = f"of a stereo camera, with {ORB_POSES[0]}, or {baseline} of rectified images"
        got = f"of a camera of type {kind} {'with a depth sensor' if depth_sensor else 'without them'}"
        bad_value("the settings", expected, got, "Give the settings that ORB-SLAM runs in stereo with.")
    camera = _orb_camera(entries, left, "PinHole")
    if np.any(camera.coefficients):
        expected = f"zero for rectified images, which have no {ORB_POSES[0]}"
        bad_value(f"Lens distortion of {left}", expected, "another", "Is it of a single camera?")
    length = array_of(entries[baseline.lower()], (), baseline)
    return make_rig(camera, camera, length / (1.0 if left == "Camera1" else camera.K[0, 0]), rectified=True)
