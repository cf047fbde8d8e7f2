"""Rooms: floor, walls and ceiling, furniture along the walls and in the middle, clutter, lamps and windows.

Hop: draws -> ``Scene`` of kind "room".
Paper: none.
"""

from __future__ import annotations

import numpy as np
import torch

from geodiff_plugin.synthetic.builder import Builder, Look
from geodiff_plugin.synthetic.layouts.palettes import colour, palette, pick, surface_look
from geodiff_plugin.synthetic.layouts.parts import Spot, camera_pose
from geodiff_plugin.synthetic.scene import Material, Scene

__all__ = ["indoor_rest", "room", "shell", "wall_decor"]


def shell(b: Builder, width: float, depth: float, height: float) -> None:
    """Floor, ceiling and four walls around x in [-w/2, w/2], z in [0, d]."""
    rng = b.rng
    floors = ("planks", "parquet", "tiles", "carpet", "carpet", "concrete", "checker", "marble", "plain")
    layer = floors[int(rng.integers(len(floors)))]
    family = {"planks": "wood", "parquet": "wood", "tiles": "stone", "carpet": "any", "marble": "stone"}.get(layer, "grey")
    floor = surface_look(rng, layer, family, gloss=pick(rng, 0.0, 0.05, 0.3), macro=0.2)
    b.quad((0, 0, depth / 2), width / 2, depth / 2, floor, fixed=True)
    ceiling = surface_look(rng, pick(rng, "plain", "plain", "tiles", "plaster"), "white", macro=0.1)
    b.quad((0, -height, depth / 2), width / 2, depth / 2, ceiling, fixed=True)
    wall = surface_look(rng, pick(rng, "plain", "plaster", "plaster", "wallpaper", "pinstripes", "brick", "blocks"),
                        pick(rng, "wall", "wall", "white", "painted"), macro=0.15)
    other = surface_look(rng, pick(rng, "plain", "plaster", "wallpaper"), pick(rng, "wall", "painted", "white"))
    half = np.pi / 2
    for x, yaw, look in ((-width / 2, -half, wall), (width / 2, half, pick(rng, wall, other))):
        b.quad((x, -height / 2, depth / 2), depth / 2, height / 2, look, yaw=yaw, pitch=half, fixed=True)
    for z, look in ((depth, pick(rng, wall, wall, other)), (0.0, wall)):
        b.quad((0, -height / 2, z), width / 2, height / 2, look, pitch=half, fixed=True)
    if rng.random() < 0.6:  # skirting board
        board = surface_look(rng, "plain", pick(rng, "white", "wood", "dark"))
        b.box((0, -0.05, depth - 0.01), (width, 0.1, 0.02), board)
        for s in (-1, 1):
            b.box((s * (width / 2 - 0.01), -0.05, depth / 2), (0.02, 0.1, depth), board)


def wall_decor(spot: Spot, height: float, low: float) -> None:
    """A poster, picture, mirror, window, board, clock or socket on a wall that faces local -z (spot at the wall)."""
    rng = spot.b.rng
    kind = rng.random()
    up = rng.uniform(max(low, 1.0), max(low + 0.1, height - 0.7))
    white = surface_look(rng, "plain", pick(rng, "white", "wood", "dark"))
    if kind < 0.5:
        w, h = rng.uniform(0.3, 1.1), rng.uniform(0.3, 0.9)
        layer = pick(rng, "poster_a", "poster_b", "poster_c", "document", "page", "fbm", "marble")
        family = "white" if layer in ("document", "page") else pick(rng, "any", "vivid", "painted", "white")
        face = Look(layer, palette(rng, family), (w, h), origin=(0.5, 0.5), macro=0)
        spot.box(0, -0.012, up - h / 2, (w + 0.06, h + 0.06, 0.02), white)
        spot.box(0, -0.02, up - h / 2 + 0.03, (w, h, 0.016), face)
    elif kind < 0.6:
        w, h = rng.uniform(0.4, 1.0), rng.uniform(0.5, 1.3)
        face = Look("plain", palette(rng, "grey"), material=Material.MIRROR, gloss=1.0, macro=0)
        spot.box(0, -0.012, up - h / 2, (w + 0.08, h + 0.08, 0.02), white)
        spot.box(0, -0.02, up - h / 2 + 0.04, (w, h, 0.016), face)
    elif kind < 0.85:
        w, h = rng.uniform(0.8, 2.0), rng.uniform(0.9, 1.5)
        pal = np.stack([colour(0.08, 0.03, 0.95), colour(rng.uniform(0.5, 0.6), 0.15, 1.0), colour(0.08, 0.05, 0.95)])
        pane = Look("window", pal, (w / max(1, round(w)), h), emission=rng.uniform(0.8, 2.5), origin=(0.5, 0.5), macro=0, gloss=0.3)
        spot.box(0, -0.01, up - h / 2, (w, h, 0.03), pane)
        spot.box(0, -0.06, up - h / 2 - 0.04, (w + 0.15, 0.04, 0.16), white)
        if rng.random() < 0.4:
            cloth = surface_look(rng, pick(rng, "stripes", "fabric", "plain"), pick(rng, "any", "painted", "white"))
            for s in (-1, 1):
                spot.box(s * (w / 2 + 0.12), -0.08, up - h / 2 - 0.3, (0.35, h + 0.6, 0.08), cloth)
    else:
        spot.column(0, -0.03, up, 0.14, 0.02, white)
        spot.box(0, -0.005, 0.3, (0.08, 0.08, 0.012), white)


def _along_wall(spot: Spot, length: float, height: float) -> None:
    """Furnish a wall of a length; spot in its middle, facing into the room (local -z)."""
    rng = spot.b.rng
    at = -length / 2 + rng.uniform(0.05, 0.4)
    while at < length / 2 - 0.5:
        kind, left = rng.random(), length / 2 - at
        low = 0.0
        if kind < 0.2 and left > 0.7:
            w = min(rng.uniform(0.6, 1.6), left)
            spot.moved(at + w / 2, -0.17).shelf(w, rng.uniform(0.8, min(2.3, height - 0.1)))
            low = height
        elif kind < 0.42 and left > 1.0:
            w, d, h = min(rng.uniform(1.0, 2.0), left), rng.uniform(0.6, 0.8), rng.uniform(0.68, 0.78)
            look = surface_look(rng, pick(rng, "wood", "plain", "plain"), pick(rng, "wood", "white", "grey"), gloss=pick(rng, 0.05, 0.3))
            desk = spot.moved(at + w / 2, -d / 2 - 0.02)
            desk.table(w, d, h, look, pick(rng, "posts", "sides", "posts"))
            desk.desk_things(w, d, h, int(rng.integers(2, 8)))
            if rng.random() < 0.7:
                desk.moved(rng.uniform(-0.3, 0.3), -d / 2 - 0.25, np.pi + rng.normal(0, 0.5)).chair()
            low = 1.3
        elif kind < 0.6:
            w, h = min(rng.uniform(0.5, 1.4), left), pick(rng, rng.uniform(0.7, 1.2), rng.uniform(1.7, 2.1))
            d = rng.uniform(0.35, 0.65)
            spot.moved(at + w / 2, -d / 2 - 0.01).cabinet(w, h, d)
            low = h + 0.3
        elif kind < 0.7 and left > 1.5:
            w = min(rng.uniform(1.5, 2.2), left)
            spot.moved(at + w / 2, -0.47).sofa(w)
            low = 1.2
        elif kind < 0.78:
            w = 0.9
            face = Look("door", palette(rng, pick(rng, "wood", "white", "grey")), (w, 2.05), origin=(0.5, 0.5))
            spot.box(at + w / 2, -0.01, 0, (w, 2.05, 0.05), face)
            low = height
        elif kind < 0.86:
            w = 0.5
            spot.moved(at + w / 2, -0.3).plant(rng.uniform(0.5, 1.5))
        else:
            w = rng.uniform(0.3, 0.9)
            for _ in range(int(rng.integers(0, 3))):
                spot.thing(at + w * rng.random(), -rng.uniform(0.15, 0.4), 0, rng.uniform(0.2, 0.5))
        if low < height - 0.8 and rng.random() < 0.65:
            wall_decor(spot.moved(at + w / 2, 0), height, low)
        at += w + rng.uniform(0.02, 0.5)


def indoor_rest(rng: np.random.Generator, kind: str, seed: int, fov: float, baseline: tuple[float, float]) -> dict:
    """Ambient light and the fields that indoor kinds share."""
    level = rng.uniform(0.16, 0.45)
    warm = colour(rng.uniform(0.06, 0.14), rng.uniform(0, 0.12), 1.0)
    t = lambda x: torch.tensor(np.asarray(x), dtype=torch.float32)  # noqa: E731
    return dict(
        ambient_up=t(level * warm), ambient_down=t(level * rng.uniform(0.35, 0.7) * warm), ao_length_m=float(rng.uniform(0.5, 1.3)),
        sky=t([[0.6, 0.75, 1.0]] * 3), sky_clouds=0.0, fog_density=0.0, fog_colour=t([0.5, 0.5, 0.5]),
        fov_deg=float(fov), baseline_m=float(rng.uniform(*baseline)), kind=kind, seed=seed,
    )


def room(rng: np.random.Generator, seed: int) -> Scene:
    """Draw a room."""
    b = Builder(rng)
    width, depth, height = rng.uniform(2.6, 6.5), rng.uniform(3.0, 7.5), rng.uniform(2.35, 3.0)
    shell(b, width, depth, height)
    half = np.pi / 2
    _along_wall(Spot(b, 0, depth), width, height)
    _along_wall(Spot(b, -width / 2, depth / 2, -half), depth, height)
    _along_wall(Spot(b, width / 2, depth / 2, half), depth, height)
    # The camera: standing back and looking across, or close to a desk and looking down.
    close = rng.random() < 0.45
    x, z = rng.uniform(-0.4, 0.4) * (width - 0.8), rng.uniform(0.35, 0.45 * depth)
    if not close:
        z = rng.uniform(0.3, 0.8)
    tall = rng.uniform(1.0, 1.9)
    pitch = np.radians(rng.uniform(8, 42) if close else rng.uniform(-5, 22))
    yaw = np.arctan2(-x * rng.uniform(0.2, 1.2), depth * 0.7 - z) + rng.normal(0, 0.25)
    roll = np.radians(rng.normal(0, 4) if close else rng.normal(0, 1.5))
    if close:  # a table in view
        w, d, h = rng.uniform(1.0, 2.2), rng.uniform(0.6, 1.0), rng.uniform(0.6, 0.78)
        away = d / 2 + rng.uniform(0.45, 1.1)
        look = surface_look(rng, pick(rng, "wood", "plain", "marble", "planks"), pick(rng, "wood", "white", "grey", "dark"), gloss=pick(rng, 0.05, 0.3))
        table = Spot(b, x, z, yaw).moved(rng.normal(0, 0.25), away, rng.normal(0, 0.35))
        table.table(w, d, h, look, pick(rng, "posts", "sides", "foot"))
        table.desk_things(w, d, h, int(rng.integers(4, 14)))
        if rng.random() < 0.6:
            table.moved(rng.uniform(-0.4, 0.4), d / 2 + 0.3, rng.normal(0, 0.5)).chair()
    elif rng.random() < 0.75:
        middle = Spot(b, rng.uniform(-0.2, 0.2) * width, rng.uniform(0.5, 0.65) * depth, rng.uniform(-1, 1))
        w, d, h = rng.uniform(0.9, 1.8), rng.uniform(0.6, 1.0), rng.uniform(0.4, 0.78)
        middle.table(w, d, h, surface_look(rng, "wood", pick(rng, "wood", "white", "dark"), gloss=0.1), pick(rng, "posts", "foot"))
        middle.desk_things(w, d, h, int(rng.integers(1, 8)))
        for k in range(int(rng.integers(0, 5))):
            middle.moved(0, 0, k * half).moved(rng.normal(0, 0.2), d / 2 + rng.uniform(0.2, 0.6), rng.normal(0, 0.4)).chair()
    for _ in range(int(rng.integers(0, 6))):
        Spot(b, rng.uniform(-0.45, 0.45) * width, rng.uniform(0.3, 0.95) * depth).thing(0, 0, 0, rng.uniform(0.15, 0.5))
    lamps = int(rng.integers(1, 4))
    shade_look = Look("plain", np.ones((3, 3)), emission=3.0, macro=0)
    warm = colour(rng.uniform(0.05, 0.15), rng.uniform(0, 0.25), 1.0)
    power = rng.uniform(1.5, 4.0) * (width * depth / 20) ** 0.5
    for _ in range(lamps):
        lx, lz = rng.uniform(-0.35, 0.35) * width, rng.uniform(0.15, 0.85) * depth
        b.box((lx, -height + 0.03, lz), (rng.uniform(0.2, 1.2), 0.05, 0.3), shade_look)
        b.light((lx, -height + 0.12, lz), warm * power / lamps)
    if rng.random() < 0.45:  # light through a window on one side
        s = pick(rng, -1, 1)
        b.light((s * (width / 2 - 0.15), -1.5, rng.uniform(0.3, 0.8) * depth), np.array([0.8, 0.9, 1.0]) * rng.uniform(0.5, 2.0))
    rest = indoor_rest(rng, "room", seed, rng.uniform(48, 80), (0.06, 0.2))
    return b.finish(camera_pose(x, -min(tall, height - 0.3), z, yaw, pitch, roll), 0.3, **rest)
