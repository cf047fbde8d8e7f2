"""Visibility: objects that a camera stands in, could see, or that are occluded.

Data flow: ``Scene`` and cameras -> a smaller ``Scene``, or masks over the left image.
Paper: S3.3 (pixels that only one view sees).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from tests.scenes.scene import Camera, RenderedView, Scene, Shape
from tests.scenes.tracing import Bundles, nearest
from tests.scenes.world import World

__all__ = ["clear_of", "hidden_from_right", "in_sight"]

_PER_PRIMITIVE = frozenset(
    {
        "shape",
        "world_to_local",
        "half",
        "taper",
        "centre",
        "radius",
        "material",
        "layer",
        "tile_m",
        "tile_offset",
        "palette",
        "gloss",
        "macro",
        "emission",
        "fixed",
    }
)


def clear_of(scene: Scene, point: torch.Tensor, gap: float) -> Scene:
    """Leave out movable primitives that a camera at ``point`` would touch."""
    linear, offset = scene.world_to_local[:, :, :3], scene.world_to_local[:, :, 3]
    local = ((linear @ point.float()) + offset) * scene.half
    flat = (scene.shape == Shape.QUAD)[:, None] & torch.tensor([False, True, False])
    outside = (local.abs() - scene.half.masked_fill(flat, 0)).clamp_min(0).square().sum(-1).sqrt()
    keep = scene.fixed | (outside > gap)
    return _select(scene, keep)


def _select(scene: Scene, keep: torch.Tensor) -> Scene:
    """The scene with only some of its primitives."""
    return replace(scene, **{name: getattr(scene, name)[keep] for name in _PER_PRIMITIVE})


def in_sight(scene: Scene, views: Sequence[tuple[Camera, tuple[int, int]]], margin_m: float) -> Scene:
    """Leave out movable primitives outside of every view by more than a margin (they may cast shadows).

    Args:
        scene: any scene.
        views: cameras and their image sizes ``(H, W)``.
        margin_m: how far outside of the pyramid of view something may be and still be kept.
    """
    keep = scene.fixed
    extent = scene.radius + margin_m
    for camera, (height, width) in views:
        pose, K = camera.T_world_from_camera.float(), camera.K
        p = (scene.centre - pose[:3, 3]) @ pose[:3, :3]
        inside = p[:, 2] > -extent
        for axis, pixels in ((0, width), (1, height)):
            # Distance to the two side planes, where the pixel coordinate is that of the edge; they need
            # not be symmetric, nor upright where K has a skew.
            for sign, edge in ((-1, -0.5), (1, pixels - 0.5)):
                normal = sign * (K[axis].double() - K.new_tensor([0.0, 0.0, edge]).double())
                normal = (normal / normal.norm()).to(p)
                inside &= p @ normal < extent
        keep = keep | inside
    return _select(scene, keep)


@torch.no_grad()
def hidden_from_right(
    scene: Scene, left: RenderedView, K_left, K_right, E, right_size, device
) -> tuple[torch.Tensor, torch.Tensor]:
    """Cast a ray from the right camera to every left pixel's point: occluded, and inside the right image."""
    height, width = left.depth_m.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    ray = torch.linalg.inv(K_left) @ torch.stack([x, y, torch.ones_like(x)]).double().reshape(3, -1)
    depth = left.depth_m.reshape(1, -1).double().cpu()
    finite = torch.isfinite(depth)
    p_left = ray * torch.where(finite, depth, torch.full_like(depth, 1e7))
    inverse = torch.linalg.inv(E)
    p_right = inverse[:3, :3] @ p_left + inverse[:3, 3:]
    pixel = K_right @ p_right
    uv = pixel[:2] / pixel[2:].clamp_min(1e-9)
    limit = torch.tensor([[right_size[1] - 0.5], [right_size[0] - 0.5]], dtype=torch.float64)
    in_view = ((uv > -0.5) & (uv < limit)).all(0) & (pixel[2] > 1e-6)
    pose = scene.T_world_from_camera.double() @ E
    towards = (pose[:3, :3] @ p_right).float()
    count = height * width
    tiles = -(-count // 64)
    pad = tiles * 64 - count
    direction = torch.cat([towards, towards[:, :1].expand(3, pad)], 1).reshape(3, tiles, 64).to(device)
    origin = pose[:3, 3].float().view(3, 1, 1).expand(3, tiles, 1).to(device)
    shape = (tiles, 64)
    # A hit clearly before the point hides it; for the sky (a point at 1e7) any hit does.
    tolerance = 2e-3
    rays = Bundles(
        torch.zeros(tiles, dtype=torch.int64, device=device),
        origin,
        direction,
        torch.full(shape, 1 - tolerance, device=device),
        torch.full(shape, -1, device=device),
    )
    t, _ = nearest(World.gather([scene], device), rays)
    hidden = torch.isfinite(t).reshape(-1)[:count].reshape(1, height, width)
    return hidden, in_view.reshape(1, height, width).to(device)
