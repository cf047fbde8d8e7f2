"""Camera matrices from EXIF data or a field of view; lens distortion taken out of images and known pixels."""

from __future__ import annotations

import math
import os
from typing import Any

import cv2
import numpy as np
from PIL import Image

from geodiff_plugin._checks import InputError, bad_value, check_number, warn
from geodiff_plugin.formats.files import ORIENTATION, open_image
from geodiff_plugin.formats.rigs import COEFFICIENT_COUNTS, intrinsics
from geodiff_plugin.types import Distortion

_IFD, _FOCAL, _FOCAL_35, _ZOOM = 0x8769, 0x920A, 0xA405, 0xA404
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
#: Most steps of Newton's method; near the middle of an image three suffice.
MOST_STEPS = 50
#: A pixel that comes back to itself this well is found.
TOLERANCE_PX = 1e-3
#: Of the differences that stand for derivatives.
STEP_PX = 1e-3


def intrinsics_from_fov(fov_deg: float, size: tuple[int, int]) -> np.ndarray:
    """K of a camera with square pixels and its principal point in the middle; ``fov_deg`` is horizontal."""
    check_number(fov_deg, "fov", 1.0, 170.0)
    focal = size[0] / 2 / math.tan(math.radians(fov_deg) / 2)
    return intrinsics(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)


def intrinsics_from_exif(
    source: str | os.PathLike[str] | Image.Image, name: str
) -> tuple[np.ndarray, list[str]]:
    """K of a photograph, to a few per cent, and sentences about what was assumed.

    Of a file for its upright pixels, of an image in memory for its pixels as they lie; refused without a
    focal length, or where the image was cropped since.
    """
    if isinstance(source, Image.Image):
        return _of(source, name)
    with open_image(source, name) as image:
        K, notes = _of(image, name)
        if image.getexif().get(ORIENTATION, 1) >= 5:
            K = intrinsics(K[1, 1], K[0, 0], K[1, 2], K[0, 2])
    return K, notes


def warn_of_other_lens(source: str | os.PathLike[str] | Image.Image, K: np.ndarray, name: str) -> None:
    """Warn of a focal length that contradicts the EXIF data of an uncropped image."""
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


def distortion_from_text(text: str, name: str = "--distortion") -> Distortion:
    """Coefficients as they are typed: ``k1,k2,p1,p2[,k3...]``, or ``fisheye:k1,k2,k3,k4``."""
    model, colon, numbers = text.rpartition(":")
    model = model if colon else "opencv"
    try:
        coefficients = np.array([float(part) for part in numbers.split(",")])
    except ValueError:
        coefficients = np.zeros(0)
    if len(coefficients) not in COEFFICIENT_COUNTS.get(model, ()) or not np.isfinite(coefficients).all():
        cure = "The order is OpenCV's: k1,k2,p1,p2,k3."
        bad_value(name, "k1,k2,p1,p2[,k3[,...]] or fisheye:k1,k2,k3,k4", repr(text), cure)
    return Distortion(model, coefficients)


def undistorted(image_01: np.ndarray, K: np.ndarray, distortion: Distortion) -> np.ndarray:
    """The image ``(H, W, 3)`` in [0, 1] of a pinhole camera with the same K and size; black without a ray."""
    coefficients, K = np.asarray(distortion.coefficients, np.float64), np.asarray(K, np.float64)
    if distortion.model == "fisheye":
        straight = cv2.fisheye.undistortImage(image_01, K, coefficients, Knew=K)
    else:
        straight = cv2.undistort(image_01, K, coefficients)
    return straight.clip(0.0, 1.0).astype(np.float32)


def _as_taken(straight_px: np.ndarray, K: np.ndarray, distortion: Distortion) -> np.ndarray:
    """Where the lens shows what a pinhole camera has at these pixels, ``(N, 1, 2)`` both."""
    rays = np.concatenate([straight_px, np.ones_like(straight_px[..., :1])], axis=2) @ np.linalg.inv(K).T
    if distortion.model == "fisheye":
        return np.asarray(cv2.fisheye.distortPoints(rays[..., :2], K, distortion.coefficients))
    return np.asarray(cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, distortion.coefficients)[0])


def undistorted_pixels(pixels: np.ndarray, K: np.ndarray, distortion: Distortion) -> np.ndarray:
    """Where pixels ``(N, 2)`` of the image as taken lie in that of ``undistorted``, with the same K.

    Float64, x and y, also outside of the image; NaN where the model sends no ray to a pixel.
    """
    taken, K = np.asarray(pixels, np.float64).reshape(-1, 1, 2), np.asarray(K, np.float64)
    straight, far = taken.copy(), np.ones(len(taken), bool)
    # Newton's method: OpenCV's own way back stops after five iterations, pixels off behind a strong lens.
    for _ in range(MOST_STEPS):
        bent = _as_taken(straight, K, distortion)
        moved = [_as_taken(straight + step, K, distortion) - bent for step in STEP_PX * np.eye(2)]
        J = np.stack([step[:, 0] / STEP_PX for step in moved], axis=2)
        # Neither mirrored nor turned over, as behind the edge of a lens.
        area = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
        ahead = (area > 0) & (J[:, 0, 0] + J[:, 1, 1] > 0)
        far = ~(np.abs(bent - taken).max(axis=(1, 2)) < TOLERANCE_PX)
        straight[~ahead] = np.nan
        move = ahead & far
        if not move.any():
            break
        straight[move] -= np.linalg.solve(J[move], (bent - taken)[move, 0, :, None])[..., None, :, 0]
    straight[far] = np.nan
    return straight[:, 0]


def undistorted_points(depth_m: np.ndarray, K: np.ndarray, distortion: Distortion) -> np.ndarray:
    """Known depths ``(H, W)`` metres of an image as taken as points ``(N, 3)`` of the camera, unmixed."""
    rows, columns = np.nonzero(np.isfinite(depth_m) & (depth_m > 0))
    straight = undistorted_pixels(np.stack([columns, rows], axis=1), K, distortion)
    rays = np.concatenate([straight, np.ones((len(straight), 1))], axis=1) @ np.linalg.inv(K).T
    points = rays * depth_m[rows, columns, None]
    return points[np.isfinite(points).all(axis=1)].astype(np.float32)
