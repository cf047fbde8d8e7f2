"""A pair of ROS ``camera_info``: files of ``camera_calibration``, or the message as ``echo`` prints it.

Data flow: ``projection_matrix`` (or ``P``) of the left and the right camera -> ``Rig``.
Paper: none.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value, refuse
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.euroc import MARK as EUROC_MARK
from geodiff_plugin.formats.kalibr import MARK as KALIBR_MARK
from geodiff_plugin.formats.rigs import make_rig, pose_from_projections, whole_pixels
from geodiff_plugin.formats.structured import array_of, parse_yaml
from geodiff_plugin.types import Rig

__all__ = ["ROS", "matches", "read"]

MARK = re.compile(r"^(projection_matrix|distortion_model|rectification_matrix)\s*:", re.MULTILINE)


def matches(text: str, path: Path) -> bool:
    """Whether a line at the margin is an entry of ``camera_info`` that no other format has there."""
    others = any(mark.search(text) for mark in (KALIBR_MARK, EUROC_MARK)) or "!!opencv-matrix" in text
    return MARK.search(text) is not None and not others


def _first(info: dict[str, Any], names: tuple[str, ...]) -> Any:
    return next((info[name] for name in names if name in info), None)


def _size(info: dict[str, Any], path: Path) -> tuple[int, int] | None:
    """``(width, height)``; ``None`` where the file has neither."""
    given = {side: _first(info, (f"image_{side}", side)) for side in ("width", "height")}
    if all(value is None for value in given.values()):
        return None
    width, height = (whole_pixels(value, f"image_{side} in {path}") for side, value in given.items())
    return width, height


def _projection(file: CalibrationFile) -> tuple[np.ndarray, tuple[int, int] | None]:
    info = parse_yaml(file.text, file.path)
    matrix = _first(info, ("projection_matrix", "P", "p"))
    matrix = matrix.get("data") if isinstance(matrix, dict) else matrix
    if matrix is None:
        bad_value(f"{file.path}", "a camera_info with projection_matrix (or P)", "none", "Is it cut off?")
    P = array_of(matrix, (3, 4), f"projection_matrix in {file.path}")
    if not P.any():
        refuse(
            f"{file.path} is of a camera that is not calibrated: its projection_matrix (P) is all zeros. "
            "Calibrate the pair (camera_calibration with two topics)."
        )
    return P, _size(info, file.path)


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of the rectified images (``image_rect``), left file first.

    ``P`` is that of the rectified image, so ``D`` and ``K`` of the raw one are not read. ``P[0, 3]`` of the
    right camera is ``-fx * baseline``, in metres.

    Raises:
        ValueError: no projection, a camera that is not calibrated, a size that is no whole number of
            pixels, or none of the two knows the other camera.
    """
    (P_left, size), (P_right, size_right) = (_projection(file) for file in files)
    source = " and ".join(str(file.path) for file in files)
    E = pose_from_projections(P_left, P_right, source)
    if np.linalg.norm(E[:3, 3]) == 0:
        bad_value(
            f"projection_matrix[0, 3] in {source}",
            "-fx * baseline in the right camera's file",
            "the same in both",
            "These are of single cameras; calibrate the pair (camera_calibration with two topics).",
        )
    return make_rig(
        P_left[:, :3], P_right[:, :3], E, source, size=size, size_right=size_right, rectified=True
    )


ROS = CalibrationFormat("a pair of ROS camera_info (projection_matrix)", matches, read, file_counts=(2,))
