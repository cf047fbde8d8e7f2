"""Two pinhole cameras: intrinsics, projection, backward warping, what is hidden (S3.3, S7.2).

Rigid transforms are kornia's (``kornia.geometry.linalg``). Where another function of kornia is similar, a
comment says why it is not used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from kornia.geometry.linalg import transform_points
from torch import Tensor

#: Two cameras count as rectified if they are parallel to within so many radians.
ANGLE_TOLERANCE = 1e-3
#: Their baseline may leave the sideways direction by this share of its length.
SIDEWAYS_TOLERANCE = 0.01
#: ``(4, 4)``, from a camera's frame with y down and z forward to one with y up and z backward, and back.
#: OpenGL, Blender, NeRF and glTF use the latter. kornia's ``camtoworld_graphics_to_vision_4x4`` turns the
#: axes of a pose in the world; a relative pose needs both sides.
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
# Nearer than this a point counts as behind the camera: its pixel would be a division by almost 0.
NEAREST_M = 1e-4
# Where such a point is put: finite, and outside of any image.
_BEHIND_PX = -1e6
# Rounding of float32 at image edges: the last pixel centre itself must count as inside.
EDGE_PX = 1e-2
#: By how much less, relative to it, another depth hides a pixel: more than a slope rises from cell to cell.
HIDDEN_MARGIN = 0.05


def image_size(image: Tensor) -> tuple[int, int]:
    """``(H, W)`` of an image or a map ``(..., H, W)``."""
    return image.shape[-2], image.shape[-1]


def stacked(parts: Sequence[Tensor]) -> Tensor:
    """Tensors along a new first axis; a single one is copied only if it is not contiguous."""
    return parts[0].contiguous()[None] if len(parts) == 1 else torch.stack(list(parts))


def resize_intrinsics(K: Tensor, size_from: tuple[int, int], size_to: tuple[int, int]) -> Tensor:
    """``K (B, 3, 3)`` after its image is resized between two ``(H, W)``, per axis, with the half-pixel shift.

    Convention:
        An integer is a pixel centre, so an image keeps its outer edges at -0.5 and ``W - 0.5``: ``cx =
        319.5`` of 640 columns becomes 159.5 of 320.
    """
    before = K.numpy(force=True)
    scale = np.array([size_to[1] / size_from[1], size_to[0] / size_from[0], 1.0], before.dtype)
    half = np.array([0.5, 0.5, 0.0], before.dtype)
    resized = before * scale[:, None]
    resized[:, :, 2] = (before[:, :, 2] + half) * scale - half
    return to_device_of(K, resized)


def scaled_size(size: tuple[int, int], rows: float, columns: float) -> tuple[int, int]:
    """A size ``(H, W)`` times a factor for each axis, a pixel at least."""
    return max(1, round(size[0] * rows)), max(1, round(size[1] * columns))


def size_within(size: tuple[int, int], most_pixels: int) -> tuple[int, int]:
    """A size ``(H, W)``, smaller by one factor for both axes where it has more than ``most_pixels``."""
    factor = min(1.0, math.sqrt(most_pixels / (size[0] * size[1])))
    return scaled_size(size, factor, factor)


def resize_image(image_01: Tensor, K: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """An image ``(C, H, W)`` at another ``size`` (antialiased), and the ``K (3, 3)`` that belongs to it."""
    before = image_size(image_01)
    if before == size:
        return image_01, K
    resized = F.interpolate(image_01[None], size, mode="bilinear", align_corners=False, antialias=True)[0]
    return resized, resize_intrinsics(K[None], before, size)[0]


def as_fine_as(image_01: Tensor, K: Tensor, K_left: Tensor) -> tuple[Tensor, Tensor]:
    """A further image ``(C, H, W)`` at no more pixels per radian than the left one, and its K.

    Then neither image aliases in the other. Each axis has its own factor: rounding to whole pixels changes
    them differently, and a rectified pair must stay rectified.
    """
    focal_left, focal = (each.numpy(force=True).diagonal() for each in (K_left, K))
    columns, rows, _ = np.minimum(focal_left / focal, 1.0).tolist()
    return resize_image(image_01, K, scaled_size(image_size(image_01), rows, columns))


def is_rectified(K_left: Tensor, K_right: Tensor, T_right_from_left: Tensor) -> np.ndarray:
    """Whether points differ along rows only, ``(...)`` bool, for ``(..., 3, 3)`` and ``(..., 4, 4)``.

    The rotation is the identity to 1e-3 an entry, ``|t_y|`` and ``|t_z|`` are below 1 % of ``|t_x|``, f
    agrees to 0.1 %, skew and cy to 0.1 % of f; cx may differ. Both K have as many pixels per radian.
    """
    K, K_r, T = (each.numpy(force=True) for each in (K_left, K_right, T_right_from_left))
    turned = np.abs(T[..., :3, :3] - np.eye(3, dtype=T.dtype)).max((-2, -1))
    t = np.abs(T[..., :3, 3])
    uneven = np.abs(K - K_r)[..., [0, 0, 1, 1], [0, 1, 1, 2]].max(-1)
    sideways = t[..., 1:].max(-1) < SIDEWAYS_TOLERANCE * t[..., 0]
    return (turned <= ANGLE_TOLERANCE) & sideways & (uneven <= ANGLE_TOLERANCE * K[..., 1, 1])


class PlaneRays(NamedTuple):
    """Where a left pixel goes in the right view: the line ``z * infinity + centre`` in its depth z.

    Both are homogeneous right pixels: of the pixel's point at infinity, and of the left camera's centre.
    """

    infinity: Tensor  # (B, 3, H * W)
    centre: Tensor  # (B, 3, 1)


def to_device_of(like: Tensor, matrix: Tensor | np.ndarray) -> Tensor:
    """A camera matrix, or positions made of cameras, on the device of ``like``, in its own dtype.

    Cameras stay on the CPU, where decisions about them are taken, until they meet pixels. The host does not
    wait: a copy of so few bytes from its memory is staged at once.
    """
    given = torch.from_numpy(np.ascontiguousarray(matrix)) if isinstance(matrix, np.ndarray) else matrix
    return given.to(like.device, non_blocking=True)


def constant_like(like: Tensor, *values: float) -> Tensor:
    """A vector of ``like``'s dtype on its device, by one copy: filling values in there is a launch each."""
    return to_device_of(like, torch.tensor(values, dtype=like.dtype, device="cpu"))


def unproject(depth_m: Tensor, K: Tensor) -> Tensor:
    """Points ``(B, H, W, 3)`` metres of a depth map ``(B, 1, H, W)`` in its camera's frame, with skew.

    Convention:
        The pixel at the principal point has ``x = y = 0``; one focal length to its right has ``x = z``.
    """
    K = to_device_of(depth_m, K).to(depth_m.dtype)
    x, y = _rays(image_size(depth_m), K)
    rays = torch.stack([x, y.expand_as(x), torch.ones_like(x)], dim=-1)
    return rays * depth_m[:, 0, ..., None]


# kornia's ``unproject_meshgrid`` has no skew, and works on every pixel where a row or a column is enough.
def _rays(size: tuple[int, int], K: Tensor) -> tuple[Tensor, Tensor]:
    """``x (B, H, W)`` and ``y (B, H, 1)`` of the points at z = 1 behind every pixel."""
    rows, columns = (torch.arange(count, device=K.device, dtype=K.dtype) for count in size)
    fx, skew, cx, fy, cy = (K[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    y = (rows[:, None] - cy) / fy
    return (columns - cx) / fx - skew / fx * y, y


def transform(points: Tensor, T: Tensor) -> Tensor:
    """Points ``(B, H, W, 3)`` of frame b in frame a, by ``T (B, 4, 4)``, ``T_a_from_b``; differentiable."""
    return transform_points(T, points.flatten(1, 2)).view_as(points)


def _in_front(z: Tensor) -> tuple[Tensor, Tensor]:
    """Mask of points in front of the camera, and a z that is safe to divide by everywhere."""
    in_front = z > NEAREST_M
    return in_front, torch.where(in_front, z, torch.ones_like(z))


# kornia's ``project_points`` has no skew, and mirrors points behind the camera into the image.
def project(points: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels ``uv (B, H, W, 2)`` and ``z (B, H, W)`` metres of points ``(B, H, W, 3)`` in a camera's frame.

    At or behind the camera (``z <= NEAREST_M``) ``uv`` is finite, outside of any image, without gradient.
    """
    z, K = points[..., 2], to_device_of(points, K)
    in_front, z_safe = _in_front(z)
    x, y = (points[..., i] / z_safe for i in (0, 1))
    fx, skew, cx, fy, cy = (K[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    uv = torch.stack([fx * x + skew * y + cx, fy * y + cy], dim=-1)
    return torch.where(in_front[..., None], uv, torch.full_like(uv, _BEHIND_PX)), z


def plane_rays(
    K_left: Tensor, K_right: Tensor, T_right_from_left: Tensor, size: tuple[int, int]
) -> PlaneRays:
    """The part of the projection from a left grid ``(H, W)`` to the right image that does not need depth.

    The third component of a homogeneous right pixel is the depth there. Rays are made on the device of the
    cameras.

    Source: Eq. 25 (eq:forward-warp_supp), with the products of matrices taken once.
    """
    x, y = _rays(size, K_left)
    M = K_right @ T_right_from_left[:, :3, :3]
    by_x, by_y, rest = M[..., None].unbind(2)  # (B, 3, 1) each
    # Not a matrix product, which TF32 rounds by a quarter pixel.
    infinity = (rest + by_y * y.mT)[..., None] + by_x[..., None] * x[:, None]
    return PlaneRays(infinity.flatten(2), K_right @ T_right_from_left[:, :3, 3:])


def rays_of(like: Tensor, K_left: Tensor, K_right: Tensor, T_right_from_left: Tensor) -> PlaneRays:
    """``plane_rays`` for the grid of a map or an image ``like (B, C, H, W)``, on its device."""
    K_left, K_right, T = (to_device_of(like, each) for each in (K_left, K_right, T_right_from_left))
    return plane_rays(K_left, K_right, T, image_size(like))


def project_rays(depth_m: Tensor, rays: PlaneRays) -> tuple[Tensor, Tensor]:
    """Pixels ``(B, H, W, 2)`` and depth in the right view ``(B, H, W)`` of a left depth map, as ``project``.

    ``depth_m (B, 1, H, W)`` metres lies on the grid of the rays; differentiable in it.
    """
    height, width = depth_m.shape[-2:]
    p = depth_m.flatten(2) * rays.infinity + rays.centre  # (B, 3, H * W)
    z = p[:, 2]
    in_front, z_safe = _in_front(z)
    uv = torch.where(in_front[:, None], p[:, :2] / z_safe[:, None], torch.full_like(p[:, :2], _BEHIND_PX))
    return uv.transpose(1, 2).unflatten(1, (height, width)), z.unflatten(1, (height, width))


@dataclass(frozen=True)
class Warped:
    """A right image seen from the left camera."""

    image: Tensor  # (B, C, H, W) on the left grid, the edge of the right image repeated where not visible
    visible: Tensor  # (B, 1, H, W) bool, in front of the right camera and within its pixel centres


def sample_at(image: Tensor, uv: Tensor, *, mode: str = "bilinear") -> Tensor:
    """Values ``(B, C, h, w)`` of an image ``(B, C, H, W)`` at ``uv (B, h, w, 2)`` pixels, its edge repeated.

    Convention:
        (0, 0) is the centre of the first pixel; the first component of ``uv`` grows to the right.
    """
    height, width = image.shape[-2:]
    # align_corners=True: -1 and 1 are the centres of the first and the last pixel, where uv counts from.
    # kornia's ``remap`` differs by up to 6e-5 px, and does not clamp points behind the camera.
    last = constant_like(uv, max(width - 1, 1), max(height - 1, 1))
    grid = (2.0 * uv / last - 1.0).clamp(-2.0, 2.0)
    return F.grid_sample(image, grid, mode=mode, padding_mode="border", align_corners=True)


def _inside(uv: Tensor, z: Tensor, size: tuple[int, int]) -> Tensor:
    """``(B, 1, H, W)`` bool: in front of the camera and within the pixel centres of an image of ``size``."""
    u, v = uv[..., 0], uv[..., 1]
    in_columns = (u >= -EDGE_PX) & (u <= size[1] - 1 + EDGE_PX)
    in_rows = (v >= -EDGE_PX) & (v <= size[0] - 1 + EDGE_PX)
    return (in_columns & in_rows & (z > NEAREST_M))[:, None]


def warp_right_to_left(
    right: Tensor,
    depth_m: Tensor,
    K_left: Tensor,
    K_right: Tensor,
    T_right_from_left: Tensor,
    *,
    rays: PlaneRays | None = None,
) -> Warped:
    """Re-render the left image from the right one by the left depth (bilinear backward warp).

    kornia's ``warp_frame_depth``, which gives the same, takes one K and does not return what is visible.
    ``right (B, C, Hr, Wr)`` is of any size, ``depth_m (B, 1, H, W)`` metres on the left grid; the image is
    differentiable in both where visible. ``rays`` are ``plane_rays`` of these cameras, to be reused.

    Convention:
        A right camera ``b`` metres to the right (``T[0, 3] = -b``): the left pixel ``u`` with depth z reads
        the right image at ``u - f * b / z``.

    Source: S7.2, with the map of Eq. 25 (eq:forward-warp_supp); Eq. 26 (eq:back-warp_supp) has the poses the
        wrong way round for camera-to-world matrices (docs/reference/paper-map.md, E1).
    """
    if rays is None:
        rays = rays_of(depth_m, K_left, K_right, T_right_from_left)
    uv, z_right = project_rays(depth_m, rays)
    visible = _inside(uv, z_right, image_size(right))
    return Warped(sample_at(right, uv), visible)


@torch.no_grad()
def hidden_in_right(
    depth_m: Tensor,
    K_left: Tensor,
    K_right: Tensor,
    T_right_from_left: Tensor,
    size_right: tuple[int, int],
    rays: PlaneRays | None = None,
) -> Tensor:
    """Left pixels that another part of the left surface hides from the right camera, ``(B, 1, H, W)`` bool.

    The surface is splatted into a depth buffer of the right view, of ``size_right (Hr, Wr)``; a pixel is
    hidden where the buffer is nearer by more than ``HIDDEN_MARGIN``, never outside the right image. ``rays``
    are ``plane_rays`` of these cameras, to be reused.
    """
    batch, _, height, width = depth_m.shape
    if rays is None:
        rays = rays_of(depth_m, K_left, K_right, T_right_from_left)
    uv, z = project_rays(depth_m, rays)
    seen = _inside(uv, z, size_right)[:, 0]  # (B, H, W)
    # No finer than the left grid, else the splatted surface has holes that show what is behind it.
    rows, columns = min(size_right[0], height), min(size_right[1], width)
    scale = constant_like(uv, columns / size_right[1], rows / size_right[0])
    cell = (uv + 0.5) * scale - 0.5
    far = torch.finfo(z.dtype).max
    z_seen = torch.where(seen, z, torch.full_like(z, far))

    def index(at: Tensor) -> Tensor:
        column, row = at[..., 0].clamp(0, columns - 1).long(), at[..., 1].clamp(0, rows - 1).long()
        return (row * columns + column).flatten(1)

    buffer = z.new_full((batch, rows * columns), far)
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):  # every cell within 3/4 px: slopes leave no holes
        target = cell.floor() + constant_like(cell, *step)
        near = ((target - cell).abs() <= 0.75).all(dim=-1)
        z_splat = torch.where(near, z_seen, torch.full_like(z, far))
        buffer.scatter_reduce_(1, index(target), z_splat.flatten(1), "amin")
    nearest = buffer.gather(1, index(cell.round())).view(batch, height, width)
    return ((z_seen > nearest * (1.0 + HIDDEN_MARGIN)) & seen)[:, None]
