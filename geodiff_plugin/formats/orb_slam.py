"""Settings of ORB-SLAM2 and ORB-SLAM3 for a stereo camera."""

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
    number,
    rigid,
)
from geodiff_plugin.formats.structured import parse_storage

__all__ = ["ORB_SLAM"]

MARK = re.compile(r"^(Camera1?\.fx|Camera\.bf)[ \t]*:", re.MULTILINE)
#: Older settings describe the rectification too, and OpenCV's reader knows these names.
RECTIFICATION = re.compile(r"^LEFT\.P[ \t]*:", re.MULTILINE)
#: Which coefficients a lens has, and what OpenCV calls it, by ``Camera.type``.
LENSES = {
    "PinHole": ("opencv", ("k1", "k2", "p1", "p2", "k3")),
    "KannalaBrandt8": ("fisheye", ("k1", "k2", "k3", "k4")),
}
#: The right camera's pose in the left one's frame, in settings of version 1.0 and in older ones.
POSES = ("Stereo.T_c1_c2", "Tlr")
SIDES = ("Camera.width", "Camera.height")
CURE = "Give the settings that ORB-SLAM runs in stereo with."

Entries = dict[str, Any]


def _number(entries: Entries, key: str) -> float:
    value = entries.get(key.lower())
    return number(value.item() if isinstance(value, np.ndarray) and value.size == 1 else value, key)


def _camera(entries: Entries, name: str, kind: str) -> Camera:
    """The camera of a name; a pinhole may leave its coefficients out, or the last one."""
    K = intrinsics(*(_number(entries, f"{name}.{key}") for key in ("fx", "fy", "cx", "cy")))
    given = any(key.lower() in entries for key in SIDES)
    size = tuple(_number(entries, key) for key in SIDES) if given else None
    model, keys = LENSES[kind]
    there = [f"{name}.{key}".lower() in entries for key in keys]
    if model == "opencv" and not any(there):
        return Camera(K, size)
    keys = keys if there[-1] else keys[:4]
    return Camera(K, size, [_number(entries, f"{name}.{key}") for key in keys], model)


def _as_taken(entries: Entries, left: str, pose: str, kind: str) -> RawRig:
    if kind not in LENSES:
        bad_value("Camera.type", f"{' or '.join(LENSES)} beside {pose}", repr(kind))
    matrix = entries[pose.lower()]
    if np.shape(matrix) not in ((3, 4), (4, 4)):
        bad_value(pose, "of shape (4, 4)", f"{np.shape(matrix)}")
    first, second = (_camera(entries, name, kind) for name in (left, "Camera2"))
    return RawRig(first, second, rigid(matrix, pose))


def _read(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The images as taken, by ``Stereo.T_c1_c2`` (or ``Tlr``), else rectified images.

    Rectified images have one camera for both, and a baseline: ``Stereo.b``, or ``Camera.bf``, which is
    fx times the baseline. Lengths are metres. Images have ``Camera.width`` and ``Camera.height``;
    ``Camera.newWidth`` is what ORB-SLAM shrinks them to, and is not read.
    """
    entries = parse_storage(texts[0])
    kind = entries.get("camera.type", "PinHole")
    left = "Camera1" if "camera1.fx" in entries else "Camera"
    pose = next((name for name in POSES if name.lower() in entries), None)
    if pose is not None:
        return _as_taken(entries, left, pose, kind)
    # Settings of version 1.0 say of rectified images that they are; older ones call them a pinhole's.
    baseline, types = {
        "Camera1": ("Stereo.b", ("Rectified",)),
        "Camera": ("Camera.bf", ("Rectified", "PinHole")),
    }[left]
    # Of a single camera with a depth sensor, the baseline is made up.
    depth_sensor = any(key.endswith("depthmapfactor") for key in entries)
    if depth_sensor or baseline.lower() not in entries or kind not in types:
        expected = f"of a stereo camera, with {POSES[0]}, or {baseline} of rectified images"
        got = f"of a camera of type {kind} {'with a depth sensor' if depth_sensor else 'without them'}"
        bad_value("the settings", expected, got, CURE)
    camera = _camera(entries, left, "PinHole")
    if np.any(array_of(camera.coefficients, (-1,), f"the lens of {left}")):
        expected = f"zero for rectified images, which have no {POSES[0]}"
        bad_value(f"Lens distortion of {left}", expected, camera.coefficients, "Is it of a single camera?")
    length = _number(entries, baseline)
    return RawRig(
        camera, camera, length if baseline == "Stereo.b" else length / camera.K[0, 0], rectified=True
    )


ORB_SLAM = CalibrationFormat(
    "ORB-SLAM's stereo settings (Camera1.fx, Camera.bf)",
    lambda text: MARK.search(text) is not None and not RECTIFICATION.search(text),
    _read,
)
