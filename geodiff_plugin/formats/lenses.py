"""Lens distortion: as it is typed, and taken out of images and points by OpenCV, or by pycolmap's models."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin._signals import keeping_sigterm
from geodiff_plugin.formats.rigs import COEFFICIENT_COUNTS, COLMAP_LENSES
from geodiff_plugin.types import Distortion

#: When OpenCV's search for a ray ends.
UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9)
#: How near to its pixel a ray that was found comes back.
TOLERANCE_PX = 0.01


def distortion_from_text(text: str, name: str = "--distortion") -> Distortion:
    """Coefficients as they are typed: ``k1,k2,p1,p2[,k3...]``, or ``fisheye:k1,k2,k3,k4``."""
    model, colon, numbers = text.rpartition(":")
    model = model if colon else "opencv"
    try:
        coefficients = np.array(numbers.split(","), dtype=np.float64)
    except ValueError:
        coefficients = np.zeros(0)
    if len(coefficients) not in COEFFICIENT_COUNTS.get(model, ()) or not np.isfinite(coefficients).all():
        cure = "The order is OpenCV's: k1,k2,p1,p2,k3."
        bad_value(name, "k1,k2,p1,p2[,k3[,...]] or fisheye:k1,k2,k3,k4", repr(text), cure)
    return Distortion(model, coefficients)


def undistorted(image_01: np.ndarray, K: np.ndarray, distortion: Distortion) -> np.ndarray:
    """The image ``(H, W, 3)`` in [0, 1] of a pinhole camera with the same K and size; black without a ray."""
    coefficients, K = np.asarray(distortion.coefficients, np.float64), np.asarray(K, np.float64)
    if distortion.model in COLMAP_LENSES:
        straight = _undistorted_by_colmap(image_01, K, distortion)
    elif distortion.model == "fisheye":
        straight = cv2.fisheye.undistortImage(image_01, K, coefficients, Knew=K)
    else:
        straight = cv2.undistort(image_01, K, coefficients)
    return straight.clip(0.0, 1.0).astype(np.float32)


def _colmap_camera(K: np.ndarray, distortion: Distortion) -> Any:
    """The camera as pycolmap has it, whose first pixel's centre lies at (0.5, 0.5)."""
    with keeping_sigterm():
        import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, distortion.model, 1.0, 1, 1)
    focals = (K[0, 0], K[1, 1])[: len(camera.focal_length_idxs())]
    camera.params = [*focals, K[0, 2] + 0.5, K[1, 2] + 0.5, *distortion.coefficients]
    return camera


def _undistorted_by_colmap(image_01: np.ndarray, K: np.ndarray, distortion: Distortion) -> np.ndarray:
    """Every pixel of the pinhole camera from where its ray meets the image as taken."""
    height, width = image_01.shape[:2]
    v, u = np.mgrid[:height, :width]
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ np.linalg.inv(K).T
    taken = _colmap_camera(K, distortion).img_from_cam(rays) - 0.5
    at = np.nan_to_num(taken, nan=-1e6).astype(np.float32).reshape(height, width, 2)
    return cv2.remap(image_01, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def undistorted_pixels(pixels: np.ndarray, K: np.ndarray, distortion: Distortion) -> np.ndarray:
    """Where pixels ``(N, 2)`` of the image as taken lie in that of ``undistorted``; NaN without a ray."""
    taken, K = np.asarray(pixels, np.float64).reshape(-1, 1, 2), np.asarray(K, np.float64)
    if not len(taken):
        return taken[:, 0]
    if distortion.model in COLMAP_LENSES:
        rays = _colmap_camera(K, distortion).cam_from_img(taken[:, 0] + 0.5)
        return rays @ K[:2, :2].T + K[:2, 2]  # without a ray NaN
    coefficients, none = np.asarray(distortion.coefficients, np.float64), np.zeros(3)
    if distortion.model == "fisheye":
        straight = cv2.fisheye.undistortPoints(taken, K, coefficients, R=np.eye(3), P=K, criteria=UNTIL)
        rays = cv2.convertPointsToHomogeneous(straight) @ np.linalg.inv(K).T
        back = cv2.fisheye.distortPoints(rays[..., :2], K, coefficients)
    else:
        straight = cv2.undistortImagePoints(taken, K, coefficients, None, UNTIL)
        rays = cv2.convertPointsToHomogeneous(straight) @ np.linalg.inv(K).T
        back = cv2.projectPoints(rays, none, none, K, coefficients)[0]
    inverted = np.abs(back - taken).max(axis=2) < TOLERANCE_PX
    return np.where(inverted, straight[:, 0], np.nan)


def undistorted_points(depth_m: np.ndarray, K: np.ndarray, distortion: Distortion) -> np.ndarray:
    """Known depths ``(H, W)`` metres of an image as taken as points ``(N, 3)`` of the camera, unmixed."""
    rows, columns = np.nonzero(np.isfinite(depth_m) & (depth_m > 0))
    straight = undistorted_pixels(np.stack([columns, rows], axis=1), K, distortion)
    rays = np.concatenate([straight, np.ones((len(straight), 1))], axis=1) @ np.linalg.inv(K).T
    points = rays * depth_m[rows, columns, None]
    return points[np.isfinite(points).all(axis=1)].astype(np.float32)
