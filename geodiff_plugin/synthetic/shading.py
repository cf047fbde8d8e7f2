"""Light on a hit: texture, ambient light with occlusion, lamps and sun with shadows, sky, fog.

Hop: nearest hits of ray bundles -> linear radiance, and what the surface reflects or lets through.
Paper: none; mirrors and glass are the hard cases of S5.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from geodiff_plugin.synthetic.patterns import LAYERS
from geodiff_plugin.synthetic.primitives import surface
from geodiff_plugin.synthetic.scene import Material, Scene
from geodiff_plugin.synthetic.textures import Atlas, sample_atlas
from geodiff_plugin.synthetic.tracing import Bundles, World, blocked, openness

__all__ = ["Lighting", "Shaded", "shade", "sky_radiance"]


@dataclass(frozen=True)
class Lighting:
    """Lights, sky and fog of a batch of ``S`` scenes.

    Attributes:
        position: ``(S, L, 3)``; ``directional`` ``(S, L)`` bool; ``colour`` ``(S, L, 3)``, black for unused slots.
        directional: see ``position``.
        colour: see ``position``.
        ambient: ``(S, 6)`` light from above and from below.
        sky: ``(S, 10)`` zenith, horizon, cloud colours and the cloud amount.
        fog: ``(S, 4)`` colour and density.
        ao_length: ``(S,)`` metres.
    """

    position: torch.Tensor
    directional: torch.Tensor
    colour: torch.Tensor
    ambient: torch.Tensor
    sky: torch.Tensor
    fog: torch.Tensor
    ao_length: torch.Tensor

    @classmethod
    def gather(cls, scenes: Sequence[Scene], device: str | torch.device) -> Lighting:
        """Stack the scenes' lights and move them to the device."""
        slots = max(s.light_position.shape[0] for s in scenes)

        def pad(x):
            return torch.cat([x, torch.zeros(slots - x.shape[0], *x.shape[1:], dtype=x.dtype)])

        return cls(
            torch.stack([pad(s.light_position) for s in scenes]).to(device),
            torch.stack([pad(s.light_directional) for s in scenes]).to(device),
            torch.stack([pad(s.light_colour) for s in scenes]).to(device),
            torch.stack([torch.cat([s.ambient_up, s.ambient_down]) for s in scenes]).to(device),
            torch.stack([torch.cat([s.sky.flatten(), torch.tensor([s.sky_clouds])]) for s in scenes]).to(device),
            torch.stack([torch.cat([s.fog_colour, torch.tensor([s.fog_density])]) for s in scenes]).to(device),
            torch.tensor([s.ao_length_m for s in scenes]).to(device),
        )


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


def _unit(v: torch.Tensor) -> torch.Tensor:
    return v * (v * v).sum(0).clamp_min(1e-20).rsqrt()


def sky_radiance(light: Lighting, atlas: Atlas, scene: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Sky seen along unit directions ``(3, B, P)``: brighter at the top or at the horizon as the scene says, clouds."""
    up = (-direction[1]).clamp_min(0)
    params = light.sky[scene]  # (B, 10)
    mix = 1 - (1 - up).pow(3)
    zenith, horizon, cloud = (params[:, k : k + 3].t()[..., None] for k in (0, 3, 6))
    base = horizon + (zenith - horizon) * mix
    reach = 0.12 / (up + 0.12)
    uv = torch.stack([direction[0] * reach, direction[2] * reach]).flatten(1)
    layer = torch.full_like(uv[0], LAYERS["clouds"], dtype=torch.int64)
    soft = sample_atlas(atlas, layer, uv, torch.full_like(uv[0], 0.004))[:, 0].reshape(up.shape)
    amount = (soft * params[:, 9, None] * (up * 6).clamp_max(1)).clamp(0, 1)
    return base + (cloud - base) * amount


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
    if atlas.photographs:
        photo = layer >= atlas.photo_from
        colour = torch.where(photo, texel[:3] * (0.4 + 1.2 * a), colour)
        return colour, torch.where(photo, torch.zeros_like(shade), texel[2])
    return colour, texel[2]


def _direct(world, light, scene, point, normal, view, prim, live, shine, gloss, shadows):
    """Diffuse light ``(3, B, P)`` and highlights ``(3, B, P)`` of all lamps and suns."""
    diffuse, highlight = torch.zeros_like(point), torch.zeros_like(point)
    for k in range(light.position.shape[1]):
        position = light.position[scene, k].t()[..., None]  # (3, B, 1)
        colour = light.colour[scene, k].t()[..., None]
        some_sun, all_sun = bool(light.directional[:, k].any()), bool(light.directional[:, k].all())
        if all_sun:
            towards = _unit(position)
            origin, ray, strength = point, towards * 500.0, 1.0
        else:
            sun = light.directional[scene, k][:, None]
            offset = position - point
            d2 = (offset * offset).sum(0)
            # From the lamp to the surface where all lights are lamps: an exact apex culls best.
            origin, ray, strength, towards = position, -offset, 1.0 / (0.4 + d2), offset * d2.clamp_min(1e-12).rsqrt()
            if some_sun:
                towards = torch.where(sun, _unit(position), towards)
                origin, ray = point, torch.where(sun, towards * 500.0, offset)
                strength = torch.where(sun, torch.ones_like(d2), strength)
        cosine = (normal * towards).sum(0).clamp_min(0)
        wanted = live & (cosine > 0) & (colour.sum(0) > 0)
        amount = cosine * strength
        if k < shadows:
            rays = Bundles(scene, origin, ray, wanted.to(point.dtype) * 0.999, prim)
            amount = amount * (1 - blocked(world, rays))
        diffuse += colour * amount
        half = _unit(towards - view)
        peak = (normal * half).sum(0).clamp_min(0).pow(shine) * gloss
        highlight += colour * (amount * peak * (0.5 + shine * 0.06))
    return diffuse, highlight


def _ambient(world, light, scene, point, normal, live, occlude):
    """Ambient light ``(3, B, P)``: more from above, less where something is near."""
    params = light.ambient[scene]
    above, below = params[:, :3].t()[..., None], params[:, 3:].t()[..., None]
    value = below + (above - below) * (0.5 - 0.5 * normal[1])
    if not occlude:
        return value * 0.8
    free = openness(world, scene, point, normal, live, light.ao_length[scene])
    return value * (0.25 + 0.75 * free)


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
        first: primary rays (ambient occlusion, reflections) rather than a bounce.
    """
    live = prim >= 0
    t0 = t.masked_fill(~live, 0.0)
    scene = rays.scene
    direction = _unit(rays.direction).expand(3, *t.shape)
    point = rays.origin + rays.direction * t0
    row = world.table.index_select(1, prim.clamp_min(0).flatten())
    n = row.shape[1]
    flat = point.reshape(3, n)
    local = torch.stack([row[k] * flat[0] + row[k + 1] * flat[1] + row[k + 2] * flat[2] + row[k + 3] for k in (1, 5, 9)])
    normal_l, uv_m = surface(row[0].long(), local, row[13:16], row[16:18])
    normal = torch.stack([row[1 + k] * normal_l[0] + row[5 + k] * normal_l[1] + row[9 + k] * normal_l[2] for k in range(3)])
    normal = _unit(normal).reshape(3, *t.shape)
    facing = (normal * direction).sum(0)
    normal = normal * -torch.sign(facing)
    cosine = facing.abs().clamp(0.02, 1)
    spread = (footprint * t0) * cosine.rsqrt()
    albedo, pane = _albedo(atlas, row, uv_m, spread.flatten())
    albedo = albedo.reshape(3, *t.shape)
    material = row[18].reshape(t.shape)
    gloss = torch.maximum(row[33], pane).reshape(t.shape)
    shine = 6 + 90 * gloss * gloss
    diffuse, highlight = _direct(world, light, scene, point, normal, direction, prim, live, shine, gloss, 99 if first else 1)
    ambient = _ambient(world, light, scene, point, normal, live, first)
    radiance = albedo * (diffuse + ambient + row[35].reshape(t.shape)) + highlight * 0.25
    # Fog pulls towards its colour; the sky keeps its own.
    fog = light.fog[scene]
    clear = torch.exp(-fog[:, 3, None] * t0 * rays.direction.square().sum(0).sqrt())
    radiance = fog[:, :3].t()[..., None] * (1 - clear) + radiance * clear
    (open_,) = (~live).any(-1).nonzero(as_tuple=True)
    if open_.numel():
        sky = sky_radiance(light, atlas, scene[open_], direction[:, open_])
        radiance[:, open_] = torch.where(live[open_], radiance[:, open_], sky)
    mirror, through = torch.zeros_like(t0), torch.zeros_like(t0)
    if first:
        fresnel = (1 - cosine).pow(4)
        is_mirror, is_glass = material == int(Material.MIRROR), material == int(Material.GLASS)
        mirror = ((gloss - 0.3).clamp_min(0) * (0.15 + 0.7 * fresnel) - 0.02).clamp_min(0)
        mirror = torch.where(is_mirror, torch.full_like(t0, 0.9), torch.where(is_glass, 0.08 + 0.7 * fresnel, mirror))
        through = is_glass * (1 - mirror) * 0.85
        mirror, through = mirror * live, through * live
    kind = torch.where(live, material.long(), torch.full_like(prim, int(Material.SKY)))
    kind = torch.where(live & (kind == int(Material.DIFFUSE)) & (gloss > 0.45), torch.full_like(kind, int(Material.GLOSSY)), kind)
    return Shaded(radiance, normal, point, mirror, through, kind)
