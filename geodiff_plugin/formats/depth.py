"""Reads known depths (maps, points, disparity), and writes maps completely or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from geodiff_plugin._internal.checks import bad_value, check_number
from geodiff_plugin._internal.strips import row_strips
from geodiff_plugin.formats.files import PathLike, check_file, open_image, read_npy, save_png
from geodiff_plugin.formats.maps import MAX_16_BITS, MM_PER_METRE, read_map_file, read_pfm
from geodiff_plugin.formats.out import atomic_path

if TYPE_CHECKING:  # which imports torch
    from geodiff_plugin.types import Rig

#: Units per metre, or per pixel of disparity, in a KITTI PNG.
KITTI_UNITS = 256.0
#: Maximum fraction of negative disparities; more indicate the opposite sign.
MAX_NEGATIVE = 0.5
#: Formats in which 0 means unknown.
IMAGE_SUFFIXES = (".png", ".tif", ".tiff")


def write_pfm(path: PathLike, values: np.ndarray) -> None:
    """Write ``(H, W)`` floats as a little-endian portable float map."""
    image = Image.fromarray(_check_map(values))
    with atomic_path(path) as temporary:
        image.save(temporary, format="PPM")  # Pillow writes floats as PFM


def _check_map(depth_m: np.ndarray) -> np.ndarray:
    depth_m = np.asarray(depth_m, dtype=np.float32)
    if depth_m.ndim != 2:
        bad_value("depth_m", "of shape (H, W)", f"shape {depth_m.shape}", "Pass one map: depth[0, ..., 0].")
    return depth_m


def write_depth_npy(path: PathLike, depth_m: np.ndarray) -> None:
    """Write a depth map ``(H, W)`` in metres as float32 ``.npy``."""
    depth_m = _check_map(depth_m)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:  # numpy appends .npy to file names
        np.save(file, depth_m, allow_pickle=False)


def depth_mm(depth_m: np.ndarray) -> np.ndarray:
    """Convert metres ``(H, W)`` to uint16 millimetres; 0 if not finite, below 0.5 mm or beyond 65.535 m."""
    depth_m = _check_map(depth_m)
    whole = np.empty(depth_m.shape, dtype=np.uint16)
    for rows in row_strips(*depth_m.shape):
        millimetres = np.rint(np.nan_to_num(depth_m[rows].astype(np.float64), posinf=0.0, neginf=0.0) * 1000)
        millimetres[(millimetres < 0) | (millimetres > MAX_16_BITS)] = 0
        whole[rows] = millimetres
    return whole


def write_depth_mm(path: PathLike, depth_m: np.ndarray) -> int:
    """Write ``depth_mm`` as a 16-bit PNG; return its number of zero pixels."""
    whole = depth_mm(depth_m)
    save_png(Image.fromarray(whole), path)
    return int((whole == 0).sum())


def sigma_mm(sigma_m: np.ndarray) -> np.ndarray:
    """Convert standard deviations in metres ``(H, W)`` to uint16 millimetres, 0 where they are not finite.

    They are rounded up, and 65535 stands for all larger values, so that none is understated.
    """
    sigma_m = _check_map(sigma_m)
    millimetres = np.ceil(sigma_m.astype(np.float64) * MM_PER_METRE).clip(1, MAX_16_BITS)
    return np.where(np.isfinite(sigma_m), millimetres, 0).astype(np.uint16)


def write_sigma_mm(path: PathLike, sigma_m: np.ndarray) -> None:
    """Write ``sigma_mm`` as a 16-bit PNG."""
    save_png(Image.fromarray(sigma_mm(sigma_m)), path)


def read_depth_png(
    path: PathLike, units_per_m: float = 1000.0, name: str = "depth"
) -> tuple[np.ndarray, np.ndarray]:
    """Read a 16-bit PNG as ``(H, W)`` float32 in metres or pixels, and its mask of nonzero pixels."""
    with open_image(path, name, "a 16-bit PNG file") as image:
        mode = image.mode
        values = np.asarray(image)
    if not mode.startswith("I"):
        hint = "An 8-bit copy does not contain the values."
        bad_value(name, "a 16-bit grey PNG file", f"{path} of mode {mode}", hint)
    return values.astype(np.float32) / np.float32(units_per_m), values > 0


def read_measured(
    path: PathLike, per_m: float | None = None, name: str = "depth"
) -> tuple[np.ndarray, np.ndarray]:
    """Read a sensor's depth map as ``(H, W)`` float32 metres, with its mask of known pixels.

    ``per_m`` is the number of file units per metre; ``None`` for floats in metres or integers in millimetres.
    Reads 16-bit PNG, ``.npy``, TIFF, PFM and EXR; the 16-bit value 65535 is unknown, as in 7-Scenes.
    """
    values = read_map_file(path, name)
    whole = values.dtype.kind in "iu"
    known = np.isfinite(values) & (values > 0)
    if values.dtype == np.uint16:
        known &= values < MAX_16_BITS  # cameras write it for unknown depth
    units = per_m or (MM_PER_METRE if whole else 1.0)
    return np.where(known, values, 0).astype(np.float32) / np.float32(units), known


def read_map(path: PathLike, name: str = "map") -> np.ndarray:
    """Read the ``(H, W)`` map of a depth model, in its own unit and space; NaN where unknown."""
    values = read_map_file(path, name)
    known = np.isfinite(values) & ((values > 0) | (Path(path).suffix.lower() not in IMAGE_SUFFIXES))
    return np.where(known, values.astype(np.float32) if values.dtype.kind in "iu" else values, np.nan)


def read_confidence(path: PathLike, name: str = "points_confidence") -> np.ndarray:
    """Read confidence of points, ``(N,)`` or ``(H, W)`` in [0, 1], from ``.npy``, ``.pfm`` or an image."""
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
    """Return the baseline of a rectified rig; raise an error for others."""
    others = E - np.eye(4)
    others[0, 3] = 0.0
    if E[0, 3] <= 0 or np.abs(others).max() > 1e-3 * max(E[0, 3], 1.0):
        hint = "Disparity needs a right camera to the right, and matches along rows."
        bad_value(name, "of a rectified pair", got, hint)
    return float(E[0, 3])


def disparity_of_depth(
    depth_m: np.ndarray, K_left: np.ndarray, K_right: np.ndarray, E: np.ndarray
) -> np.ndarray:
    """Compute disparity in pixels of a rectified rig, ``fx baseline / Z - doffs``; infinity where unknown."""
    shift = K_left[0, 0] * _baseline(E, "a submission", "a pair with a different pose")
    known = np.isfinite(depth_m) & (depth_m > 0)
    inverse = np.where(known, 1.0 / np.where(known, depth_m, 1.0), np.inf)
    return (shift * inverse - (K_right[0, 2] - K_left[0, 2])).astype(np.float32)


def _units_per_px(path: PathLike, per_px: float | None, name: str) -> float:
    """Return ``per_px``, or the default of the file type; integers in other types than PNG have none."""
    if per_px is not None:
        return float(check_number(per_px, f"{name}: units per pixel", 1e-9, 1e9))
    if Path(path).suffix.lower() == ".png":
        return KITTI_UNITS
    kind = read_map_file(path, name).dtype
    if kind.kind in "iu":
        hint = "For OpenCV's StereoBM and StereoSGBM (16 times the disparity) pass --points-scale 16."
        bad_value(name, "in pixels as floats", f"{path} of {kind}", hint)
    return 1.0


def _check_sign(disparity: np.ndarray, name: str, path: PathLike) -> None:
    """Raise an error if most disparities are negative; a few may mark unknown pixels."""
    known = disparity[np.isfinite(disparity) & (disparity != 0)]
    if len(known) and (known < 0).mean() > MAX_NEGATIVE:
        expected = "positive (column in the left image minus column in the right image)"
        hint = "For right minus left (ZED), save -disparity."
        bad_value(name, expected, f"{path} from {known.min():.4g} to {known.max():.4g}", hint)


def depth_of_disparity(
    path: PathLike,
    rig: Rig,
    size: tuple[int, int],
    name: str = "disparity",
    *,
    per_px: float | None = None,
) -> np.ndarray:
    """Convert a disparity map to depths ``(H, W)``, metres, ``fx baseline / (d + doffs)``; 0 where unknown.

    Disparity is the left column minus the right column of the same point. ``per_px`` is the number of file
    units per pixel: 256 for KITTI's PNG (default for PNG), 16 for OpenCV's matchers. The map may have another
    resolution; ``rig`` is rectified, its K for images of ``size``.
    """
    baseline_m = _baseline(rig.E, name, f"the rig of {rig.source}")
    if rig.unit is None:
        bad_value(name, "used with a rig in metres", f"the rig of {rig.source}, which has no unit")
    values = read_map(path, name) / _units_per_px(path, per_px, name)
    _check_sign(values, name, path)
    (width, height), (rows, columns) = size, values.shape
    scale = width / columns
    if abs(height / (scale * rows) - 1.0) > 0.02:
        got = f"{path} of {columns}x{rows}"
        bad_value(name, f"a map with the aspect ratio of the left image, {width}x{height} pixels", got)
    nearest = [((np.arange(n) + 0.5) * m / n).astype(int) for n, m in ((height, rows), (width, columns))]
    disparity = values[np.ix_(*nearest)] * scale
    shift = disparity + rig.K_right[0, 2] - rig.K_left[0, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = rig.K_left[0, 0] * baseline_m / shift
    known = np.isfinite(depth_m) & (shift > 0) & (disparity != 0)
    return np.where(known, depth_m, 0.0).astype(np.float32)
