"""Known depths from files: a sparse depth map, or a list of points.

Data flow: file -> what ``GeometryGuidance(points=...)`` takes.
Paper: none (points go beyond it).
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value, check_map_in_metres, check_number
from geodiff_plugin.formats.depth import read_depth_png, read_pfm
from geodiff_plugin.formats.files import check_file, read_text
from geodiff_plugin.formats.lidar import read_velodyne
from geodiff_plugin.formats.npy import read_npy
from geodiff_plugin.formats.ply import read_ply_points

__all__ = ["read_points"]

PathLike = str | os.PathLike[str]
KINDS = (
    "a 16-bit PNG (millimetres or 1/256 m), a PFM or .npy map in metres, or points in metres as .npy, "
    "text, .ply or KITTI's .bin"
)
KITTI_UNITS, MILLIMETRES = 256.0, 1000.0
#: Names under which KITTI's depth PNGs lie: the folders of its depth benchmark, and its disparities'.
KITTI_FOLDERS = re.compile(r"(^|[\\/])(proj_depth|groundtruth|groundtruth_depth|velodyne_raw)([\\/]|$)")
#: Columns of points: x y z, with an intensity, or with a colour.
COLUMNS = (3, 4, 6)
MOST_POINTS = 50_000_000
NEAREST, FARTHEST_SCALE = 1e-9, 1e9


def _rows(path: Path, name: str) -> np.ndarray:
    """Numbers of a text, one row a line: blanks, tabs, commas or semicolons between, lines of words left out.

    A first line of words is a heading; ``#`` and ``//`` start a remark, anywhere in a line.
    """
    lines = [re.split(r"#|//", line)[0].strip(" \t,;") for line in read_text(path, name, KINDS).splitlines()]
    rows = [re.split(r"[\s,;]+", line) for line in lines if line]
    headed = bool(rows) and not _is_number(rows[0][0])
    try:
        values = [[float(word) for word in row] for row in rows[headed:]]
    except ValueError:
        bad_value(name, "rows of numbers, below one heading at most", f"{path} with words among them")
    if not values or len({len(row) for row in values}) > 1:
        lengths = sorted({len(row) for row in values})
        bad_value(name, "points in metres, one a line", f"{path} with rows of {lengths or 'no'} numbers")
    return np.array(values)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _png_scale(path: Path, scale: float | None) -> float:
    if scale is not None:
        return scale
    if KITTI_FOLDERS.search(str(path.parent)):
        warnings.warn(
            f"{path} is read in KITTI's units of 1/256 m, as its folder's name says; "
            "give --points-scale 1000 (scale=1000) if it is in millimetres.",
            stacklevel=4,
        )
        return KITTI_UNITS
    return MILLIMETRES


def read_points(
    path: PathLike,
    name: str = "points",
    *,
    scale: float | None = None,
    calibration: Sequence[PathLike] = (),
) -> np.ndarray:
    """Read depths that are known, of the left image.

    Args:
        path: a map of the left image, 0 or not finite where nothing is known: 16-bit PNG of millimetres (of
            1/256 m in folders that KITTI's depth benchmark names so), PFM or two-dimensional ``.npy`` of
            metres. Or points, metres, in the left camera's frame (x right, y down, z forward): ``N x 3``, ``N
            x 4`` or ``N x 6`` as ``.npy`` or text (blanks or commas, a heading is left out), of which the
            first three columns count; ``.ply``; KITTI's velodyne ``.bin`` with its calibration.
        name: the argument that it came in, for messages.
        scale: units of the file in a metre, > 0, for any kind: 1000 for millimetres, 256 for KITTI's PNG.
        calibration: of a ``.bin``: KITTI's object ``calib/N.txt``, or ``calib_velo_to_cam.txt`` with
            ``calib_cam_to_cam.txt``.

    Returns:
        ``(H, W)`` float32 metres, 0 where unknown, or ``(N, 3)`` float32 metres.

    Raises:
        FileNotFoundError, IsADirectoryError, PermissionError: no readable file.
        ValueError: a file of another kind, or that does not decode.
    """
    found = check_file(path, name, "a file of known depths")
    if scale is not None:
        check_number(scale, f"{name}-scale", NEAREST, FARTHEST_SCALE)
    kind = found.suffix.lower()
    if calibration and kind != ".bin":
        bad_value(f"{name}-calib", "given with a velodyne .bin only", f"{found}")
    if kind == ".png":
        return read_depth_png(found, _png_scale(found, scale), name)[0]
    if kind in (".jpg", ".jpeg", ".tif", ".tiff", ".exr"):
        bad_value(name, KINDS, f"{found}", "Save it as .npy or PFM in metres.")
    if kind == ".pfm":
        values = read_pfm(found, name)
    elif kind == ".ply":
        values = read_ply_points(found, name)
    elif kind == ".bin":
        values = read_velodyne(found, calibration, name)
    else:
        values = read_npy(found, name, KINDS) if kind == ".npy" else _rows(found, name)
    if values.ndim != 2 or 0 in values.shape or values.size > MOST_POINTS:
        bad_value(name, "a map (H, W) or points (N, 3) of numbers", f"{found} of shape {values.shape}")
    if values.shape[1] in COLUMNS:
        values = values[:, :3]
    elif scale is None:
        check_map_in_metres(values, name, f"{found} of {values.dtype}")
    with np.errstate(over="ignore"):
        values = (values / (scale or 1.0)).astype(np.float32)
    return values if values.shape[1] == 3 else np.where(np.isfinite(values), values, np.float32(0))
