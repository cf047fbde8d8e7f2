"""A pair of ROS ``camera_info``: files of ``camera_calibration``, or the message as ``echo`` prints it."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value, refuse
from geodiff_plugin.formats.kalibr import EUROC, KALIBR
from geodiff_plugin.formats.rigs import CalibrationFormat, CameraChoice, RawRig, array_of, projected, size_of
from geodiff_plugin.formats.structured import is_storage, parse_yaml

__all__ = ["ROS"]

MARK = re.compile(r"^(projection_matrix|distortion_model|rectification_matrix)\s*:", re.MULTILINE)
CURE = "Calibrate the pair (camera_calibration with two topics)."


def _matches(text: str) -> bool:
    others = KALIBR.matches(text) or EUROC.matches(text) or is_storage(text)
    return MARK.search(text) is not None and not others


def _camera(text: str) -> tuple[np.ndarray, Any]:
    info = parse_yaml(text)
    matrix = next((info[name] for name in ("projection_matrix", "P", "p") if name in info), None)
    if matrix is None:
        bad_value("the file", "a camera_info with projection_matrix (or P)", "none", "Is it cut off?")
    P = array_of(matrix.get("data") if isinstance(matrix, dict) else matrix, (3, 4), "projection_matrix")
    if not P.any():
        refuse(f"the camera is not calibrated: its projection_matrix (P) is all zeros. {CURE}")
    return P, size_of(info, "image_width", "image_height") or size_of(info)


def _read(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The rectified images (``image_rect``), left file first.

    ``P`` is that of the rectified image, so ``D`` and ``K`` of the raw one are not read. ``P[0, 3]`` of the
    right camera is ``-fx * baseline``, in metres.
    """
    (P_left, size_left), (P_right, size_right) = (_camera(text) for text in texts)
    raw = projected(P_left, P_right, size_left, size_right)
    if not raw.pose[:3, 3].any():
        bad_value(
            "projection_matrix[0, 3]",
            "-fx * baseline in the right camera's file",
            "the same in both",
            f"These are of single cameras. {CURE}",
        )
    return raw


ROS = CalibrationFormat("a pair of ROS camera_info (projection_matrix)", _matches, _read, file_counts=(2,))
