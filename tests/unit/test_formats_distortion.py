"""Lens distortion taken out of images."""

from __future__ import annotations

import numpy as np
import pytest

from geodiff_plugin.formats.distortion import (
    distortion_from_text,
    undistorted,
    undistorted_pixels,
    undistorted_points,
)

K = np.array([[100.0, 0, 79.5], [0, 100.0, 59.5], [0, 0, 1]])


def blob(at: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:120, :160]
    return np.repeat(np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 4.0)[..., None], 3, 2).astype(np.float32)


def middle(image: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:120, :160]
    weight = image[..., 0] / image[..., 0].sum()
    return np.array([(u * weight).sum(), (v * weight).sum()])


def bent_px(pinhole: np.ndarray, lens: str) -> np.ndarray:
    """By the definition of both models."""
    rays = (pinhole - K[:2, 2]) / 100
    r = np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    k1, k2 = map(float, lens.rpartition(":")[2].split(",")[:2])
    if lens.startswith("fisheye"):
        theta = np.arctan(r)
        return 100 * rays * theta * (1 + k1 * theta**2 + k2 * theta**4) / r + K[:2, 2]
    return 100 * rays * (1 + k1 * r**2 + k2 * r**4) + K[:2, 2]


LENSES = ["-0.2,0.05,0,0", "-0.35,0.15,0,0", "0.4,0.1,0,0,0", "fisheye:0.03,0,0,0", "fisheye:-0.05,0.02,0,0"]


@pytest.mark.parametrize("lens", LENSES)
def test_pixels_come_to_those_of_a_pinhole_camera(lens) -> None:
    """To the corners, where OpenCV's few iterations alone are off by a pixel."""
    v, u = np.mgrid[:120:7, :160:7]
    pinhole = np.stack([u, v], -1).reshape(-1, 2).astype(float)
    found = undistorted_pixels(bent_px(pinhole, lens), K, distortion_from_text(lens))
    np.testing.assert_allclose(found, pinhole, atol=0.01)


def test_a_pixel_without_a_ray_is_nan() -> None:
    """r (1 - 0.3 r^2) is at most 0.70."""
    lens = distortion_from_text("-0.3,0,0,0")
    found = undistorted_pixels(np.array([[79.5 + 68, 59.5], [79.5 + 72, 59.5]]), K, lens)
    assert np.isfinite(found[0]).all() and np.isnan(found[1]).all()


@pytest.mark.parametrize("lens", LENSES)
def test_known_depths_become_points_of_the_pinhole_camera(lens) -> None:
    depth_m = np.zeros((120, 160), np.float32)
    at = np.array([(30, 20), (31, 20), (80, 60), (120, 90)])
    depth_m[at[:, 1], at[:, 0]] = (2.0, 5.0, 3.0, 4.0)
    depth_m[0, 0], depth_m[0, 1] = np.nan, -1.0
    points = undistorted_points(depth_m, K, distortion_from_text(lens))
    assert sorted(points[:, 2].tolist()) == [2, 3, 4, 5], "each value once, as it was"
    pinhole = points[:, :2] / points[:, 2:] * 100 + K[:2, 2]
    taken = bent_px(pinhole.astype(float), lens)
    by_value = np.array([taken[points[:, 2] == value][0] for value in (2, 5, 3, 4)])
    np.testing.assert_allclose(by_value, at, atol=0.02)


@pytest.mark.parametrize("point", [(0.4, 0.3), (-0.3, 0.1)])
def test_a_point_comes_to_its_pinhole_pixel(point) -> None:
    x, y = point
    r2 = x * x + y * y
    pinhole = np.array([100 * x + 79.5, 100 * y + 59.5])
    radial = 1 - 0.2 * r2 + 0.05 * r2**2
    bent = np.array([100 * x * radial + 79.5, 100 * y * radial + 59.5])
    found = undistorted(blob(bent), K, distortion_from_text("-0.2,0.05,0,0"))
    assert np.allclose(middle(found), pinhole, atol=0.1)
    theta = np.arctan(np.sqrt(r2))
    scale = theta * (1 + 0.03 * theta**2) / np.sqrt(r2)
    bent = np.array([100 * x * scale + 79.5, 100 * y * scale + 59.5])
    found = undistorted(blob(bent), K, distortion_from_text("fisheye:0.03,0,0,0"))
    assert np.allclose(middle(found), pinhole, atol=0.1)
