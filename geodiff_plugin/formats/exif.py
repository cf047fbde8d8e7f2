"""Camera matrices from EXIF data, or from a field of view."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin._checks import InputError, bad_value, check_number, warn
from geodiff_plugin.formats.files import open_image
from geodiff_plugin.formats.rigs import intrinsics

_ORIENTATION, _IFD, _FOCAL, _FOCAL_35, _ZOOM = 0x0112, 0x8769, 0x920A, 0xA405, 0xA404
_WIDTH, _HEIGHT, _X_RESOLUTION, _Y_RESOLUTION, _UNIT = 0xA002, 0xA003, 0xA20E, 0xA20F, 0xA210
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
#: Diagonal of a 35 mm frame, which equivalent focal lengths are compared by.
_DIAGONAL_35_MM = math.hypot(36.0, 24.0)
#: A focal length further off its EXIF than this factor is of an image of another size: EXIF is known to a few
#: per cent, and rectification or a lens that was straightened changes it by less.
_OTHER_LENS = 1.4
#: Sides may be rounded by this share before an image counts as cropped.
_SAME_SHAPE = 0.01
CURES = "Give K (--fx --fy --cx --cy or --K), a field of view (--fov), or photographs with their EXIF."


def intrinsics_from_fov(fov_deg: float, size: tuple[int, int]) -> np.ndarray:
    """K of a camera with square pixels and its principal point in the middle; ``fov_deg`` is horizontal."""
    check_number(fov_deg, "fov", 1.0, 170.0)
    focal = size[0] / 2 / math.tan(math.radians(fov_deg) / 2)
    return intrinsics(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)


def intrinsics_from_exif(
    source: str | os.PathLike[str] | Image.Image, name: str
) -> tuple[np.ndarray, list[str]]:
    """K of a photograph: of a file for its upright pixels, of an image in memory for its pixels as they lie.

    A focal length in 35 mm equivalent is taken by the diagonal; else a focal length in mm with the resolution
    of the sensor. Both are known to a few per cent.

    Returns K ``(3, 3)`` in pixels, and sentences about what was assumed; refuses an image without a focal
    length, or one that was cropped since.
    """
    if isinstance(source, Image.Image):
        return _of(source, name)
    with open_image(source, name) as image:
        K, notes = _of(image, name)
        turned = image.getexif().get(_ORIENTATION) in (5, 6, 7, 8)
    return intrinsics(K[1, 1], K[0, 0], K[1, 2], K[0, 2]) if turned else K, notes


def warn_of_other_lens(source: str | os.PathLike[str] | Image.Image, K: np.ndarray, name: str) -> None:
    """Warn of a focal length that contradicts the image's own EXIF, which two rectified views cannot tell.

    Nothing is said of an image without a focal length, or one that was cropped or zoomed digitally.
    """
    try:
        theirs, notes = intrinsics_from_exif(source, name)
    except InputError:
        return
    factor = K[0, 0] / theirs[0, 0]
    if len(notes) > 1 or max(factor, 1 / factor) < _OTHER_LENS:
        return
    warn(
        f"K has a focal length of {K[0, 0]:.0f} px for {name}, {factor:.2f} times the {theirs[0, 0]:.0f} px "
        "of its EXIF: is K for an image of another size? If it is, all metres are off by that factor.",
        stacklevel=3,
    )


def _number(entries: Any, tag: int) -> float:
    try:
        value = float(entries.get(tag) or 0.0)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return value if math.isfinite(value) and value > 0 else 0.0


def _of(image: Image.Image, name: str) -> tuple[np.ndarray, list[str]]:
    entries = image.getexif().get_ifd(_IFD)
    width, height = image.size
    taken = _number(entries, _WIDTH), _number(entries, _HEIGHT)
    if all(taken):
        shapes = [(taken[0] / taken[1]) / shape for shape in (width / height, height / width)]
        if min(max(ratio, 1 / ratio) for ratio in shapes) > 1 + _SAME_SHAPE:
            got = f"one of {taken[0]:.0f}x{taken[1]:.0f}: it was cropped since it was taken"
            cure = f"Give the image as it was taken. {CURES}"
            bad_value(f"EXIF of {name}", f"of an image of {width}x{height}", got, cure)
    focal_35, focal_mm, zoom = (_number(entries, tag) for tag in (_FOCAL_35, _FOCAL, _ZOOM))
    per_unit_x, per_unit_y = (_number(entries, tag) for tag in (_X_RESOLUTION, _Y_RESOLUTION))
    if focal_35:
        fx = fy = focal_35 * math.hypot(width, height) / _DIAGONAL_35_MM
        notes = [f"K of {name}: {focal_35:g} mm in 35 mm equivalent by its EXIF, {fx:.0f} px."]
    elif focal_mm and per_unit_x and taken[0]:
        mm = _MM_PER_UNIT.get(int(_number(entries, _UNIT) or 2), 25.4)
        pitch_x, pitch_y = mm / per_unit_x, mm / (per_unit_y or per_unit_x)
        fx = focal_mm / pitch_x * (max(width, height) / max(taken)) * max(zoom, 1.0)
        fy = fx * pitch_x / pitch_y
        notes = [f"K of {name}: {focal_mm:g} mm on its sensor by its EXIF, {fx:.0f} px."]
    else:
        bad_value(f"K of {name}", "known", "no focal length in its EXIF", CURES)
    if zoom > 1.01:
        said = "not every camera says whether that is counted in"
        notes.append(f"{name} was zoomed digitally by {zoom:g}; {said}.")
    return intrinsics(fx, fy, (width - 1) / 2, (height - 1) / 2), notes
