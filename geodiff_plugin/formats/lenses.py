"""Parses lens distortion, and removes it from images and known depths."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.cameras import BEHIND_CAMERA_PX, Camera, Distortion
from geodiff_plugin.formats.rigs import COEFFICIENT_COUNTS, COLMAP_LENSES


def distortion_from_text(text: str, name: str = "--distortion") -> Distortion:
    """Parse coefficients: ``k1,k2,p1,p2[,k3...]``, or ``fisheye:k1,k2,k3,k4``."""
    model, colon, numbers = text.rpartition(":")
    model = model if colon else "opencv"
    try:
        coefficients = np.array(numbers.split(","), dtype=np.float64)
    except ValueError:
        coefficients = np.zeros(0)
    if len(coefficients) not in COEFFICIENT_COUNTS.get(model, ()) or not np.isfinite(coefficients).all():
        hint = "Use OpenCV's order: k1,k2,p1,p2,k3."
        bad_value(name, "k1,k2,p1,p2[,k3[,...]] or fisheye:k1,k2,k3,k4", repr(text), hint)
    return Distortion(model, coefficients)


def undistorted(image_01: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the image ``(H, W, 3)`` in [0, 1] for the same K without distortion; black where unobserved."""
    if camera.lens is None:
        return image_01
    K, coefficients = (np.asarray(each, np.float64) for each in (camera.K, camera.lens.coefficients))
    if camera.lens.model in COLMAP_LENSES:
        straight = _resampled(image_01, camera)
    elif camera.lens.model == "fisheye":
        straight = cv2.fisheye.undistortImage(image_01, K, coefficients, Knew=K)
    else:
        straight = cv2.undistort(image_01, K, coefficients)
    return straight.clip(0.0, 1.0).astype(np.float32)


def _resampled(image_01: np.ndarray, camera: Camera) -> np.ndarray:
    """Sample every undistorted pixel at the projection of its ray in the original image."""
    height, width = image_01.shape[:2]
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    taken, _ = camera.project(replace(camera, lens=None).rays(pixels))
    at = np.nan_to_num(taken, nan=BEHIND_CAMERA_PX).astype(np.float32)
    return cv2.remap(image_01, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def undistorted_points(depth_m: np.ndarray, camera: Camera) -> np.ndarray:
    """Return known depths ``(H, W)`` metres of a distorted image as points ``(N, 3)``, uninterpolated."""
    rows, columns = np.nonzero(np.isfinite(depth_m) & (depth_m > 0))
    points = camera.rays(np.stack([columns, rows], axis=1)) * depth_m[rows, columns, None]
    return points[np.isfinite(points).all(axis=1)].astype(np.float32)
