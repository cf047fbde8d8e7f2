"""Depth and disparity maps: PFM, npy, 16-bit PNG in millimetres or KITTI's 1/256; strips of large maps."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Iterator

import numpy as np
from PIL import Image

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import check_file, read_npy
from geodiff_plugin.formats.out import atomic_path

__all__ = [
    *("STRIP_PIXELS", "depth_mm", "read_depth_mm_png", "read_depth_png", "read_disparity_kitti_png"),
    *("read_map", "read_pfm", "row_strips", "write_depth_mm", "write_depth_npy", "write_pfm"),
]

PathLike = str | os.PathLike[str]
LARGEST_MM = 65535
#: Pixels of a strip: a map of float64 of so many is 8 MB.
STRIP_PIXELS = 1 << 20
#: What depth models are read from.
MAP_FILES = "a map (H, W) as .npy, .npz, .pfm or 16-bit .png"


def row_strips(height: int, width: int) -> Iterator[slice]:
    """Slices of at most ``STRIP_PIXELS`` pixels, or one row, that cover all rows: arrays stay small."""
    rows = max(1, STRIP_PIXELS // max(1, width))
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))


def read_pfm(path: PathLike, name: str = "map") -> np.ndarray:
    """Read a portable float map.

    Returns:
        ``(H, W)`` or ``(H, W, 3)`` float32, top row first (the file has the bottom row first); infinity and
        0, which data sets use for "unknown", stay as they are.

    Raises:
        OSError, ValueError: no readable file, not a PFM, or cut off; ``name`` is the argument in the message.
    """
    file = check_file(path, name, "a PFM file")
    with open(file, "rb") as stream:
        kind = stream.readline(8).strip()
        try:
            width, height = (int(word) for word in stream.readline(64).split())
            scale = float(stream.readline(64))
        except ValueError:
            kind, width, height, scale = b"", 0, 0, 0.0
        data = stream.read()
    if kind not in (b"Pf", b"PF") or min(width, height) < 1:
        expected = "a PFM file (Pf or PF, size, scale)"
        bad_value(name, expected, f"{file}, whose head is another", "Is it a PNG or npy?")
    shape = (height, width) if kind == b"Pf" else (height, width, 3)
    count = int(np.prod(shape))
    if len(data) < 4 * count:
        expected = f"a whole PFM file of {4 * count} bytes of data"
        bad_value(name, expected, f"{file} with {len(data)}", "Is it cut off?")
    values = np.frombuffer(data, dtype="<f4" if scale < 0 else ">f4", count=count)
    return np.flipud(values.reshape(shape)).astype(np.float32)


def write_pfm(path: PathLike, values: np.ndarray) -> None:
    """Write ``(H, W)`` or ``(H, W, 3)`` floats as a little-endian portable float map, whole or not at all.

    Raises:
        ValueError: another shape.
        OSError: the folder does not exist or is not writable.
    """
    values = np.asarray(values, dtype="<f4")
    if values.ndim != 2 and not (values.ndim == 3 and values.shape[-1] == 3):
        bad_value("values", "of shape (H, W) or (H, W, 3)", f"shape {values.shape}")
    kind = b"Pf" if values.ndim == 2 else b"PF"
    with atomic_path(path) as temporary:
        head = b"%s\n%d %d\n-1.0\n" % (kind, values.shape[1], values.shape[0])
        temporary.write_bytes(head + np.flipud(values).tobytes())


def _check_map(depth_m: np.ndarray) -> np.ndarray:
    depth_m = np.asarray(depth_m, dtype=np.float32)
    if depth_m.ndim != 2:
        bad_value("depth_m", "of shape (H, W)", f"shape {depth_m.shape}", "Take one map: depth[0, ..., 0].")
    return depth_m


def write_depth_npy(path: PathLike, depth_m: np.ndarray) -> None:
    """Write ``(H, W)`` metres as float32 ``.npy``, whole or not at all.

    Raises:
        ValueError: another shape.
        OSError: the folder does not exist or is not writable.
    """
    depth_m = _check_map(depth_m)
    # An open file, since numpy appends .npy to a name that lacks it.
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.save(file, depth_m, allow_pickle=False)


def depth_mm(depth_m: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """Depth as whole millimetres of 16 bits, as ROS' ``16UC1`` images and RGB-D data sets have it.

    ``depth_m`` is ``(H, W)`` metres, ``valid`` boolean of that shape; the result is ``(H, W)`` uint16, 0
    where not valid, not finite, under half a millimetre or beyond 65.535 m.

    Raises:
        ValueError: another shape.
    """
    depth_m = _check_map(depth_m)
    keep = np.isfinite(depth_m) if valid is None else np.isfinite(depth_m) & np.asarray(valid, dtype=bool)
    whole = np.empty(depth_m.shape, dtype=np.uint16)
    for rows in row_strips(*depth_m.shape):
        millimetres = np.rint(np.where(keep[rows], depth_m[rows], 0.0).astype(np.float64) * 1000.0)
        millimetres[(millimetres < 0) | (millimetres > LARGEST_MM)] = 0
        whole[rows] = millimetres
    return whole


def write_depth_mm(path: PathLike, depth_m: np.ndarray, valid: np.ndarray | None = None) -> int:
    """Write ``depth_mm`` as a 16-bit PNG, whole or not at all; returns how many of its pixels are 0.

    Raises:
        ValueError: another shape.
        OSError: the folder does not exist or is not writable.
    """
    whole = depth_mm(depth_m, valid)
    with atomic_path(path) as temporary:
        Image.fromarray(whole).save(temporary, format="PNG")
    return int((whole == 0).sum())


def read_depth_png(path: PathLike, units_per_m: float, name: str = "depth") -> tuple[np.ndarray, np.ndarray]:
    """Read a 16-bit PNG of depth or disparity with so many units in a metre or pixel (KITTI has 256).

    Returns:
        ``(H, W)`` float32 metres (or pixels), and the ``(H, W)`` boolean mask of where it is known (not 0).

    Raises:
        OSError, ValueError: no readable file, not a 16-bit PNG, or cut off.
    """
    file = check_file(path, name, "a 16-bit PNG file")
    try:
        with Image.open(file) as image:
            image.load()
            mode, values = image.mode, np.asarray(image)
    except (OSError, SyntaxError, ValueError, EOFError, zlib.error, Image.DecompressionBombError) as error:
        got = f"{file}, which does not decode ({error})"
        bad_value(name, "a whole 16-bit PNG file", got, "Is it cut off?")
    if not mode.startswith("I"):
        cure = "An 8-bit copy has lost the values."
        bad_value(name, "a 16-bit grey PNG file", f"{file} of mode {mode}", cure)
    return values.astype(np.float32) / np.float32(units_per_m), values > 0


def read_disparity_kitti_png(path: PathLike, name: str = "disparity") -> tuple[np.ndarray, np.ndarray]:
    """Read KITTI's 16-bit PNG of disparity * 256, in pixels; otherwise as ``read_depth_png``."""
    return read_depth_png(path, 256.0, name)


def read_depth_mm_png(path: PathLike, name: str = "depth") -> tuple[np.ndarray, np.ndarray]:
    """Read a 16-bit PNG of millimetres, as metres; otherwise as ``read_depth_png``."""
    return read_depth_png(path, 1000.0, name)


def read_map(path: PathLike, name: str = "map") -> np.ndarray:
    """Read the map of a depth model, in whatever unit and space it is.

    Args:
        path: ``.npy``; ``.npz`` with ``depth``, or a single array; ``.pfm``; or a 16-bit ``.png``. Axes of
            length 1 are dropped.
        name: the argument that it came in, for messages.

    Returns:
        ``(H, W)`` as in the file; NaN where it is not finite, and where a PNG has 0.

    Raises:
        OSError, ValueError: no readable file, another kind of it, or more than one map.
    """
    file = check_file(path, name, MAP_FILES)
    kind = file.suffix.lower()
    if kind == ".png":
        values, valid = read_depth_png(file, 1.0, name)
        values = np.where(valid, values, np.nan)
    elif kind == ".npz":
        try:
            with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
                values = archive["depth" if "depth" in archive.files else " ".join(archive.files)]
        except (OSError, ValueError, EOFError, KeyError, zlib.error, zipfile.BadZipFile) as error:
            bad_value(name, "an .npz with 'depth' or a single array", f"{file} ({error})")
    else:
        values = read_pfm(file, name) if kind == ".pfm" else read_npy(file, name, MAP_FILES)
    values = np.squeeze(values)
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        bad_value(name, MAP_FILES, f"{file} of shape {values.shape}", "Save one map of the left image.")
    return np.where(np.isfinite(values), values, np.nan)
