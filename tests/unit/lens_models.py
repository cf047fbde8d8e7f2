"""Lenses of every model, and where they put rays, by the library that defines the model."""

import cv2
import numpy as np
import pytest

from geodiff_plugin.cameras import Distortion

SIZE = (90, 64)
K = np.array([[70.0, 0, 40.5], [0, 62.0, 36.25], [0, 0, 1]])
LENSES = {
    "opencv": [-0.12, 0.03, 0.004, -0.006, 0.01],
    "fisheye": [0.05, -0.02, 0.006, -0.001],
    "FOV": [0.9],
    "THIN_PRISM_FISHEYE": [0.03, -0.01, 0.002, -0.003, 0.004, 0.001, 0.003, -0.002],
    "EUCM": [0.6, 1.1],
    "SIMPLE_DIVISION": [-0.08],
}


def lens_of(model: str) -> Distortion:
    return Distortion(model, np.array(LENSES[model]))


def taken_pixels(rays: np.ndarray, model: str) -> np.ndarray:
    """Distorted pixels of rays ``(N, 2)``, by the library that defines the model."""
    if model == "opencv":
        points = np.column_stack([rays, np.ones(len(rays))])
        return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(LENSES[model]))[0][:, 0]
    if model == "fisheye":
        theta = np.hypot(*rays.T)
        angle = np.arctan(theta)
        k1, k2, k3, k4 = LENSES[model]
        bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
        return rays * (bent / theta)[:, None] * K.diagonal()[:2] + K[:2, 2]
    pycolmap = pytest.importorskip("pycolmap")
    focals = [70.0, 62.0]
    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, 8, 8)
    if len(camera.focal_length_idxs()) == 1:
        focals = focals[:1]
    camera.params = [*focals, 41.0, 36.75, *LENSES[model]]
    return camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])) - 0.5


def matrix_of(model: str) -> np.ndarray:
    """K, with one focal length for models that have only one."""
    return K * [[1], [70 / 62 if model == "SIMPLE_DIVISION" else 1], [1]] + (
        [[0, 0, 0], [0, 0, 36.25 - 36.25 * 70 / 62 if model == "SIMPLE_DIVISION" else 0], [0, 0, 0]]
    )
