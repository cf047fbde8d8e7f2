"""Undistorts photographs and what is known of their pixels, with OpenCV's model or its fisheye model."""

from __future__ import annotations

import cv2
import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import COEFFICIENT_COUNTS
from geodiff_plugin.types import Distortion

#: Most steps of Newton's method; near the middle of an image three suffice.
MOST_STEPS = 50
#: A pixel that comes back to itself this well is found.
TOLERANCE_PX = 1e-3
#: Of the differences that stand for derivatives.
STEP_PX = 1e-3


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
    """Where pixels of the image as it was taken lie in the image that ``undistorted`` makes of it.

    ``pixels`` are ``(N, 2)`` x and y, the centre of the first pixel at (0, 0), ``K`` is of both images. The
    result is ``(N, 2)`` float64, also outside of the image; NaN where the model sends no ray to a pixel.
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
    """The known depths of an image as it was taken, as points; no two are mixed, and none is rounded.

    ``depth_m`` is ``(H, W)`` metres along the optical axis, 0 or not finite where unknown. The result is
    ``(N, 3)`` float32 metres in the camera's frame, without those that no ray of the lens model belongs to.
    """
    rows, columns = np.nonzero(np.isfinite(depth_m) & (depth_m > 0))
    straight = undistorted_pixels(np.stack([columns, rows], axis=1), K, distortion)
    rays = np.concatenate([straight, np.ones((len(straight), 1))], axis=1) @ np.linalg.inv(K).T
    points = rays * depth_m[rows, columns, None]
    return points[np.isfinite(points).all(axis=1)].astype(np.float32)
