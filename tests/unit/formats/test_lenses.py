"""Images and known depths without lens distortion, for a camera with non-square pixels."""

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera, Distortion
from geodiff_plugin.formats import lenses
from tests.unit.lens_models import LENSES, SIZE, K, lens_of, matrix_of, taken_pixels


@pytest.mark.parametrize("model", LENSES)
def test_undistorted_image_agrees_with_undistorted_pixels(model):
    """In an image of linear gradients, every value reveals the pixel it was sampled from."""
    width, height = SIZE
    matrix = matrix_of(model)
    v, u = np.mgrid[:height, :width].astype(float)
    image = np.stack([u / width, v / height, (u + 2 * v) / 300], -1).astype(np.float32)
    straight = lenses.undistorted(image, Camera(matrix, lens=lens_of(model)))
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
    clipped = lenses.undistorted(5 * image - 2, Camera(matrix, lens=lens_of(model)))
    assert np.isin(clipped, (0, 1)).mean() > 0.4 and clipped.min() == 0
    assert lenses.undistorted(image, Camera(matrix)) is image


@pytest.mark.parametrize("model", ["opencv", "fisheye", "EUCM"])
def test_known_depths_become_points_along_undistorted_rays(model):
    width, height = SIZE
    depth = np.full((height, width), np.nan, np.float32)
    at = [(10, 20), (33, 70), (50, 15), (40, 44)]  # rows and columns
    for n, (row, column) in enumerate(at):
        depth[row, column] = 1.5 + n
    depth[5, 5], depth[6, 6], depth[7, 7] = 0.0, -1.0, np.inf
    points = lenses.undistorted_points(depth, Camera(K, lens=lens_of(model)))
    assert points.dtype == np.float32 and len(points) == 4
    order = np.argsort([row * width + column for row, column in at])
    np.testing.assert_allclose(points[:, 2], np.array([1.5, 2.5, 3.5, 4.5])[order])
    pixels = np.array([(column, row) for row, column in at], float)[order]
    np.testing.assert_allclose(taken_pixels(points[:, :2] / points[:, 2:], model), pixels, atol=0.02)
    lost = Distortion("opencv", np.array([-9.0, 0, 0, 0]))
    assert len(lenses.undistorted_points(depth, Camera(K, lens=lost))) < 4


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
            r"\A--lens must be k1,k2,p1,p2\[,k3\[,\.\.\.\]\] or fisheye:k1,k2,k3,k4; got '.*'\. "
            r"Use OpenCV's order: "
        )
        with pytest.raises(InputError, match=sentence):
            lenses.distortion_from_text(text, "--lens")
        return
    lens = lenses.distortion_from_text(text)
    assert (lens.model, lens.coefficients.tolist()) == (model, coefficients)
