"""Known depths from files: a sparse depth map, a list of points, PLY, KITTI's velodyne scans."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value, check_metres, check_number, warn
from geodiff_plugin.formats.benchmarks import KITTI_ROW
from geodiff_plugin.formats.depth import read_depth_png, read_map, read_pfm
from geodiff_plugin.formats.files import check_file, open_image, read_npy, read_rows, read_text
from geodiff_plugin.types import Rig

__all__ = ["depth_of_disparity", "read_confidence", "read_ply_points", "read_points"]

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
#: What known depths come in as well and is not read, and what to save it as.
UNREAD = dict.fromkeys((".jpg", ".jpeg", ".tif", ".tiff", ".exr"), "Save it as .npy or PFM in metres.")
UNREAD |= dict.fromkeys((".pcd", ".las", ".laz", ".obj", ".off", ".e57"), "Save the cloud as .ply.")
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
    file = check_file(path, name, "a file of known depths")
    if scale is not None:
        check_number(scale, f"{name}-scale", NEAREST, FARTHEST_SCALE)
    kind = file.suffix.lower()
    if calibration and kind != ".bin":
        bad_value(f"{name}-calib", "given with a velodyne .bin only", f"{file}")
    if kind in UNREAD:
        bad_value(name, KINDS, f"{file}", UNREAD[kind])
    if kind == ".png":
        return read_depth_png(file, _png_scale(file, scale), name)[0]
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


def depth_of_disparity(
    path: PathLike, rig: Rig, size: tuple[int, int], name: str = "disparity"
) -> np.ndarray:
    """Depths by a disparity map of the left image, from a stereo network or a sensor.

    Args:
        path: of ``read_map``; a PNG holds 256 units a pixel, as KITTI's.
        rig: rectified; its K are for images of ``size``.
        size: ``(width, height)`` of the left image. A map of another size is one of the image scaled to it:
            its disparities grow with its width, and every pixel takes the nearest.
        name: the argument that it came in, for messages.

    Returns:
        ``(H, W)`` float32 metres, ``fx baseline / (d + doffs)``; 0 where the disparity is not finite or 0, or
        nothing is in front of the cameras.

    Raises:
        OSError, ValueError: no map; a rig that is not rectified, or a map of another shape.
    """
    x, others = rig.E[0, 3], rig.E - np.eye(4)
    others[0, 3] = 0.0
    if x <= 0 or np.abs(others).max() > 1e-3 * max(x, 1.0) or rig.unit is None:
        cure = "Its right camera stands to the right, and a disparity goes along rows."
        bad_value(name, "of a rectified rig in metres", f"the rig of {rig.source}", cure)
    values = read_map(path, name) / (KITTI_UNITS if Path(path).suffix.lower() == ".png" else 1.0)
    (width, height), (rows, columns) = size, values.shape
    scale = width / columns
    if abs(height / (scale * rows) - 1.0) > 0.02:
        got = f"{path} of {columns}x{rows}"
        bad_value(name, f"a map of the shape of the left image, {width}x{height} pixels", got)
    nearest = [((np.arange(n) + 0.5) * m / n).astype(int) for n, m in ((height, rows), (width, columns))]
    disparity = values[np.ix_(*nearest)] * scale
    shift = disparity + rig.K_right[0, 2] - rig.K_left[0, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = rig.K_left[0, 0] * x / shift
    return np.where(np.isfinite(depth_m) & (shift > 0) & (disparity != 0), depth_m, 0.0).astype(np.float32)


def read_confidence(path: PathLike, name: str = "points_confidence") -> np.ndarray:
    """How far to rely on points: ``(N,)`` or ``(H, W)`` in [0, 1], from ``.npy``, ``.pfm``, or an image.

    Raises:
        OSError, ValueError: no such file.
    """
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


def _png_scale(path: Path, scale: float | None) -> float:
    if scale is not None:
        return scale
    if not KITTI_FOLDERS.search(str(path.parent)):
        return MILLIMETRES
    warn(
        f"{path} is read in KITTI's units of 1/256 m, as its folder's name says; "
        "give --points-scale 1000 (scale=1000) if it is in millimetres.",
        stacklevel=4,
    )
    return KITTI_UNITS


def _table(path: Path, name: str) -> np.ndarray:
    """Numbers of a text, one row a line, below one heading at most.

    The heading tells which columns are x, y and z if it has one word a column. The points of a COLMAP model
    are refused: they are in the frame and unit of the model, and the file tells neither.
    """
    rows = read_rows(path, name, KINDS)
    named = path.stem.lower() == COLMAP_STEM and rows and len(rows[0]) >= COLMAP_COLUMNS
    if named or COLMAP_MARK in read_text(path, name, KINDS):
        bad_value(
            name,
            "points in metres in the left camera's frame, one a line",
            f"{path}, the points of a COLMAP model, in its frame and unit",
            "Transform their X, Y and Z by the pose of the left image in images.txt, multiply them by the "
            "metres in a unit of the model, and save them alone.",
        )
    heading = rows.pop(0) if rows and not _is_number(rows[0][0]) else []
    lengths = sorted({len(row) for row in rows})
    if len(lengths) != 1:
        expected = "points in metres, one a line"
        bad_value(name, expected, f"{path} with rows of {lengths or 'no'} numbers")
    columns = _columns(heading, lengths[0], path, name)
    try:
        return np.array([[float(row[column]) for column in columns] for row in rows])
    except ValueError:
        bad_value(name, "rows of numbers, below one heading at most", f"{path} with words among them")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _columns(heading: list[str], count: int, path: Path, name: str) -> Sequence[int]:
    """Where a heading has x, y and z; all columns below a title, whose words are not as many as they are."""
    if len(heading) != count:
        return range(count)
    words = [re.sub(r"([_ ]?m|[_ ]?[\[(]m[\])])$", "", word.lower()) for word in heading]
    if any(words.count(axis) != 1 for axis in "xyz"):
        cure = "Write the points as x, y and z of the left camera, or the depths as a map of the left image."
        got = f"{path} with {', '.join(heading)}"
        bad_value(name, "points with columns x, y and z, in metres", got, cure)
    return [words.index(axis) for axis in "xyz"]


def _ply_head(data: bytes, path: Path, name: str) -> tuple[str, int, list[tuple[str, str]], int]:
    """Format, number of points, their properties as ``(name, type)``, and where the data begins."""
    end = data.find(b"end_header", 0, LONGEST_HEAD)
    begin = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or begin == 0:
        bad_value(name, "a PLY file", f"{path} without a PLY head", "Is it cut off, or another format?")
    kind, count, properties, element = "", 0, [], ""
    for line in data[:end].decode("latin-1").splitlines():
        match line.split():
            case ["format", kind, *_]:
                pass
            case ["element", element, number] if element == "vertex" and number.isdecimal():
                count = int(number[:12])
            case ["element", element, *_] if not count:
                bad_value(name, "a PLY file whose first element is vertex", f"{path} with {element!r} first")
            case ["property", of, axis] if element == "vertex" and of in PLY_TYPES:
                properties.append((axis, PLY_TYPES[of]))
            case ["property", *_] if element == "vertex":
                bad_value(name, "a PLY file whose points have plain properties", f"{path} with {line!r}")
    names = [key for key, _ in properties]
    plain = {"x", "y", "z"} <= set(names) and len(set(names)) == len(names)
    if kind not in PLY_ORDERS or not count or not plain:
        bad_value(name, "a PLY file with points (element vertex with x, y, z)", f"{path}, which has none")
    if count > MOST_POINTS:
        bad_value(name, f"at most {MOST_POINTS} points", f"{path} with {count}")
    return kind, count, properties, begin


def read_ply_points(path: Path, name: str = "points") -> np.ndarray:
    """The points ``(N, 3)`` float64 of a PLY file, ASCII or binary, in the file's unit and frame.

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
            expected = f"{count} points of {len(columns)} numbers"
            bad_value(name, expected, f"{path} with others", "Is it cut off?")
        return table[:, [columns.index(axis) for axis in "xyz"]]
    row = np.dtype([(key, PLY_ORDERS[kind] + code) for key, code in properties])
    if len(data) - begin < count * row.itemsize:
        got = f"{path} with {len(data) - begin} bytes of them"
        bad_value(name, f"{count} points of {row.itemsize} bytes", got, "Is it cut off?")
    table = np.frombuffer(data, dtype=row, count=count, offset=begin)
    return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _camera_from_velodyne(paths: Sequence[PathLike], name: str) -> np.ndarray:
    """``(4, 4)``: from the scanner's frame to that of the rectified left colour camera, which is camera 2."""
    rows: dict[str, np.ndarray] = {}
    for path in paths:
        for key, words in KITTI_ROW.findall(read_text(path, name, VELODYNE)):
            if all(_is_number(word) for word in words.split()):
                rows[key] = np.array(words.split(), dtype=np.float64)

    def matrix(keys: tuple[str, ...], height: int, width: int) -> np.ndarray:
        row = next((rows[key] for key in keys if key in rows), None)
        if row is None or row.size != height * width or not np.isfinite(row).all():
            bad_value(name, VELODYNE, f"files without {' or '.join(keys)} of {height * width} numbers")
        T = np.eye(4)
        T[:height, :width] = row.reshape(height, width)
        return T

    rectify = matrix(("R0_rect", "R_rect_00", "R_rect"), 3, 3)
    projection = matrix(("P2", "P_rect_02"), 3, 4)
    if "R" in rows and "T" in rows:
        moved = matrix(("R",), 3, 3)
        moved[:3, 3] = matrix(("T",), 3, 1)[:3, 0]
    else:
        moved = matrix(("Tr_velo_to_cam", "Tr_velo_cam"), 3, 4)
    beside = np.eye(4)  # camera 2 stands beside camera 0, in whose frame the rest is
    try:
        beside[:3, 3] = np.linalg.solve(projection[:3, :3], projection[:3, 3])
    except np.linalg.LinAlgError:
        bad_value(name, VELODYNE, "a P2 that is no projection")
    return beside @ rectify @ moved


def _velodyne(path: Path, calibration: Sequence[PathLike], name: str) -> np.ndarray:
    """The points of a scan (float32 x, y, z, reflectance) before the left camera, ``(N, 3)`` metres."""
    if not calibration:
        cure = "The scanner has a frame of its own: x forward, y left, z up."
        bad_value(f"{name}-calib", f"given with a .bin ({VELODYNE})", "nothing", cure)
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
