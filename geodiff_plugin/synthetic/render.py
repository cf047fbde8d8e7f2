"""Rendering: cameras to ray bundles, nearest hits, light, one bounce, exposure.

Hop: ``Scene`` + ``Camera`` -> ``RenderedView``.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin.synthetic.scene import Camera, RenderedView, Scene
from geodiff_plugin.synthetic.shading import Lighting, Shaded, shade
from geodiff_plugin.synthetic.textures import Atlas, atlas
from geodiff_plugin.synthetic.tracing import Bundles, World, nearest

__all__ = ["LinearViews", "as_views", "expose", "render_linear", "render_views"]

_TILE = 8
_FAR = 1e4


@dataclass(frozen=True)
class LinearViews:
    """A batch of views before exposure.

    Attributes:
        radiance: ``(V, 3, H, W)`` linear.
        depth_m: ``(V, 1, H, W)``, inf for the sky.
        material: ``(V, 1, H, W)`` int64.
    """

    radiance: torch.Tensor
    depth_m: torch.Tensor
    material: torch.Tensor


def _camera_rays(cameras: Sequence[Camera], owner: torch.Tensor, size: tuple[int, int], device) -> tuple[Bundles, torch.Tensor]:
    """Bundles of 8x8 pixels; ``t`` of a ray is planar depth. Also metres a pixel covers at depth 1."""
    height, width = -(-size[0] // _TILE) * _TILE, -(-size[1] // _TILE) * _TILE
    K = torch.stack([c.K for c in cameras]).double()
    pose = torch.stack([c.T_world_from_camera for c in cameras]).to(device, torch.float32)
    # Pixel -> camera direction with z = 1, then the world.
    inverse = torch.linalg.inv(K).to(device, torch.float32)
    x = torch.arange(width, device=device, dtype=torch.float32)
    y = torch.arange(height, device=device, dtype=torch.float32)
    row, column = y.view(-1, _TILE), x.view(-1, _TILE)
    th, tw = row.shape[0], column.shape[0]
    px = column[None, :, None, :].expand(th, tw, _TILE, _TILE).reshape(1, th * tw, _TILE * _TILE)
    py = row[:, None, :, None].expand(th, tw, _TILE, _TILE).reshape(1, th * tw, _TILE * _TILE)
    matrix = pose[:, :3, :3] @ inverse  # (V, 3, 3)
    direction = torch.stack([
        matrix[:, k, 0, None, None] * px + matrix[:, k, 1, None, None] * py + matrix[:, k, 2, None, None] for k in range(3)
    ]).flatten(1, 2)
    bundles = th * tw
    origin = pose[:, :3, 3].t().repeat_interleave(bundles, 1)[..., None]
    scene = owner.to(device).repeat_interleave(bundles)
    shape = direction.shape[1:]
    t_max = torch.full(shape, _FAR, device=device)
    skip = torch.full(shape, -1, device=device, dtype=torch.int64)
    pixel = inverse[:, 0, 0].repeat_interleave(bundles)[:, None].expand(shape)
    return Bundles(scene, origin, direction, t_max, skip), pixel


def _bounce(world: World, light: Lighting, table: Atlas, rays: Bundles, hit: Shaded, prim, pixel) -> torch.Tensor:
    """Add one reflection and what is seen through glass."""
    base = hit.radiance * (1 - hit.mirror - hit.through)
    direction = rays.direction * rays.direction.square().sum(0).rsqrt()
    mirrored = direction - 2 * (direction * hit.normal).sum(0) * hit.normal
    (reflects,) = (hit.mirror > 0).any(-1).nonzero(as_tuple=True)
    (passes,) = (hit.through > 0).any(-1).nonzero(as_tuple=True)
    some = torch.cat([reflects, passes])
    if some.numel() == 0:
        return base
    weight = torch.cat([hit.mirror[reflects], hit.through[passes]])
    way = torch.cat([mirrored[:, reflects], direction[:, passes]], 1)
    part = Bundles(rays.scene[some], hit.point[:, some], way, (weight > 0) * _FAR, prim[some])
    t, other = nearest(world, part)
    seen = shade(world, light, table, part, t, other, pixel[some] * 3, first=False)
    return base.index_add_(1, some, seen.radiance * weight)


def _untile(x: torch.Tensor, views: int, size: tuple[int, int]) -> torch.Tensor:
    """``(C, V * tiles, 64)`` -> ``(V, C, H, W)``."""
    th, tw = -(-size[0] // _TILE), -(-size[1] // _TILE)
    x = x.reshape(x.shape[0], views, th, tw, _TILE, _TILE).permute(1, 0, 2, 4, 3, 5)
    return x.reshape(views, -1, th * _TILE, tw * _TILE)[:, :, : size[0], : size[1]].contiguous()


@torch.no_grad()
def render_linear(
    scenes: Sequence[Scene],
    cameras: Sequence[Camera],
    owner: Sequence[int],
    size: tuple[int, int],
    device: str | torch.device = "cpu",
    photographs: bool = False,
) -> LinearViews:
    """Radiance and depth of a batch of views.

    Args:
        scenes: the worlds.
        cameras: ``V`` cameras.
        owner: ``V`` indices, the scene that each camera looks at.
        size: ``(H, W)`` pixels, the same for all.
        device: where to render.
        photographs: the scenes use photographs as textures.
    """
    world, light = World.gather(scenes, device), Lighting.gather(scenes, device)
    table = atlas(str(device), photographs)
    rays, pixel = _camera_rays(cameras, torch.as_tensor(owner), size, device)
    t, prim = nearest(world, rays)
    hit = shade(world, light, table, rays, t, prim, pixel, first=True)
    radiance = _bounce(world, light, table, rays, hit, prim, pixel)
    views = len(cameras)
    return LinearViews(
        _untile(radiance, views, size), _untile(t[None], views, size), _untile(hit.material[None], views, size)
    )


def expose(radiance: torch.Tensor, gain: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Auto exposure with a soft shoulder, then sRGB.

    Args:
        radiance: ``(V, 3, H, W)`` linear.
        gain: ``(V,)`` exposure to use; None measures it, from the mean of the log luminance.

    Returns:
        ``(V, 3, H, W)`` in [0, 1] and the gain used.
    """
    if gain is None:
        luminance = radiance.mean(1).clamp_min(1e-4)
        gain = 0.26 / luminance.log().mean((1, 2)).exp()
        gain = torch.minimum(gain, 0.75 / luminance.mean((1, 2)).clamp_min(1e-4))
    linear = 1 - torch.exp(-1.25 * radiance * gain[:, None, None, None])
    image = torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(1e-6).pow(1 / 2.4) - 0.055)
    return image.clamp(0, 1), gain


def render_views(
    scene: Scene, views: list[Camera], size: tuple[int, int] = (192, 256), device: str | torch.device = "cpu"
) -> list[RenderedView]:
    """Render a scene from several cameras, all with the exposure of the first.

    Args:
        scene: from ``sample_scene``.
        views: at least one camera.
        size: ``(H, W)`` pixels of every view.
        device: where to render.

    Returns:
        One view a camera, on the device.

    Raises:
        ValueError: no camera, or a size below 1.
    """
    if not views:
        bad_value("views", "a list of at least one Camera", "an empty list")
    if min(size) < 1:
        bad_value("size", "(H, W) in pixels", size)
    linear = render_linear([scene], views, [0] * len(views), size, device)
    _, gain = expose(linear.radiance[:1])
    image, _ = expose(linear.radiance, gain.expand(len(views)))
    return as_views(image, linear)


def as_views(image: torch.Tensor, linear: LinearViews) -> list[RenderedView]:
    """Split a batch into records."""
    return [
        RenderedView(i, d, torch.isfinite(d), m)
        for i, d, m in zip(image, linear.depth_m, linear.material, strict=True)
    ]

