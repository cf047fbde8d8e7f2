"""Rooms: floor, walls and ceiling, furniture along the walls and in the middle, clutter, lamps and windows.

Data flow: draws -> ``Scene`` of kind "room".
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Builder, Look
from tests.scenes.layouts.clutter import thing
from tests.scenes.layouts.furniture import cabinet, counter, desk_things, shelf, table
from tests.scenes.layouts.interior import area_light, door_look, indoor_rest, shell, wall_decor
from tests.scenes.layouts.palettes import colour, pick, surface_look
from tests.scenes.layouts.plants import pot_plant
from tests.scenes.layouts.seats import chair, lounger, sofa
from tests.scenes.layouts.spot import Spot, camera_pose
from tests.scenes.scene import Scene

__all__ = ["room"]


def _desk(spot: Spot, width: float) -> float:
    rng = spot.rng
    d, h = rng.uniform(0.6, 0.8), rng.uniform(0.68, 0.78)
    look = surface_look(
        rng,
        pick(rng, "wood", "plain", "plain"),
        pick(rng, "wood", "white", "grey"),
        gloss=pick(rng, 0.05, 0.3),
    )
    desk = spot.moved(0, -d / 2 - 0.02)
    table(desk, width, d, h, look, pick(rng, "posts", "sides", "posts"))
    desk_things(desk, width, d, h, int(rng.integers(2, 8)))
    if rng.random() < 0.7:
        chair(desk.moved(rng.uniform(-0.3, 0.3), -d / 2 - 0.25, np.pi + rng.normal(0, 0.5)))
    return 1.3


def _piece(spot: Spot, left: float, height: float) -> tuple[float, float]:
    """One piece of furniture from the spot to the right; its width, and where the free wall begins."""
    rng = spot.rng
    kind = rng.random()
    if kind < 0.18 and left > 0.7:
        w = min(rng.uniform(0.6, 1.6), left)
        shelf(spot.moved(w / 2, -0.17), w, rng.uniform(0.8, min(2.3, height - 0.1)))
        return w, height
    if kind < 0.38 and left > 1.0:
        w = min(rng.uniform(1.0, 2.0), left)
        return w, _desk(spot.moved(w / 2, 0), w)
    if kind < 0.52:
        w, h = min(rng.uniform(0.5, 1.4), left), pick(rng, rng.uniform(0.7, 1.2), rng.uniform(1.7, 2.1))
        d = rng.uniform(0.35, 0.65)
        cabinet(spot.moved(w / 2, -d / 2 - 0.01), w, h, d)
        return w, h + 0.3
    if kind < 0.6 and left > 1.5:
        w = min(rng.uniform(1.5, 3.5), left)
        counter(spot.moved(w / 2, -0.3), w)
        return w, height
    if kind < 0.7 and left > 1.0:
        w = min(rng.uniform(0.9, 2.2), left)
        sofa(spot.moved(w / 2, -0.47), w)
        return w, 1.2
    if kind < 0.78:
        spot.box(
            0.45, -0.005, 0, (1.0, 2.12, 0.06), surface_look(rng, "plain", pick(rng, "white", "wood", "grey"))
        )
        spot.box(0.45, -0.03, 0, (0.86, 2.05, 0.04), door_look(rng, 0.86, 2.05))
        return 0.95, height
    if kind < 0.87:
        pot_plant(spot.moved(0.25, -0.3), rng.uniform(0.5, 1.7))
        return 0.5, 1.6
    w = rng.uniform(0.3, 0.9)
    for _ in range(int(rng.integers(0, 3))):
        thing(spot, w * rng.random(), -rng.uniform(0.15, 0.4), 0, rng.uniform(0.2, 0.5))
    return w, 0.6


def _along_wall(spot: Spot, length: float, height: float) -> None:
    """Furnish a wall of a length; spot in its middle, facing into the room (local -z)."""
    rng = spot.rng
    at = -length / 2 + rng.uniform(0.05, 0.4)
    while at < length / 2 - 0.5:
        w, low = _piece(spot.moved(at, 0), length / 2 - at, height)
        if low < height - 0.8 and rng.random() < 0.65:
            wall_decor(spot.moved(at + w / 2, 0), height, low)
        at += w + rng.uniform(0.02, 0.5)


def _near_table(eye: Spot) -> None:
    """A table with objects in front of the camera, and a chair at it."""
    rng = eye.rng
    w, d, h = rng.uniform(1.0, 2.2), rng.uniform(0.6, 1.0), rng.uniform(0.6, 0.78)
    layer = pick(rng, "wood", "wood", "plain", "marble", "planks")
    family = pick(rng, "wood", "wood", "white", "grey", "dark")
    look = surface_look(rng, layer, family, gloss=pick(rng, 0.05, 0.3))
    spot = eye.moved(rng.normal(0, 0.25), d / 2 + rng.uniform(0.45, 1.1), rng.normal(0, 0.35))
    table(spot, w, d, h, look, pick(rng, "posts", "posts", "sides", "foot"))
    desk_things(spot, w, d, h, int(rng.integers(2, 12)), office=0.45)
    for _ in range(int(rng.integers(0, 3))):
        side = pick(rng, 0.0, np.pi / 2, -np.pi / 2)
        chair(
            spot.moved(0, 0, side).moved(
                rng.uniform(-0.3, 0.3), d / 2 + rng.uniform(0.05, 0.4), rng.normal(0, 0.3)
            )
        )


def _middle(b: Builder, width: float, depth: float) -> None:
    """A table with chairs, or easy chairs, in the middle of the room."""
    rng = b.rng
    spot = Spot(b, rng.uniform(-0.2, 0.2) * width, rng.uniform(0.5, 0.65) * depth, rng.uniform(-1, 1))
    if rng.random() < 0.15:
        lounger(spot.moved(0, 0, rng.uniform(-3, 3)))
        return
    w, d, h = rng.uniform(0.9, 1.8), rng.uniform(0.6, 1.0), rng.uniform(0.4, 0.78)
    look = surface_look(rng, "wood", pick(rng, "wood", "white", "dark"), gloss=0.1)
    table(spot, w, d, h, look, pick(rng, "posts", "foot"))
    desk_things(spot, w, d, h, int(rng.integers(1, 8)), office=0.3)
    for k in range(int(rng.integers(0, 5))):
        at = spot.moved(0, 0, k * np.pi / 2)
        chair(at.moved(rng.normal(0, 0.2), d / 2 + rng.uniform(0.2, 0.6), rng.normal(0, 0.4)))


def _lamps(b: Builder, width: float, depth: float, height: float) -> None:
    rng = b.rng
    shade = Look("plain", np.ones((3, 3)), emission=3.0, macro=0)
    warm = colour(rng.uniform(0.05, 0.15), rng.uniform(0, 0.25), 1.0)
    power = rng.uniform(1.5, 4.0) * (width * depth / 20) ** 0.5
    lamps = int(rng.choice([1, 2, 3], p=[0.55, 0.35, 0.1]))
    for _ in range(lamps):
        lx, lz = rng.uniform(-0.35, 0.35) * width, rng.uniform(0.15, 0.85) * depth
        b.box((lx, -height + 0.03, lz), (rng.uniform(0.2, 1.2), 0.05, 0.3), shade)
        if lamps == 1:
            area_light(b, (lx, -height + 0.12, lz), rng.uniform(0.1, 0.35), warm * power)
        else:
            b.light((lx, -height + 0.12, lz), warm * power / lamps)
    if rng.random() < 0.4:  # light through a window on one side
        at = (pick(rng, -1, 1) * (width / 2 - 0.15), -1.5, rng.uniform(0.3, 0.8) * depth)
        b.light(at, np.array([0.8, 0.9, 1.0]) * rng.uniform(0.5, 3.0))


def room(rng: np.random.Generator, seed: int) -> Scene:
    """Draw a room, seen from one end or from near a table."""
    b = Builder(rng)
    width, depth, height = rng.uniform(2.6, 6.5), rng.uniform(3.0, 7.5), rng.uniform(2.35, 3.0)
    shell(b, width, depth, height)
    half = np.pi / 2
    _along_wall(Spot(b, 0, depth), width, height)
    _along_wall(Spot(b, -width / 2, depth / 2, -half), depth, height)
    _along_wall(Spot(b, width / 2, depth / 2, half), depth, height)
    close = rng.random() < 0.5
    x = rng.uniform(-0.4, 0.4) * (width - 0.8)
    z = rng.uniform(0.35, 0.45 * depth) if close else rng.uniform(0.3, 0.8)
    pitch = np.radians(rng.uniform(5, 42) if close else rng.uniform(-5, 22))
    yaw = np.arctan2(-x * rng.uniform(0.2, 1.2), depth * 0.7 - z) + rng.normal(0, 0.25)
    roll = np.radians(rng.normal(0, 4) if close else rng.normal(0, 1.5))
    if close:
        _near_table(Spot(b, x, z, yaw))
    elif rng.random() < 0.75:
        _middle(b, width, depth)
    for _ in range(int(rng.integers(0, 5))):
        thing(
            Spot(b, rng.uniform(-0.45, 0.45) * width, rng.uniform(0.3, 0.95) * depth),
            0,
            0,
            0,
            rng.uniform(0.15, 0.5),
        )
    if rng.random() < 0.2:  # a post, screen or door edge close to one side of the camera
        near = Spot(b, x, z, yaw).moved(pick(rng, -1, 1) * rng.uniform(0.5, 0.9), rng.uniform(0.8, 1.4))
        look = surface_look(
            rng, pick(rng, "plain", "wood", "poster_a", "plaster"), pick(rng, "wall", "dark", "any", "white")
        )
        near.box(
            0,
            0,
            0,
            (rng.uniform(0.1, 0.6), rng.uniform(1.6, height), rng.uniform(0.03, 0.2)),
            look,
            turn=rng.normal(0, 0.6),
        )
    if rng.random() < 0.3:
        rug = surface_look(rng, pick(rng, "carpet", "stripes", "wallpaper", "checker"), "any")
        b.quad((x, -0.006, z + 1.5), rng.uniform(0.6, 1.2), rng.uniform(0.8, 1.6), rug, yaw=yaw)
    _lamps(b, width, depth, height)
    tall = min(rng.uniform(1.0, 1.9), height - 0.3)
    rest = indoor_rest(rng, "room", seed, rng.uniform(48, 80), (0.06, 0.2))
    return b.finish(camera_pose(x, -tall, z, yaw, pitch, roll), 0.3, **rest)
