"""Reads the passthrough cameras of a Meta Quest 3, as written by QuestRealityCapture with its MRUK backend.

Source: ``MrukCameraRecorder.cs`` of t-34400/QuestRealityCapture, which writes the fields of Meta's
``PassthroughCameraAccess`` (MR Utility Kit) unchanged. ``ViewportPointToLocalRay`` there defines them: pixels
of the whole sensor, rows counted from the bottom, and Unity's axes (x right, y up, z forward, left-handed).
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.rigs import CameraChoice, RawCamera, array_of, intrinsics, make_rig, pose_of
from geodiff_plugin.types import Rig

#: Conversion between Unity's axes and OpenCV's, in either direction.
OPENCV_FROM_UNITY = np.diag([1.0, -1.0, 1.0, 1.0])


def read_quest(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read ``left_camera_mruk_intrinsics.json`` and the right one; their poses are in the headset's frame."""
    cameras = {each["cameraPosition"]: each for each in map(json.loads, texts)}
    if cameras.keys() != {"Left", "Right"}:
        bad_value("the files", "one of the left and one of the right camera", ", ".join(cameras))
    left, right = cameras["Left"], cameras["Right"]
    E = np.linalg.inv(_pose(left["lensOffset"])) @ _pose(right["lensOffset"])
    return make_rig(_camera(left), _camera(right), E)


def _pose(entries: dict[str, dict[str, float]]) -> np.ndarray:
    """Return the pose ``(4, 4)`` of a camera in the headset's frame, both with OpenCV's axes."""
    turn = Rotation.from_quat([entries["rotation"][axis] for axis in "xyzw"])
    place = [entries["position"][axis] for axis in "xyz"]
    pose: np.ndarray = OPENCV_FROM_UNITY @ pose_of(turn, place) @ OPENCV_FROM_UNITY
    return pose


def _camera(entries: dict[str, Any]) -> RawCamera:
    """Return the camera of the images: a centred crop of the sensor, resized."""
    size, sensor = (
        array_of([entries[key][side] for side in ("width", "height")], (2,), key)
        for key in ("resolution", "sensorResolution")
    )
    if not (size.min() > 0 and sensor.min() > 0):
        bad_value("resolution and sensorResolution", "above 0", f"{size.tolist()} and {sensor.tolist()}")
    ratio = size / sensor
    crop = sensor * ratio / ratio.max()
    scale = size / crop
    fx, fy = (entries["focalLength"][axis] * each for axis, each in zip("xy", scale, strict=True))
    centre = np.array([entries["principalPoint"][axis] for axis in "xy"])
    from_left, from_bottom = (centre - (sensor - crop) / 2) * scale
    width, height = size.astype(int).tolist()
    return RawCamera(intrinsics(fx, fy, from_left - 0.5, height - from_bottom - 0.5), (width, height))
