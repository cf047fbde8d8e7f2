"""Lens distortion, compared with OpenCV and pycolmap for a camera with non-square pixels."""

import cv2
import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import lenses
from geodiff_plugin.types import Distortion

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


@pytest.mark.parametrize("model", LENSES)
def test_undistorted_pixels_match_their_rays(model):
    rays = np.random.default_rng(0).uniform(-0.45, 0.45, (30, 2))
    matrix = matrix_of(model)
    straight = rays * matrix.diagonal()[:2] + matrix[:2, 2]
    taken = taken_pixels(rays, model)
    assert np.abs(taken - straight).max() > 0.5
    found = lenses.undistorted_pixels(taken, matrix, lens_of(model))
    np.testing.assert_allclose(found, straight, atol=0.02)
    assert lenses.undistorted_pixels(np.zeros((0, 2)), matrix, lens_of(model)).shape == (0, 2)


@pytest.mark.parametrize("model", LENSES)
def test_undistorted_image_agrees_with_undistorted_pixels(model):
    """In an image of linear gradients, every value reveals the pixel it was sampled from."""
    width, height = SIZE
    matrix = matrix_of(model)
    v, u = np.mgrid[:height, :width].astype(float)
    image = np.stack([u / width, v / height, (u + 2 * v) / 300], -1).astype(np.float32)
    straight = lenses.undistorted(image, matrix, lens_of(model))
    assert straight.dtype == np.float32 and straight.shape == image.shape
    rays = np.stack([(u - matrix[0, 2]) / matrix[0, 0], (v - matrix[1, 2]) / matrix[1, 1]], -1).reshape(-1, 2)
    taken = taken_pixels(rays, model).reshape(height, width, 2)
    margin = 2
    inside = (taken > margin).all(-1) & (taken < np.array(SIZE) - 1 - margin).all(-1)
    assert inside.mean() > 0.4
    expected = np.stack(
        [taken[..., 0] / width, taken[..., 1] / height, (taken[..., 0] + 2 * taken[..., 1]) / 300], -1
    )
    np.testing.assert_allclose(straight[inside], expected[inside], atol=2e-3)
    outside = (taken < -2).any(-1) | (taken > np.array(SIZE) + 1).any(-1)
    assert not straight[outside].any()
    assert np.isin(lenses.undistorted(5 * image - 2, matrix, lens_of(model)), (0, 1)).mean() > 0.4
    assert lenses.undistorted(5 * image - 2, matrix, lens_of(model)).min() == 0


@pytest.mark.parametrize("model", ["opencv", "fisheye"])
def test_pixels_without_a_ray_become_nan(model):
    """Strong barrel distortion folds back, so that no ray exists beyond its rim."""
    coefficients = [-0.6, 0, 0, 0] if model == "opencv" else [-0.9, 0, 0, 0]
    lens = Distortion(model, np.array(coefficients))
    pixels = np.array([[42.0, 37.0], [400.0, 300.0], [41, 36], [-500, 36]])
    found = lenses.undistorted_pixels(pixels, K, lens)
    assert np.isnan(found).all(1).tolist() == [False, True, False, True]
    np.testing.assert_allclose(found[[0, 2]], pixels[[0, 2]], atol=0.1)


def test_pixels_just_beyond_the_rim_of_a_lens_become_nan():
    """``r (1 - 0.6 r^2)`` is largest at ``r = sqrt(1 / 1.8)``."""
    lens, r = Distortion("opencv", np.array([-0.6, 0, 0, 0])), np.sqrt(1 / 1.8)
    rim = K[0, 2] + K[0, 0] * r * (1 - 0.6 * r**2)
    pixels = np.column_stack([rim + np.array([-0.3, -0.05, 0.05, 0.3]), np.full(4, K[1, 2])])
    found = lenses.undistorted_pixels(pixels, K, lens)
    assert np.isnan(found).any(1).tolist() == [False, False, True, True]


@pytest.mark.parametrize("model", ["opencv", "fisheye", "EUCM"])
def test_known_depths_become_points_along_undistorted_rays(model):
    width, height = SIZE
    depth = np.full((height, width), np.nan, np.float32)
    at = [(10, 20), (33, 70), (50, 15), (40, 44)]  # rows and columns
    for n, (row, column) in enumerate(at):
        depth[row, column] = 1.5 + n
    depth[5, 5], depth[6, 6], depth[7, 7] = 0.0, -1.0, np.inf
    points = lenses.undistorted_points(depth, K, lens_of(model))
    assert points.dtype == np.float32 and len(points) == 4
    order = np.argsort([row * width + column for row, column in at])
    np.testing.assert_allclose(points[:, 2], np.array([1.5, 2.5, 3.5, 4.5])[order])
    pixels = np.array([(column, row) for row, column in at], float)[order]
    np.testing.assert_allclose(taken_pixels(points[:, :2] / points[:, 2:], model), pixels, atol=0.02)
    lost = Distortion("opencv", np.array([-9.0, 0, 0, 0]))
    assert len(lenses.undistorted_points(depth, K, lost)) < 4


@pytest.mark.parametrize(
    ("text", "model", "coefficients"),
    [
        ("0.1,-0.2,0.003,0.004", "opencv", [0.1, -0.2, 0.003, 0.004]),
        ("opencv:0.1,-0.2,0.003,0.004,5", "opencv", [0.1, -0.2, 0.003, 0.004, 5]),
        ("1,2,3,4,5,6,7,8", "opencv", [1, 2, 3, 4, 5, 6, 7, 8]),
        ("fisheye:1,2,3,4", "fisheye", [1, 2, 3, 4]),
        ("fisheye:1,2,3,4,5", None, None),
        ("0.1,0.2,0.3", None, None),
        ("0.1,x,0.3,1", None, None),
        ("0.1,nan,0.3,1", None, None),
        ("FOV:1", None, None),
        (":1,2,3,4", None, None),
    ],
)
def test_typed_coefficient_counts_must_fit_the_model(text, model, coefficients):
    if model is None:
        sentence = (
            r"\A--lens must be k1,k2,p1,p2\[,k3\[,\.\.\.\]\] or fisheye:k1,k2,k3,k4; got '.*'\. The order is "
        )
        with pytest.raises(InputError, match=sentence):
            lenses.distortion_from_text(text, "--lens")
        return
    lens = lenses.distortion_from_text(text)
    assert (lens.model, lens.coefficients.tolist()) == (model, coefficients)
