"""Sun, sky, haze and buildings, shared by streets and terrain.

Data flow: draws -> lights and sky fields of a ``Scene``; buildings in a ``Builder``.
"""

from __future__ import annotations

import numpy as np
import torch

from tests.scenes.builder import Builder, Look
from tests.scenes.layouts.palettes import colour, palette, pick, surface_look
from tests.scenes.layouts.spot import Spot
from tests.scenes.patterns import TILE_M

__all__ = ["building", "daylight", "facade_look", "house"]


def daylight(b: Builder, kind: str, seed: int, fov: float, baseline: tuple[float, float]) -> dict:
    """Add the sun (weak and soft under cloud); returns sky, ambient light, haze and the other fields."""
    rng = b.rng
    overcast = rng.random() < 0.3
    azimuth, height = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(12, 65))
    warm = colour(0.1, 0.25 * (1 - height), 1.0)
    strength = rng.uniform(0.15, 0.5) if overcast else rng.uniform(1.5, 4.5)
    # An overcast sun is a wide patch: three directions give it a soft edge.
    offsets = ((0.0, 0.0), (0.16, 0.05), (-0.08, 0.14)) if overcast else ((0.0, 0.0),)
    for da, dh in offsets:
        a, h = azimuth + da, height + dh
        towards = (np.cos(h) * np.sin(a), -np.sin(h), np.cos(h) * np.cos(a))
        b.light(towards, warm * strength / len(offsets), directional=True)
    grey = rng.uniform(0.0, 0.12) if overcast else rng.uniform(0.2, 0.6)
    blue = colour(rng.uniform(0.56, 0.62), grey, 1.0)
    level, bright = rng.uniform(0.35, 0.8), rng.uniform(0.9, 2.2)
    horizon = 0.6 * np.ones(3) + 0.4 * blue
    haze = [0.0, rng.uniform(0.0005, 0.004), rng.uniform(0.004, 0.015)]
    ground = level * rng.uniform(0.25, 0.45) * np.array([1, 0.97, 0.9])
    zenith = bright * blue * (1.0 if overcast else 0.75)

    def t(x):
        return torch.tensor(np.asarray(x), dtype=torch.float32)

    return dict(
        ambient_up=t(level * (0.6 + 0.4 * blue)),
        ambient_down=t(ground),
        ao_length_m=float(rng.uniform(1.0, 2.5)),
        sky=t([zenith, bright * horizon, np.full(3, 1.15 * bright)]),
        sky_clouds=float(rng.uniform(0, 1.2)),
        fog_density=float(rng.choice(haze, p=[0.5, 0.42, 0.08])),
        fog_colour=t(bright * horizon * 0.85),
        fov_deg=float(fov),
        baseline_m=float(rng.uniform(*baseline)),
        kind=kind,
        seed=seed,
    )


def facade_look(rng: np.random.Generator, height: float, family: str | None = None) -> Look:
    """Windows in rows of a storey each, the ground floor's sill on the ground."""
    layer = pick(rng, "facade_a", "facade_a", "facade_b", "facade_c", "facade_d")
    tile = TILE_M[layer] * rng.uniform(0.85, 1.15)
    families = ("wall", "wall", "painted", "stone", "brick", "white", "white", "grey")
    pal = palette(rng, family or families[int(rng.integers(len(families)))])
    pal[2] = palette(rng, pick(rng, "white", "white", "dark", "wood"))[0]
    return Look(layer, pal, (tile, tile), macro=0.2, origin=(rng.random(), -height / 2 / tile))


def building(
    b: Builder,
    x: float,
    z: float,
    size: tuple[float, float, float],
    ground: float,
    yaw: float = 0.0,
    door_side: float = -1.0,
) -> None:
    """Block with windows, perhaps a shop and a roof; ``door_side`` is the street's side along x."""
    rng = b.rng
    spot = Spot(b, x, z, yaw, ground)
    w, h, d = size
    look = facade_look(rng, h)
    if rng.random() < 0.2:
        look = surface_look(rng, pick(rng, "brick", "blocks", "plaster"), pick(rng, "brick", "stone", "wall"))
    spot.box(0, 0, 0, size, look)
    if rng.random() < 0.3:
        pal = palette(rng, pick(rng, "any", "dark", "wood"))
        shop = Look("shopfront", pal, (9.0, 3.3), origin=(rng.random(), 0.5))
        spot.box(door_side * 0.08, 0, 0, (w, 3.3, d - 0.2), shop)
    else:
        plinth = surface_look(rng, pick(rng, "ashlar", "concrete", "plaster"), pick(rng, "stone", "grey"))
        spot.box(door_side * 0.05, 0, 0, (w, rng.uniform(0.3, 1.0), d), plinth)
        for _ in range(int(rng.integers(1, 3))):
            pal = palette(rng, pick(rng, "wood", "dark", "vivid"))
            face = Look("door", pal, (1.2, 2.3), origin=(0.5, 0.5))
            spot.box(door_side * w / 2, rng.uniform(-0.4, 0.4) * d, 0, (0.25, 2.3, 1.2), face)
    if rng.random() < 0.55:
        roof = surface_look(rng, "roof", pick(rng, "brick", "dark", "grey"))
        taper = pick(rng, (0.98, 0.0), (0.9, 0.6))
        spot.wedge(0, 0, h, (w + 0.6, rng.uniform(1.5, 4), d + 0.3), roof, taper)
    else:
        spot.box(0, 0, h, (w + 0.5, 0.35, d + 0.1), surface_look(rng, "concrete", "stone"))


def house(spot: Spot) -> None:
    """Detached house with a gable and a chimney, perhaps a garage next to it; its front along local -z."""
    rng = spot.rng
    w, d = rng.uniform(7, 12), rng.uniform(7, 10)
    h = 2.9 * int(rng.integers(1, 3)) + rng.uniform(0.2, 0.8)
    spot.box(0, 0, 0, (w, h, d), facade_look(rng, h))
    plinth = surface_look(rng, pick(rng, "ashlar", "concrete"), pick(rng, "stone", "grey"))
    spot.box(0, 0, 0, (w + 0.06, rng.uniform(0.3, 0.9), d + 0.06), plinth)
    roof = surface_look(rng, "roof", pick(rng, "brick", "brick", "dark", "grey"))
    taper = pick(rng, (0.98, 0.0), (0.0, 0.98), (0.95, 0.5))
    spot.wedge(0, 0, h, (w + 0.8, rng.uniform(2, 4.5), d + 0.8), roof, taper)
    spot.box(rng.uniform(-0.25, 0.25) * w, 0, h, (0.6, 4.2, 0.6), surface_look(rng, "brick", "brick"))
    face = Look(
        "door", palette(rng, pick(rng, "wood", "dark", "vivid", "white")), (1.1, 2.1), origin=(0.5, 0.5)
    )
    spot.box(rng.uniform(-0.3, 0.3) * w, -d / 2, 0, (1.1, 2.1, 0.2), face)
    if rng.random() < 0.5:
        side = pick(rng, -1, 1)
        doors = Look("pinstripes", palette(rng, pick(rng, "white", "grey", "painted")), (0.5, 0.5))
        for k in range(int(rng.integers(1, 4))):
            lx = side * (w / 2 + 1.7 + 3.2 * k)
            spot.box(
                lx, -d * 0.3, 0, (3.2, 2.6, 5.0), surface_look(rng, "plaster", pick(rng, "white", "wall"))
            )
            spot.box(lx, -d * 0.3 - 2.5, 0, (2.5, 2.1, 0.06), doors)
