"""Reads known depths of points, in the frame of the left camera or a sensor."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._internal.camera_checks import check_metres
from geodiff_plugin._internal.checks import bad_value, check_number
from geodiff_plugin.formats.depth import IMAGE_SUFFIXES
from geodiff_plugin.formats.files import PathLike, check_file, read_npy, read_rows
from geodiff_plugin.formats.maps import MM_PER_METRE, read_map_file
from geodiff_plugin.formats.pcd import read_pcd_points

KINDS = (
    "a map (16-bit PNG or TIFF in mm; float TIFF, .exr, .pfm, .npy or .npz in metres) or points in metres "
    "(.npy, text, .ply, .pcd, .las)"
)
#: Unsupported suffixes: description, and how to convert to points.
FOREIGN = {
    ".bin": (
        "points of a lidar in its own frame (KITTI's velodyne)",
        "Pass KITTI's --calib with calib_velo_to_cam.txt in the same folder; in Python: "
        "formats.read_lidar(file, [calibration]).",
    ),
    **dict.fromkeys(
        (".h5", ".hdf5", ".mat"),
        (
            "an HDF5 or MATLAB file",
            "Save its map as .npy: numpy.save('depth.npy', h5py.File(path)['depth']).",
        ),
    ),
}
#: Maximum lateral coordinate of known points; larger ones are map coordinates.
MAX_SIDEWAYS_M = 1e5
COLUMNS = (3, 4, 6)  # x y z, optionally with intensity or colour
NUMBER = re.compile(r"[-+]?(\d.*|\..*|nan|inf)", re.IGNORECASE)


def read_points(path: PathLike, name: str = "points", *, scale: float | None = None) -> np.ndarray:
    """Read known depths of the left image: ``(H, W)`` float32 metres, 0 where unknown, or ``(N, 3)``.

    Points are in the left camera's frame: ``.npy`` or text with 3, 4 or 6 columns, or with a heading of x, y
    and z; ``.ply``. ``scale`` is the file's units per metre: 1000 for millimetres, 256 for KITTI's PNG.
    """
    file = check_file(path, name, "a file of known depths")
    if scale is not None:
        check_number(scale, f"{name}-scale", 1e-9, 1e9)
    kind = file.suffix.lower()
    if kind in FOREIGN:
        bad_value(name, KINDS, f"{file}, {FOREIGN[kind][0]}", FOREIGN[kind][1])
    if kind in IMAGE_SUFFIXES:
        return _of_image(file, name, scale)
    readers: dict[str, Callable[[Path, str], np.ndarray]] = {
        ".npy": lambda path, what: read_npy(path, what, KINDS),
        **dict.fromkeys((".pfm", ".exr", ".npz", ".dpt"), read_map_file),
        **dict.fromkeys((".las", ".laz"), read_las_points),
        **{".ply": read_ply_points, ".pcd": read_pcd_points},
    }
    values = readers.get(kind, _table)(file, name)
    if values.ndim != 2 or 0 in values.shape:
        bad_value(name, "a map (H, W) or points (N, 3) of numbers", f"{file} of shape {values.shape}")
    if values.shape[1] in COLUMNS:
        values = values[:, :3]
    if scale is None:
        check_metres(values, name, f"{file} of {values.dtype}")
    if values.shape[1] == 3:
        _check_no_map_coordinates(values[:, :2] / (scale or 1.0), file, name)
    with np.errstate(over="ignore"):
        values = (values / (scale or 1.0)).astype(np.float32)
    return values if values.shape[1] == 3 else np.where(np.isfinite(values), values, np.float32(0))


def _check_no_map_coordinates(sideways: np.ndarray, file: Path, name: str) -> None:
    """Raise an error if x and y ``(N, 2)`` are map coordinates in metres, as in lidar surveys."""
    middle = np.median(np.abs(sideways), axis=0)
    if middle.max() > MAX_SIDEWAYS_M:
        expected = "points in the frame of the left camera (x right, y down, z forward)"
        hint = "Transform them with the camera pose: (points - position) @ R."
        bad_value(
            name,
            expected,
            f"{file} with x and y of {middle[0]:.0f} and {middle[1]:.0f} m (map coordinates)",
            hint,
        )


def _of_image(file: Path, name: str, scale: float | None) -> np.ndarray:
    """Read the map of a PNG or TIFF: integers are millimetres, floats metres, unless ``scale`` is given."""
    values = read_map_file(file, name)
    units = scale or (MM_PER_METRE if values.dtype.kind in "iu" else 1.0)
    known = np.isfinite(values) & (values > 0)
    return np.where(known, values, 0).astype(np.float32) / np.float32(units)


def read_las_points(path: Path, name: str = "points") -> np.ndarray:
    """Read the points ``(N, 3)`` of a LAS file (LAZ with lazrs) with laspy, in its unit and frame."""
    try:
        import laspy
    except ImportError:
        hint = (
            "Install it with: pip install 'laspy[lazrs]', or convert the file: pdal translate FILE out.ply."
        )
        bad_value(name, KINDS, path, hint)
    try:
        return np.array(laspy.read(path).xyz, np.float64)
    except laspy.LaspyException as error:
        if laspy.LazBackend.detect_available():
            bad_value(name, "a whole LAS file", f"{path} ({error})", "It may be truncated.")
        hint = (
            "Install it with: pip install 'laspy[lazrs]', or convert the file: pdal translate FILE out.ply."
        )
        bad_value(name, "a LAS file, or LAZ with laspy's lazrs", f"{path} ({error})", hint)
    except Exception as error:  # any error that a damaged file may cause
        bad_value(name, "a whole LAS file", f"{path} ({error})", "It may be truncated.")


def _table(path: Path, name: str) -> np.ndarray:
    """Read numbers of a text, one row per line, with at most one heading."""
    rows = read_rows(path, name, KINDS)
    heading = rows.pop(0) if rows and not NUMBER.fullmatch(rows[0][0]) else []
    lengths = {len(row) for row in rows}
    if lengths == {len(heading)}:  # one word per column
        words = [re.sub(r"([_ ]?m|[_ ]?[\[(]m[\])])$", "", word.lower()) for word in heading]
        if any(words.count(axis) != 1 for axis in "xyz"):
            hint = "Save points as x, y and z of the left camera, or depths as a map of the left image."
            got = f"{path} with {', '.join(heading)}"
            bad_value(name, "points with columns x, y and z, in metres", got, hint)
        rows = [[row[words.index(axis)] for axis in "xyz"] for row in rows]
    with suppress(ValueError):  # words, or rows of different lengths
        return np.array(rows, dtype=np.float64).reshape(len(rows), -1)
    got = f"{path} with words, or rows of {sorted(lengths)} numbers"
    bad_value(name, "points in metres, one per line, with at most one heading", got)


def read_ply_points(path: Path, name: str = "points") -> np.ndarray:
    """Read the points ``(N, 3)`` float64 of a PLY file, ASCII or binary, in its unit and frame."""
    import trimesh

    count = re.search(rb"\nelement vertex (\d+)\s", path.read_bytes())
    try:
        how: dict[str, Any] = {"process": False, "skip_materials": True, "fix_texture": False}
        cloud: Any = trimesh.load(path, file_type="ply", **how)
        points = np.array(cloud.vertices, np.float64)
    except Exception:  # any error that a damaged file may cause
        points = np.empty((0, 3))
    if count is None or not 0 < int(count.group(1)) == len(points):
        expected = "a whole PLY file whose vertices have x, y and z"
        bad_value(name, expected, path, "It may be truncated, or in a different format.")
    return points
