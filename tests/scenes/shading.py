"""Shading of a hit: texture, light, haze, and what mirrors and glass add.

Data flow: nearest hits of ray bundles -> linear radiance, and what the surface reflects or lets through.
Paper: none; mirrors and glass are the hard cases of S5.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from tests.scenes.lighting import Lighting, SurfacePoints, ambient_light, direct_light, sky_radiance, unit
from tests.scenes.patterns import LAYERS
from tests.scenes.primitives import surface
from tests.scenes.scene import Material
from tests.scenes.textures import Atlas, sample_atlas
from tests.scenes.tracing import Bundles
from tests.scenes.world import World

__all__ = ["Shaded", "shade"]


@dataclass(frozen=True)
class Shaded:
    """Radiance and what is needed for one bounce; all ``(B, P)`` or ``(3, B, P)``.

    Attributes:
        radiance: ``(3, B, P)`` linear, without reflection.
        normal: ``(3, B, P)`` unit, towards the viewer.
        point: ``(3, B, P)`` world.
        mirror: share that a reflection contributes.
        through: share that is seen through the surface.
        material: int64 ``Material``.
    """

    radiance: torch.Tensor
    normal: torch.Tensor
    point: torch.Tensor
    mirror: torch.Tensor
    through: torch.Tensor
    material: torch.Tensor


def _albedo(atlas: Atlas, row: torch.Tensor, uv_m: torch.Tensor, footprint_m: torch.Tensor):
    """Albedo ``(3, n)`` and texture gloss ``(n,)`` from the parameter rows ``(F, n)``."""
    tile = row[20:22]
    uv = uv_m / tile + row[22:24]
    width = footprint_m / torch.minimum(tile[0], tile[1])
    layer = row[19].long()
    texel = sample_atlas(atlas, layer, uv, width).t()
    # A broad second noise hides the repetition of the tile.
    broad = sample_atlas(atlas, torch.full_like(layer, LAYERS["fbm"]), uv * 0.17 + 0.3, width * 0.17)[:, 0]
    a, b, c = row[24:27], row[27:30], row[30:33]
    colour = a + (b - a) * texel[0]
    colour = colour + (c - colour) * texel[1]
    shade = texel[3] * (1 + row[34] * (broad - 0.5) * 1.6)
    colour = colour * shade
    if atlas.images:
        photo = layer >= atlas.photo_from
        colour = torch.where(photo, texel[:3] * (0.4 + 1.2 * a), colour)
        return colour, torch.where(photo, torch.zeros_like(shade), texel[2])
    return colour, texel[2]


def _surface_rows(world: World, prim: torch.Tensor, point: torch.Tensor, direction: torch.Tensor):
    """Parameter rows ``(F, n)`` of the hits, normals towards the viewer, metres along u and v."""
    row = world.table.index_select(1, prim.clamp_min(0).flatten())
    flat = point.reshape(3, -1)
    local = torch.stack(
        [row[k] * flat[0] + row[k + 1] * flat[1] + row[k + 2] * flat[2] + row[k + 3] for k in (1, 5, 9)]
    )
    n, uv_m = surface(row[0].long(), local, row[13:16], row[16:18])
    normal = torch.stack([row[1 + k] * n[0] + row[5 + k] * n[1] + row[9 + k] * n[2] for k in range(3)])
    normal = unit(normal).reshape(point.shape)
    return row, normal * -torch.sign((normal * direction).sum(0)), uv_m


def _specular(material: torch.Tensor, gloss: torch.Tensor, cosine: torch.Tensor, live: torch.Tensor):
    """Fractions of the radiance that a reflection and what lies behind glass contribute."""
    fresnel = (1 - cosine).pow(4)
    is_mirror, is_glass = material == int(Material.MIRROR), material == int(Material.GLASS)
    mirror = ((gloss - 0.3).clamp_min(0) * (0.15 + 0.7 * fresnel) - 0.035).clamp_min(0)
    mirror = torch.where(is_glass, 0.08 + 0.7 * fresnel, mirror).masked_fill(is_mirror, 0.9)
    return mirror * live, is_glass * (1 - mirror) * 0.85 * live


def shade(
    world: World,
    light: Lighting,
    atlas: Atlas,
    rays: Bundles,
    t: torch.Tensor,
    prim: torch.Tensor,
    footprint: torch.Tensor,
    first: bool,
) -> Shaded:
    """Shade the nearest hits of ray bundles.

    Args:
        world: primitives.
        light: lights and sky.
        atlas: textures.
        rays: the rays that were followed.
        t: ``(B, P)`` distances, inf for the sky.
        prim: ``(B, P)`` what was hit, -1 for the sky.
        footprint: ``(B, P)`` metres that a pixel covers at distance 1 of ``t``.
        first: primary rays (ambient occlusion, all shadows, reflections) rather than a bounce.
    """
    live = prim >= 0
    t0 = t.masked_fill(~live, 0.0)
    direction = unit(rays.direction).expand(3, *t.shape)
    point = rays.origin + rays.direction * t0
    row, normal, uv_m = _surface_rows(world, prim, point, direction)
    cosine = (normal * direction).sum(0).abs().clamp(0.02, 1)
    spread = footprint * t0 * cosine.rsqrt()
    albedo, pane = _albedo(atlas, row, uv_m, spread.flatten())
    gloss = torch.maximum(row[33], pane).reshape(t.shape)
    at = SurfacePoints(rays.scene, point, normal, direction, prim, live, gloss)
    diffuse, highlight = direct_light(world, light, at, 99 if first else 1)
    ambient = ambient_light(world, light, at, first)
    radiance = albedo.reshape(point.shape) * (diffuse + ambient + row[35].reshape(t.shape)) + highlight * 0.25
    # Haze pulls towards its colour; the sky keeps its own.
    fog = light.fog[rays.scene]
    clear = torch.exp(-fog[:, 3, None] * t0 * rays.direction.square().sum(0).sqrt())
    radiance = fog[:, :3].t()[..., None] * (1 - clear) + radiance * clear
    (open_,) = (~live).any(-1).nonzero(as_tuple=True)
    if open_.numel():
        sky = sky_radiance(light, atlas, rays.scene[open_], direction[:, open_])
        radiance[:, open_] = torch.where(live[open_], radiance[:, open_], sky)
    material = row[18].long().reshape(t.shape).masked_fill(~live, int(Material.SKY))
    mirror = through = torch.zeros_like(t0)
    if first:
        mirror, through = _specular(material, gloss, cosine, live)
    shiny = (material == int(Material.DIFFUSE)) & (gloss > 0.45)
    return Shaded(radiance, normal, point, mirror, through, material.masked_fill(shiny, int(Material.GLOSSY)))
