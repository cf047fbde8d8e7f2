"""Sun, sky, fog and buildings, shared by streets and terrain.

Hop: draws -> lights and sky fields of a ``Scene``; buildings in a ``Builder``.
Paper: none.
"""

from __future__ import annotations

import numpy as np
import torch

from geodiff_plugin.synthetic.builder import Builder, Look
from geodiff_plugin.synthetic.layouts.palettes import colour, palette, pick, surface_look
from geodiff_plugin.synthetic.layouts.parts import Spot
from geodiff_plugin.synthetic.patterns import TILE_M

__all__ = ["building", "daylight", "facade_look"]


def daylight(b: Builder, kind: str, seed: int, fov: float, baseline: tuple[float, float]) -> dict:
    """Add the sun (or none, under cloud) and return sky, ambient light, haze and the rest of the fields."""
    rng = b.rng
    overcast = rng.random() < 0.35
    azimuth, height = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(18, 70))
    towards = (np.cos(height) * np.sin(azimuth), -np.sin(height), np.cos(height) * np.cos(azimuth))
    warm = colour(0.1, 0.25 * (1 - height), 1.0)
    strength = rng.uniform(0.15, 0.45) if overcast else rng.uniform(1.2, 2.6)
    b.light(towards, warm * strength, directional=True)
    blue = colour(rng.uniform(0.56, 0.62), rng.uniform(0.0, 0.12) if overcast else rng.uniform(0.2, 0.6), 1.0)
    level = rng.uniform(0.6, 0.9)
    bright = rng.uniform(0.9, 1.7)
    t = lambda x: torch.tensor(np.asarray(x), dtype=torch.float32)  # noqa: E731
    horizon = 0.6 * np.ones(3) + 0.4 * blue
    return dict(
        ambient_up=t(level * (0.6 + 0.4 * blue)), ambient_down=t(level * rng.uniform(0.25, 0.45) * np.array([1, 0.97, 0.9])),
        ao_length_m=float(rng.uniform(1.0, 2.5)), sky=t([bright * blue * (1.0 if overcast else 0.75), bright * horizon, bright * np.full(3, 1.15)]),
        sky_clouds=float(rng.uniform(0, 1.2)), fog_density=float(rng.choice([0.0, rng.uniform(0.0005, 0.004), rng.uniform(0.004, 0.015)], p=[0.3, 0.55, 0.15])),
        fog_colour=t(bright * horizon * 0.85), fov_deg=float(fov), baseline_m=float(rng.uniform(*baseline)), kind=kind, seed=seed,
    )


def facade_look(rng: np.random.Generator, height: float, family: str | None = None) -> Look:
    """Windows in rows of a storey each, the ground floor's sill on the ground."""
    layer = pick(rng, "facade_a", "facade_a", "facade_b", "facade_c", "facade_d")
    k = rng.uniform(0.85, 1.15)
    tile = TILE_M[layer] * k
    pal = palette(rng, family or pick(rng, "wall", "wall", "painted", "stone", "brick", "white"))
    pal[2] = palette(rng, pick(rng, "white", "white", "dark", "wood"))[0]
    return Look(layer, pal, (tile, tile), macro=0.2, origin=(rng.random(), -height / 2 / tile))


def building(b: Builder, x: float, z: float, size: tuple[float, float, float], ground: float, yaw: float = 0.0, door_side: float = -1.0) -> None:
    """Block with windows, perhaps a shop below and a roof above; ``door_side`` is the street's side along x."""
    rng = b.rng
    spot = Spot(b, x, z, yaw, ground)
    w, h, d = size
    look = facade_look(rng, h)
    if rng.random() < 0.2:
        look = surface_look(rng, pick(rng, "brick", "blocks", "plaster"), pick(rng, "brick", "stone", "wall"))
    spot.box(0, 0, 0, size, look)
    if rng.random() < 0.35:
        shop = Look("shopfront", palette(rng, pick(rng, "any", "dark", "wood")), (9.0, 3.3), origin=(rng.random(), 0.5))
        spot.box(door_side * 0.08, 0, 0, (w, 3.3, d - 0.2), shop)
    else:
        plinth = surface_look(rng, pick(rng, "blocks", "concrete", "plaster"), pick(rng, "stone", "grey"))
        spot.box(door_side * 0.05, 0, 0, (w, rng.uniform(0.3, 1.0), d), plinth)
        for _ in range(int(rng.integers(1, 3))):
            dz = rng.uniform(-0.4, 0.4) * d
            face = Look("door", palette(rng, pick(rng, "wood", "dark", "vivid")), (1.2, 2.3), origin=(0.5, 0.5))
            spot.box(door_side * w / 2, dz, 0, (0.25, 2.3, 1.2), face)
    if rng.random() < 0.55:
        roof = surface_look(rng, "roof", pick(rng, "brick", "dark", "grey"))
        spot.wedge(0, 0, h, (w + 0.6, rng.uniform(1.5, 4), d + 0.3), roof, pick(rng, (0.98, 0.0), (0.9, 0.6)))
    else:
        spot.box(0, 0, h, (w + 0.5, 0.35, d + 0.1), surface_look(rng, "concrete", "stone"))
