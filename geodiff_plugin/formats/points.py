"""Known depths from files: a sparse depth map, or a list of points, PLY among them."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np

from geodiff_plugin._checks import bad_value, check_metres, check_number, warn
from geodiff_plugin.formats.depth import read_depth_png, read_pfm
from geodiff_plugin.formats.files import check_file, read_npy, read_text, refuse_decimal_commas
from geodiff_plugin.formats.kitti import read_velodyne

__all__ = ["read_ply_points", "read_points"]

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
#: What known depths come in as well, and is not read.
PICTURES, CLOUDS = (
    (".jpg", ".jpeg", ".tif", ".tiff", ".exr"),
    (".pcd", ".las", ".laz", ".obj", ".off", ".e57"),
)
#: How COLMAP opens its list of points, its name for the file, and the fewest numbers of its lines.
COLMAP_MARK, COLMAP_STEM, COLMAP_COLUMNS = "# 3D point list with", "points3d", 8
MOST_POINTS = 50_000_000
NEAREST, FARTHEST_SCALE = 1e-9, 1e9
PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
#: A head is text; none is near this size.
LONGEST_HEAD = 65_536


def _rows(path: Path, name: str) -> np.ndarray:
    """Numbers of a text, one row a line: blanks, tabs, commas or semicolons between.

    A first line of words is a heading, and tells which columns are x, y and z if it has one word a column;
    ``#`` and ``//`` start a remark, anywhere in a line.
    """
    text = read_text(path, name, KINDS).replace('"', "")
    lines = [re.split(r"#|//", line)[0].strip(" \t,;") for line in text.splitlines()]
    refuse_decimal_commas(lines, path, name)
    rows = [re.split(r"[\s,;]+", line) for line in lines if line]
    named = path.stem.lower() == COLMAP_STEM and rows and len(rows[0]) >= COLMAP_COLUMNS
    if named or COLMAP_MARK in text:
        _refuse_colmap(path, name)
    heading = rows.pop(0) if rows and not _is_number(rows[0][0]) else []
    columns = _columns(heading, len(rows[0]), path, name) if rows else None
    try:
        values = [[float(word) for word in (row if columns is None else _of(row, columns))] for row in rows]
    except ValueError:
        bad_value(name, "rows of numbers, below one heading at most", f"{path} with words among them")
    if not values or len({len(row) for row in rows}) > 1:
        lengths = sorted({len(row) for row in rows})
        bad_value(name, "points in metres, one a line", f"{path} with rows of {lengths or 'no'} numbers")
    return np.array(values)


def _refuse_colmap(path: Path, name: str) -> NoReturn:
    """Refuse the points of a COLMAP model, whose first three numbers are no x, y and z.

    They cannot be read: they are in the frame and unit of the model, and the file tells neither.
    """
    bad_value(
        name,
        "points in metres in the left camera's frame, one a line",
        f"{path}, the points of a COLMAP model, in its frame and unit",
        "Transform their X, Y and Z by the pose of the left image in images.txt, multiply them by the "
        "metres in a unit of the model, and save them alone.",
    )


def _of(row: list[str], columns: list[int]) -> list[str]:
    return [row[column] for column in columns if column < len(row)]


def _columns(heading: list[str], count: int, path: Path, name: str) -> list[int] | None:
    """Where a heading has x, y and z; ``None`` for a title, whose words are not as many as the columns."""
    if len(heading) != count:
        return None
    words = [re.sub(r"([_ ]?m|[_ ]?[\[(]m[\])])$", "", word.lower()) for word in heading]
    if any(words.count(axis) != 1 for axis in "xyz"):
        cure = "Write the points as x, y and z of the left camera, or the depths as a map of the left image."
        got = f"{path} with {', '.join(heading)}"
        bad_value(name, "points with columns x, y and z, in metres", got, cure)
    return [words.index(axis) for axis in "xyz"]


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
        warn(
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
            x 4`` or ``N x 6`` as ``.npy`` or text (blanks or commas), of which those columns count that a
            heading names x, y and z, else the first three; ``.ply``; KITTI's velodyne ``.bin`` with its
            calibration.
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
    if kind in PICTURES:
        bad_value(name, KINDS, f"{found}", "Save it as .npy or PFM in metres.")
    if kind in CLOUDS:
        bad_value(name, KINDS, f"{found}", "Save the cloud as .ply.")
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
    if scale is None:
        check_metres(values, name, f"{found} of {values.dtype}")
    with np.errstate(over="ignore"):
        values = (values / (scale or 1.0)).astype(np.float32)
    values = values if values.shape[1] == 3 else np.where(np.isfinite(values), values, np.float32(0))
    return values


def _ply_head(data: bytes, path: Path, name: str) -> tuple[str, int, list[tuple[str, str]], int]:
    """Format, number of points, their properties as ``(name, type)``, and where the data begins."""
    end = data.find(b"end_header", 0, LONGEST_HEAD)
    begin = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or begin == 0:
        bad_value(name, "a PLY file", f"{path} without a PLY head", "Is it cut off, or another format?")
    kind, count, properties, element = "", None, [], ""
    for line in data[:end].decode("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            kind = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            if words[1] == "vertex":
                count = int(words[2][:12])
            elif count is None:
                bad_value(name, "a PLY file whose first element is vertex", f"{path} with {words[1]!r} first")
            element = words[1]
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in PLY_TYPES:
                bad_value(name, "a PLY file whose points have plain properties", f"{path} with {line!r}")
            properties.append((words[2], PLY_TYPES[words[1]]))
    names = [key for key, _ in properties]
    if (
        kind not in PLY_ORDERS
        or not count
        or not {"x", "y", "z"} <= set(names)
        or len(set(names)) < len(names)
    ):
        bad_value(name, "a PLY file with points (element vertex with x, y, z)", f"{path}, which has none")
    if count > MOST_POINTS:
        bad_value(name, f"at most {MOST_POINTS} points", f"{path} with {count}")
    return kind, count, properties, begin


def read_ply_points(path: Path, name: str = "points") -> np.ndarray:
    """The points of a PLY file.

    Args:
        path: an existing file.
        name: the argument that it came in, for messages.

    Returns:
        ``(N, 3)`` float64, in the file's unit and frame.

    Raises:
        ValueError: not PLY, no x, y, z, or cut off.
    """
    data = path.read_bytes()
    kind, count, properties, begin = _ply_head(data, path, name)
    columns = [key for key, _ in properties]
    if kind == "ascii":
        lines = data[begin:].decode("latin-1").splitlines()[:count]
        try:
            table = np.array([[float(word) for word in line.split()[: len(columns)]] for line in lines])
        except ValueError:
            table = np.empty(0)
        if table.shape != (count, len(columns)):
            cure = "Is it cut off?"
            bad_value(name, f"{count} points of {len(columns)} numbers", f"{path} with others", cure)
        return table[:, [columns.index(axis) for axis in "xyz"]]
    row = np.dtype([(key, PLY_ORDERS[kind] + code) for key, code in properties])
    if len(data) - begin < count * row.itemsize:
        got = f"{path} with {len(data) - begin} bytes of them"
        bad_value(name, f"{count} points of {row.itemsize} bytes", got, "Is it cut off?")
    table = np.frombuffer(data, dtype=row, count=count, offset=begin)
    return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
