"""Lights of a batch of scenes: lamps and suns with shadows, ambient light with occlusion, the sky.

Data flow: surface points and normals -> light that arrives; directions -> sky.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from tests.scenes.occlusion import openness
from tests.scenes.patterns import LAYERS
from tests.scenes.scene import Scene
from tests.scenes.textures import Atlas, sample_atlas
from tests.scenes.tracing import Bundles, blocked
from tests.scenes.world import World

__all__ = ["Lighting", "SurfacePoints", "ambient_light", "direct_light", "sky_radiance", "unit"]

_SUN_M = 500.0


def unit(v: torch.Tensor) -> torch.Tensor:
    """Vectors ``(3, ...)`` at length 1."""
    return v * (v * v).sum(0).clamp_min(1e-20).rsqrt()


@dataclass(frozen=True)
class Lighting:
    """Lights, sky and fog of a batch of ``S`` scenes.

    Attributes:
        position: ``(S, L, 3)`` position, or direction towards a directional light.
        directional: ``(S, L)`` bool.
        colour: ``(S, L, 3)``, black for unused slots.
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
            torch.stack([torch.cat([s.sky.flatten(), torch.tensor([s.sky_clouds])]) for s in scenes]).to(
                device
            ),
            torch.stack([torch.cat([s.fog_colour, torch.tensor([s.fog_density])]) for s in scenes]).to(
                device
            ),
            torch.tensor([s.ao_length_m for s in scenes]).to(device),
        )


def sky_radiance(light: Lighting, atlas: Atlas, scene: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Sky along unit directions ``(3, B, P)``: from horizon to zenith, with clouds."""
    up = (-direction[1]).clamp_min(0)
    params = light.sky[scene]  # (B, 10)
    mix = 1 - (1 - up).pow(3)
    zenith, horizon, cloud = (params[:, k : k + 3].t()[..., None] for k in (0, 3, 6))
    base = horizon + (zenith - horizon) * mix
    radius = 0.12 / (up + 0.12)
    uv = torch.stack([direction[0] * radius, direction[2] * radius]).flatten(1)
    layer = torch.full_like(uv[0], LAYERS["clouds"], dtype=torch.int64)
    soft = sample_atlas(atlas, layer, uv, torch.full_like(uv[0], 0.004))[:, 0].reshape(up.shape)
    amount = (soft * params[:, 9, None] * (up * 6).clamp_max(1)).clamp(0, 1)
    return base + (cloud - base) * amount


@dataclass(frozen=True)
class SurfacePoints:
    """Points to be lit, ``(3, B, P)`` or ``(B, P)``.

    Attributes:
        scene: ``(B,)`` int64.
        point: world position.
        normal: unit, towards the viewer.
        view: unit direction of the ray that came here.
        prim: int64, the primitive under the point.
        live: bool, False for the sky.
        gloss: strength of highlights.
    """

    scene: torch.Tensor
    point: torch.Tensor
    normal: torch.Tensor
    view: torch.Tensor
    prim: torch.Tensor
    live: torch.Tensor
    gloss: torch.Tensor


def direct_light(
    world: World, light: Lighting, at: SurfacePoints, shadows: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Diffuse light and highlights of all lamps and suns.

    Args:
        world: what casts shadows.
        light: the lights.
        at: the points.
        shadows: how many of the lights cast shadows.

    Returns:
        ``(3, B, P)`` light on the surface, ``(3, B, P)`` highlights.
    """
    diffuse, highlight = torch.zeros_like(at.point), torch.zeros_like(at.point)
    shine = 6 + 90 * at.gloss * at.gloss
    for k in range(light.position.shape[1]):
        colour = light.colour[at.scene, k].t()[..., None]
        towards, strength, origin, ray = _light_rays(light, k, at)
        cosine = (at.normal * towards).sum(0).clamp_min(0)
        amount = cosine * strength
        if k < shadows:
            wanted = at.live & (cosine > 0) & (colour.sum(0) > 0)
            rays = Bundles(at.scene, origin, ray, wanted.to(amount.dtype) * 0.999, at.prim)
            amount = amount * (1 - blocked(world, rays))
        diffuse += colour * amount
        half = unit(towards - at.view)
        peak = (at.normal * half).sum(0).clamp_min(0).pow(shine) * at.gloss
        highlight += colour * (amount * peak * (0.5 + shine * 0.06))
    return diffuse, highlight


def _light_rays(light: Lighting, k: int, at: SurfacePoints):
    """Unit direction to light ``k``, its strength, and shadow rays (origin, direction up to t = 1)."""
    position = light.position[at.scene, k].t()[..., None]  # (3, B, 1)
    suns = light.directional[:, k]
    if bool(suns.all()):
        towards = unit(position)
        return towards, 1.0, at.point, towards * _SUN_M
    offset = position - at.point
    d2 = (offset * offset).sum(0)
    towards, strength = offset * d2.clamp_min(1e-12).rsqrt(), 1.0 / (0.4 + d2)
    if not bool(suns.any()):
        # From the lamp to the surface: a bundle with one apex culls best.
        return towards, strength, position, -offset
    sun = light.directional[at.scene, k][:, None]
    towards = torch.where(sun, unit(position), towards)
    strength = torch.where(sun, torch.ones_like(d2), strength)
    return towards, strength, at.point, torch.where(sun, towards * _SUN_M, offset)


def ambient_light(world: World, light: Lighting, at: SurfacePoints, occlude: bool) -> torch.Tensor:
    """Ambient light ``(3, B, P)``: more from above, less where something is near (if ``occlude``)."""
    params = light.ambient[at.scene]
    above, below = params[:, :3].t()[..., None], params[:, 3:].t()[..., None]
    value = below + (above - below) * (0.5 - 0.5 * at.normal[1])
    if not occlude:
        return value * 0.8
    free = openness(world, at.scene, at.point, at.normal, at.live, light.ao_length[at.scene])
    return value * (0.25 + 0.75 * free)
