"""Furniture: tables, shelves, cabinets, kitchen counters, monitors, lamps.

Data flow: a place and a size -> primitives in a ``Builder``.
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Look
from tests.scenes.layouts.clutter import cloth, leaflet, magazine, thing
from tests.scenes.layouts.palettes import palette, pick, surface_look
from tests.scenes.layouts.spot import Spot
from tests.scenes.scene import Material

__all__ = ["cabinet", "counter", "desk_things", "monitor", "shelf", "table"]


def table(spot: Spot, width: float, depth: float, height: float, look: Look, legs: str = "posts") -> None:
    """Table or desk, front at local -z; ``legs`` is "posts", "sides" or "foot"."""
    rng = spot.rng
    top = rng.uniform(0.02, 0.05)
    spot.box(0, 0, height - top, (width, top, depth), look)
    metal = surface_look(rng, "plain", pick(rng, "grey", "dark", "wood"), gloss=0.2)
    if legs == "posts":
        leg = rng.uniform(0.03, 0.08)
        for sx in (-1, 1):
            for sz in (-1, 1):
                x, z = sx * (width / 2 - leg), sz * (depth / 2 - leg)
                spot.box(
                    x, z, 0, (leg, height - top, leg), pick(rng, metal, look) if sx + sz == -2 else metal
                )
    elif legs == "sides":
        for sx in (-1, 1):
            spot.box(sx * (width / 2 - 0.02), 0, 0, (0.03, height - top, depth * 0.9), look)
        if rng.random() < 0.6:
            front = Look("drawers", palette(rng, "wood"), (0.45, height), origin=(0.5, 0.5))
            x = pick(rng, -1, 1) * (width / 2 - 0.27)
            spot.box(x, 0, 0.05, (0.42, height - 0.1, depth * 0.85), front)
    else:
        spot.column(0, 0, 0.02, 0.05, height - top - 0.02, metal)
        spot.column(0, 0, 0, 0.28, 0.03, metal)


def monitor(spot: Spot, scale: float = 1.0) -> None:
    """Screen on a foot, facing local -z; on or off."""
    rng = spot.rng
    w = rng.uniform(0.42, 0.65) * scale
    h = w * rng.uniform(0.56, 0.65)
    dark = surface_look(rng, "plain", pick(rng, "dark", "dark", "grey"), gloss=0.2)
    spot.box(0, 0.02, 0, (0.22, 0.015, 0.18), dark)
    spot.box(0, 0.05, 0, (0.05, 0.25, 0.03), dark)
    if rng.random() < 0.5:
        layer = pick(rng, "screen_a", "screen_b", "poster_c")
        pal = palette(rng, pick(rng, "white", "white", "any"))
        face = Look(layer, pal, (w, h), gloss=0.4, macro=0, emission=0.5, origin=(0.5, 0.5))
    else:
        face = Look("plain", np.full((3, 3), 0.015), gloss=0.85, material=Material.GLOSSY, macro=0)
    spot.box(0, 0, 0.12, (w, h, 0.025), face)
    spot.box(0, 0.03, 0.13, (w * 0.98, h * 0.96, 0.03), dark)


def desk_things(
    spot: Spot, width: float, depth: float, height: float, count: int, office: float = 0.7
) -> None:
    """Computer (with chance ``office``), papers, lamp and clutter on a table."""
    rng = spot.rng
    top = spot.moved(0, 0, 0, height)
    if rng.random() < office:
        monitor(top.moved(rng.uniform(-0.25, 0.25) * width, depth * 0.18, rng.normal(0, 0.2)))
        if rng.random() < 0.7:
            keys = Look(
                "keyboard", palette(rng, pick(rng, "dark", "grey", "white")), (0.45, 0.16), origin=(0.5, 0.5)
            )
            place = (rng.uniform(-0.2, 0.2) * width, -depth * 0.25, 0)
            top.box(*place, (0.44, 0.025, 0.15), keys, turn=rng.normal(0, 0.15))
        if rng.random() < 0.4:
            monitor(top.moved(pick(rng, -1, 1) * 0.36 * width, depth * 0.12, rng.normal(0, 0.3)))
    if rng.random() < 0.4:
        _desk_lamp(top.moved(pick(rng, -1, 1) * 0.4 * width, depth * 0.3))
    for _ in range(int(rng.integers(0, 4))):
        place = rng.uniform(-0.4, 0.4) * width, rng.uniform(-0.4, 0.4) * depth
        magazine(top.moved(*place, rng.uniform(-np.pi, np.pi)))
    for _ in range(count):
        thing(
            top,
            rng.uniform(-0.45, 0.45) * width,
            rng.uniform(-0.45, 0.45) * depth,
            0,
            rng.uniform(0.06, 0.28),
        )
    if rng.random() < 0.15:
        cloth(
            top.moved(rng.uniform(-0.4, 0.4) * width, rng.uniform(-0.4, 0.4) * depth), rng.uniform(0.2, 0.5)
        )


def _desk_lamp(spot: Spot) -> None:
    """A foot, a thin stem and a conical shade."""
    look = surface_look(spot.rng, "plain", pick(spot.rng, "vivid", "grey", "dark"), gloss=0.5)
    spot.column(0, 0, 0, 0.09, 0.02, look)
    spot.column(0, 0, 0.02, 0.01, 0.38, look)
    spot.column(0, 0, 0.36, 0.1, 0.14, look, top=0.45)


def shelf(spot: Spot, width: float, height: float, depth: float = 0.3) -> None:
    """Book shelf, open towards local -z."""
    rng = spot.rng
    wood = surface_look(rng, pick(rng, "wood", "plain"), pick(rng, "wood", "white", "dark", "grey"))
    spot.box(0, depth / 2 - 0.01, 0, (width, height, 0.02), wood)
    for sx in (-1, 1):
        spot.box(sx * (width / 2 - 0.01), 0, 0, (0.02, height, depth), wood)
    rows = max(2, int(height / rng.uniform(0.32, 0.45)))
    step = (height - 0.03) / rows
    for k in range(rows + 1):
        spot.box(0, 0, k * step, (width - 0.04, 0.022, depth), wood)
        if k == rows:
            break
        up = k * step + 0.022
        if rng.random() < 0.75:
            fill, h = rng.uniform(0.5, 1.0), step * rng.uniform(0.6, 0.85)
            pal = palette(rng, pick(rng, "any", "vivid", "dark", "painted"))
            books = Look(pick(rng, "books_a", "books_b"), pal, (0.9, h), origin=(rng.random(), 0.5))
            shift = pick(rng, -1, 1) * (1 - fill) * (width / 2 - 0.03)
            spot.box(shift, rng.uniform(-0.04, 0.02), up, ((width - 0.05) * fill, h, depth * 0.65), books)
        else:
            for _ in range(int(rng.integers(0, 4))):
                thing(spot, rng.uniform(-0.4, 0.4) * width, -0.03, up, step * 0.55)


def cabinet(spot: Spot, width: float, height: float, depth: float) -> None:
    """Closed cabinet, chest of drawers or fridge, with objects on top if low."""
    rng = spot.rng
    pal = palette(rng, pick(rng, "wood", "white", "grey", "painted"))
    tile = (width / max(1, round(width / 0.9)), height)
    look = Look(pick(rng, "cabinet", "drawers"), pal, tile, gloss=rng.uniform(0, 0.3), origin=(0.5, 0.5))
    spot.box(0, 0, 0, (width, height, depth), look)
    if height < 1.5:
        for _ in range(int(rng.integers(0, 4))):
            place = rng.uniform(-0.4, 0.4) * width, rng.uniform(-0.2, 0.2) * depth
            thing(spot, *place, height, rng.uniform(0.1, 0.35))


def counter(spot: Spot, width: float) -> None:
    """Kitchen line against a wall: cupboards, worktop, splashback, jars, wall cupboards or a screen."""
    rng = spot.rng
    front = Look(
        "cabinet", palette(rng, pick(rng, "vivid", "white", "wood", "grey", "painted")), (1.0, 0.85),
        gloss=rng.uniform(0.1, 0.6), origin=(rng.random(), 0.5),
    )  # fmt: skip
    spot.box(0, 0, 0, (width, 0.86, 0.58), front)
    spot.box(
        0,
        -0.01,
        0.86,
        (width, 0.04, 0.62),
        surface_look(rng, pick(rng, "speckle", "wood", "marble", "plain"), "grey"),
    )
    splash = surface_look(
        rng, pick(rng, "mosaic", "tiles", "plain"), pick(rng, "white", "painted", "grey"), (0.3, 0.6)
    )
    spot.box(0, 0.29, 0.9, (width, 0.55, 0.012), splash)
    for _ in range(int(rng.integers(2, 8))):
        place = spot.moved(rng.uniform(-0.46, 0.46) * width, rng.uniform(0.0, 0.2), rng.normal(0, 0.25), 0.9)
        if rng.random() < 0.5:
            leaflet(place, rng.uniform(0.2, 0.34))
        else:
            thing(place, 0, 0, 0, rng.uniform(0.1, 0.3))
    if rng.random() < 0.5:
        above = Look(
            front.layer, front.palette if rng.random() < 0.6 else palette(rng, "white"), (0.9, 0.7), gloss=0.2
        )
        spot.box(0, 0.12, 1.5, (width * rng.uniform(0.5, 1), 0.7, 0.33), above)
    elif rng.random() < 0.5:
        monitor(spot.moved(rng.uniform(-0.3, 0.3) * width, 0.2, 0, 1.35), 1.4)
