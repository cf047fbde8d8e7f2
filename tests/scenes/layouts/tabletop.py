"""Table tops: many touching and overlapping objects at close range, a wall behind.

Data flow: draws -> ``Scene`` of kind "tabletop".
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Builder
from tests.scenes.layouts.clutter import cloth, leaflet, thing
from tests.scenes.layouts.furniture import desk_things, table
from tests.scenes.layouts.interior import area_light, indoor_rest, shell, wall_decor
from tests.scenes.layouts.palettes import colour, object_look, pick, surface_look
from tests.scenes.layouts.seats import chair, lounger
from tests.scenes.layouts.spot import Spot, camera_pose
from tests.scenes.scene import Scene

__all__ = ["tabletop"]


def _still_life(spot: Spot, w: float, d: float) -> None:
    """Objects over ``w`` by ``d`` metres around the spot, on the surface of its ground."""
    rng = spot.rng
    b = spot.b
    size = rng.uniform(0.1, 0.3)
    for _ in range(int(rng.integers(6, 28))):
        thing(
            spot, rng.uniform(-0.46, 0.46) * w, rng.uniform(-0.46, 0.46) * d, 0, size * rng.uniform(0.4, 1.7)
        )
    for _ in range(int(rng.integers(0, 3))):  # a board or a book that leans back
        x, z = spot.at(rng.uniform(-0.4, 0.4) * w, d / 2 - 0.06)
        tall = rng.uniform(0.3, 0.8)
        turn = dict(yaw=spot.yaw, pitch=rng.uniform(0.05, 0.25))
        b.box(
            (x, spot.ground - tall / 2, z),
            (rng.uniform(0.2, 0.6), tall, 0.03),
            object_look(rng, tall),
            **turn,
        )
    for _ in range(int(rng.integers(0, 3))):
        leaflet(
            spot.moved(rng.uniform(-0.4, 0.4) * w, rng.uniform(0, 0.45) * d, rng.normal(0, 0.4)),
            rng.uniform(0.2, 0.35),
        )
    if rng.random() < 0.3:
        cloth(spot.moved(rng.uniform(-0.4, 0.4) * w, rng.uniform(-0.4, 0.4) * d), rng.uniform(0.25, 0.6))


def tabletop(rng: np.random.Generator, seed: int) -> Scene:
    """Draw a table top, or a still life on the floor."""
    b = Builder(rng)
    width, depth, height = rng.uniform(3, 5), rng.uniform(3, 5), 2.6
    shell(b, width, depth, height)
    w, d, h = rng.uniform(0.9, 2.2), rng.uniform(0.6, 1.2), rng.uniform(0.5, 0.85)
    gap = pick(rng, 0.02, rng.uniform(0.02, 1.5))
    turn = rng.normal(0, 0.08) if gap < 0.05 else rng.normal(0, 0.4)
    centre = Spot(b, rng.normal(0, 0.2), depth - d / 2 - gap, turn)
    if rng.random() < 0.22:
        h = 0.0
        seat = pick(rng, chair, lounger)
        seat(centre.moved(rng.uniform(-0.3, 0.3), 0, rng.normal(0, 0.6)))
    else:
        layer = pick(rng, "wood", "wood", "plain", "marble", "planks", "fabric", "checker", "tiles")
        family = pick(rng, "wood", "wood", "white", "grey", "any")
        table(
            centre,
            w,
            d,
            h,
            surface_look(rng, layer, family, gloss=pick(rng, 0.0, 0.1, 0.5)),
            pick(rng, "posts", "sides", "foot"),
        )
        if rng.random() < 0.3:
            desk_things(centre, w, d, h, 3)
    _still_life(centre.moved(0, 0, 0, h), w, d)
    for _ in range(int(rng.integers(0, 3))):
        wall_decor(Spot(b, rng.uniform(-0.4, 0.4) * width, depth), height, h + 0.3)
    for _ in range(int(rng.integers(0, 4))):
        place = Spot(b, rng.uniform(-0.45, 0.45) * width, depth - rng.uniform(0.2, 1.0))
        thing(place, 0, 0, 0, rng.uniform(0.2, 0.6))
    warm = colour(rng.uniform(0.05, 0.15), rng.uniform(0, 0.25), 1.0)
    for _ in range(int(rng.integers(1, 3))):
        at = (rng.uniform(-0.4, 0.4) * width, -rng.uniform(1.9, 2.5), rng.uniform(0.2, 0.85) * depth)
        area_light(b, at, rng.uniform(0.08, 0.3), warm * rng.uniform(0.8, 2.2))
    pose = _eye(centre, w, d, h, width, depth)
    rest = indoor_rest(rng, "tabletop", seed, rng.uniform(38, 68), (0.05, 0.16))
    return b.finish(pose, 0.25, **rest)


def _eye(centre: Spot, w: float, d: float, h: float, width: float, depth: float) -> np.ndarray:
    """A camera near the surface that looks at its objects."""
    rng = centre.rng
    far, azimuth = d / 2 + rng.uniform(0.35, 1.5), rng.normal(0, 0.35)
    rise = rng.uniform(0.15, 0.9) + (0.3 if h == 0 else 0.0)
    target = centre.at(rng.normal(0, 0.12) * w, rng.normal(0, 0.1) * d)
    x = np.clip(target[0] - np.sin(azimuth) * far, -width / 2 + 0.3, width / 2 - 0.3)
    z = np.clip(target[1] - np.cos(azimuth) * far, 0.3, depth - 0.3)
    pitch = np.arctan2(rise - rng.uniform(0, 0.2), np.hypot(target[0] - x, target[1] - z))
    yaw = np.arctan2(target[0] - x, target[1] - z) + rng.normal(0, 0.06)
    return camera_pose(x, -h - rise, z, yaw, pitch, np.radians(rng.normal(0, 2)))
