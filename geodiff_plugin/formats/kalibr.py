"""Kalibr's ``camchain.yaml``, and pairs of EuRoC's ``sensor.yaml`` (and of other sets of the ASL)."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import (
    CalibrationFormat,
    Camera,
    CameraChoice,
    RawRig,
    array_of,
    intrinsics,
    rigid,
    two_cameras,
)
from geodiff_plugin.formats.structured import parse_yaml

__all__ = ["EUROC", "KALIBR"]

CAMERA = re.compile(r"^cam\d+:\s*(?:#.*)?$", re.MULTILINE)
BODY_POSE = re.compile(r"^T_BS\s*:", re.MULTILINE)
#: OpenCV's name of a distortion model.
LENSES = {"radtan": "opencv", "radial-tangential": "opencv", "equidistant": "fisheye"}


def _camera(entries: dict[str, Any], coefficients: str) -> Camera:
    """A camera; ``coefficients`` names the entry with those of its lens."""
    if entries["camera_model"] != "pinhole":
        cure = "Calibrate with pinhole-radtan or pinhole-equi, or undistort the images to a pinhole first."
        bad_value("camera_model", "pinhole", repr(entries["camera_model"]), cure)
    K = intrinsics(*array_of(entries["intrinsics"], (4,), "intrinsics"))
    model, numbers = entries["distortion_model"], array_of(entries[coefficients], (-1,), coefficients)
    if model == "none":
        return Camera(K, entries["resolution"])
    array_of(numbers, (4,), coefficients)
    return Camera(K, entries["resolution"], numbers, LENSES.get(model, str(model)))


def _from_first(chain: dict[str, Any], camera: int) -> np.ndarray:
    """Takes points of cam0 to those of another camera, along the chain."""
    T = np.eye(4)
    for n in range(1, camera + 1):
        T = rigid(chain[f"cam{n}"]["T_cn_cnm1"], f"T_cn_cnm1 of cam{n}") @ T
    return T


def _read_kalibr(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """Two cameras of a chain, cam0 and cam1 unless chosen; ``T_cn_cnm1`` takes points to a camera."""
    chain = parse_yaml(texts[0])
    have = [n for n in range(len(chain)) if f"cam{n}" in chain]
    pair = (0, 1) if choice.cameras is None else two_cameras(choice, have)
    T_left, T_right = (_from_first(chain, n) for n in pair)
    left, right = (_camera(chain[f"cam{n}"], "distortion_coeffs") for n in pair)
    return RawRig(left, right, T_left @ np.linalg.inv(T_right))


def _read_euroc(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The images as taken, left file first; ``T_BS`` is a camera's pose in the body's frame, in metres."""
    sensors = [parse_yaml(text) for text in texts]
    T_body_left, T_body_right = (rigid(sensor["T_BS"]["data"], "T_BS") for sensor in sensors)
    left, right = (_camera(sensor, "distortion_coefficients") for sensor in sensors)
    return RawRig(left, right, np.linalg.inv(T_body_left) @ T_body_right)


KALIBR = CalibrationFormat(
    "Kalibr camchain.yaml (cam0, cam1)",
    lambda text: CAMERA.search(text) is not None,
    _read_kalibr,
    uses_cameras=True,
)
EUROC = CalibrationFormat(
    "a pair of EuRoC sensor.yaml (T_BS)",
    lambda text: BODY_POSE.search(text) is not None,
    _read_euroc,
    file_counts=(2,),
)
