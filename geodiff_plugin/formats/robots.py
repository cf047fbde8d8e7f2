"""Calibrations that robotics uses: Kalibr's chains, EuRoC's sensors, ROS camera_info, ORB-SLAM's settings."""

from __future__ import annotations

from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value, refuse
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    RawRig,
    array_of,
    intrinsics,
    number,
    projected,
    rigid,
    size_of,
    two_cameras,
)
from geodiff_plugin.formats.structured import CUT_OFF, parse_storage, parse_yaml

__all__ = ["read_euroc", "read_kalibr", "read_orb_slam", "read_ros"]

#: OpenCV's name of a distortion model.
LENSES = dict.fromkeys(("radtan", "radial-tangential", "plumb_bob", "rational_polynomial", ""), "opencv")
LENSES |= {"equidistant": "fisheye", "fisheye": "fisheye"}
CALIBRATE_PAIR = "Calibrate the pair (camera_calibration with two topics)."
#: Which coefficients a lens has, and what OpenCV calls it, by ORB-SLAM's ``Camera.type``.
ORB_LENSES = {
    "PinHole": ("opencv", ("k1", "k2", "p1", "p2", "k3")),
    "KannalaBrandt8": ("fisheye", ("k1", "k2", "k3", "k4")),
}
#: The right camera's pose in the left one's frame, in settings of version 1.0 and in older ones.
ORB_POSES = ("Stereo.T_c1_c2", "Tlr")
#: The baseline of rectified images and their types, by the left camera's name: settings of version 1.0 say
#: that they are rectified, older ones call them a pinhole's.
ORB_RECTIFIED = {"Camera1": ("Stereo.b", ("Rectified",)), "Camera": ("Camera.bf", ("Rectified", "PinHole"))}


def _pinhole(entries: dict[str, Any], coefficients: str) -> Camera:
    """A camera of Kalibr or EuRoC; ``coefficients`` names the entry with those of its lens."""
    if entries["camera_model"] != "pinhole":
        cure = "Calibrate with pinhole-radtan or pinhole-equi, or undistort the images to a pinhole first."
        bad_value("camera_model", "pinhole", repr(entries["camera_model"]), cure)
    K = intrinsics(*array_of(entries["intrinsics"], (4,), "intrinsics"))
    model, numbers = entries["distortion_model"], array_of(entries[coefficients], (-1,), coefficients)
    if model == "none":
        return Camera(K, entries["resolution"])
    array_of(numbers, (4,), coefficients)
    return Camera(K, entries["resolution"], numbers, LENSES.get(model, str(model)))


def read_kalibr(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """Two cameras of a chain, cam0 and cam1 unless chosen; ``T_cn_cnm1`` takes points to a camera."""
    chain = parse_yaml(texts[0])
    have = [n for n in range(len(chain)) if f"cam{n}" in chain]
    pair = (0, 1) if choice.cameras is None else two_cameras(choice, have)
    from_first = [np.eye(4)]
    for n in range(1, max(pair) + 1):
        step = rigid(chain[f"cam{n}"]["T_cn_cnm1"], f"T_cn_cnm1 of cam{n}")
        from_first.append(step @ from_first[-1])
    left, right = (_pinhole(chain[f"cam{n}"], "distortion_coeffs") for n in pair)
    return RawRig(left, right, from_first[pair[0]] @ np.linalg.inv(from_first[pair[1]]))


def read_euroc(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The images as taken, left file first; ``T_BS`` is a camera's pose in the body's frame, in metres."""
    sensors = [parse_yaml(text) for text in texts]
    T_body_left, T_body_right = (rigid(sensor["T_BS"]["data"], "T_BS") for sensor in sensors)
    left, right = (_pinhole(sensor, "distortion_coefficients") for sensor in sensors)
    return RawRig(left, right, np.linalg.inv(T_body_left) @ T_body_right)


def _camera_info(text: str) -> tuple[dict[str, Any], np.ndarray, Any]:
    info = parse_yaml(text)
    matrix = next((info[name] for name in ("projection_matrix", "P", "p") if name in info), None)
    if matrix is None:
        bad_value("the file", "a camera_info with projection_matrix (or P)", "none", CUT_OFF)
    P = array_of(matrix.get("data") if isinstance(matrix, dict) else matrix, (3, 4), "projection_matrix")
    if not P.any():
        refuse(f"the camera is not calibrated: its projection_matrix (P) is all zeros. {CALIBRATE_PAIR}")
    return info, P, size_of(info, "image_width", "image_height") or size_of(info)


def read_ros(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """Files of ``camera_calibration``, or the message as ``echo`` prints it, left file first.

    They stand for the rectified images (``image_rect``), of which ``P`` is; ``P[0, 3]`` of the right camera
    is ``-fx * baseline``, in metres. Those that say ``rectified: false``, as ``geodiff depth`` writes them
    for a bag, stand for the images as taken: ``K`` and ``D``, posed by ``R``, which turns a camera's points
    to the rectified frame.
    """
    (left, P_left, size_left), (right, P_right, size_right) = map(_camera_info, texts)
    raw = projected(P_left, P_right, size_left, size_right)
    if not raw.pose[:3, 3].any():
        expected = "-fx * baseline in the right camera's file"
        cure = f"These are of single cameras. {CALIBRATE_PAIR}"
        bad_value("projection_matrix[0, 3]", expected, "the same in both", cure)
    if left.get("rectified", True) and right.get("rectified", True):
        return raw
    turns, cameras = [], []
    for info, size in ((left, size_left), (right, size_right)):
        turns.append(np.eye(4))
        turns[-1][:3, :3] = array_of(info["R"], (3, 3), "R")
        model = str(info["distortion_model"])
        cameras.append(Camera(array_of(info["K"], (3, 3), "K"), size, info["D"], LENSES.get(model, model)))
    E = np.linalg.inv(rigid(turns[0], "R")) @ raw.pose @ rigid(turns[1], "R")
    return RawRig(cameras[0], cameras[1], E)


def _orb_number(entries: dict[str, Any], key: str) -> float:
    value = entries.get(key.lower())
    return number(value.item() if isinstance(value, np.ndarray) and value.size == 1 else value, key)


def _orb_camera(entries: dict[str, Any], name: str, kind: str) -> Camera:
    """The camera of a name; a pinhole may leave its coefficients out, or the last one."""
    K = intrinsics(*(_orb_number(entries, f"{name}.{key}") for key in ("fx", "fy", "cx", "cy")))
    sides = "Camera.width", "Camera.height"
    given = any(key.lower() in entries for key in sides)
    size = tuple(_orb_number(entries, key) for key in sides) if given else None
    model, keys = ORB_LENSES[kind]
    there = [f"{name}.{key}".lower() in entries for key in keys]
    if model == "opencv" and not any(there):
        return Camera(K, size)
    keys = keys if there[-1] else keys[:4]
    return Camera(K, size, [_orb_number(entries, f"{name}.{key}") for key in keys], model)


def read_orb_slam(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The images as taken, by ``Stereo.T_c1_c2`` (or ``Tlr``), else rectified images.

    Rectified images have one camera for both, and a baseline: ``Stereo.b``, or ``Camera.bf``, which is
    fx times the baseline. Lengths are metres. Images have ``Camera.width`` and ``Camera.height``;
    ``Camera.newWidth`` is what ORB-SLAM shrinks them to, and is not read.
    """
    entries = parse_storage(texts[0])
    kind = entries.get("camera.type", "PinHole")
    left = "Camera1" if "camera1.fx" in entries else "Camera"
    pose = next((name for name in ORB_POSES if name.lower() in entries), None)
    if pose is not None:
        if kind not in ORB_LENSES:
            bad_value("Camera.type", f"{' or '.join(ORB_LENSES)} beside {pose}", repr(kind))
        matrix = entries[pose.lower()]
        if np.shape(matrix) not in ((3, 4), (4, 4)):
            bad_value(pose, "of shape (4, 4)", f"{np.shape(matrix)}")
        first, second = (_orb_camera(entries, name, kind) for name in (left, "Camera2"))
        return RawRig(first, second, rigid(matrix, pose))
    baseline, types = ORB_RECTIFIED[left]
    # Of a single camera with a depth sensor, the baseline is made up.
    depth_sensor = any(key.endswith("depthmapfactor") for key in entries)
    if depth_sensor or baseline.lower() not in entries or kind not in types:
        expected = f"of a stereo camera, with {ORB_POSES[0]}, or {baseline} of rectified images"
        got = f"of a camera of type {kind} {'with a depth sensor' if depth_sensor else 'without them'}"
        bad_value("the settings", expected, got, "Give the settings that ORB-SLAM runs in stereo with.")
    camera = _orb_camera(entries, left, "PinHole")
    if np.any(array_of(camera.coefficients, (-1,), f"the lens of {left}")):
        expected = f"zero for rectified images, which have no {ORB_POSES[0]}"
        bad_value(f"Lens distortion of {left}", expected, camera.coefficients, "Is it of a single camera?")
    length = _orb_number(entries, baseline)
    baseline_m = length if baseline == "Stereo.b" else length / camera.K[0, 0]
    return RawRig(camera, camera, baseline_m, rectified=True)
