"""Implements differentiable two-view geometry: projection, backward warping and occlusion (S7.2).

Comments explain why similar functions of kornia are not used.

Layer 1: imports ``cameras``; imported by all higher layers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.cameras import BEHIND_CAMERA_PX, Camera, keep_nearest, pixels_of_rays, rays_of_pixels

#: ``(4, 4)`` conversion between camera frames with y down, z forward and with y up, z backward, in either
#: direction. OpenGL, Blender, NeRF and glTF use the latter. kornia's ``camtoworld_graphics_to_vision_4x4``
#: converts the axes of a pose in the world; a relative pose needs both sides.
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
# Depth below which a point counts as behind the camera, since its projection would divide by almost 0.
NEAREST_M = 1e-4
# Tolerance at image edges: with float32 rounding, the last pixel centre must still count as inside.
EDGE_PX = 1e-2
#: Relative depth difference above which a nearer surface occludes a pixel: larger than the rise of a slope
#: between cells.
OCCLUSION_MARGIN = 0.05


def image_size(image: Tensor) -> tuple[int, int]:
    """Return ``(H, W)`` of an image or a map ``(..., H, W)``."""
    return image.shape[-2], image.shape[-1]


def stacked(parts: Sequence[Tensor]) -> Tensor:
    """Stack tensors along a new first axis; a single one is copied only if it is not contiguous."""
    return parts[0].contiguous()[None] if len(parts) == 1 else torch.stack(list(parts))


class PlaneRays(NamedTuple):
    """Epipolar line of each left pixel in the right view: ``z * infinity + centre`` for its depth z.

    Both are homogeneous right pixels: of the pixel's point at infinity, and of the left camera's centre.
    """

    infinity: Tensor  # (B, 3, H * W)
    centre: Tensor  # (B, 3, 1)


def to_device_of(like: Tensor, matrix: Tensor | np.ndarray) -> Tensor:
    """Copy a few numbers, such as positions from cameras, to the device of ``like``, in their own dtype.

    Cameras stay on the CPU, where decisions are made, until they are applied to pixels. The host does not
    wait, since a copy of so few bytes is staged immediately.
    """
    given = torch.from_numpy(np.ascontiguousarray(matrix)) if isinstance(matrix, np.ndarray) else matrix
    return given.to(like.device, non_blocking=True)


def on_device_of(like: Tensor, matrix: np.ndarray) -> Tensor:
    """Copy a camera matrix to the device and dtype of ``like``."""
    return to_device_of(like, torch.from_numpy(matrix).to(like.dtype))


def constant_like(like: Tensor, *values: float) -> Tensor:
    """Create a vector in ``like``'s dtype on its device by one copy, without a kernel launch per value."""
    return to_device_of(like, torch.tensor(values, dtype=like.dtype, device="cpu"))


def _in_front(z: Tensor) -> tuple[Tensor, Tensor]:
    """Return a mask of points in front of the camera, and a z that is safe to divide by."""
    in_front = z > NEAREST_M
    return in_front, torch.where(in_front, z, torch.ones_like(z))


# kornia's ``project_points`` does not support skew, and mirrors points behind the camera into the image.
def project(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Project points ``(..., 3)`` in a camera's frame to pixels ``uv (..., 2)`` and ``z (...)`` metres.

    At or behind the camera (``z <= NEAREST_M``) ``uv`` is finite, outside any image, without gradient.
    """
    z = points[..., 2]
    in_front, z_safe = _in_front(z)
    K = on_device_of(points, camera.K)
    uv = torch.stack(pixels_of_rays(K, points[..., 0] / z_safe, points[..., 1] / z_safe), dim=-1)
    return torch.where(in_front[..., None], uv, torch.full_like(uv, BEHIND_CAMERA_PX)), z


def plane_rays(
    like: Tensor, lefts: Sequence[Camera], rights: Sequence[Camera], Ts: Sequence[np.ndarray]
) -> PlaneRays:
    """Precompute the part of the projection from a left grid to the right image that does not need depth.

    ``lefts`` and ``rights`` are the cameras of each image of a batch, ``Ts (4, 4)`` their
    ``T_right_from_left``. Grid, device and dtype are as in ``like (B, C, H, W)``. The third component of a
    homogeneous right pixel is its depth.

    Source: Eq. 25 (eq:forward-warp_supp), with the products of matrices taken once.
    """
    K_left, K_right, T = (
        on_device_of(like, np.stack(each))
        for each in ([camera.K for camera in lefts], [camera.K for camera in rights], Ts)
    )
    rows, columns = (torch.arange(side, device=like.device, dtype=like.dtype) for side in image_size(like))
    x, y = rays_of_pixels(K_left[:, None, None], columns, rows[:, None])  # (B, H, W) and (B, H, 1)
    M = K_right @ T[:, :3, :3]
    by_x, by_y, rest = M[..., None].unbind(2)  # (B, 3, 1) each
    # Not a matrix product, which TF32 would round by a quarter pixel.
    infinity = (rest + by_y * y.mT)[..., None] + by_x[..., None] * x[:, None]
    return PlaneRays(infinity.flatten(2), K_right @ T[:, :3, 3:])


def project_rays(depth_m: Tensor, rays: PlaneRays) -> tuple[Tensor, Tensor]:
    """Project a left depth map to pixels ``(B, H, W, 2)`` and depth ``(B, H, W)`` in the right view.

    ``depth_m (B, 1, H, W)`` metres is on the grid of the rays. Differentiable in it.
    """
    height, width = depth_m.shape[-2:]
    p = depth_m.flatten(2) * rays.infinity + rays.centre  # (B, 3, H * W)
    z = p[:, 2]
    in_front, z_safe = _in_front(z)
    uv = torch.where(
        in_front[:, None], p[:, :2] / z_safe[:, None], torch.full_like(p[:, :2], BEHIND_CAMERA_PX)
    )
    return uv.transpose(1, 2).unflatten(1, (height, width)), z.unflatten(1, (height, width))


@dataclass(frozen=True)
class Warped:
    """A right image warped to the left view."""

    image: Tensor  # (B, C, H, W) on the left grid; border of the right image where not visible
    visible: Tensor  # (B, 1, H, W) bool, in front of the right camera and within its pixel centres


def sample_at(image: Tensor, uv: Tensor, *, mode: str = "bilinear") -> Tensor:
    """Sample an image ``(B, C, H, W)`` at pixels ``uv (B, h, w, 2)``, border replicated: ``(B, C, h, w)``.

    Convention:
        (0, 0) is the centre of the first pixel; the first component of ``uv`` grows to the right.
    """
    height, width = image.shape[-2:]
    # align_corners=True: -1 and 1 are the centres of the first and last pixel, where uv counts from. kornia's
    # ``remap`` differs by up to 6e-5 px and does not clamp points behind the camera.
    last = constant_like(uv, max(width - 1, 1), max(height - 1, 1))
    grid = (2.0 * uv / last - 1.0).clamp(-2.0, 2.0)
    return F.grid_sample(image, grid, mode=mode, padding_mode="border", align_corners=True)


def _inside(uv: Tensor, z: Tensor, size: tuple[int, int]) -> Tensor:
    """Return ``(B, 1, H, W)`` bool: in front of the camera and within the pixel centres of ``size``."""
    u, v = uv[..., 0], uv[..., 1]
    in_columns = (u >= -EDGE_PX) & (u <= size[1] - 1 + EDGE_PX)
    in_rows = (v >= -EDGE_PX) & (v <= size[0] - 1 + EDGE_PX)
    return (in_columns & in_rows & (z > NEAREST_M))[:, None]


def warp_right_to_left(right: Tensor, depth_m: Tensor, rays: PlaneRays) -> Warped:
    """Re-render the left image from the right one with the left depth (bilinear backward warp).

    kornia's ``warp_frame_depth`` gives the same image but takes one K and does not return visibility. ``right
    (B, C, Hr, Wr)`` has any size; ``depth_m (B, 1, H, W)`` metres is on the left grid of the ``rays``. The
    image is differentiable in both where visible.

    Convention:
        For a right camera ``b`` metres to the right (``T[0, 3] = -b``), the left pixel ``u`` with depth z
        samples the right image at ``u - f * b / z``.

    Source: S7.2, with the map of Eq. 25 (eq:forward-warp_supp); Eq. 26 (eq:back-warp_supp) has the poses
        reversed for camera-to-world matrices (docs/explanation/method.md, E1).
    """
    uv, z_right = project_rays(depth_m, rays)
    visible = _inside(uv, z_right, image_size(right))
    return Warped(sample_at(right, uv), visible)


@torch.no_grad()
def occluded_in_right(depth_m: Tensor, rays: PlaneRays, size_right: tuple[int, int]) -> Tensor:
    """Return left pixels that the left surface itself occludes from the right camera, ``(B, 1, H, W)`` bool.

    The surface is splatted into a depth buffer of the right view, of ``size_right (Hr, Wr)``. A pixel is
    occluded if the buffer is nearer by more than ``OCCLUSION_MARGIN``, and never outside the right image.
    """
    batch, _, height, width = depth_m.shape
    uv, z = project_rays(depth_m, rays)
    seen = _inside(uv, z, size_right)[:, 0]  # (B, H, W)
    # No finer than the left grid; otherwise the splatted surface has holes that expose the background.
    rows, columns = min(size_right[0], height), min(size_right[1], width)
    scale = constant_like(uv, columns / size_right[1], rows / size_right[0])
    cell = (uv + 0.5) * scale - 0.5
    z_seen = torch.where(seen, z, torch.inf)

    def index(at: Tensor) -> Tensor:
        column, row = at[..., 0].clamp(0, columns - 1).long(), at[..., 1].clamp(0, rows - 1).long()
        return (row * columns + column).flatten(1)

    buffer = z.new_full((batch, rows * columns), torch.inf)
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):  # every cell within 3/4 px: slopes leave no holes
        target = cell.floor() + constant_like(cell, *step)
        near = ((target - cell).abs() <= 0.75).all(dim=-1)
        keep_nearest(buffer, index(target), torch.where(near, z_seen, torch.inf).flatten(1))
    nearest = buffer.gather(1, index(cell.round())).view(batch, height, width)
    return ((z_seen > nearest * (1.0 + OCCLUSION_MARGIN)) & seen)[:, None]
