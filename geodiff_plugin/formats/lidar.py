"""KITTI's velodyne scans, transformed to the left camera's frame.

Data flow: ``.bin`` of x, y, z, reflectance + calibration -> ``(N, 3)`` metres, x right, y down, z forward.
Paper: none (points go beyond it).
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import check_file, read_text

__all__ = ["read_velodyne"]

PathLike = str | os.PathLike[str]
EXPECTED = "KITTI's calib/N.txt, or calib_velo_to_cam.txt together with calib_cam_to_cam.txt"
#: The left colour camera, which the benchmarks' left images are of.
CAMERA = 2


def _rows(paths: Sequence[PathLike], name: str) -> dict[str, np.ndarray]:
    """Every ``key: numbers`` of the files; other lines are left out."""
    rows: dict[str, np.ndarray] = {}
    for path in paths:
        for key, words in re.findall(r"^\s*(\w+)\s*:(.*)$", read_text(path, name, EXPECTED), re.MULTILINE):
            try:
                rows[key] = np.array([float(word) for word in words.split()])
            except ValueError:
                continue
    return rows


def _matrix(
    rows: dict[str, np.ndarray], keys: tuple[str, ...], shape: tuple[int, int], name: str
) -> np.ndarray:
    found = next((rows[key] for key in keys if key in rows), None)
    if found is None or found.size != shape[0] * shape[1] or not np.isfinite(found).all():
        bad_value(name, EXPECTED, f"files without {' or '.join(keys)} of {shape[0] * shape[1]} numbers")
    matrix = np.eye(4)
    matrix[: shape[0], : shape[1]] = found.reshape(shape)
    return matrix


def _camera_from_velodyne(paths: Sequence[PathLike], name: str) -> np.ndarray:
    """``(4, 4)``: from the scanner's frame to that of the rectified left colour camera."""
    rows = _rows(paths, name)
    rectify = _matrix(rows, ("R0_rect", "R_rect_00", "R_rect"), (3, 3), name)
    projection = _matrix(rows, (f"P{CAMERA}", f"P_rect_0{CAMERA}"), (3, 4), name)
    if "R" in rows and "T" in rows:
        moved = np.eye(4)
        moved[:3, :3] = _matrix(rows, ("R",), (3, 3), name)[:3, :3]
        moved[:3, 3] = _matrix(rows, ("T",), (3, 1), name)[:3, 0]
    else:
        moved = _matrix(rows, ("Tr_velo_to_cam", "Tr_velo_cam"), (3, 4), name)
    beside = np.eye(4)  # camera 2 stands beside camera 0, in whose frame the rest is
    try:
        beside[:3, 3] = np.linalg.solve(projection[:3, :3], projection[:3, 3])
    except np.linalg.LinAlgError:
        bad_value(name, EXPECTED, f"a P{CAMERA} that is no projection")
    return beside @ rectify @ moved


def read_velodyne(path: Path, calibration: Sequence[PathLike], name: str = "points") -> np.ndarray:
    """A velodyne scan as points of the left colour camera.

    Args:
        path: ``.bin``, float32 x, y, z, reflectance.
        calibration: one file or two, see ``read_points``.
        name: the argument that ``path`` came in, for messages.

    Returns:
        ``(N, 3)`` metres; what lies behind the camera is left out.

    Raises:
        OSError, ValueError: no calibration, or one without the scanner's pose; not whole points.
    """
    if not calibration:
        cure = "The scanner has a frame of its own: x forward, y left, z up."
        bad_value(f"{name}-calib", f"given with a .bin ({EXPECTED})", "nothing", cure)
    for file in calibration:
        check_file(file, f"{name}-calib", "a calibration file")
    data = path.read_bytes()
    if len(data) % 16:
        expected = "a velodyne .bin of whole points (4 float32 each)"
        bad_value(name, expected, f"{path} of {len(data)} bytes", "Is it cut off?")
    scan = np.frombuffer(data, dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    T = _camera_from_velodyne(calibration, f"{name}-calib")
    points = scan @ T[:3, :3].T + T[:3, 3]
    points = points[np.isfinite(points).all(axis=1) & (points[:, 2] > 0)]
    if not len(points):
        bad_value(name, "a scan with points before the camera", f"{path} with none")
    return points
