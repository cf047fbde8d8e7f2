"""Open ground: hills, rocks, bushes and trees, and terraces with steps, walls, railings and benches.

Data flow: draws -> ``Scene`` of kind "terrain".
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Builder
from tests.scenes.layouts.clutter import thing
from tests.scenes.layouts.furniture import table
from tests.scenes.layouts.outdoor import building, daylight, facade_look, house
from tests.scenes.layouts.palettes import object_look, pick, surface_look
from tests.scenes.layouts.plants import bush, pot_plant, rock, tree, tree_line
from tests.scenes.layouts.seats import bench, chair, lounger
from tests.scenes.layouts.spot import Spot, camera_pose
from tests.scenes.scene import Scene

__all__ = ["terrain"]


def _relief_y(hills: list[tuple[float, float, float, float]], x: float, z: float) -> float:
    """World y of the ground; hills ``(x, z, radius, height)`` are ellipsoids centred in the plane."""
    top = 0.0
    for hx, hz, a, h in hills:
        r = ((x - hx) ** 2 + (z - hz) ** 2) / a**2
        if r < 1:
            top = max(top, h * np.sqrt(1 - r))
    return -top


def _wild(b: Builder) -> tuple[float, float, float]:
    """Hills, rocks and vegetation; returns the camera's x, ground height and z."""
    rng = b.rng
    hills: list[tuple[float, float, float, float]] = []
    family = pick(rng, "leaf", "moss", "dry", "soil", "stone")
    layer = pick(rng, "grass", "grass", "soil", "gravel", "rock")
    b.quad((0, 0, 150), 400, 400, surface_look(rng, layer, family, macro=0.8), fixed=True)
    for _ in range(int(rng.integers(2, 8))):
        a, far = rng.uniform(6, 40), rng.uniform(8, 110)
        x, h = rng.normal(0, 0.5) * far, a * rng.uniform(0.03, 0.2)
        hills.append((x, far, a, h))
        b.ball((x, 0, far), (a, h, a), surface_look(rng, layer, family, macro=0.8), fixed=True)
    if rng.random() < 0.4:  # a path
        path = surface_look(rng, pick(rng, "gravel", "soil", "asphalt"), "stone", macro=0.5)
        b.quad(
            (rng.normal(0, 1), -0.01, 60),
            rng.uniform(0.6, 1.6),
            80,
            path,
            yaw=rng.normal(0, 0.15),
            fixed=True,
        )
    for _ in range(int(rng.integers(4, 24))):
        z = 2.0 + rng.exponential(14)
        x = rng.normal(0, 0.5) * (z + 3)
        spot = Spot(b, x, z, rng.uniform(-3, 3), _relief_y(hills, x, z))
        kind = rng.random()
        if kind < 0.4:
            rock(spot, rng.uniform(0.3, 1.2) * (1 + z / 25))
        elif kind < 0.65:
            bush(spot, rng.uniform(0.5, 1.8))
        elif z > 5:
            tree(spot, rng.uniform(3, 11), int(rng.integers(9, 16)) if z < 30 else 5)
    if rng.random() < 0.5:
        tree_line(
            Spot(b, rng.normal(0, 15), rng.uniform(25, 90), rng.normal(0, 0.3)), 80, rng.uniform(4, 14), 16
        )
    for _ in range(int(rng.integers(0, 3))):
        z = rng.uniform(20, 90)
        x = rng.normal(0, 0.4) * z
        house(Spot(b, x, z, rng.uniform(-1, 1), _relief_y(hills, x, z) + 0.5))
    return 0.0, _relief_y(hills, 0.0, 0.0), 0.0


def _stairs(b: Builder, side: float, depth: float, stone, pave) -> None:
    """A flight up to a second level, or a row of sitting steps."""
    rng = b.rng
    s = pick(rng, -1, 1)
    steps, first = int(rng.integers(3, 10)), rng.uniform(3, depth * 0.6)
    wide = rng.uniform(2, side)
    x = s * (side - wide / 2)
    if rng.random() < 0.5:
        for k in range(steps):
            b.standing(x, first + 0.32 * k + 2, 0, (wide, 0.16 * (k + 1), 4.0), stone)
        b.standing(x, first + 0.32 * steps + 4, 0, (wide, 0.16 * steps, 4.0), pave)
    else:
        for k in range(steps):
            b.standing(x, first + 0.32 * k, 0, (wide, 0.16 * (k + 1), 0.32), stone)


def _border(b: Builder, side: float, depth: float, stone) -> None:
    """A low wall or a railing at the far edge."""
    rng = b.rng
    if rng.random() < 0.6:
        b.standing(0, depth + 4.2, 0, (2 * side, rng.uniform(0.5, 1.1), 0.35), stone)
        return
    metal = surface_look(rng, "plain", pick(rng, "dark", "grey"))
    b.box((0, -1.0, depth + 3.9), (2 * side, 0.05, 0.05), metal)
    for x in np.arange(-side, side, rng.uniform(0.35, 0.9)):
        b.standing(x, depth + 3.9, 0, (0.03, 1.0, 0.03), metal)


def _terrace_piece(spot: Spot, stone) -> None:
    rng = spot.rng
    kind = rng.random()
    if kind < 0.2:
        pot_plant(spot, rng.uniform(0.6, 1.8))
    elif kind < 0.45:
        w, d = rng.uniform(0.8, 1.6), 0.8
        table(
            spot,
            w,
            d,
            0.74,
            surface_look(rng, pick(rng, "planks", "plain", "marble"), pick(rng, "wood", "white", "grey")),
        )
        for k in range(int(rng.integers(0, 4))):
            chair(spot.moved(0, 0, k * np.pi / 2).moved(0, d / 2 + rng.uniform(0.1, 0.5), rng.normal(0, 0.4)))
    elif kind < 0.55:
        lounger(spot)
    elif kind < 0.65:
        bench(spot, rng.uniform(1.2, 2.4))
    elif kind < 0.78:
        spot.box(0, 0, 0, (rng.uniform(0.5, 2), rng.uniform(0.3, 0.9), 0.5), stone)
    elif kind < 0.87:
        spot.column(0, 0, 0, rng.uniform(0.12, 0.3), rng.uniform(2, 4), stone, top=0.9)
    else:
        thing(spot, 0, 0, 0, rng.uniform(0.3, 0.7))


def _terrace(b: Builder) -> tuple[float, float, float]:
    """A paved terrace with a house on one side or behind; returns the camera's x, ground height and z."""
    rng = b.rng
    b.quad(
        (0, 1.5, 150),
        400,
        400,
        surface_look(rng, pick(rng, "grass", "soil"), pick(rng, "leaf", "dry"), macro=0.6),
        fixed=True,
    )
    layer = pick(rng, "paving", "flagstones", "tiles", "planks", "cobbles", "concrete")
    pave = surface_look(rng, layer, pick(rng, "stone", "grey", "brick"), macro=0.3)
    depth, side = rng.uniform(4, 18), rng.uniform(3, 9)
    b.box((0, 0.75, depth / 2 - 2), (2 * side, 1.5, depth + 12), pave, fixed=True)
    layer = pick(rng, "ashlar", "brick", "blocks", "plaster", "rock")
    stone = surface_look(rng, layer, pick(rng, "stone", "brick", "wall"), macro=0.4)
    if rng.random() < 0.6:
        _stairs(b, side, max(depth, 6), stone, pave)
    wall = facade_look(rng, 9.0) if rng.random() < 0.6 else stone
    if rng.random() < 0.6:
        s = pick(rng, -1, 1)
        b.standing(
            s * (side + 3), depth * 0.5, 1.5, (6, rng.uniform(5, 11), depth + rng.uniform(4, 20)), wall
        )
    if rng.random() < 0.45:  # the house closes the view, a bench along it
        b.standing(0, depth + 7, 1.5, (2 * side + 4, rng.uniform(4, 11), 6), wall)
        bench(Spot(b, rng.uniform(-0.3, 0.3) * side, depth + 3.5), rng.uniform(1.5, side))
    else:
        _border(b, side, depth, stone)
        for _ in range(int(rng.integers(2, 9))):
            tree(Spot(b, rng.normal(0, 14), depth + rng.uniform(6, 40), 0, 1.5), rng.uniform(5, 12), 9)
        if rng.random() < 0.5:
            size = (rng.uniform(8, 20), rng.uniform(6, 12), 10)
            building(b, rng.normal(0, 12), depth + rng.uniform(18, 50), size, 1.5, rng.uniform(-0.5, 0.5))
    for _ in range(int(rng.integers(3, 12))):
        _terrace_piece(
            Spot(b, rng.uniform(-0.85, 0.85) * side, rng.uniform(1.5, depth + 3), rng.uniform(-3, 3)), stone
        )
    return rng.uniform(-0.5, 0.5) * side, 0.0, 0.0


def terrain(rng: np.random.Generator, seed: int) -> Scene:
    """Draw open ground or a terrace."""
    b = Builder(rng)
    x, ground, z = _terrace(b) if rng.random() < 0.55 else _wild(b)
    for _ in range(int(rng.integers(0, 3))):
        Spot(b, rng.normal(0, 3), rng.uniform(2, 8), 0, ground).box(
            0, 0, 0, rng.uniform(0.2, 1.0, 3), object_look(rng, 0.6)
        )
    rest = daylight(b, "terrain", seed, rng.uniform(48, 80), (0.12, 0.4))
    pitch, roll = np.radians(rng.uniform(-4, 18)), np.radians(rng.normal(0, 1.5))
    pose = camera_pose(x, ground - rng.uniform(0.9, 2.0), z, rng.normal(0, 0.2), pitch, roll)
    return b.finish(pose, 0.7, **rest)
