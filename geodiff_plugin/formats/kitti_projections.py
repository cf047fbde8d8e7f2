"""KITTI ``P0`` .. ``P3`` files (2012 benchmark, odometry, object).

Data flow: ``P0: ...`` .. ``P3: ...`` (3x4 each) -> ``Rig``.
Paper: S5.1 (KITTI stereo).
"""

from __future__ import annotations

import re
from pathlib import Path

from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.kitti_cam_to_cam import kitti_row
from geodiff_plugin.formats.kitti_cameras import choose_cameras
from geodiff_plugin.formats.rigs import make_rig, pose_from_projections
from geodiff_plugin.types import Rig

__all__ = ["KITTI_PROJECTIONS", "matches", "read"]

# The number behind the colon keeps OpenCV's "P1: !!opencv-matrix" out.
ROW = re.compile(r"^\s*P([0-3])\s*:\s*[-+.\d]", re.MULTILINE)


def matches(text: str, path: Path) -> bool:
    """Whether a line is ``P0:`` .. ``P3:`` and numbers."""
    return ROW.search(text) is not None


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of two cameras of a file of projections, which says no image size.

    Raises:
        ValueError: a camera or a line is missing or malformed.
    """
    path, text = files[0].path, files[0].text
    cameras = choose_cameras({int(number) for number in ROW.findall(text)}, choice, path)
    P_left, P_right = (kitti_row(text, f"P{camera}", 12, path).reshape(3, 4) for camera in cameras)
    return make_rig(
        P_left[:, :3], P_right[:, :3], pose_from_projections(P_left, P_right, path), path, rectified=True
    )


KITTI_PROJECTIONS = CalibrationFormat(
    "KITTI projections (P0: ... to P3: ...)", matches, read, uses_cameras=True
)
