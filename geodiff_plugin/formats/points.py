"""Known depths from files: a sparse depth map, a list of points, PLY, KITTI's velodyne scans."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from geodiff_plugin._camera_checks import check_intrinsics, check_metres
from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin.formats.depth import read_depth_png, read_pfm
from geodiff_plugin.formats.files import check_file, open_image, read_npy, read_rows, read_text
from geodiff_plugin.formats.stereo import KITTI_ROW

PathLike = str | os.PathLike[str]
KINDS = (
    "a 16-bit PNG (millimetres), a PFM or .npy map in metres, or points in metres as .npy, text, .ply or "
    "KITTI's .bin"
)
MILLIMETRES = 1000.0
#: Columns of points: x y z, with an intensity, or with a colour.
COLUMNS = (3, 4, 6)
NUMBER = re.compile(r"[-+]?(\d.*|\..*|nan|inf)", re.IGNORECASE)
MOST_POINTS = 50_000_000
NEAREST, FARTHEST_SCALE = 1e-9, 1e9
PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
#: The head of a PLY file without its comments: order, number and plain properties of the first element.
PLY_HEAD = re.compile(
    rf"ply\s+format ({'|'.join(PLY_ORDERS)}) \S+\s+element vertex (\d{{1,12}})\s+"
    rf"((?:property (?:{'|'.join(PLY_TYPES)}) \w+\s+)+)(?:element|end_header)"
)
#: A head is text; none is near this size.
LONGEST_HEAD = 65_536
VELODYNE = "KITTI's calib/N.txt, or calib_velo_to_cam.txt together with calib_cam_to_cam.txt"


def read_points(
    path: PathLike,
    name: str = "points",
    *,
    scale: float | None = None,
    calibration: Sequence[PathLike] = (),
) -> np.ndarray:
    """Read depths that are known, of the left image.

    Args:
        path: a map of the left image, 0 or not finite where nothing is known: 16-bit PNG of millimetres, PFM
            or two-dimensional ``.npy`` of metres. Or points, metres, in the left camera's frame (x right, y
            down, z forward): ``N x 3``, ``N x 4`` or ``N x 6`` as ``.npy`` or text (blanks or commas), of
            which those columns count that a heading names x, y and z, else the first three; ``.ply``; KITTI's
            velodyne ``.bin``.
        name: the argument that it came in, for messages.
        scale: units of the file in a metre, > 0, for any kind: 1000 for millimetres, 256 for KITTI's PNG.
        calibration: of a ``.bin``: KITTI's object ``calib/N.txt``, or ``calib_velo_to_cam.txt`` with
            ``calib_cam_to_cam.txt``.

    Returns:
        ``(H, W)`` float32 metres, 0 where unknown, or ``(N, 3)`` float32 metres.

    Raises:
        OSError, ValueError: no readable file, one of another kind, or one that does not decode.
    """
    file = check_file(path, name, "a file of known depths")
    if scale is not None:
        check_number(scale, f"{name}-scale", NEAREST, FARTHEST_SCALE)
    kind = file.suffix.lower()
    if calibration and kind != ".bin":
        bad_value(f"{name}-calib", "given with a velodyne .bin only", f"{file}")
    if kind == ".png":
        return read_depth_png(file, scale or MILLIMETRES, name)[0]
    if kind == ".bin":
        values = _velodyne(file, calibration, name)
    elif kind == ".npy":
        values = read_npy(file, name, KINDS)
    else:
        values = {".pfm": read_pfm, ".ply": read_ply_points}.get(kind, _table)(file, name)
    if values.ndim != 2 or 0 in values.shape or values.size > MOST_POINTS:
        bad_value(name, "a map (H, W) or points (N, 3) of numbers", f"{file} of shape {values.shape}")
    if values.shape[1] in COLUMNS:
        values = values[:, :3]
    if scale is None:
        check_metres(values, name, f"{file} of {values.dtype}")
    with np.errstate(over="ignore"):
        values = (values / (scale or 1.0)).astype(np.float32)
    return values if values.shape[1] == 3 else np.where(np.isfinite(values), values, np.float32(0))


def read_confidence(path: PathLike, name: str = "points_confidence") -> np.ndarray:
    """How far to rely on points: ``(N,)`` or ``(H, W)`` in [0, 1], from ``.npy``, ``.pfm``, or an image."""
    file = check_file(path, name, "a file of confidences")
    kind = file.suffix.lower()
    if kind == ".png":
        with open_image(file, name) as image:
            values = np.asarray(image)
        if values.ndim != 2 or values.dtype not in (np.uint8, np.uint16):
            bad_value(name, "a grey PNG of 8 or 16 bits", f"{file} of shape {values.shape}")
        return (values / np.iinfo(values.dtype).max).astype(np.float32)
    values = read_pfm(file, name) if kind == ".pfm" else read_npy(file, name, "numbers in [0, 1] as .npy")
    return np.squeeze(values).astype(np.float32)


def _table(path: Path, name: str) -> np.ndarray:
    """Numbers of a text, one row a line, below one heading at most."""
    rows = read_rows(path, name, KINDS)
    heading = rows.pop(0) if rows and not NUMBER.fullmatch(rows[0][0]) else []
    lengths = sorted({len(row) for row in rows})
    got = f"rows of {lengths or 'no'} numbers"
    if len(lengths) == 1:
        columns = _columns(heading, path, name) if len(heading) == lengths[0] else range(lengths[0])
        with suppress(ValueError):
            return np.array([[row[column] for column in columns] for row in rows], dtype=np.float64)
        got = "words among them"
    bad_value(name, "points in metres, one a line, below one heading at most", f"{path} with {got}")


def _columns(heading: list[str], path: Path, name: str) -> Sequence[int]:
    """Where a heading with a word a column has x, y and z."""
    words = [re.sub(r"([_ ]?m|[_ ]?[\[(]m[\])])$", "", word.lower()) for word in heading]
    if any(words.count(axis) != 1 for axis in "xyz"):
        cure = "Write the points as x, y and z of the left camera, or the depths as a map of the left image."
        got = f"{path} with {', '.join(heading)}"
        bad_value(name, "points with columns x, y and z, in metres", got, cure)
    return [words.index(axis) for axis in "xyz"]


def read_ply_points(path: Path, name: str = "points") -> np.ndarray:
    """The points ``(N, 3)`` float64 of a PLY file, ASCII or binary, in the file's unit and frame."""
    data = path.read_bytes()
    begin = data.find(b"\n", data.find(b"end_header", 0, LONGEST_HEAD)) + 1
    head = re.sub(r"(?m)^(comment|obj_info)\b.*\n", "", data[:begin].decode("latin-1"))
    match = PLY_HEAD.match(head)
    order, number, properties = match.groups() if match else ("", "0", "")
    words = properties.split()
    columns, kinds, count = words[2::3], words[1::3], int(number)
    named = {"x", "y", "z"} <= set(columns) and len(set(columns)) == len(columns)
    if not named or not 0 < count <= MOST_POINTS:
        expected = f"a PLY file that begins with vertices of plain x, y and z, at most {MOST_POINTS}"
        bad_value(name, expected, f"{path}, which has none", "Is it cut off, or another format?")
    if order == "ascii":
        lines = data[begin:].decode("latin-1").splitlines()[:count]
        with suppress(ValueError):
            table = np.array([line.split()[: len(columns)] for line in lines], dtype=np.float64)
            if table.shape == (count, len(columns)):
                return table[:, [columns.index(axis) for axis in "xyz"]]
    else:
        row = np.dtype([(c, PLY_ORDERS[order] + PLY_TYPES[k]) for c, k in zip(columns, kinds, strict=True)])
        if len(data) - begin >= count * row.itemsize:
            points = np.frombuffer(data, dtype=row, count=count, offset=begin)
            return np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=1)
    expected = f"a PLY file with all its {count} points of {len(columns)} numbers"
    bad_value(name, expected, f"{path} with others", "Is it cut off?")


def _camera_from_velodyne(paths: Sequence[PathLike], name: str) -> np.ndarray:
    """``(4, 4)``: from the scanner's frame to that of the rectified left colour camera, which is camera 2."""
    rows: dict[str, np.ndarray] = {}
    for path in paths:
        for key, words in KITTI_ROW.findall(read_text(path, name, VELODYNE)):
            with suppress(ValueError):  # a row of words, such as the date
                rows[key] = np.array(words.split(), dtype=np.float64)

    def matrix(height: int, width: int, *keys: str) -> np.ndarray:
        row = next((rows[key] for key in keys if key in rows), np.empty(0))
        if row.size != height * width or not np.isfinite(row).all():
            bad_value(name, VELODYNE, f"files without {' or '.join(keys)} of {height * width} numbers")
        T = np.eye(4)
        T[:height, :width] = row.reshape(height, width)
        return T

    rectify = matrix(3, 3, "R0_rect", "R_rect_00", "R_rect")
    if "R" in rows and "T" in rows:
        moved = matrix(3, 3, "R")
        moved[:3, 3] = matrix(3, 1, "T")[:3, 0]
    else:
        moved = matrix(3, 4, "Tr_velo_to_cam", "Tr_velo_cam")
    projection = matrix(3, 4, "P2", "P_rect_02")
    beside = np.eye(4)  # camera 2 stands beside camera 0, in whose frame the rest is
    beside[:3, 3] = np.linalg.inv(check_intrinsics(projection[:3, :3], f"P2 of {name}")) @ projection[:3, 3]
    return beside @ rectify @ moved


def _velodyne(path: Path, calibration: Sequence[PathLike], name: str) -> np.ndarray:
    """The points of a scan (float32 x, y, z, reflectance) before the left camera, ``(N, 3)`` metres."""
    if not calibration:
        cure = "The scanner has a frame of its own: x forward, y left, z up."
        bad_value(f"{name}-calib", f"given with a .bin ({VELODYNE})", "nothing", cure)
    size = path.stat().st_size
    if size % 16:
        expected = "a velodyne .bin of whole points (4 float32 each)"
        bad_value(name, expected, f"{path} of {size} bytes", "Is it cut off?")
    scan = np.fromfile(path, dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    T = _camera_from_velodyne(calibration, f"{name}-calib")
    points = scan @ T[:3, :3].T + T[:3, 3]
    points = points[np.isfinite(points).all(axis=1) & (points[:, 2] > 0)]
    if not len(points):
        bad_value(name, "a scan with points before the camera", f"{path} with none")
    return points
