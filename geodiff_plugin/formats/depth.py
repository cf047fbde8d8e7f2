"""Known depths: maps, points, disparity; written maps are there whole or not at all; strips of maps."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from geodiff_plugin._camera_checks import check_metres
from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin.formats.files import PathLike, check_file, open_image, read_npy, read_rows
from geodiff_plugin.formats.out import atomic_path

if TYPE_CHECKING:  # which imports torch
    from geodiff_plugin.types import Rig

LARGEST_MM, MILLIMETRES, KITTI_UNITS = 65535, 1000.0, 256.0
#: Pixels of a strip: a map of float64 of so many is 8 MB.
STRIP_PIXELS = 1 << 20
MAP_FILES = "a map (H, W) as .npy, .npz, .pfm or 16-bit .png"
KINDS = "a 16-bit PNG (mm), a .pfm or .npy map, or points as .npy, text or .ply, in metres"
COLUMNS = (3, 4, 6)  # x y z, with an intensity, or with a colour
NUMBER = re.compile(r"[-+]?(\d.*|\..*|nan|inf)", re.IGNORECASE)


def row_strips(height: int, width: int) -> Iterator[slice]:
    """Slices of at most ``STRIP_PIXELS`` pixels, or one row, that cover all rows: arrays stay small."""
    rows = max(1, STRIP_PIXELS // max(1, width))
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))


def read_pfm(path: PathLike, name: str = "map") -> np.ndarray:
    """The ``(H, W)`` float32 of a grey portable float map, top row first, unlike the file."""
    file = check_file(path, name, "a PFM file")
    with open(file, "rb") as stream:
        kind = stream.readline(8).strip()
        try:
            width, height = (int(word) for word in stream.readline(64).split())
            scale = float(stream.readline(64))
        except ValueError:
            kind, width, height, scale = b"", 0, 0, 0.0
        data = stream.read()
    if kind != b"Pf" or min(width, height) < 1 or len(data) < 4 * width * height:
        bad_value(name, "a whole grey PFM file (Pf, size, scale)", file, "Is it cut off, or a PNG or npy?")
    values = np.frombuffer(data, dtype="<f4" if scale < 0 else ">f4", count=width * height)
    return np.flipud(values.reshape(height, width)).astype(np.float32)


def write_pfm(path: PathLike, values: np.ndarray) -> None:
    """Write ``(H, W)`` floats as a little-endian portable float map."""
    values = _check_map(values)
    with atomic_path(path) as temporary:
        head = f"Pf\n{values.shape[1]} {values.shape[0]}\n-1.0\n".encode()
        temporary.write_bytes(head + np.flipud(values).astype("<f4").tobytes())


def _check_map(depth_m: np.ndarray) -> np.ndarray:
    depth_m = np.asarray(depth_m, dtype=np.float32)
    if depth_m.ndim != 2:
        bad_value("depth_m", "of shape (H, W)", f"shape {depth_m.shape}", "Take one map: depth[0, ..., 0].")
    return depth_m


def write_depth_npy(path: PathLike, depth_m: np.ndarray) -> None:
    """Write a depth map ``(H, W)`` in metres as float32 ``.npy``."""
    depth_m = _check_map(depth_m)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:  # to a name, numpy appends .npy
        np.save(file, depth_m, allow_pickle=False)


def depth_mm(depth_m: np.ndarray) -> np.ndarray:
    """Metres ``(H, W)`` as uint16 millimetres; 0 where not finite, under 0.5 mm or beyond 65.535 m."""
    depth_m = _check_map(depth_m)
    whole = np.empty(depth_m.shape, dtype=np.uint16)
    for rows in row_strips(*depth_m.shape):
        millimetres = np.rint(np.nan_to_num(depth_m[rows].astype(np.float64), posinf=0.0, neginf=0.0) * 1000)
        millimetres[(millimetres < 0) | (millimetres > LARGEST_MM)] = 0
        whole[rows] = millimetres
    return whole


def write_depth_mm(path: PathLike, depth_m: np.ndarray) -> int:
    """Write ``depth_mm`` as a 16-bit PNG; returns how many of its pixels are 0."""
    whole = depth_mm(depth_m)
    with atomic_path(path) as temporary:
        Image.fromarray(whole).save(temporary, format="PNG")
    return int((whole == 0).sum())


def read_depth_png(
    path: PathLike, units_per_m: float = 1000.0, name: str = "depth"
) -> tuple[np.ndarray, np.ndarray]:
    """``(H, W)`` float32 of a 16-bit PNG with so many units a metre or pixel, and where it is not 0."""
    with open_image(path, name, "a 16-bit PNG file") as image:
        mode, values = image.mode, np.asarray(image)
    if not mode.startswith("I"):
        cure = "An 8-bit copy has lost the values."
        bad_value(name, "a 16-bit grey PNG file", f"{path} of mode {mode}", cure)
    return values.astype(np.float32) / np.float32(units_per_m), values > 0


def read_map(path: PathLike, name: str = "map") -> np.ndarray:
    """The ``(H, W)`` map of a depth model, in its own unit and space; NaN where unknown."""
    file = check_file(path, name, MAP_FILES)
    kind = file.suffix.lower()
    if kind == ".png":
        values, valid = read_depth_png(file, 1.0, name)
        values = np.where(valid, values, np.nan)
    elif kind == ".npz":
        try:
            with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
                values = archive["depth" if "depth" in archive.files else " ".join(archive.files)]
        except Exception as error:  # of any kind that a damaged file leads to
            bad_value(name, "an .npz with 'depth' or a single array", f"{file} ({error})")
    else:
        values = read_pfm(file, name) if kind == ".pfm" else read_npy(file, name, MAP_FILES)
    values = np.squeeze(values)
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        bad_value(name, MAP_FILES, f"{file} of shape {values.shape}", "Save one map of the left image.")
    return np.where(np.isfinite(values), values, np.nan)


def read_points(path: PathLike, name: str = "points", *, scale: float | None = None) -> np.ndarray:
    """Read known depths of the left image: ``(H, W)`` float32 metres, 0 where unknown, or ``(N, 3)``.

    Points are in the left camera's frame: ``.npy`` or text of 3, 4 or 6 columns, or with a heading that names
    x, y and z; ``.ply``. ``scale`` is the units of the file in a metre: 1000 for millimetres, 256 for
    KITTI's PNG.
    """
    file = check_file(path, name, "a file of known depths")
    if scale is not None:
        check_number(scale, f"{name}-scale", 1e-9, 1e9)
    kind = file.suffix.lower()
    if kind == ".png":
        return read_depth_png(file, scale or MILLIMETRES, name)[0]
    if kind == ".npy":
        values = read_npy(file, name, KINDS)
    else:
        values = {".pfm": read_pfm, ".ply": read_ply_points}.get(kind, _table)(file, name)
    if values.ndim != 2 or 0 in values.shape:
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
    lengths = {len(row) for row in rows}
    if lengths == {len(heading)}:  # a word a column
        words = [re.sub(r"([_ ]?m|[_ ]?[\[(]m[\])])$", "", word.lower()) for word in heading]
        if any(words.count(axis) != 1 for axis in "xyz"):
            cure = "Write the points as x, y and z of the left camera, or depths as a map of the left image."
            got = f"{path} with {', '.join(heading)}"
            bad_value(name, "points with columns x, y and z, in metres", got, cure)
        rows = [[row[words.index(axis)] for axis in "xyz"] for row in rows]
    with suppress(ValueError):  # words, or rows of several lengths
        return np.array(rows, dtype=np.float64).reshape(len(rows), -1)
    got = f"{path} with words, or rows of {sorted(lengths)} numbers"
    bad_value(name, "points in metres, one a line, below one heading at most", got)


def read_ply_points(path: Path, name: str = "points") -> np.ndarray:
    """The points ``(N, 3)`` float64 of a PLY file, ASCII or binary, in the file's unit and frame."""
    import trimesh

    count = re.search(rb"\nelement vertex (\d+)\s", path.read_bytes())
    try:
        how: dict[str, Any] = {"process": False, "skip_materials": True, "fix_texture": False}
        cloud: Any = trimesh.load(path, file_type="ply", **how)
        points = np.array(cloud.vertices, np.float64)
    except Exception:  # of any kind that a damaged file leads to
        points = np.empty((0, 3))
    if count is None or not 0 < int(count.group(1)) == len(points):
        expected = "a whole PLY file whose vertices have x, y and z"
        bad_value(name, expected, path, "Is it cut off, or another format?")
    return points


def _baseline(E: np.ndarray, name: str, got: str) -> float:
    """Distance of the cameras of a rectified rig; others are refused."""
    others = E - np.eye(4)
    others[0, 3] = 0.0
    if E[0, 3] <= 0 or np.abs(others).max() > 1e-3 * max(E[0, 3], 1.0):
        cure = "Its right camera stands to the right, and a disparity goes along rows."
        bad_value(name, "of a rectified pair", got, cure)
    return float(E[0, 3])


def disparity_of_depth(
    depth_m: np.ndarray, K_left: np.ndarray, K_right: np.ndarray, E: np.ndarray
) -> np.ndarray:
    """Disparity in pixels of a rectified rig, ``fx baseline / Z - doffs``; infinity where unknown."""
    shift = K_left[0, 0] * _baseline(E, "a submission", "a pair with another pose")
    known = np.isfinite(depth_m) & (depth_m > 0)
    inverse = np.where(known, 1.0 / np.where(known, depth_m, 1.0), np.inf)
    return (shift * inverse - (K_right[0, 2] - K_left[0, 2])).astype(np.float32)


def depth_of_disparity(
    path: PathLike, rig: Rig, size: tuple[int, int], name: str = "disparity"
) -> np.ndarray:
    """Depths ``(H, W)``, metres, ``fx baseline / (d + doffs)``, of a disparity map; 0 where unknown.

    The map may be one of the image scaled; ``rig`` is rectified, its K for images of ``size``.
    """
    baseline_m = _baseline(rig.E, name, f"the rig of {rig.source}")
    if rig.unit is None:
        bad_value(name, "of a rig in metres", f"the rig of {rig.source}, which has no unit")
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
        depth_m = rig.K_left[0, 0] * baseline_m / shift
    return np.where(np.isfinite(depth_m) & (shift > 0) & (disparity != 0), depth_m, 0.0).astype(np.float32)
