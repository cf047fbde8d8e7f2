"""Table tops: many touching and overlapping things seen from near, a wall behind.

Hop: draws -> ``Scene`` of kind "tabletop".
Paper: none.
"""

from __future__ import annotations

import numpy as np

from geodiff_plugin.synthetic.builder import Builder
from geodiff_plugin.synthetic.layouts.palettes import colour, object_look, pick, surface_look
from geodiff_plugin.synthetic.layouts.parts import Spot, camera_pose
from geodiff_plugin.synthetic.layouts.room import indoor_rest, shell, wall_decor
from geodiff_plugin.synthetic.scene import Scene

__all__ = ["tabletop"]


def tabletop(rng: np.random.Generator, seed: int) -> Scene:
    """Draw a table top."""
    b = Builder(rng)
    width, depth, height = rng.uniform(3, 5), rng.uniform(3, 5), 2.6
    shell(b, width, depth, height)
    w, d, h = rng.uniform(0.9, 2.2), rng.uniform(0.6, 1.2), rng.uniform(0.5, 0.85)
    gap = pick(rng, 0.02, rng.uniform(0.02, 1.5))
    centre = Spot(b, rng.normal(0, 0.2), depth - d / 2 - gap, rng.normal(0, 0.08) if gap < 0.05 else rng.normal(0, 0.4))
    look = surface_look(rng, pick(rng, "wood", "plain", "marble", "planks", "fabric", "checker", "tiles"),
                        pick(rng, "wood", "wood", "white", "grey", "any"), gloss=pick(rng, 0.0, 0.1, 0.5))
    centre.table(w, d, h, look, pick(rng, "posts", "sides", "foot"))
    if rng.random() < 0.3:
        centre.desk_things(w, d, h, 3)
    size = rng.uniform(0.1, 0.3)
    for _ in range(int(rng.integers(8, 30))):
        centre.thing(rng.uniform(-0.46, 0.46) * w, rng.uniform(-0.46, 0.46) * d, h, size * rng.uniform(0.4, 1.7))
    for _ in range(int(rng.integers(0, 3))):  # a stack or a board that leans on the wall
        x, z = centre.at(rng.uniform(-0.4, 0.4) * w, d / 2 - 0.06)
        tall = rng.uniform(0.3, 0.8)
        b.box((x, -h - tall / 2, z), (rng.uniform(0.2, 0.6), tall, 0.03), object_look(rng, tall), yaw=centre.yaw, pitch=rng.uniform(0.05, 0.25))
    for _ in range(int(rng.integers(0, 3))):
        wall_decor(Spot(b, rng.uniform(-0.4, 0.4) * width, depth), height, h + 0.3)
    for _ in range(int(rng.integers(0, 4))):
        Spot(b, rng.uniform(-0.45, 0.45) * width, depth - rng.uniform(0.2, 1.0)).thing(0, 0, 0, rng.uniform(0.2, 0.6))
    far = d / 2 + rng.uniform(0.35, 1.3)
    azimuth = rng.normal(0, 0.35)
    rise = rng.uniform(0.15, 0.9)
    target = centre.at(rng.normal(0, 0.12) * w, rng.normal(0, 0.1) * d)
    x = np.clip(target[0] - np.sin(azimuth) * far, -width / 2 + 0.3, width / 2 - 0.3)
    z = np.clip(target[1] - np.cos(azimuth) * far, 0.3, depth - 0.3)
    run = np.hypot(target[0] - x, target[1] - z)
    pitch = np.arctan2(rise - rng.uniform(0, 0.2), run)
    yaw = np.arctan2(target[0] - x, target[1] - z) + rng.normal(0, 0.06)
    warm = colour(rng.uniform(0.05, 0.15), rng.uniform(0, 0.25), 1.0)
    for _ in range(int(rng.integers(1, 4))):
        at = (rng.uniform(-0.4, 0.4) * width, -rng.uniform(1.9, 2.5), rng.uniform(0.2, 0.85) * depth)
        b.light(at, warm * rng.uniform(0.6, 1.8))
    rest = indoor_rest(rng, "tabletop", seed, rng.uniform(38, 68), (0.05, 0.16))
    return b.finish(camera_pose(x, -h - rise, z, yaw, pitch, np.radians(rng.normal(0, 2))), 0.25, **rest)
