"""Cars and vans, people, poles with lamps, signs and wires.

Data flow: a place -> primitives in a ``Builder``.
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Look
from tests.scenes.layouts.palettes import colour, object_look, palette, pick, surface_look
from tests.scenes.layouts.spot import Spot
from tests.scenes.scene import Material, Shape

__all__ = ["car", "person", "pole", "wires"]


def car(spot: Spot) -> None:
    """Car or van along local z, its back towards local -z."""
    rng = spot.rng
    paint = Look(
        "plain",
        palette(rng, pick(rng, "grey", "dark", "white", "vivid", "grey")),
        gloss=rng.uniform(0.4, 0.75),
        macro=0.05,
    )
    glass = Look(
        "plain", np.full((3, 3), rng.uniform(0.01, 0.05)), gloss=0.9, macro=0, material=Material.GLOSSY
    )
    length, width, height = rng.uniform(3.6, 4.8), rng.uniform(1.62, 1.85), rng.uniform(1.38, 1.6)
    kind = rng.random()
    if kind < 0.15:  # van
        length, height = rng.uniform(4.6, 6.0), rng.uniform(1.9, 2.6)
        spot.wedge(0, 0, 0.3, (width, height - 0.3, length), paint, (0.08, 0.12))
        spot.wedge(0, 0, height * 0.58, (width + 0.01, height * 0.28, length * 0.93), glass, (0.05, 0.04))
    else:
        estate = kind < 0.45
        spot.wedge(0, 0, 0.22, (width, 0.62, length), paint, (0.06, 0.05))
        long_, shift = (0.7, -0.13) if estate else (0.55, rng.uniform(-0.12, -0.02))
        slope = 0.24 if estate else 0.42
        roof = height - 0.82
        spot.wedge(0, shift * length, 0.82, (width * 0.94, roof, length * long_), glass, (0.2, slope))
        spot.wedge(
            0,
            shift * length,
            height - 0.07,
            (width * 0.77, 0.06, length * long_ * (1.03 - slope)),
            paint,
            (0.1, 0.05),
        )
        for part in (-0.48, 0.0, 0.46):  # pillars between the windows
            lz = (shift + part * long_ * (1 - slope * 0.5)) * length
            spot.wedge(0, lz, 0.82, (width * 0.945, roof, 0.07), paint, (0.2, 0.0))
    _details(spot, length, width)


def _details(spot: Spot, length: float, width: float) -> None:
    black = Look("plain", np.full((3, 3), 0.015), macro=0.1)
    rim = surface_look(spot.rng, "plain", "grey", gloss=0.4)
    red = Look("plain", np.array([[0.5, 0.02, 0.02]] * 3), emission=0.3, macro=0)
    plate = Look("document", palette(spot.rng, "white"), (0.5, 0.2))
    for end in (-1, 1):
        for sx in (-1, 1):
            lamp = (sx * (width / 2 - 0.2), end * length / 2 * 0.985, 0.58)
            spot.box(*lamp, (0.3, 0.14, 0.06), red if end < 0 else plate)
            x, z = spot.at(sx * (width / 2 - 0.09), end * length * 0.31)
            turn = dict(yaw=spot.yaw, roll=np.pi / 2)
            spot.b.add(Shape.FRUSTUM, (x, spot.ground - 0.31, z), (0.31, 0.11, 0.31), black, **turn)
            x, z = spot.at(sx * (width / 2 - 0.07), end * length * 0.31)
            spot.b.add(Shape.FRUSTUM, (x, spot.ground - 0.31, z), (0.18, 0.11, 0.18), rim, **turn)
        spot.box(0, end * length / 2 * 0.99, 0.38, (0.5, 0.12, 0.04), plate)
        spot.box(0, end * length / 2 * 0.985, 0.24, (width * 0.97, 0.12, 0.06), black)


def person(spot: Spot) -> None:
    """Standing or walking figure."""
    rng = spot.rng
    h = rng.uniform(1.5, 1.9)
    skin = Look("plain", np.array([colour(0.06, 0.4, rng.uniform(0.4, 0.9))] * 3))
    trousers, coat = object_look(rng, 0.5, 0), object_look(rng, 0.5, 0)
    stride = rng.uniform(0, 0.12)
    spot.column(-0.09, -stride, 0, 0.08, h * 0.5, trousers, top=1.15)
    spot.column(0.09, stride, 0, 0.08, h * 0.5, trousers, top=1.15)
    spot.ball(0, 0, h * 0.65, (0.23, h * 0.2, 0.14), coat)
    for s in (-1, 1):
        spot.ball(s * 0.25, s * stride, h * 0.6, (0.055, h * 0.18, 0.06), coat)
    spot.ball(0, 0, h * 0.93, (0.085, 0.12, 0.1), skin)


def pole(spot: Spot, height: float, arm: float = 0.0, sign: bool = False) -> None:
    """Lamp post (an ``arm`` in metres along local x), traffic sign, or a bare pole."""
    rng = spot.rng
    look = surface_look(rng, "concrete", pick(rng, "grey", "dark", "wood"))
    spot.column(0, 0, 0, rng.uniform(0.035, 0.12), height, look, top=0.7)
    if arm:
        spot.box(arm / 2, 0, height - 0.1, (abs(arm), 0.07, 0.07), look)
        spot.box(arm, 0, height - 0.16, (0.6, 0.1, 0.22), look)
    if sign:
        layer = pick(rng, "poster_a", "poster_b", "label_a", "plain")
        face = Look(layer, palette(rng, "vivid"), (0.7, 0.7), origin=(0.5, 0.5))
        if rng.random() < 0.5:
            spot.box(0, -0.08, height - 0.7, (0.65, 0.65, 0.02), face)
        else:
            spot.rod(0, -0.1, height - 0.35, 0.33, 0.02, face)


def wires(spot: Spot, length: float, height: float, count: int) -> None:
    """Overhead wires along local z."""
    black = Look("plain", np.full((3, 3), 0.02), macro=0)
    for k in range(count):
        spot.rod((k - (count - 1) / 2) * 0.4, length / 2, height - 0.15 * (k % 2), 0.012, length, black)
