"""Rendering: cameras to ray bundles, nearest hits, light, one bounce, smooth edges, exposure.

Data flow: ``Scene`` + ``Camera`` -> ``RenderedView``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F

from geodiff_plugin._internal.checks import bad_value
from tests.scenes.cameras import TILE, camera_rays, tile, untile
from tests.scenes.lighting import Lighting, unit
from tests.scenes.scene import Camera, RenderedView, Scene
from tests.scenes.shading import Shaded, shade
from tests.scenes.textures import Atlas, atlas
from tests.scenes.tracing import Bundles, nearest
from tests.scenes.world import World

__all__ = ["LinearViews", "as_views", "expose", "render_linear", "render_views", "soften"]

_FAR = 1e4
# Rotated grid: four samples with four different rows and columns of the pixel.
_SUBPIXELS = ((-0.375, -0.125), (-0.125, 0.375), (0.125, -0.375), (0.375, 0.125))


@dataclass(frozen=True)
class LinearViews:
    """A batch of views before exposure.

    Attributes:
        radiance: ``(V, 3, H, W)`` linear.
        depth_m: ``(V, 1, H, W)``, inf for the sky.
        material: ``(V, 1, H, W)`` int64.
        edges: ``(V, 1, H, W)`` bool, pixels next to one of another primitive.
    """

    radiance: torch.Tensor
    depth_m: torch.Tensor
    material: torch.Tensor
    edges: torch.Tensor


@dataclass(frozen=True)
class _Stage:
    """Everything that rays meet."""

    world: World
    light: Lighting
    atlas: Atlas


def _bounce(
    stage: _Stage, rays: Bundles, hit: Shaded, prim: torch.Tensor, pixel: torch.Tensor
) -> torch.Tensor:
    """Add one reflection and what is seen through glass."""
    base = hit.radiance * (1 - hit.mirror - hit.through)
    (reflects,) = (hit.mirror > 0).any(-1).nonzero(as_tuple=True)
    (passes,) = (hit.through > 0).any(-1).nonzero(as_tuple=True)
    some = torch.cat([reflects, passes])
    if some.numel() == 0:
        return base
    direction = unit(rays.direction)
    mirrored = direction - 2 * (direction * hit.normal).sum(0) * hit.normal
    weight = torch.cat([hit.mirror[reflects], hit.through[passes]])
    way = torch.cat([mirrored[:, reflects], direction[:, passes]], 1)
    part = Bundles(rays.scene[some], hit.point[:, some], way, (weight > 0) * _FAR, prim[some])
    t, other = nearest(stage.world, part)
    seen = shade(stage.world, stage.light, stage.atlas, part, t, other, pixel[some] * 3, first=False)
    return base.index_add_(1, some, seen.radiance * weight)


def _follow(stage: _Stage, rays: Bundles, pixel: torch.Tensor):
    """Radiance ``(3, B, P)``, ``t``, primitive and material of primary rays."""
    t, prim = nearest(stage.world, rays)
    hit = shade(stage.world, stage.light, stage.atlas, rays, t, prim, pixel, first=True)
    return _bounce(stage, rays, hit, prim, pixel), t, prim, hit.material


def _find_edges(prim: torch.Tensor) -> torch.Tensor:
    """Pixels whose right, left, upper or lower neighbour shows another primitive."""
    across = prim[..., 1:] != prim[..., :-1]
    down = prim[..., 1:, :] != prim[..., :-1, :]
    edges = F.pad(across, (0, 1)) | F.pad(across, (1, 0))
    return edges | F.pad(down, (0, 0, 0, 1)) | F.pad(down, (0, 0, 1, 0))


def _supersample(
    stage: _Stage, rays: Bundles, steps: torch.Tensor, pixel: torch.Tensor, chosen: torch.Tensor
):
    """Mean radiance ``(3, n)`` over four samples of the chosen pixels (flat indices) of one scene."""
    count = chosen.shape[0]
    padded = torch.cat([chosen, chosen[-1:].expand(-count % (TILE * TILE))])
    shape = (padded.shape[0] // (TILE * TILE), TILE * TILE)
    bundle = padded // rays.t_max.shape[1]
    centre = rays.direction.flatten(1)[:, padded]
    along_x, along_y = steps[:, :, 0].t()[:, bundle], steps[:, :, 1].t()[:, bundle]
    part = Bundles(
        rays.scene[:1].expand(shape[0]),
        rays.origin[:, :1].expand(3, shape[0], 1),
        centre.reshape(3, *shape),
        rays.t_max.new_full(shape, _FAR),
        rays.skip.new_full(shape, -1),
    )
    width = pixel.flatten()[padded].reshape(shape)
    total = 0
    for dx, dy in _SUBPIXELS:
        moved = (centre + dx * along_x + dy * along_y).reshape(3, *shape)
        total = total + _follow(stage, replace(part, direction=moved), width)[0]
    return total.flatten(1)[:, :count] / len(_SUBPIXELS)


@torch.no_grad()
def render_linear(
    scenes: Sequence[Scene],
    cameras: Sequence[Camera],
    owner: Sequence[int],
    size: tuple[int, int],
    device: str | torch.device = "cpu",
    images: bool = False,
    antialias: bool = False,
) -> LinearViews:
    """Radiance and depth of a batch of views.

    Args:
        scenes: the worlds.
        cameras: ``V`` cameras.
        owner: ``V`` indices, the scene that each camera looks at.
        size: ``(H, W)`` pixels, the same for all.
        device: where to render.
        images: whether the scenes use photos as textures.
        antialias: shade pixels on outlines four times. Depth is always that of the pixel's centre.
    """
    stage = _Stage(World.gather(scenes, device), Lighting.gather(scenes, device), atlas(str(device), images))
    rays, pixel, steps = camera_rays(cameras, torch.as_tensor(owner), size, device, _FAR)
    radiance, t, prim, material = _follow(stage, rays, pixel)
    views = len(cameras)
    edges = _find_edges(untile(prim[None], views, size))
    if antialias:
        per_view = rays.scene.shape[0] // views
        flags = tile(edges)[0].flatten(1)
        for v in range(views):
            some = slice(v * per_view, (v + 1) * per_view)
            (chosen,) = flags[some].flatten().nonzero(as_tuple=True)
            if chosen.numel():
                mine = Bundles(
                    rays.scene[some],
                    rays.origin[:, some],
                    rays.direction[:, some],
                    rays.t_max[some],
                    rays.skip[some],
                )
                mean = _supersample(stage, mine, steps[some], pixel[some], chosen)
                radiance[:, some] = (
                    radiance[:, some].flatten(1).index_copy(1, chosen, mean).reshape(3, per_view, -1)
                )
    return LinearViews(
        untile(radiance, views, size),
        untile(t[None], views, size),
        untile(material[None], views, size),
        edges,
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
    image = torch.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(1e-6).pow(1 / 2.4) - 0.055
    )
    return image.clamp(0, 1), gain


def soften(image_01: torch.Tensor, edges: torch.Tensor) -> torch.Tensor:
    """Cheap antialiasing: outlines, and only they, take the binomial mean of their neighbourhood.

    Args:
        image_01: ``(V, 3, H, W)``.
        edges: ``(V, 1, H, W)`` bool.
    """
    x = F.pad(image_01, (1, 1, 1, 1), mode="replicate")
    x = (x[..., :-2] + 2 * x[..., 1:-1] + x[..., 2:]) / 4
    x = (x[..., :-2, :] + 2 * x[..., 1:-1, :] + x[..., 2:, :]) / 4
    return torch.where(edges, x, image_01)


def as_views(image: torch.Tensor, linear: LinearViews) -> list[RenderedView]:
    """Split a batch into records."""
    return [
        RenderedView(i, d, torch.isfinite(d), m)
        for i, d, m in zip(image, linear.depth_m, linear.material, strict=True)
    ]


def render_views(
    scene: Scene,
    views: list[Camera],
    size: tuple[int, int] = (192, 256),
    device: str | torch.device = "cpu",
    antialias: bool = True,
) -> list[RenderedView]:
    """Render a scene from several cameras, all with the exposure of the first.

    Args:
        scene: from ``sample_scene``.
        views: at least one camera.
        size: ``(H, W)`` pixels of every view.
        device: where to render.
        antialias: shade pixels on outlines four times.

    Returns:
        One view a camera, on the device.

    Raises:
        ValueError: no camera, or a size below 1.
    """
    if not views:
        bad_value("views", "a list of at least one Camera", "an empty list")
    if min(size) < 1:
        bad_value("size", "(H, W) in pixels", size)
    linear = render_linear([scene], views, [0] * len(views), size, device, antialias=antialias)
    _, gain = expose(linear.radiance[:1])
    image, _ = expose(linear.radiance, gain.expand(len(views)))
    return as_views(image, linear)
