"""Pinhole cameras as bundles of rays: one bundle a square tile of pixels.

Data flow: ``Camera`` + image size -> ``Bundles``; maps over bundles -> images.
Paper: S3.3 (pinhole projection).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F

from tests.scenes.scene import Camera
from tests.scenes.tracing import Bundles

__all__ = ["TILE", "camera_rays", "intrinsics", "tile", "untile"]

TILE = 8
"""Side of a tile in pixels."""


def intrinsics(size: tuple[int, int], fov_deg: float) -> torch.Tensor:
    """Matrix with square pixels, a field of view along the longer side and a centred principal point.

    Args:
        size: ``(H, W)`` pixels.
        fov_deg: degrees.

    Returns:
        ``(3, 3)`` float64, pixels.
    """
    height, width = size
    f = max(height, width) / 2 / np.tan(np.radians(fov_deg) / 2)
    return torch.tensor([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]], dtype=torch.float64)


def camera_rays(
    cameras: Sequence[Camera],
    owner: torch.Tensor,
    size: tuple[int, int],
    device: str | torch.device,
    far: float,
) -> tuple[Bundles, torch.Tensor, torch.Tensor]:
    """Rays of all pixels; their ``t`` is planar depth, since directions have camera z = 1.

    Args:
        cameras: ``V`` cameras.
        owner: ``(V,)`` scene of each.
        size: ``(H, W)``; padded to whole tiles.
        device: where.
        far: how far to follow them, metres.

    Returns:
        bundles view by view, ``(B, P)`` metres that a pixel covers at depth 1, and ``(B, 3, 2)``
        by how much the direction changes from a pixel to the next along x and y.
    """
    height, width = -(-size[0] // TILE) * TILE, -(-size[1] // TILE) * TILE
    # Inverted in double on the CPU: every device gets the same rays.
    inverse = torch.linalg.inv(torch.stack([c.K for c in cameras]).cpu().double())
    pose = torch.stack([c.T_world_from_camera for c in cameras]).cpu().double()
    matrix = (pose[:, :3, :3] @ inverse).float().to(device)
    origin = pose[:, :3, 3].float().to(device)
    x = torch.arange(width, device=device, dtype=torch.float32).view(-1, TILE)
    y = torch.arange(height, device=device, dtype=torch.float32).view(-1, TILE)
    th, tw = y.shape[0], x.shape[0]
    px = x[None, :, None, :].expand(th, tw, TILE, TILE).reshape(1, th * tw, TILE * TILE)
    py = y[:, None, :, None].expand(th, tw, TILE, TILE).reshape(1, th * tw, TILE * TILE)
    direction = torch.stack(
        [
            matrix[:, k, 0, None, None] * px + matrix[:, k, 1, None, None] * py + matrix[:, k, 2, None, None]
            for k in range(3)
        ]
    ).flatten(1, 2)
    bundles, shape = th * tw, direction.shape[1:]
    rays = Bundles(
        owner.to(device).repeat_interleave(bundles),
        origin.t().repeat_interleave(bundles, 1)[..., None],
        direction,
        torch.full(shape, far, device=device),
        torch.full(shape, -1, device=device, dtype=torch.int64),
    )
    pixel = inverse[:, 0, 0].float().to(device).repeat_interleave(bundles)[:, None].expand(shape)
    return rays, pixel, matrix[:, :, :2].repeat_interleave(bundles, 0)


def untile(x: torch.Tensor, views: int, size: tuple[int, int]) -> torch.Tensor:
    """``(C, V * tiles, P)`` -> ``(V, C, H, W)``, padding cut off."""
    th, tw = -(-size[0] // TILE), -(-size[1] // TILE)
    x = x.reshape(x.shape[0], views, th, tw, TILE, TILE).permute(1, 0, 2, 4, 3, 5)
    return x.reshape(views, -1, th * TILE, tw * TILE)[:, :, : size[0], : size[1]].contiguous()


def tile(x: torch.Tensor) -> torch.Tensor:
    """``(V, C, H, W)`` -> ``(C, V * tiles, P)``, padded with zeros."""
    x = F.pad(x, (0, -x.shape[3] % TILE, 0, -x.shape[2] % TILE))
    views, channels, height, width = x.shape
    x = x.reshape(views, channels, height // TILE, TILE, width // TILE, TILE).permute(1, 0, 2, 4, 3, 5)
    return x.reshape(channels, -1, TILE * TILE)
