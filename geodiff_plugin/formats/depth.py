"""Known depths: maps, points, disparity; written maps are there whole or not at all; strips of maps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin._strips import row_strips
from geodiff_plugin.formats.files import PathLike, check_file, open_image, read_npy, save_png
from geodiff_plugin.formats.maps import read_map_file, read_pfm
from geodiff_plugin.formats.out import atomic_path

if TYPE_CHECKING:  # which imports torch
    from geodiff_plugin.types import Rig

#: The largest value of 16 bits; cameras write it where they know nothing.
LARGEST_MM = 65535
#: Units of a metre in a depth map of whole numbers.
MILLIMETRES = 1000.0
#: Units of a metre, or of a pixel of disparity, in a PNG of KITTI.
KITTI_UNITS = 256.0
#: Disparities of which this share is negative have another sign.
MOST_NEGATIVE = 0.5
#: Maps of these are 0 where unknown.
PICTURES = (".png", ".tif", ".tiff")


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
        save_png(Image.fromarray(whole), temporary)
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


def read_measured(
    path: PathLike, per_m: float | None = None, name: str = "depth"
) -> tuple[np.ndarray, np.ndarray]:
    """``(H, W)`` float32 metres of a depth map of a sensor, and where it is known.

    ``per_m`` is how many units of the file a metre has; ``None`` for floats in metres and whole millimetres.
    16-bit PNG, ``.npy``, TIFF, PFM and EXR are read; 65535 of 16 bits is unknown, as 7-Scenes writes it.
    """
    values = read_map_file(path, name)
    whole = values.dtype.kind in "iu"
    known = np.isfinite(values) & (values > 0)
    if values.dtype == np.uint16:
        known &= values < LARGEST_MM
    units = per_m or (MILLIMETRES if whole else 1.0)
    return np.where(known, values, 0).astype(np.float32) / np.float32(units), known


def read_map(path: PathLike, name: str = "map") -> np.ndarray:
    """The ``(H, W)`` map of a depth model, in its own unit and space; NaN where unknown."""
    values = read_map_file(path, name)
    known = np.isfinite(values) & ((values > 0) | (Path(path).suffix.lower() not in PICTURES))
    return np.where(known, values.astype(np.float32) if values.dtype.kind in "iu" else values, np.nan)


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


def _units_per_px(path: PathLike, per_px: float | None, name: str) -> float:
    """``per_px``, or what the kind of file says; whole numbers that are no PNG say nothing."""
    if per_px is not None:
        return float(check_number(per_px, f"{name}: units per pixel", 1e-9, 1e9))
    if Path(path).suffix.lower() == ".png":
        return KITTI_UNITS
    kind = read_map_file(path, name).dtype
    if kind.kind in "iu":
        cure = "Those of OpenCV's StereoBM and StereoSGBM are 16 times the disparity: give --points-scale 16."
        bad_value(name, "in pixels as floats", f"{path} of {kind}", cure)
    return 1.0


def _check_sign(disparity: np.ndarray, name: str, path: PathLike) -> None:
    """Refuse disparities of which most are negative; a few mark what is unknown."""
    known = disparity[np.isfinite(disparity) & (disparity != 0)]
    if len(known) and (known < 0).mean() > MOST_NEGATIVE:
        expected = "above 0: the column in the left image minus that in the right one"
        cure = "Right minus left, as ZED's, is the negative of it: save -disparity."
        bad_value(name, expected, f"{path} from {known.min():.4g} to {known.max():.4g}", cure)


def depth_of_disparity(
    path: PathLike,
    rig: Rig,
    size: tuple[int, int],
    name: str = "disparity",
    *,
    per_px: float | None = None,
) -> np.ndarray:
    """Depths ``(H, W)``, metres, ``fx baseline / (d + doffs)``, of a disparity map; 0 where unknown.

    A disparity is a left column minus that of the same point in the right image. ``per_px`` is how many units
    of the file a pixel has: 256 for KITTI's PNG, the default for one, 16 for OpenCV's matchers. The map may
    be one of the image scaled; ``rig`` is rectified, its K for images of ``size``.
    """
    baseline_m = _baseline(rig.E, name, f"the rig of {rig.source}")
    if rig.unit is None:
        bad_value(name, "of a rig in metres", f"the rig of {rig.source}, which has no unit")
    values = read_map(path, name) / _units_per_px(path, per_px, name)
    _check_sign(values, name, path)
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
    known = np.isfinite(depth_m) & (shift > 0) & (disparity != 0)
    return np.where(known, depth_m, 0.0).astype(np.float32)
