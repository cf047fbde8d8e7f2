"""Open ground: hills, rocks, bushes and trees, and terraces with steps, walls and railings.

Hop: draws -> ``Scene`` of kind "terrain".
Paper: none.
"""

from __future__ import annotations

import numpy as np

from geodiff_plugin.synthetic.builder import Builder, Look
from geodiff_plugin.synthetic.layouts.outdoor import building, daylight, facade_look
from geodiff_plugin.synthetic.layouts.palettes import object_look, pick, surface_look
from geodiff_plugin.synthetic.layouts.parts import Spot, camera_pose
from geodiff_plugin.synthetic.scene import Scene

__all__ = ["terrain"]


class _Relief:
    """Height of the ground: hills are ellipsoids with their centres in the plane."""

    def __init__(self) -> None:
        self.hills: list[tuple[float, ...]] = []

    def y(self, x: float, z: float) -> float:
        top = 0.0
        for hx, hz, a, h in self.hills:
            r = ((x - hx) ** 2 + (z - hz) ** 2) / a**2
            if r < 1:
                top = max(top, h * np.sqrt(1 - r))
        return -top


def _wild(b: Builder) -> tuple[float, float, float]:
    """Hills, rocks and vegetation; returns the camera's x, ground height and z."""
    rng = b.rng
    relief = _Relief()
    family = pick(rng, "leaf", "dry", "soil", "stone")
    layer = pick(rng, "grass", "grass", "soil", "gravel", "rock")
    b.quad((0, 0, 150), 400, 400, surface_look(rng, layer, family, macro=0.8), fixed=True)
    for _ in range(int(rng.integers(2, 8))):
        a, far = rng.uniform(6, 40), rng.uniform(8, 110)
        x, h = rng.normal(0, 0.5) * far, a * rng.uniform(0.03, 0.2)
        relief.hills.append((x, far, a, h))
        b.ball((x, 0, far), (a, h, a), surface_look(rng, layer, family, macro=0.8), fixed=True)
    if rng.random() < 0.4:  # a path
        b.quad((rng.normal(0, 1), -0.01, 60), rng.uniform(0.6, 1.6), 80, surface_look(rng, pick(rng, "gravel", "soil"), "stone", macro=0.5), yaw=rng.normal(0, 0.15), fixed=True)
    for _ in range(int(rng.integers(4, 22))):
        z = 2.0 + rng.exponential(14)
        x = rng.normal(0, 0.5) * (z + 3)
        spot = Spot(b, x, z, rng.uniform(-3, 3), relief.y(x, z))
        kind = rng.random()
        if kind < 0.4:
            spot.rock(rng.uniform(0.3, 1.2) * (1 + z / 25))
        elif kind < 0.6:
            bush = surface_look(rng, pick(rng, "leaves", "hedge"), "leaf")
            for _ in range(3):
                spot.ball(rng.normal(0, 0.4), rng.normal(0, 0.4), 0.3, rng.uniform(0.3, 0.9, 3), bush)
        elif z > 5:
            spot.tree(rng.uniform(3, 10), int(rng.integers(6, 11)) if z < 30 else 4)
    for _ in range(int(rng.integers(0, 3))):
        z = rng.uniform(20, 90)
        x = rng.normal(0, 0.4) * z
        building(b, x, z, (rng.uniform(6, 12), rng.uniform(3.5, 7), rng.uniform(6, 12)), relief.y(x, z) + 0.5, rng.uniform(-1, 1))
    return 0.0, relief.y(0.0, 0.0), 0.0


def _terrace(b: Builder) -> tuple[float, float, float]:
    """Paved terrace with steps, walls, planters, railings, a house on one side and trees beyond."""
    rng = b.rng
    b.quad((0, 1.5, 150), 400, 400, surface_look(rng, pick(rng, "grass", "soil"), pick(rng, "leaf", "dry"), macro=0.6), fixed=True)
    pave = surface_look(rng, pick(rng, "paving", "flagstones", "tiles", "planks", "cobbles"), pick(rng, "stone", "grey", "brick"), macro=0.3)
    depth, side = rng.uniform(8, 18), rng.uniform(4, 9)
    b.box((0, 0.75, depth / 2 - 4), (2 * side, 1.5, depth + 8), pave, fixed=True)
    stone = surface_look(rng, pick(rng, "ashlar", "brick", "blocks", "plaster", "rock"), pick(rng, "stone", "brick", "wall"), macro=0.4)
    s = pick(rng, -1, 1)
    steps, first = int(rng.integers(3, 10)), rng.uniform(3, depth * 0.6)
    wide = rng.uniform(2, side)
    up = pick(rng, True, False)
    for k in range(steps):  # stairs up to a second level
        b.standing(s * (side - wide / 2), first + 0.32 * k + 2, 0, (wide, 0.16 * (k + 1), 4.0) if up else (wide, 0.16 * (steps - k), 0.32), stone)
    if up:
        b.standing(s * (side - wide / 2), first + 0.32 * steps + 4, 0, (wide, 0.16 * steps, 4.0), pave)
    if rng.random() < 0.7:
        look = facade_look(rng, 9.0) if rng.random() < 0.6 else stone
        b.standing(-s * (side + 3), depth * 0.5, 1.5, (6, rng.uniform(5, 11), depth + rng.uniform(4, 20)), look)
    if rng.random() < 0.6:
        b.standing(0, depth + 4.2, 0, (2 * side, rng.uniform(0.5, 1.1), 0.35), stone)
    else:
        metal = surface_look(rng, "plain", pick(rng, "dark", "grey"))
        b.box((0, -1.0, depth + 3.9), (2 * side, 0.05, 0.05), metal)
        for x in np.arange(-side, side, rng.uniform(0.35, 0.9)):
            b.standing(x, depth + 3.9, 0, (0.03, 1.0, 0.03), metal)
    for _ in range(int(rng.integers(3, 12))):
        spot = Spot(b, rng.uniform(-0.85, 0.85) * side, rng.uniform(1.5, depth + 3), rng.uniform(-3, 3))
        kind = rng.random()
        if kind < 0.25:
            spot.plant(rng.uniform(0.6, 1.8))
        elif kind < 0.4:
            spot.chair()
        elif kind < 0.55:
            spot.table(rng.uniform(0.8, 1.6), 0.8, 0.74, surface_look(rng, "planks", "wood"))
        elif kind < 0.75:
            spot.box(0, 0, 0, (rng.uniform(0.5, 2), rng.uniform(0.3, 0.9), 0.5), stone)
        elif kind < 0.85:
            spot.column(0, 0, 0, rng.uniform(0.12, 0.3), rng.uniform(2, 4), stone, top=0.9)
        else:
            spot.thing(0, 0, 0, rng.uniform(0.3, 0.7))
    for _ in range(int(rng.integers(2, 9))):
        Spot(b, rng.normal(0, 14), depth + rng.uniform(6, 40), 0, 1.5).tree(rng.uniform(5, 12), 7)
    if rng.random() < 0.5:
        building(b, rng.normal(0, 12), depth + rng.uniform(18, 50), (rng.uniform(8, 20), rng.uniform(6, 12), 10), 1.5, rng.uniform(-0.5, 0.5))
    return rng.uniform(-0.5, 0.5) * side, 0.0, 0.0


def terrain(rng: np.random.Generator, seed: int) -> Scene:
    """Draw open ground or a terrace."""
    b = Builder(rng)
    x, ground, z = _terrace(b) if rng.random() < 0.55 else _wild(b)
    for _ in range(int(rng.integers(0, 3))):
        Spot(b, rng.normal(0, 3), rng.uniform(2, 8), 0, ground).box(0, 0, 0, rng.uniform(0.2, 1.0, 3), object_look(rng, 0.6))
    rest = daylight(b, "terrain", seed, rng.uniform(48, 80), (0.12, 0.4))
    pose = camera_pose(x, ground - rng.uniform(0.9, 2.0), z, rng.normal(0, 0.2), np.radians(rng.uniform(-4, 18)), np.radians(rng.normal(0, 1.5)))
    return b.finish(pose, 0.7, **rest)
