"""Cameras, projection, warping: against ``z (u, v, 1) = K p`` in NumPy, with a skew and in any pose."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin import geometry as g

SIZE = (24, 32)
K = np.array([[31.0, 7.0, 14.2], [0.0, 28.0, 12.7], [0.0, 0.0, 1.0]])
K_RIGHT = np.array([[36.0, -4.0, 17.0], [0.0, 33.0, 10.0], [0.0, 0.0, 1.0]])


def camera(f=30.0, cx=15.5, cy=11.5) -> np.ndarray:
    return np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])


def T_of(at=(0.0, 0.0, 0.0), axis=(0, 1, 0), angle=0.0) -> np.ndarray:
    """``T_right_from_left`` of a right camera at a place, turned about an axis."""
    E = np.eye(4)
    E[:3, :3] = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    E[:3, 3] = at
    return np.linalg.inv(E)


def tensor(x) -> torch.Tensor:
    return torch.as_tensor(np.asarray(x), dtype=torch.float64)[None]


def pixels(size) -> np.ndarray:
    """``(3, H, W)`` homogeneous."""
    v, u = np.mgrid[: size[0], : size[1]].astype(float)
    return np.stack([u, v, np.ones_like(u)])


def points_of(depth_m, K) -> np.ndarray:
    return np.einsum("ij,jhw->ihw", np.linalg.inv(K), pixels(depth_m.shape)) * depth_m


def uv_of(points, K) -> np.ndarray:
    seen = np.einsum("ij,jhw->ihw", K, points)
    return seen[:2] / seen[2]


def last(x: torch.Tensor) -> np.ndarray:
    """``(1, H, W, C)`` as ``(C, H, W)``."""
    return x[0].permute(2, 0, 1).numpy()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("pose", "size_right"),
    [
        ({"at": (0.2, -0.05, 0.3)}, (24, 32)),
        ({"axis": (0.2, 1, 0.1), "angle": 0.15}, (48, 64)),
        ({}, (30, 20)),
    ],
)
def test_projection_and_warp_are_the_definition(seed, pose, size_right):
    depth = 1.0 + 3.0 * np.random.default_rng(seed).random(SIZE)
    T, K_r = T_of(**pose), g.resize_intrinsics(tensor(K_RIGHT), SIZE, size_right)[0].numpy()
    points = points_of(depth, K)
    in_right = np.einsum("ij,jhw->ihw", T[:3, :3], points) + T[:3, 3, None, None]
    expected = uv_of(in_right, K_r)
    cloud = g.unproject(tensor(depth)[None], tensor(K))
    np.testing.assert_allclose(last(cloud), points, atol=1e-12)
    moved = g.transform(cloud, tensor(T))
    np.testing.assert_allclose(last(moved), in_right, atol=1e-12)
    rays = g.plane_rays(tensor(K), tensor(K_r), tensor(T), SIZE)
    for uv, z in (g.project(moved, tensor(K_r)), g.project_rays(tensor(depth)[None], rays)):
        np.testing.assert_allclose(last(uv), expected, atol=1e-9)
        np.testing.assert_allclose(z[0], in_right[2], atol=1e-12)
    # An image that is its own coordinates reads back the right pixel.
    ramp = tensor(pixels(size_right)[:2])
    for known in ({}, {"rays": rays}):
        warped = g.warp_right_to_left(ramp, tensor(depth)[None], tensor(K), tensor(K_r), tensor(T), **known)
        limits = np.array([size_right[1] - 1, size_right[0] - 1])[:, None, None]
        inside = ((expected >= -0.01) & (expected <= limits + 0.01)).all(0)  # to a hundredth of a pixel
        np.testing.assert_array_equal(warped.visible[0, 0], inside)
        assert inside.mean() > 0.3
        np.testing.assert_allclose(
            warped.image[0].numpy()[:, inside], np.clip(expected, 0, limits)[:, inside], atol=1e-9
        )


def test_depth_at_and_behind_the_camera_is_finite_invisible_and_without_gradient():
    values = torch.tensor([2.0, 0.5, 0.25, 0.0, -1.0, 1e-9, 0.25 + 1e-12, 1e9])
    depth = values.repeat(1, 1, 4, 1).double().requires_grad_()
    camera_8, ahead = tensor(camera(cx=3.5, cy=1.5)), tensor(T_of(at=(0.0, 0.0, 0.25)))
    image = torch.rand(1, 1, 4, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    warped = g.warp_right_to_left(image, depth, camera_8, camera_8, ahead)
    uv, _ = g.project(g.transform(g.unproject(depth, camera_8), ahead), camera_8)
    by_rays, _ = g.project_rays(depth, g.rays_of(depth, camera_8, camera_8, ahead))
    (gradient,) = torch.autograd.grad(warped.image.sum() + by_rays.sum() + uv.sum(), depth)
    behind = values <= 0.25 + 1e-6
    assert all(torch.isfinite(x).all() for x in (warped.image, by_rays, uv, gradient))
    assert not warped.visible[..., behind].any() and (gradient[..., behind] == 0).all()
    assert warped.visible[..., 7].all()  # a point at infinity is seen
    away = tensor(T_of(angle=np.pi))
    assert not g.warp_right_to_left(image, depth.detach().abs() + 1, camera_8, camera_8, away).visible.any()


@pytest.mark.parametrize("size_right", [(40, 60), (80, 120), (20, 30)])
def test_a_near_square_hides_the_strip_beside_it(size_right):
    """Right camera at +x: the square shifts left by more than the wall, and covers a strip at its left."""
    size = (40, 60)
    depth = torch.full((1, 1, *size), 4.0)
    depth[..., 10:30, 25:40] = 2.0
    wide = tensor(camera(40.0, 29.5, 19.5)).float()
    K_right = g.resize_intrinsics(wide, size, size_right)
    hidden = g.hidden_in_right(depth, wide, K_right, tensor(T_of(at=(0.6, 0, 0))).float(), size_right)[0, 0]
    # disparities 12 and 6 px: wall pixels u with u - 6 in [25 - 12, 40 - 12), that is columns 19..24
    expected = torch.zeros(size, dtype=torch.bool)
    expected[10:30, 19:25] = True
    coarse = max(1, size[1] // size_right[1])  # a buffer cell covers that many left pixels
    assert (hidden != expected).sum() <= 2 * (20 + 6) * coarse
    assert hidden[12:28, 20:24].all()
    assert not hidden[12:28, 25 + coarse :].any() and not hidden[:, : 19 - coarse].any()
