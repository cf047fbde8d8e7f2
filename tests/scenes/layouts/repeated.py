"""Rooms with a repeated pattern: a fence, bars, tiles, blinds or shelves, with things in front of it.

Data flow: draws -> ``Scene`` of kind "repeated".
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Builder, Look
from tests.scenes.layouts.clutter import thing
from tests.scenes.layouts.interior import area_light, indoor_rest, shell, wall_decor
from tests.scenes.layouts.palettes import colour, palette, pick, surface_look
from tests.scenes.layouts.spot import Spot, camera_pose
from tests.scenes.scene import Scene

__all__ = ["PATTERNS", "repeated_room"]


def _fence(spot: Spot, width: float) -> None:
    """Flat pickets on two rails."""
    rng = spot.rng
    look = surface_look(rng, "plain", pick(rng, "white", "wood", "painted"), macro=0.05)
    picket, height = rng.uniform(0.05, 0.09), rng.uniform(0.9, 1.3)
    period = picket * rng.uniform(1.6, 2.2)
    for x in np.arange(-width / 2, width / 2, period):
        spot.box(x, 0, 0, (picket, height, 0.02), look)
    for up in (0.2, height - 0.25):
        spot.box(0, 0.03, up, (width, 0.07, 0.03), look)


def _bars(spot: Spot, width: float) -> None:
    """A cot or balustrade: two rows of round bars between rails, something low between the rows."""
    rng = spot.rng
    look = surface_look(rng, "plain", pick(rng, "white", "wood", "grey"), macro=0.05)
    radius, height, depth = rng.uniform(0.008, 0.014), rng.uniform(0.8, 1.1), rng.uniform(0.5, 0.7)
    period = rng.uniform(0.07, 0.12)
    for z in (0.0, depth):
        for x in np.arange(-width / 2, width / 2, period):
            spot.column(x, z, 0.1, radius, height - 0.1, look)
        for up in (0.08, height):
            spot.box(0, z, up, (width, 0.04, 0.03), look)
    cloth = surface_look(rng, pick(rng, "fabric", "plain", "stripes"), "any")
    spot.box(0, depth / 2, 0.1, (width - 0.1, 0.25, depth - 0.1), cloth)


def _tiles(spot: Spot, width: float) -> None:
    """A wall of exactly equal tiles."""
    rng = spot.rng
    layer = pick(rng, "tiles", "checker", "dots", "wallpaper")
    side = rng.uniform(0.25, 0.45)
    look = Look(layer, palette(rng, pick(rng, "stone", "white", "any")), (side, side), macro=0.05)
    spot.box(0, 0.05, 0, (width, rng.uniform(1.6, 2.2), 0.1), look)


def _blinds(spot: Spot, width: float) -> None:
    """Slats, upright or level, before a dark opening."""
    rng = spot.rng
    look = surface_look(rng, "plain", pick(rng, "white", "grey", "painted"), macro=0.05)
    dark = surface_look(rng, "plain", "dark")
    height, low = rng.uniform(1.3, 1.7), rng.uniform(0.4, 0.7)
    spot.box(0, 0.15, low, (width, height, 0.03), dark)
    if rng.random() < 0.7:
        slat = rng.uniform(0.07, 0.1)
        for x in np.arange(-width / 2, width / 2, slat * rng.uniform(1.1, 1.3)):
            spot.box(x, 0, low, (slat, height, 0.004), look, turn=0.5)
    else:
        for up in np.arange(low, low + height, rng.uniform(0.05, 0.07)):
            spot.box(0, 0, up, (width, 0.004, 0.05), look, pitch=0.5)


def _shelves(spot: Spot, width: float) -> None:
    """Equal compartments, each with the same box in it."""
    rng = spot.rng
    wood, deep = surface_look(rng, "plain", pick(rng, "wood", "white"), macro=0.05), 0.3
    across, rise = rng.uniform(0.22, 0.35), rng.uniform(0.28, 0.4)
    size = across * rng.uniform(0.5, 0.75), rise * rng.uniform(0.5, 0.8), deep * 0.7
    box = Look("label_a", palette(rng, "vivid"), (size[0], size[1]), origin=(0.5, 0.5), macro=0)
    rows = int(1.9 / rise)
    for x in np.arange(-width / 2, width / 2, across):
        spot.box(x, 0, 0, (0.018, rows * rise, deep), wood)
        for row in range(rows):
            spot.box(x + across / 2, 0, row * rise + 0.018, size, box)
    for row in range(rows + 1):
        spot.box(0, 0, row * rise, (width, 0.018, deep), wood)
    spot.box(0, deep / 2, 0, (width, rows * rise, 0.01), wood)


PATTERNS = {"fence": _fence, "bars": _bars, "tiles": _tiles, "blinds": _blinds, "shelves": _shelves}
"""Pattern -> function that puts it at a spot, ``width`` metres wide. Seeds take turns, two each in a row."""


def repeated_room(rng: np.random.Generator, seed: int) -> Scene:
    """Draw a room with one repeated pattern, seen from one end."""
    b = Builder(rng)
    width, depth, height = rng.uniform(3.4, 5.0), rng.uniform(3.6, 5.5), rng.uniform(2.4, 2.9)
    shell(b, width, depth, height)
    distance = rng.uniform(1.6, 2.8)
    pattern = list(PATTERNS.values())[seed // 2 % len(PATTERNS)]
    place = Spot(b, rng.uniform(-0.3, 0.3), 0.4 + distance, rng.uniform(-0.35, 0.35))
    pattern(place, rng.uniform(1.6, 2.6))
    wall_decor(Spot(b, rng.uniform(-1.0, 1.0), depth), height, 1.0)
    for _ in range(int(rng.integers(1, 4))):
        thing(place, rng.uniform(-0.9, 0.9), -rng.uniform(0.3, 0.7), 0, rng.uniform(0.3, 0.7))
    warm = colour(rng.uniform(0.05, 0.15), rng.uniform(0, 0.2), 1.0)
    at = (rng.uniform(-0.35, 0.35) * width, 0.12 - height, rng.uniform(0.2, 0.5) * depth)
    area_light(b, at, 0.2, warm * rng.uniform(1.0, 2.5))
    rest = indoor_rest(rng, "repeated", seed, rng.uniform(60, 72), (0.07, 0.14))
    yaw, pitch = rng.uniform(-0.15, 0.15), np.radians(rng.uniform(2, 14))
    eye = rng.uniform(-0.3, 0.3), -rng.uniform(0.9, 1.4), 0.4
    return b.finish(camera_pose(*eye, yaw, pitch, rng.normal(0, 0.03)), 0.3, **rest)
