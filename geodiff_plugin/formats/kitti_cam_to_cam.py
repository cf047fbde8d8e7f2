"""KITTI ``calib_cam_to_cam`` (2015 benchmark, raw data; DrivingStereo shares it).

Data flow: ``P_rect_xx`` (3x4), ``S_rect_xx`` -> ``Rig``.
Paper: S5.1 (KITTI stereo).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.kitti_cameras import choose_cameras
from geodiff_plugin.formats.rigs import make_rig, pose_from_projections, whole_pixels
from geodiff_plugin.types import Rig

__all__ = ["KITTI_CAM_TO_CAM", "kitti_row", "matches", "read"]

ROW = re.compile(r"^\s*P_rect_(\d+)\s*:(.*)$", re.MULTILINE)


def matches(text: str, path: Path) -> bool:
    """Whether a line starts with ``P_rect_<number>:``."""
    return ROW.search(text) is not None


def kitti_row(text: str, key: str, count: int, path: Path) -> np.ndarray:
    """``count`` float64 numbers behind ``key:``.

    Raises:
        ValueError: the line is missing, or has fewer or other than numbers.
    """
    line = re.search(rf"^\s*{key}\s*:(.*)$", text, re.MULTILINE)
    words = line.group(1).split() if line else []
    try:
        values = np.array([float(w) for w in words])
    except ValueError:
        values = np.empty(0)
    if values.size != count:
        bad_value(
            f"{key} in {path}",
            f"{count} numbers",
            f"{line.group(1).strip() if line else 'no such line'!r}",
            "Is the file cut off?",
        )
    return values


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of two cameras of a ``calib_cam_to_cam`` file; its images are the rectified ones.

    Raises:
        ValueError: a camera or a line is missing or malformed.
    """
    path, text = files[0].path, files[0].text
    cameras = choose_cameras({int(number): None for number, _ in ROW.findall(text)}, choice, path)
    width = len(ROW.findall(text)[0][0])
    names = [f"{camera:0{width}d}" for camera in cameras]
    P_left, P_right = (kitti_row(text, f"P_rect_{n}", 12, path).reshape(3, 4) for n in names)
    sizes = [_size(text, f"S_rect_{n}", path) for n in names]
    E = pose_from_projections(P_left, P_right, path)
    return make_rig(
        P_left[:, :3], P_right[:, :3], E, path, size=sizes[0], size_right=sizes[1], rectified=True
    )


def _size(text: str, key: str, path: Path) -> tuple[int, int] | None:
    if key not in text:
        return None
    width, height = (whole_pixels(value, f"{key} in {path}") for value in kitti_row(text, key, 2, path))
    return width, height


KITTI_CAM_TO_CAM = CalibrationFormat(
    "KITTI calib_cam_to_cam (P_rect_02: ...)", matches, read, uses_cameras=True
)
