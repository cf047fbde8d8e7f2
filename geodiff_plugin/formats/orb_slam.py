"""Settings of ORB-SLAM2 and ORB-SLAM3 for a stereo camera.

Data flow: both cameras and ``Stereo.T_c1_c2``, or one and ``Stereo.b`` or ``Camera.bf`` -> ``Rig``.
Paper: none.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.lenses import FactoryCamera, lens_of, rig_of_cameras
from geodiff_plugin.formats.opencv_storage import parse_storage
from geodiff_plugin.formats.rigs import (
    check_rigid,
    intrinsics,
    make_rig,
    pose_to_the_right,
    positive,
    whole_pixels,
)
from geodiff_plugin.types import Distortion, Rig

__all__ = ["ORB_SLAM", "matches", "read"]

MARK = re.compile(r"^(Camera1?\.fx|Camera\.bf)[ \t]*:", re.MULTILINE)
#: Older settings describe the rectification too, and OpenCV's reader knows these names.
RECTIFICATION = re.compile(r"^LEFT\.P[ \t]*:", re.MULTILINE)
CAMERA_TYPE = re.compile(r"^Camera\.type[ \t]*:[ \t]*[\"']?(\w+)", re.MULTILINE)
#: Which coefficients a lens has, and what OpenCV calls it, by ``Camera.type``.
LENSES = {
    "PinHole": ("opencv", ("k1", "k2", "p1", "p2", "k3")),
    "KannalaBrandt8": ("fisheye", ("k1", "k2", "k3", "k4")),
}
#: The right camera's pose in the left one's frame, in settings of version 1.0 and in older ones.
POSES = ("Stereo.T_c1_c2", "Tlr")

_Entries = dict[str, np.ndarray]


def matches(text: str, path: Path) -> bool:
    """Whether a line is ``Camera.fx``, ``Camera1.fx`` or ``Camera.bf``, and none is ``LEFT.P``."""
    return MARK.search(text) is not None and not RECTIFICATION.search(text)


def _number(entries: _Entries, key: str, path: Path) -> float:
    value = entries.get(key.lower(), np.empty(0))
    if value.size != 1 or not np.isfinite(value).all():
        bad_value(f"{key} in {path}", "a finite number", "none" if not value.size else f"{value}")
    return float(value.item())


def _positive(entries: _Entries, key: str, path: Path) -> float:
    return positive(_number(entries, key, path), f"{key} in {path}")


def _size(entries: _Entries, path: Path) -> tuple[int, int] | None:
    keys = ("Camera.width", "Camera.height")
    if not any(key.lower() in entries for key in keys):
        return None
    width, height = (whole_pixels(_number(entries, key, path), f"{key} in {path}") for key in keys)
    return width, height


def _K(entries: _Entries, name: str, path: Path) -> np.ndarray:
    fx, fy = (_positive(entries, f"{name}.{key}", path) for key in ("fx", "fy"))
    return intrinsics(fx, fy, *(_number(entries, f"{name}.{key}", path) for key in ("cx", "cy")))


def _lens(entries: _Entries, name: str, kind: str, path: Path) -> Distortion | None:
    model, keys = LENSES[kind]
    there = [f"{name}.{key}".lower() in entries for key in keys]
    # A pinhole may leave its coefficients out, or the last one.
    if model == "opencv" and not any(there):
        return None
    last = len(keys) if there[-1] else 4
    return lens_of(
        np.array([_number(entries, f"{name}.{key}", path) for key in keys[:last]]),
        f"Lens distortion of {name} in {path}",
        model,
    )


def _left(entries: _Entries) -> str:
    return "Camera1" if "camera1.fx" in entries else "Camera"


def _as_taken(entries: _Entries, pose: str, kind: str, path: Path) -> Rig:
    if kind not in LENSES:
        bad_value(f"Camera.type in {path}", f"{' or '.join(LENSES)} beside {pose}", repr(kind))
    T, where = entries[pose.lower()], f"{pose} in {path}"
    if T.shape not in ((3, 4), (4, 4)):
        bad_value(where, "of shape (4, 4)", f"{T.shape}")
    E = check_rigid(np.vstack([T[:3], (0, 0, 0, 1)]) if len(T) == 3 else T, where)
    left, right = (
        FactoryCamera(_K(entries, name, path), _size(entries, path), _lens(entries, name, kind, path))
        for name in (_left(entries), "Camera2")
    )
    return rig_of_cameras(left, right, E, str(path))


def _rectified(entries: _Entries, baseline: str, path: Path) -> Rig:
    name = _left(entries)
    lens = _lens(entries, name, "PinHole", path)
    if lens is not None:
        bad_value(
            f"Lens distortion of {name} in {path}",
            f"zero in the settings of rectified images, which have no {POSES[0]}",
            np.array2string(lens.coefficients, precision=4, separator=", "),
            "Is it of a single camera?",
        )
    K = _K(entries, name, path)
    length = _positive(entries, baseline, path)
    E = pose_to_the_right(length if baseline == "Stereo.b" else length / K[0, 0])
    return make_rig(K, K, E, path, size=_size(entries, path), rectified=True)


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of the images as taken, by ``Stereo.T_c1_c2`` (or ``Tlr``), else of rectified images.

    Rectified images have one camera for both, and a baseline: ``Stereo.b``, or ``Camera.bf``, which is
    fx times the baseline. Lengths are metres. Images have ``Camera.width`` and ``Camera.height``;
    ``Camera.newWidth`` is what ORB-SLAM shrinks them to, and is not read.

    Raises:
        ValueError: an entry is missing or malformed, a single camera, or one with a depth sensor.
    """
    path = files[0].path
    entries = parse_storage(files[0].text, path)
    found = CAMERA_TYPE.search(files[0].text)
    kind = found[1] if found else "PinHole"
    pose = next((name for name in POSES if name.lower() in entries), None)
    if pose is not None:
        return _as_taken(entries, pose, kind, path)
    # Settings of version 1.0 say of rectified images that they are; older ones call them a pinhole's.
    baseline, types = {
        "Camera1": ("Stereo.b", ("Rectified",)),
        "Camera": ("Camera.bf", ("Rectified", "PinHole")),
    }[_left(entries)]
    # Of a single camera with a depth sensor, the baseline is made up.
    depth_sensor = any(key.endswith("depthmapfactor") for key in entries)
    if depth_sensor or baseline.lower() not in entries or kind not in types:
        bad_value(
            f"{path}",
            f"ORB-SLAM's settings of a stereo camera, with {POSES[0]}, or {baseline} of rectified images",
            f"those of a camera of type {kind} {'with a depth sensor' if depth_sensor else 'without them'}",
            "Give the settings that ORB-SLAM runs in stereo with.",
        )
    return _rectified(entries, baseline, path)


ORB_SLAM = CalibrationFormat("ORB-SLAM's stereo settings (Camera1.fx, Camera.bf)", matches, read)
