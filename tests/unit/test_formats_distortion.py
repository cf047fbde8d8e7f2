"""Lens distortion taken out of images."""

import numpy as np
import pytest

from geodiff_plugin.formats.lenses import (
    distortion_from_text,
    undistorted,
    undistorted_pixels,
    undistorted_points,
)

K = np.array([[100.0, 0, 79.5], [0, 100.0, 59.5], [0, 0, 1]])
LENSES = ["-0.2,0.05,0,0", "-0.35,0.15,0,0", "0.4,0.1,0,0,0", "fisheye:0.03,0,0,0", "fisheye:-0.05,0.02,0,0"]


def bent_px(pinhole: np.ndarray, lens: str) -> np.ndarray:
    """By the definition of both models."""
    rays = (pinhole - K[:2, 2]) / 100
    r = np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    k1, k2 = map(float, lens.rpartition(":")[2].split(",")[:2])
    if lens.startswith("fisheye"):
        theta = np.arctan(r)
        return 100 * rays * theta * (1 + k1 * theta**2 + k2 * theta**4) / r + K[:2, 2]
    return 100 * rays * (1 + k1 * r**2 + k2 * r**4) + K[:2, 2]


@pytest.mark.parametrize("lens", LENSES)
def test_pixels_and_known_depths_come_to_those_of_a_pinhole_camera(lens) -> None:
    """To the corners, where OpenCV's few iterations alone are off by a pixel."""
    v, u = np.mgrid[:120:7, :160:7]
    pinhole = np.stack([u, v], -1).reshape(-1, 2).astype(float)
    found = undistorted_pixels(bent_px(pinhole, lens), K, distortion_from_text(lens))
    np.testing.assert_allclose(found, pinhole, atol=0.01)
    depth_m, at = np.zeros((120, 160), np.float32), np.array([(30, 20), (80, 60), (31, 20), (120, 90)])
    depth_m[at[:, 1], at[:, 0]] = (2.0, 3.0, 5.0, 4.0)
    depth_m[0, :2] = np.nan, -1.0
    points = undistorted_points(depth_m, K, distortion_from_text(lens))
    assert sorted(points[:, 2].tolist()) == [2, 3, 4, 5], "each value once, as it was"
    taken = bent_px(points[:, :2] / points[:, 2:] * 100.0 + K[:2, 2], lens)
    np.testing.assert_allclose(taken[np.argsort(points[:, 2])], at[[0, 1, 3, 2]], atol=0.02)


@pytest.mark.parametrize("lens", [LENSES[0], LENSES[3]])
def test_a_blob_in_an_image_comes_to_its_pinhole_pixel(lens) -> None:
    v, u = np.mgrid[:120, :160]
    for pinhole in np.array([[119.5, 89.5], [49.5, 69.5]]):
        at = bent_px(pinhole[None], lens)[0]
        blob = np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 4.0)[..., None].repeat(3, 2)
        image = undistorted(blob.astype(np.float32), K, distortion_from_text(lens))[..., 0]
        middle = [(along * image).sum() / image.sum() for along in (u, v)]
        np.testing.assert_allclose(middle, pinhole, atol=0.1)
