"""Depth and disparity maps: PFM, npy, 16-bit PNG; one from the other; strips of large maps."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import check_file, open_image, read_npy
from geodiff_plugin.formats.out import atomic_path

if TYPE_CHECKING:  # which imports torch
    from geodiff_plugin.types import Rig

PathLike = str | os.PathLike[str]
LARGEST_MM, KITTI_UNITS = 65535, 256.0
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
    """The ``(H, W)`` float32 of a grey portable float map, top row first, unlike the file.

    Infinity and 0, which data sets use for "unknown", stay as they are.
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
    if kind != b"Pf" or min(width, height) < 1:
        expected = "a grey PFM file (Pf, size, scale)"
        bad_value(name, expected, f"{file}, whose head is another", "Is it a PNG or npy?")
    size = 4 * width * height
    if len(data) < size:
        got = f"{file} with {len(data)}"
        bad_value(name, f"a whole PFM file of {size} bytes of data", got, "Is it cut off?")
    values = np.frombuffer(data[:size], dtype="<f4" if scale < 0 else ">f4")
    return np.flipud(values.reshape(height, width)).astype(np.float32)


def write_pfm(path: PathLike, values: np.ndarray) -> None:
    """Write ``(H, W)`` floats as a little-endian portable float map, whole or not at all."""
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
    """Write a depth map ``(H, W)`` in metres as float32 ``.npy``, whole or not at all."""
    depth_m = _check_map(depth_m)
    # An open file, since numpy appends .npy to a name that lacks it.
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.save(file, depth_m, allow_pickle=False)


def depth_mm(depth_m: np.ndarray) -> np.ndarray:
    """Metres ``(H, W)`` as whole millimetres of 16 bits, as ROS' ``16UC1`` and RGB-D data sets have it.

    0 where not finite, under half a millimetre or beyond 65.535 m.
    """
    depth_m = _check_map(depth_m)
    whole = np.empty(depth_m.shape, dtype=np.uint16)
    for rows in row_strips(*depth_m.shape):
        millimetres = np.rint(np.nan_to_num(depth_m[rows].astype(np.float64), posinf=0.0, neginf=0.0) * 1000)
        millimetres[(millimetres < 0) | (millimetres > LARGEST_MM)] = 0
        whole[rows] = millimetres
    return whole


def write_depth_mm(path: PathLike, depth_m: np.ndarray) -> int:
    """Write ``depth_mm`` as a 16-bit PNG, whole or not at all; returns how many of its pixels are 0."""
    whole = depth_mm(depth_m)
    with atomic_path(path) as temporary:
        Image.fromarray(whole).save(temporary, format="PNG")
    return int((whole == 0).sum())


def read_depth_png(
    path: PathLike, units_per_m: float = 1000.0, name: str = "depth"
) -> tuple[np.ndarray, np.ndarray]:
    """Depth or disparity of a 16-bit PNG with so many units in a metre or pixel (KITTI has 256).

    ``(H, W)`` float32 metres or pixels, and the ``(H, W)`` boolean mask of where it is known, which is not 0.
    """
    with open_image(path, name, "a 16-bit PNG file") as image:
        mode, values = image.mode, np.asarray(image)
    if not mode.startswith("I"):
        cure = "An 8-bit copy has lost the values."
        bad_value(name, "a 16-bit grey PNG file", f"{path} of mode {mode}", cure)
    return values.astype(np.float32) / np.float32(units_per_m), values > 0


def read_map(path: PathLike, name: str = "map") -> np.ndarray:
    """The ``(H, W)`` map of a depth model, in whatever unit and space it is.

    A file ``.npy``; ``.npz`` with ``depth``, or a single array; ``.pfm``; or a 16-bit ``.png``. Axes of
    length 1 are dropped. NaN where it is not finite, and where a PNG has 0.
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
    """Disparity in pixels of a rectified rig, ``fx baseline / Z - doffs``; infinity where depth is unknown.

    ``depth_m`` is ``(H, W)`` in the unit of ``E``; the intrinsics are in its pixels.
    """
    shift = K_left[0, 0] * _baseline(E, "a submission", "a pair with another pose")
    known = np.isfinite(depth_m) & (depth_m > 0)
    inverse = np.where(known, 1.0 / np.where(known, depth_m, 1.0), np.inf)
    return (shift * inverse - (K_right[0, 2] - K_left[0, 2])).astype(np.float32)


def depth_of_disparity(
    path: PathLike, rig: Rig, size: tuple[int, int], name: str = "disparity"
) -> np.ndarray:
    """Depths ``(H, W)``, metres, by a disparity map of the left image, from a stereo network or a sensor.

    The map, of ``read_map``, may be one of the image scaled: its disparities grow with its width, and every
    pixel takes the nearest. A PNG holds 256 units a pixel, as KITTI's. ``rig`` is rectified, in metres, its K
    for images of ``size``, ``(width, height)``. The depth is ``fx baseline / (d + doffs)``; 0 where the
    disparity is not finite or 0, or nothing is in front of the cameras.
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
