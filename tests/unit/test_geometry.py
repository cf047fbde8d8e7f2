"""Cameras, projection, warping: invariants and closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.geometry.linalg import inverse_transformation, relative_transformation

from geodiff_plugin import geometry as g

SIZE = (24, 32)


def rotation(axis, angle, dtype=torch.float64):
    axis = torch.tensor(axis, dtype=dtype)
    x, y, z = axis / axis.norm()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=dtype)
    return torch.eye(3, dtype=dtype) + math.sin(angle) * skew + (1 - math.cos(angle)) * (skew @ skew)


def pose(axis=(0, 1, 0), angle=0.0, at=(0, 0, 0), dtype=torch.float64):
    E = torch.eye(4, dtype=dtype)
    E[:3, :3] = rotation(axis, angle, dtype)
    E[:3, 3] = torch.tensor(at, dtype=dtype)
    return E[None]


def camera(f=30.0, cx=15.5, cy=11.5, fy=None, dtype=torch.float64):
    return torch.tensor([[[f, 0, cx], [0, fy or f, cy], [0, 0, 1]]], dtype=dtype)


def depth_map(seed=0, batch=1, size=SIZE, near=1.0, far=4.0):
    generator = torch.Generator().manual_seed(seed)
    return near + (far - near) * torch.rand(batch, 1, *size, generator=generator, dtype=torch.float64)


def pixel_grid(size):
    v, u = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    return torch.stack([u, v], dim=-1).double()[None]


@pytest.mark.parametrize("size_to", [(48, 64), (12, 20), (24, 32), (7, 5)])
def test_resized_intrinsics_keep_edges_in_place(size_to):
    K = camera(f=31.0, fy=29.0, cx=14.2, cy=12.7)
    resized = g.resize_intrinsics(K, SIZE, size_to)
    sx, sy = size_to[1] / SIZE[1], size_to[0] / SIZE[0]
    corner = torch.tensor([-0.5, -0.5, 1.0], dtype=torch.float64)
    far_corner = torch.tensor([SIZE[1] - 0.5, SIZE[0] - 0.5, 1.0], dtype=torch.float64)
    ray, far_ray = torch.linalg.solve(K[0], corner), torch.linalg.solve(K[0], far_corner)
    torch.testing.assert_close(resized[0] @ ray, corner)
    expected = torch.tensor([size_to[1] - 0.5, size_to[0] - 0.5, 1.0], dtype=torch.float64)
    torch.testing.assert_close(resized[0] @ far_ray, expected)
    assert resized[0, 0, 0] == pytest.approx(31.0 * sx) and resized[0, 1, 1] == pytest.approx(29.0 * sy)
    torch.testing.assert_close(g.resize_intrinsics(resized, size_to, SIZE), K)


@pytest.mark.parametrize("angle", [0.0, 0.3, math.pi])
def test_nearest_rotation_is_proper_and_close(angle):
    generator = torch.Generator().manual_seed(1)
    exact = rotation((1, 2, 3), angle)
    noisy = exact + 1e-3 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
    nearest = g.nearest_rotation(noisy)
    torch.testing.assert_close(nearest @ nearest.T, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(nearest) == pytest.approx(1.0)
    assert (nearest - exact).norm() < 4e-3
    torch.testing.assert_close(g.nearest_rotation(exact), exact)


@pytest.mark.parametrize("seed", range(3))
def test_project_undoes_unproject(seed):
    depth = depth_map(seed, batch=2)
    K = torch.cat([camera(), camera(f=12.0, fy=50.0, cx=3.0, cy=20.0)])
    uv, z = g.project(g.unproject(depth, K), K)
    torch.testing.assert_close(uv, pixel_grid(SIZE).expand(2, -1, -1, -1))
    torch.testing.assert_close(z, depth[:, 0])


@pytest.mark.parametrize("angle", [0.0, 0.15, 2.5])
def test_rays_equal_unproject_transform_project(angle):
    depth = depth_map(3)
    T = relative_transformation(pose((0.2, 1, 0.1), angle, (0.4, -0.1, 0.2)), pose())
    K_left, K_right = camera(), camera(f=45.0, cx=20.0, cy=9.0)
    uv, z = g.project(g.transform(g.unproject(depth, K_left), T), K_right)
    rays = g.plane_rays(K_left, K_right, T, SIZE)
    uv_rays, z_rays = g.project_rays(depth, rays)
    torch.testing.assert_close(z_rays, z)
    torch.testing.assert_close(uv_rays, uv)


def test_zero_baseline_is_the_identity():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, 3, *SIZE, generator=generator)
    depth = depth_map(1, batch=2).float()
    K, T = camera(dtype=torch.float32).expand(2, -1, -1), torch.eye(4).expand(2, -1, -1)
    warped = g.warp_right_to_left(image, depth, K, K, T)
    torch.testing.assert_close(warped.image, image, atol=1e-5, rtol=0)
    assert warped.visible.all()
    assert not g.hidden_in_right(depth, K, K, T, SIZE).any()


@pytest.mark.parametrize("size_right", [(24, 32), (48, 64), (30, 20)])
def test_own_size_and_intrinsics_of_the_right_view(size_right):
    """A linear ramp as the right image reads back the analytic right pixel."""
    K_right = g.resize_intrinsics(camera(f=33.0, cx=17.0, cy=10.0), SIZE, size_right)
    ramp = pixel_grid(size_right).permute(0, 3, 1, 2)  # (1, 2, Hr, Wr): its own pixel coordinates
    depth = torch.full((1, 1, *SIZE), 2.5, dtype=torch.float64)
    T = relative_transformation(pose(at=(0.2, -0.05, 0.3)), pose())
    warped = g.warp_right_to_left(ramp, depth, camera(), K_right, T)
    u, v = pixel_grid(SIZE).unbind(-1)
    x, y, z = (u - 15.5) / 30 * 2.5 - 0.2, (v - 11.5) / 30 * 2.5 + 0.05, 2.5 - 0.3
    expected_u = K_right[0, 0, 0] * x / z + K_right[0, 0, 2]
    expected_v = K_right[0, 1, 1] * y / z + K_right[0, 1, 2]
    torch.testing.assert_close(warped.uv, torch.stack([expected_u, expected_v], dim=-1))
    inside = (expected_u >= 0) & (expected_u <= size_right[1] - 1)
    inside &= (expected_v >= 0) & (expected_v <= size_right[0] - 1)
    assert torch.equal(warped.visible[:, 0], inside) and 0.4 < inside.double().mean() < 1.0
    read = warped.image.permute(0, 2, 3, 1)[inside]
    torch.testing.assert_close(read, torch.stack([expected_u, expected_v], dim=-1)[inside])


def test_depth_at_and_behind_the_camera_is_finite_invisible_and_without_gradient():
    values = torch.tensor([2.0, 0.5, 0.25, 0.0, -1.0, 1e-9, 0.25 + 1e-12, 1e9])
    depth = values.repeat(1, 1, 4, 1).double().requires_grad_()
    T = relative_transformation(
        pose(at=(0.0, 0.0, 0.25)), pose()
    )  # the right camera is a quarter metre ahead
    K = camera(cx=3.5, cy=1.5)
    image = torch.rand(1, 1, 4, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    warped = g.warp_right_to_left(image, depth, K, K, T)
    points = g.transform(g.unproject(depth, K), T)
    uv, _ = g.project(points, K)
    (gradient,) = torch.autograd.grad(warped.image.sum() + warped.uv.sum() + uv.sum(), depth)
    behind = values <= 0.25 + 1e-6
    assert torch.isfinite(warped.image).all() and torch.isfinite(warped.uv).all() and torch.isfinite(uv).all()
    assert torch.isfinite(gradient).all()
    assert not warped.visible[..., behind].any() and (gradient[..., behind] == 0).all()
    assert warped.visible[..., 7].all()  # a point at infinity is seen


def test_camera_looking_away_sees_nothing():
    depth = depth_map()
    T = relative_transformation(pose((0, 1, 0), math.pi), pose())
    warped = g.warp_right_to_left(torch.rand(1, 3, *SIZE).double(), depth, camera(), camera(), T)
    assert not warped.visible.any() and torch.isfinite(warped.image).all()


def test_rotation_alone_moves_every_depth_alike():
    T = relative_transformation(pose((0, 1, 0), 0.1), pose())
    uv_near, _ = g.project_rays(depth_map(1), g.plane_rays(camera(), camera(), T, SIZE))
    uv_far, _ = g.project_rays(50 * depth_map(2), g.plane_rays(camera(), camera(), T, SIZE))
    torch.testing.assert_close(uv_near, uv_far)


@pytest.mark.parametrize("size_right", [(40, 60), (80, 120), (20, 30)])
def test_a_near_square_hides_the_strip_beside_it(size_right):
    """Right camera at +x: the square shifts left by more than the wall, and covers a strip at its left."""
    size = (40, 60)
    depth = torch.full((1, 1, *size), 4.0)
    depth[..., 10:30, 25:40] = 2.0
    K = torch.tensor([[[40.0, 0, 29.5], [0, 40.0, 19.5], [0, 0, 1]]])
    K_right = g.resize_intrinsics(K, size, size_right)
    T = relative_transformation(pose(at=(0.6, 0, 0), dtype=torch.float32), torch.eye(4)[None])
    hidden = g.hidden_in_right(depth, K, K_right, T, size_right)[0, 0]
    # disparities 12 and 6 px: wall pixels u with u - 6 in [25 - 12, 40 - 12), that is columns 19..24
    expected = torch.zeros(size, dtype=torch.bool)
    expected[10:30, 19:25] = True
    coarse = max(1, size[1] // size_right[1])  # a buffer cell covers that many left pixels
    assert (hidden != expected).sum() <= 2 * (20 + 6) * coarse
    assert hidden[12:28, 20:24].all()
    assert not hidden[12:28, 25 + coarse :].any() and not hidden[:, : 19 - coarse].any()


def test_a_slanted_floor_hides_nothing():
    v = torch.arange(40.0).view(1, 1, 40, 1).expand(1, 1, 40, 60)
    depth = 60.0 / (v + 5.0)
    K = torch.tensor([[[40.0, 0, 29.5], [0, 40.0, -5.0], [0, 0, 1]]])
    T = relative_transformation(
        pose((1, 0, 0), 0.05, (0.2, 0.1, 0.3), dtype=torch.float32), torch.eye(4)[None]
    )
    assert not g.hidden_in_right(depth, K, K, T, (40, 60)).any()


def test_functions_keep_the_dtype():
    for dtype in (torch.float32, torch.float64):
        K, T = camera(dtype=dtype), pose(dtype=dtype)
        depth = depth_map().to(dtype)
        warped = g.warp_right_to_left(torch.rand(1, 3, *SIZE, dtype=dtype), depth, K, K, T)
        assert {warped.image.dtype, warped.uv.dtype, warped.z_right.dtype} == {dtype}
        assert g.resize_intrinsics(K, SIZE, (10, 10)).dtype == dtype
        assert g.unproject(depth, K).dtype == dtype and g.nearest_rotation(K).dtype == dtype


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, True),
        ({"at": (0.5, 0.004, 0.004)}, True),
        ({"at": (0.5, 0.006, 0)}, False),
        ({"at": (0.5, 0, 0.006)}, False),
        ({"at": (0, 0, 0)}, False),
        ({"angle": 5e-4}, True),
        ({"angle": 2e-3}, False),
        ({"angle": 2e-3, "axis": (0, 0, 1)}, False),
        ({"cx": 25.0}, True),  # Middlebury's doffs
        ({"cy": 11.6}, False),
        ({"f": 30.1}, False),
    ],
)
def test_rectified_means_that_rows_are_epipolar_lines(change, expected):
    K_right = camera(**{name: change[name] for name in ("f", "cx", "cy") if name in change})
    E = pose(
        **({"at": (0.5, 0, 0)} | {name: change[name] for name in ("at", "angle", "axis") if name in change})
    )
    assert g.is_rectified(camera(), K_right, inverse_transformation(E)).tolist() == [expected]
