"""A pair of ``sensor.yaml``, one for each camera, as EuRoC MAV and other sets of the ASL write them.

Data flow: ``T_BS``, ``intrinsics``, ``distortion_coefficients`` of the left and the right camera -> ``Rig``.
Paper: none.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.kalibr import pinhole_camera
from geodiff_plugin.formats.lenses import FactoryCamera, rig_of_cameras
from geodiff_plugin.formats.rigs import check_rigid
from geodiff_plugin.formats.structured import array_of, entry, parse_yaml
from geodiff_plugin.types import Rig

__all__ = ["EUROC", "MARK", "matches", "read"]

MARK = re.compile(r"^T_BS\s*:", re.MULTILINE)
#: OpenCV's name of a distortion model.
LENSES = {"radial-tangential": "opencv", "radtan": "opencv", "equidistant": "fisheye"}


def matches(text: str, path: Path) -> bool:
    """Whether a line is ``T_BS:``, the pose of a sensor in the body's frame."""
    return MARK.search(text) is not None


def _camera(file: CalibrationFile) -> tuple[FactoryCamera, np.ndarray]:
    """The camera, and its pose in the body's frame."""
    # Who reads the file with OpenCV has to mark the matrix, which YAML itself does not know.
    data, where = parse_yaml(file.text.replace("!!opencv-matrix", ""), file.path), f"{file.path}"
    pose = entry(data, "T_BS", where)
    numbers = array_of(entry(pose, "data", f"T_BS in {where}"), (4, 4), f"T_BS in {where}")
    camera = pinhole_camera(data, where, "distortion_coefficients", LENSES)
    return camera, check_rigid(numbers, f"T_BS in {where}")


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of the images as taken, left file first; lengths are metres.

    Raises:
        ValueError: an entry is missing or malformed, or another model of a camera or a lens than pinhole,
            radial-tangential, equidistant.
    """
    (left, T_body_left), (right, T_body_right) = (_camera(file) for file in files)
    E = np.linalg.inv(T_body_left) @ T_body_right
    return rig_of_cameras(left, right, E, " and ".join(str(file.path) for file in files))


EUROC = CalibrationFormat("a pair of EuRoC sensor.yaml (T_BS)", matches, read, file_counts=(2,))
