"""Corridors: a long narrow room with doors, lamps and objects along the walls.

Data flow: draws -> ``Scene`` of kind "corridor".
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Builder, Look
from tests.scenes.layouts.clutter import thing
from tests.scenes.layouts.furniture import cabinet
from tests.scenes.layouts.interior import door_look, indoor_rest, shell, wall_decor
from tests.scenes.layouts.palettes import colour, pick, surface_look
from tests.scenes.layouts.plants import pot_plant
from tests.scenes.layouts.seats import bench
from tests.scenes.layouts.spot import Spot, camera_pose
from tests.scenes.scene import Scene

__all__ = ["corridor"]

_DOOR = 0.92


def _side(spot: Spot, length: float, height: float, door: Look) -> None:
    """Doors, posters and furniture along one wall (local -z faces the corridor)."""
    rng = spot.rng
    frame = surface_look(rng, "plain", pick(rng, "white", "wood", "grey"))
    at = -length / 2 + rng.uniform(0.3, 1.5)
    while at < length / 2 - 1.2:
        kind = rng.random()
        if kind < 0.5:
            spot.box(at + _DOOR / 2, -0.005, 0, (_DOOR + 0.16, 2.12, 0.06), frame)
            spot.box(at + _DOOR / 2, -0.03, 0, (_DOOR, 2.04, 0.04), door)
            at += _DOOR + rng.uniform(0.6, 2.5)
        elif kind < 0.66:
            w, d = rng.uniform(0.4, 1.2), rng.uniform(0.25, 0.4)
            cabinet(spot.moved(at + w / 2, -d / 2), w, rng.uniform(0.6, 1.9), d)
            at += w + rng.uniform(0.2, 1.5)
        elif kind < 0.72:
            bench(spot.moved(at + 0.6, -0.28), 1.2)
            at += 1.4
        elif kind < 0.8:
            pot_plant(spot.moved(at + 0.3, -0.25), rng.uniform(0.6, 1.4))
            at += 1.0
        elif kind < 0.9:
            thing(spot, at + 0.2, -0.25, 0, rng.uniform(0.2, 0.45))
            at += 0.8
        else:
            wall_decor(spot.moved(at + 0.6, 0), height, 0.9)
            at += rng.uniform(1.2, 2.4)


def corridor(rng: np.random.Generator, seed: int) -> Scene:
    """Draw a corridor."""
    b = Builder(rng)
    width, depth, height = rng.uniform(1.5, 3.2), rng.uniform(7, 26), rng.uniform(2.4, 3.2)
    shell(b, width, depth, height)
    half = np.pi / 2
    door = door_look(rng, _DOOR, 2.04)
    for x, yaw in ((-width / 2, -half), (width / 2, half)):
        spot = Spot(b, x, depth / 2, yaw)
        _side(spot, depth, height, door)
        if rng.random() < 0.4:  # a panel on the lower wall, a rail above it
            panel = surface_look(
                rng, pick(rng, "tiles", "planks", "plain"), pick(rng, "painted", "wood", "grey")
            )
            spot.box(0, -0.002, 0, (depth, 1.0, 0.01), panel)
            spot.box(0, -0.02, 1.0, (depth, 0.05, 0.04), panel)
    end = Spot(b, 0, depth)
    if rng.random() < 0.6:
        end.box(0, -0.02, 0, (min(width * 0.7, 1.1), 2.1, 0.05), door)
    else:
        wall_decor(end, height, 1.0)
    lamp = Look("plain", np.ones((3, 3)), emission=3.0, macro=0)
    count = int(np.clip(depth / rng.uniform(2.0, 4.0), 2, 9))
    for k in range(count):
        b.box((0, -height + 0.02, (k + 0.5) * depth / count), (rng.uniform(0.15, 0.6), 0.04, 1.0), lamp)
    warm = colour(rng.uniform(0.05, 0.17), rng.uniform(0, 0.2), 1.0)
    for z in (0.12, 0.4, 0.75):
        b.light((0, -height + 0.15, depth * z), warm * rng.uniform(0.8, 2.5))
    x, tall = rng.uniform(-0.3, 0.3) * (width - 0.8), rng.uniform(0.9, 1.8)
    pitch, roll = np.radians(rng.uniform(-4, 14)), np.radians(rng.normal(0, 1.5))
    pose = camera_pose(x, -tall, rng.uniform(0.4, 1.2), rng.normal(0, 0.15), pitch, roll)
    rest = indoor_rest(rng, "corridor", seed, rng.uniform(48, 80), (0.06, 0.2))
    return b.finish(pose, 0.3, **rest)
