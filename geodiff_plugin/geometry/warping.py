"""The right image seen from the left camera, and which left pixels the right one does not see (S7.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from geodiff_plugin.geometry.cameras import image_size
from geodiff_plugin.geometry.projection import NEAREST_M, PlaneRays, made_there, plane_rays, project_rays

# Rounding of float32 at image edges: the last pixel centre itself must count as inside.
_EDGE_PX = 1e-2


@dataclass(frozen=True)
class Warped:
    """The right image on the left grid.

    Attributes:
        image: ``(B, C, H, W)``, the right image's values; its edge repeated where not visible.
        visible: ``(B, 1, H, W)`` bool, in front of the right camera and within its pixel centres.
        uv: ``(B, H, W, 2)`` pixels of the right image.
        z_right: ``(B, H, W)`` metres, depth in the right view.
    """

    image: torch.Tensor
    visible: torch.Tensor
    uv: torch.Tensor
    z_right: torch.Tensor


def sample_at(image: torch.Tensor, uv: torch.Tensor, *, mode: str = "bilinear") -> torch.Tensor:
    """Values ``(B, C, h, w)`` of an image ``(B, C, H, W)`` at ``uv (B, h, w, 2)`` pixels, its edge repeated.

    Differentiable in the image and, inside of it and for ``mode="bilinear"``, in ``uv``; other modes are
    ``"nearest"`` and ``"bicubic"``.

    Convention:
        (0, 0) is the centre of the first pixel. A ``uv`` that grows by 1 in its first component reads one
        pixel further right.
    """
    height, width = image.shape[-2:]
    # align_corners=True: -1 and 1 are the centres of the first and the last pixel, where uv counts from.
    # Like kornia's ``remap``, whose places differ by up to 6e-5 px; and it sends points behind the camera on.
    last = made_there(uv, max(width - 1, 1), max(height - 1, 1))
    grid = (2.0 * uv / last - 1.0).clamp(-2.0, 2.0)
    return F.grid_sample(image, grid, mode=mode, padding_mode="border", align_corners=True)


def _inside(uv: torch.Tensor, z: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """``(B, 1, H, W)`` bool: in front of the camera and within the pixel centres of an image of ``size``."""
    u, v = uv[..., 0], uv[..., 1]
    in_columns = (u >= -_EDGE_PX) & (u <= size[1] - 1 + _EDGE_PX)
    in_rows = (v >= -_EDGE_PX) & (v <= size[0] - 1 + _EDGE_PX)
    return (in_columns & in_rows & (z > NEAREST_M))[:, None]


def warp_right_to_left(
    right: torch.Tensor,
    depth_m: torch.Tensor,
    K_left: torch.Tensor,
    K_right: torch.Tensor,
    T_right_from_left: torch.Tensor,
    *,
    rays: PlaneRays | None = None,
) -> Warped:
    """Re-render the left image from the right one by the left depth (bilinear backward warp).

    As kornia's ``warp_frame_depth`` where that is defined: it takes one K, and does not say what is visible.

    Args:
        right: ``(B, C, Hr, Wr)`` float image, of any size.
        depth_m: ``(B, 1, H, W)`` float, metres, on the left grid.
        K_left: ``(B, 3, 3)`` float, pixels of the left grid.
        K_right: ``(B, 3, 3)``, pixels of ``right``.
        T_right_from_left: ``(B, 4, 4)``.
        rays: ``plane_rays`` of these cameras, where they are used again and again.

    Returns:
        ``Warped``. ``image`` is differentiable in ``depth_m`` and ``right``; its gradient in depth is zero
        where not visible. ``visible`` has no gradient.

    Convention:
        A right camera ``b`` metres to the right (``T[0, 3] = -b``): the left pixel ``u`` with depth z reads
        the right image at ``u - f * b / z``.

    Source: S7.2, with the map of Eq. 25 (eq:forward-warp_supp); Eq. 26 (eq:back-warp_supp) has the poses
        the wrong way round for camera-to-world matrices (docs/reference/paper-map.md, E1).
    """
    if rays is None:
        rays = plane_rays(K_left, K_right, T_right_from_left, image_size(depth_m))
    uv, z_right = project_rays(depth_m, rays)
    visible = _inside(uv, z_right, image_size(right))
    return Warped(sample_at(right, uv), visible, uv, z_right)


@torch.no_grad()
def hidden_in_right(
    depth_m: torch.Tensor,
    K_left: torch.Tensor,
    K_right: torch.Tensor,
    T_right_from_left: torch.Tensor,
    size_right: tuple[int, int],
    *,
    margin: float = 0.05,
    rays: PlaneRays | None = None,
) -> torch.Tensor:
    """Left pixels that another part of the left surface hides from the right camera, ``(B, 1, H, W)``.

    The surface is splatted into a depth buffer of the right view; a pixel is hidden when the buffer at its
    place is nearer than the pixel by more than the relative ``margin``. False outside of the right image, of
    ``size_right`` ``(Hr, Wr)``. Other arguments as for ``warp_right_to_left``; not differentiable.
    """
    batch, _, height, width = depth_m.shape
    if rays is None:
        rays = plane_rays(K_left, K_right, T_right_from_left, (height, width))
    uv, z = project_rays(depth_m, rays)
    seen = _inside(uv, z, size_right)[:, 0]  # (B, H, W)
    # No finer than the left grid, else the splatted surface has holes that show what is behind it.
    rows, columns = min(size_right[0], height), min(size_right[1], width)
    scale = made_there(uv, columns / size_right[1], rows / size_right[0])
    cell = (uv + 0.5) * scale - 0.5
    far = torch.finfo(z.dtype).max
    z_seen = torch.where(seen, z, torch.full_like(z, far))

    def index(at: torch.Tensor) -> torch.Tensor:
        column, row = at[..., 0].clamp(0, columns - 1).long(), at[..., 1].clamp(0, rows - 1).long()
        return (row * columns + column).flatten(1)

    buffer = z.new_full((batch, rows * columns), far)
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):  # every cell within 3/4 px: slopes leave no holes
        target = cell.floor() + made_there(cell, *step)
        near = ((target - cell).abs() <= 0.75).all(dim=-1)
        z_splat = torch.where(near, z_seen, torch.full_like(z, far))
        buffer.scatter_reduce_(1, index(target), z_splat.flatten(1), "amin")
    nearest = buffer.gather(1, index(cell.round())).view(batch, height, width)
    return ((z_seen > nearest * (1.0 + margin)) & seen)[:, None]
