"""Common parts of indoor scenes: floor, walls and ceiling, objects on walls, lamps, ambient light.

Data flow: draws -> primitives, lights and fields of a ``Scene``.
"""

from __future__ import annotations

import numpy as np
import torch

from tests.scenes.builder import Builder, Look
from tests.scenes.layouts.palettes import colour, palette, pick, surface_look
from tests.scenes.layouts.spot import Spot
from tests.scenes.scene import Material

__all__ = ["area_light", "door_look", "indoor_rest", "shell", "wall_decor"]

_FLOORS = (
    "planks",
    "parquet",
    "tiles",
    "carpet",
    "carpet",
    "concrete",
    "checker",
    "marble",
    "plain",
    "pinstripes",
)
_FLOOR_FAMILY = {"planks": "wood", "parquet": "wood", "tiles": "stone", "carpet": "any", "marble": "stone"}


def shell(b: Builder, width: float, depth: float, height: float) -> None:
    """Floor, ceiling and four walls around x in [-w/2, w/2], z in [0, d]."""
    rng = b.rng
    layer = _FLOORS[int(rng.integers(len(_FLOORS)))]
    family = _FLOOR_FAMILY.get(layer, "grey")
    floor = surface_look(rng, layer, family, gloss=pick(rng, 0.0, 0.05, 0.3), macro=0.2)
    b.quad((0, 0, depth / 2), width / 2, depth / 2, floor, fixed=True)
    ceiling = surface_look(rng, pick(rng, "plain", "plain", "tiles", "plaster"), "white", macro=0.1)
    b.quad((0, -height, depth / 2), width / 2, depth / 2, ceiling, fixed=True)
    layer = pick(rng, "plain", "plaster", "plaster", "wallpaper", "pinstripes", "brick", "blocks")
    wall = surface_look(rng, layer, pick(rng, "wall", "wall", "white", "painted"), macro=0.15)
    other = surface_look(
        rng, pick(rng, "plain", "plaster", "wallpaper"), pick(rng, "wall", "painted", "white", "vivid")
    )
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


def door_look(rng: np.random.Generator, width: float, height: float) -> Look:
    """A panelled door leaf."""
    return Look(
        "door",
        palette(rng, pick(rng, "wood", "white", "grey", "dark", "painted")),
        (width, height),
        origin=(0.5, 0.5),
    )


def wall_decor(spot: Spot, height: float, low: float) -> None:
    """A poster, mirror, window or clock on a wall that faces local -z (spot at the wall), above ``low``."""
    rng = spot.rng
    up = rng.uniform(max(low, 1.0), max(low + 0.1, height - 0.7))
    frame = surface_look(rng, "plain", pick(rng, "white", "wood", "dark"))
    kind = rng.random()
    if kind < 0.5:
        w, h = rng.uniform(0.3, 1.1), rng.uniform(0.3, 0.9)
        layer = pick(rng, "poster_a", "poster_b", "poster_c", "document", "page", "fbm", "marble", "leaves")
        family = "white" if layer in ("document", "page") else pick(rng, "any", "vivid", "painted", "white")
        face = Look(layer, palette(rng, family), (w, h), origin=(0.5, 0.5), macro=0)
        _framed(spot, w, h, up, face, frame, 0.03)
    elif kind < 0.62:
        face = Look("plain", palette(rng, "grey"), material=Material.MIRROR, gloss=1.0, macro=0)
        _framed(spot, rng.uniform(0.4, 1.2), rng.uniform(0.5, 1.3), up, face, frame, 0.04)
    elif kind < 0.88:
        _window(spot, rng.uniform(0.8, 2.2), rng.uniform(0.9, 1.5), up, frame)
    else:
        spot.rod(0, -0.03, up, 0.14, 0.02, frame)
        spot.box(0, -0.005, 0.3, (0.08, 0.08, 0.012), frame)


def _framed(spot: Spot, w: float, h: float, up: float, face: Look, frame: Look, border: float) -> None:
    spot.box(0, -0.012, up - h / 2, (w + 2 * border, h + 2 * border, 0.02), frame)
    spot.box(0, -0.02, up - h / 2 + border, (w, h, 0.016), face)


def _window(spot: Spot, w: float, h: float, up: float, frame: Look) -> None:
    """Bright panes with a view, a sill, perhaps curtains or blinds."""
    rng = spot.rng
    sky = colour(rng.uniform(0.5, 0.6), 0.15, 1.0)
    pal = np.stack([colour(0.08, 0.03, 0.95), sky, colour(0.08, 0.05, 0.95)])
    tile = (w / max(1, round(w)), h)
    glow = rng.uniform(0.8, 4.0)
    spot.box(
        0,
        -0.01,
        up - h / 2,
        (w, h, 0.03),
        Look("window", pal, tile, emission=glow, origin=(0.5, 0.5), macro=0, gloss=0.3),
    )
    spot.box(0, -0.06, up - h / 2 - 0.04, (w + 0.15, 0.04, 0.16), frame)
    dressing = rng.random()
    if dressing < 0.35:
        family = pick(rng, "any", "painted", "white")
        cloth = surface_look(rng, pick(rng, "stripes", "fabric", "plain"), family)
        for s in (-1, 1):
            for k in range(3):  # folds
                lx = s * (w / 2 + 0.02 + 0.1 * k)
                spot.column(lx, -0.09, up - h / 2 - 0.3, 0.06, h + 0.6, cloth)
    elif dressing < 0.5:
        slat = surface_look(rng, "plain", "white")
        for k in range(int(rng.integers(3, 9))):
            spot.box(0, -0.05, up + h / 2 - 0.07 * (k + 1), (w, 0.012, 0.05), slat, pitch=0.5)


def area_light(b: Builder, centre: tuple[float, float, float], size: float, colour_: np.ndarray) -> None:
    """A lamp; in one scene of three a wide one, of three parts, whose shadows are soft."""
    rng = b.rng
    if rng.random() < 0.33:
        for k in range(3):
            a = 2.1 * k
            b.light((centre[0] + size * np.cos(a), centre[1], centre[2] + size * np.sin(a)), colour_ / 3)
    else:
        b.light(centre, colour_)


def indoor_rest(
    rng: np.random.Generator, kind: str, seed: int, fov: float, baseline: tuple[float, float]
) -> dict:
    """Ambient light and the other fields that indoor kinds share."""
    level = rng.uniform(0.12, 0.45)
    warm = colour(rng.uniform(0.06, 0.14), rng.uniform(0, 0.12), 1.0)

    def t(x):
        return torch.tensor(np.asarray(x), dtype=torch.float32)

    return dict(
        ambient_up=t(level * warm),
        ambient_down=t(level * rng.uniform(0.35, 0.7) * warm),
        ao_length_m=float(rng.uniform(0.5, 1.3)),
        sky=t([[0.6, 0.75, 1.0]] * 3),
        sky_clouds=0.0,
        fog_density=0.0,
        fog_colour=t([0.5, 0.5, 0.5]),
        fov_deg=float(fov),
        baseline_m=float(rng.uniform(*baseline)),
        kind=kind,
        seed=seed,
    )
