"""From pixels with a depth to points and back, for one camera and across two (Eq. 9, Eq. 25)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.depth import unproject_meshgrid
from kornia.geometry.linalg import transform_points

from geodiff_plugin.geometry.cameras import image_size

# Nearer than this a point counts as behind the camera: its pixel would be a division by almost 0.
NEAREST_M = 1e-4
# Where such a point is put: finite, and outside of any image.
_BEHIND_PX = -1e6


class PlaneRays(NamedTuple):
    """Where a left pixel goes in the right view, as a line in its depth: ``p = z * A + b``.

    Attributes:
        A: ``(B, 3, H * W)``, homogeneous right pixel of the left pixel's point at infinity.
        b: ``(B, 3, 1)``, homogeneous right pixel of the left camera's centre (the epipole).
    """

    A: torch.Tensor
    b: torch.Tensor


def made_there(like: torch.Tensor, *values: float) -> torch.Tensor:
    """A small constant of ``like``'s dtype, made on its device: a list would be copied there, every time."""
    return torch.stack([like.new_full((), value) for value in values])


def unproject(depth_m: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """Points ``(B, H, W, 3)`` metres of a depth map ``(B, 1, H, W)`` in its camera's frame; differentiable.

    ``K (B, 3, 3)`` is in pixels of the map's grid. A skew ``K[0, 1]`` is obeyed, here and wherever a K is
    taken.

    Convention:
        The pixel at the principal point has ``x = y = 0``; one focal length to its right has ``x = z``.
    """
    return _rays(image_size(depth_m), K.to(depth_m.dtype)) * depth_m[:, 0, ..., None]


def _rays(size: tuple[int, int], K: torch.Tensor) -> torch.Tensor:
    """Points at z = 1 behind every pixel, ``(B, H, W, 3)``."""
    rays = unproject_meshgrid(*size, K, device=K.device, dtype=K.dtype)
    slant = (K[:, 0, 1] / K[:, 0, 0])[:, None, None]  # kornia's know no skew
    return torch.cat([rays[..., :1] - (slant * rays[..., 1])[..., None], rays[..., 1:]], dim=-1)


def transform(points: torch.Tensor, T: torch.Tensor) -> torch.Tensor:
    """Points ``(B, H, W, 3)`` of frame b in frame a, by ``T (B, 4, 4)``, ``T_a_from_b``; differentiable."""
    return transform_points(T, points.flatten(1, 2)).view_as(points)


def _in_front(z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mask of points in front of the camera, and a z that is safe to divide by everywhere."""
    in_front = z > NEAREST_M
    return in_front, torch.where(in_front, z, torch.ones_like(z))


# kornia's ``project_points`` knows no skew, and mirrors points behind the camera into the image.
def project(points: torch.Tensor, K: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels of points in a camera's frame.

    Args:
        points: ``(B, H, W, 3)`` float, metres, in the frame of the camera.
        K: ``(B, 3, 3)`` float, pixels.

    Returns:
        ``uv`` ``(B, H, W, 2)`` pixels (column, row) and ``z`` ``(B, H, W)`` metres. At or behind the camera
        (``z <= NEAREST_M``) ``uv`` is a finite place outside of any image, with zero gradient.
    """
    z = points[..., 2]
    in_front, z_safe = _in_front(z)
    x, y = (points[..., i] / z_safe for i in (0, 1))
    fx, skew, cx, fy, cy = (K[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    uv = torch.stack([fx * x + skew * y + cx, fy * y + cy], dim=-1)
    return torch.where(in_front[..., None], uv, torch.full_like(uv, _BEHIND_PX)), z


def plane_rays(
    K_left: torch.Tensor, K_right: torch.Tensor, T_right_from_left: torch.Tensor, size: tuple[int, int]
) -> PlaneRays:
    """Everything of the left-to-right projection that does not depend on depth.

    The pixel with depth z has the homogeneous right pixel ``z * A + b``, whose third component is its depth
    in the right view.

    Args:
        K_left: ``(B, 3, 3)`` float, pixels of the left grid of ``size`` ``(H, W)``.
        K_right: ``(B, 3, 3)``, pixels of the right image.
        T_right_from_left: ``(B, 4, 4)``.
        size: of the left grid.

    Source: Eq. 25 (eq:forward-warp_supp), with the products of matrices taken once.
    """
    rays = _rays(size, K_left).flatten(1, 2).transpose(1, 2)  # (B, 3, H * W)
    M = K_right @ T_right_from_left[:, :3, :3]
    A = (M[..., None] * rays[:, None]).sum(2)  # not a matrix product, which TF32 rounds by a quarter pixel
    b = K_right @ T_right_from_left[:, :3, 3:]
    return PlaneRays(A, b)


def project_rays(depth_m: torch.Tensor, rays: PlaneRays) -> tuple[torch.Tensor, torch.Tensor]:
    """Right-view pixels of a left depth map: ``project(transform(unproject))`` by precomputed rays, cheaper.

    ``depth_m (B, 1, H, W)`` metres lies on the grid of the rays. Returns ``uv (B, H, W, 2)`` pixels of the
    right image and ``z_right (B, H, W)`` metres, as ``project``; differentiable in depth.
    """
    height, width = depth_m.shape[-2:]
    p = depth_m.flatten(2) * rays.A + rays.b  # (B, 3, H * W)
    z = p[:, 2]
    in_front, z_safe = _in_front(z)
    uv = torch.where(in_front[:, None], p[:, :2] / z_safe[:, None], torch.full_like(p[:, :2], _BEHIND_PX))
    return uv.transpose(1, 2).unflatten(1, (height, width)), z.unflatten(1, (height, width))
