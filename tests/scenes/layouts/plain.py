"""Plain rooms: painted walls at all angles to the camera, uneven light, a door and few objects.

Data flow: draws -> ``Scene`` of kind "plain".
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Builder, Look
from tests.scenes.layouts.furniture import cabinet, table
from tests.scenes.layouts.interior import area_light, indoor_rest
from tests.scenes.layouts.palettes import colour, palette, pick, surface_look
from tests.scenes.layouts.seats import chair, lounger
from tests.scenes.layouts.spot import Spot, camera_pose
from tests.scenes.scene import Scene

__all__ = ["plain_room"]

#: How much the paint of a wall varies in brightness, and over how many metres its pattern repeats.
PAINT, PAINT_TILE_M = 0.01, 0.4


def _paint(rng: np.random.Generator) -> Look:
    """Fine-grained paint of one colour."""
    base = colour(rng.uniform(0.05, 0.17), rng.uniform(0.0, 0.12), rng.uniform(0.65, 0.95))
    tones = np.stack([base, base * (1.0 - PAINT), base])
    return Look("speckle", tones, (PAINT_TILE_M, PAINT_TILE_M), macro=0.0)


def _shell(b: Builder, width: float, depth: float, height: float) -> None:
    """Painted walls and ceiling around x in [-w/2, w/2], z in [0, d]; a floor with a pattern."""
    rng, half = b.rng, np.pi / 2
    floor = surface_look(rng, pick(rng, "planks", "carpet", "tiles"), pick(rng, "wood", "stone"), macro=0.2)
    b.quad((0, 0, depth / 2), width / 2, depth / 2, floor, fixed=True)
    b.quad((0, -height, depth / 2), width / 2, depth / 2, _paint(rng), fixed=True)
    paint = _paint(rng)
    for x, yaw in ((-width / 2, -half), (width / 2, half)):
        b.quad((x, -height / 2, depth / 2), depth / 2, height / 2, paint, yaw=yaw, pitch=half, fixed=True)
    for z in (depth, 0.0):
        b.quad((0, -height / 2, z), width / 2, height / 2, paint, pitch=half, fixed=True)
    board = surface_look(rng, "plain", pick(rng, "white", "wood"))
    b.box((0, -0.04, depth - 0.01), (width, 0.08, 0.02), board)
    for side in (-1, 1):
        b.box((side * (width / 2 - 0.01), -0.04, depth / 2), (0.02, 0.08, depth), board)


def _door(spot: Spot) -> None:
    """A smooth door leaf in its frame, on a wall behind the spot."""
    rng = spot.rng
    spot.box(0, -0.005, 0, (1.0, 2.12, 0.06), _paint(rng))
    spot.box(0, -0.03, 0, (0.86, 2.05, 0.04), _paint(rng))


def _picture(spot: Spot) -> None:
    rng = spot.rng
    width, height = rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.7)
    look = Look("poster_a", palette(rng, "any"), (width, height), origin=(0.5, 0.5), macro=0)
    spot.box(rng.uniform(-0.8, 0.8), -0.02, rng.uniform(1.0, 1.5), (width, height, 0.02), look)


def plain_room(rng: np.random.Generator, seed: int) -> Scene:
    """Draw a sparsely furnished room with painted walls, seen from one end."""
    b = Builder(rng)
    width, depth, height = rng.uniform(2.4, 4.2), rng.uniform(2.8, 4.5), rng.uniform(2.35, 2.8)
    _shell(b, width, depth, height)
    half = np.pi / 2
    walls = Spot(b, 0, depth), Spot(b, -width / 2, depth / 2, -half), Spot(b, width / 2, depth / 2, half)
    order = rng.permutation(len(walls))
    _door(walls[order[0]].moved(rng.uniform(-0.5, 0.5), 0))
    _picture(walls[order[1]])
    if rng.random() < 0.7:
        cabinet(walls[order[1]].moved(rng.uniform(-0.6, 0.6), -0.25), rng.uniform(0.5, 1.2), 0.8, 0.45)
    middle = Spot(b, rng.uniform(-0.2, 0.2) * width, rng.uniform(0.55, 0.75) * depth, rng.uniform(-3, 3))
    thing = int(rng.integers(3))
    if thing == 0:
        chair(middle)
    elif thing == 1:
        lounger(middle)
    else:
        table(middle, rng.uniform(0.6, 1.2), 0.6, 0.72, surface_look(rng, "wood", "wood"))
    warm = colour(rng.uniform(0.05, 0.15), rng.uniform(0, 0.2), 1.0)
    at = (rng.uniform(-0.35, 0.35) * width, 0.12 - height, rng.uniform(0.3, 0.8) * depth)
    area_light(b, at, 0.2, warm * rng.uniform(1.0, 2.5))
    side = (pick(rng, -1, 1) * (width / 2 - 0.3), -1.4, rng.uniform(0.2, 0.6) * depth)
    b.light(side, np.array([0.8, 0.9, 1.0]) * rng.uniform(0.3, 1.0))  # a window next to the camera
    x, z = rng.uniform(-0.3, 0.3) * width, rng.uniform(0.3, 0.5)
    yaw, pitch = rng.uniform(-0.6, 0.6), np.radians(rng.uniform(-4, 16))
    rest = indoor_rest(rng, "plain", seed, rng.uniform(62, 74), (0.07, 0.12))
    return b.finish(camera_pose(x, -rng.uniform(1.2, 1.6), z, yaw, pitch, rng.normal(0, 0.03)), 0.3, **rest)
