"""Undistorts photographs, with OpenCV's model or its fisheye model.

Data flow: image, K, coefficients -> the image that a pinhole camera of the same K would have taken.
Paper: none; every formula of the package is of a pinhole camera.
"""

from __future__ import annotations

import cv2
import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.lenses import COUNTS
from geodiff_plugin.types import Distortion

__all__ = ["distortion_from_text", "undistorted"]


def distortion_from_text(text: str, name: str = "--distortion") -> Distortion:
    """Coefficients as they are typed: ``k1,k2,p1,p2[,k3...]``, or ``fisheye:k1,k2,k3,k4``.

    Raises:
        ValueError: no numbers, or another count of them.
    """
    model, colon, numbers = text.rpartition(":")
    model = model if colon else "opencv"
    try:
        coefficients = np.array([float(part) for part in numbers.split(",")])
    except ValueError:
        coefficients = np.zeros(0)
    if model not in COUNTS or len(coefficients) not in COUNTS[model] or not np.isfinite(coefficients).all():
        cure = "The order is OpenCV's: k1,k2,p1,p2,k3."
        bad_value(name, "k1,k2,p1,p2[,k3[,...]] or fisheye:k1,k2,k3,k4", repr(text), cure)
    return Distortion(model, coefficients)


def undistorted(image_01: np.ndarray, K: np.ndarray, distortion: Distortion) -> np.ndarray:
    """The image of a pinhole camera with the same K and size.

    Args:
        image_01: ``(H, W, 3)`` float32 in [0, 1].
        K: ``(3, 3)`` pixels, of the image as it was taken and of the result.
        distortion: of the lens.

    Returns:
        ``(H, W, 3)`` float32; black where the lens saw nothing.
    """
    coefficients, K = np.asarray(distortion.coefficients, np.float64), np.asarray(K, np.float64)
    if distortion.model == "fisheye":
        straight = cv2.fisheye.undistortImage(image_01, K, coefficients, Knew=K)
    else:
        straight = cv2.undistort(image_01, K, coefficients)
    return straight.clip(0.0, 1.0).astype(np.float32)
