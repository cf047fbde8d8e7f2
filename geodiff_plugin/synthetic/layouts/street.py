"""Streets in towns, suburbs and the country: road and kerbs, facades, gardens, cars, poles, trees, people.

Hop: draws -> ``Scene`` of kind "street".
Paper: none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodiff_plugin.synthetic.builder import Builder, Look
from geodiff_plugin.synthetic.layouts.outdoor import building, daylight, house
from geodiff_plugin.synthetic.layouts.palettes import palette, pick, surface_look
from geodiff_plugin.synthetic.layouts.plants import bush, leaf_look, tree, tree_line
from geodiff_plugin.synthetic.layouts.spot import Spot, camera_pose
from geodiff_plugin.synthetic.layouts.traffic import car, person, pole, wires
from geodiff_plugin.synthetic.patterns import TILE_M
from geodiff_plugin.synthetic.scene import Scene

__all__ = ["street"]


@dataclass(frozen=True)
class _Plan:
    """Cross-section of the street in metres, and how far it goes."""

    half_road: float
    walk: float
    kerb: float
    end: float

    @property
    def edge(self) -> float:
        """From the middle to the far side of the pavement."""
        return self.half_road + 0.18 + self.walk


def _ground(b: Builder, plan: _Plan, marked: float) -> None:
    rng = b.rng
    verge = surface_look(
        rng,
        pick(rng, "grass", "grass", "soil", "paving"),
        pick(rng, "leaf", "moss", "dry", "stone"),
        macro=0.5,
    )
    b.quad((0, 0.02, 150), 300, 300, verge, fixed=True)
    pal = palette(rng, "asphalt")
    pal[2] = palette(rng, "white")[0]
    if rng.random() < marked:
        tile = (plan.half_road * 2, rng.uniform(9, 14))
        road = Look("road", pal, tile, macro=0.35, origin=(0.5, rng.random()))
    else:
        road = Look(pick(rng, "asphalt", "asphalt", "cobbles"), pal, (TILE_M["asphalt"],) * 2, macro=0.5)
    b.quad((0, 0, 150), plan.half_road, 250, road, fixed=True)
    if plan.walk == 0:
        return
    pave = surface_look(
        rng, pick(rng, "paving", "flagstones", "concrete", "tiles"), pick(rng, "stone", "grey"), macro=0.3
    )
    stone = surface_look(rng, "concrete", "stone")
    for s in (-1, 1):
        y, tall = -plan.kerb / 2 + 0.05, plan.kerb + 0.1
        b.box((s * (plan.half_road + 0.09), y, 150), (0.18, tall, 500), stone, fixed=True)
        b.box((s * (plan.edge - plan.walk / 2), y, 150), (plan.walk, tall - 0.01, 500), pave, fixed=True)


def _fence(spot: Spot, length: float) -> None:
    """Hedge, wall or fence along local z."""
    rng = spot.rng
    layer = pick(rng, "hedge", "leaves", "brick", "planks", "blocks")
    family = {"brick": "brick", "planks": "wood", "blocks": "stone"}.get(layer, pick(rng, "leaf", "moss"))
    spot.box(
        0,
        0,
        0,
        (rng.uniform(0.2, 1.0), rng.uniform(0.6, 2.2), length),
        surface_look(rng, layer, family, macro=0.4),
    )


def _trees(b: Builder, s: int, low: float, high: float, z: float, length: float, count: int) -> None:
    rng = b.rng
    for _ in range(count):
        spot = Spot(b, s * rng.uniform(low, high), z + rng.uniform(0, length))
        tree(spot, rng.uniform(4, 12), int(rng.integers(9, 18)) if spot.z < 45 else 5)


def _town_side(b: Builder, s: int, plan: _Plan) -> None:
    """Rows of blocks with gaps for gardens."""
    rng = b.rng
    z = rng.uniform(-14, -4)
    built = rng.choice([0.95, 0.6])
    terrace = rng.random() < 0.5
    setback = rng.choice([0.0, rng.uniform(2, 7)])
    storeys = rng.uniform(2, 6)
    while z < plan.end:
        length = rng.uniform(7, 20)
        middle = z + length / 2
        if rng.random() < built:
            h = 3.0 * max(1, round(storeys + rng.normal(0, 0.8))) + rng.uniform(0.2, 1.2)
            w, jump = rng.uniform(8, 12), 0 if terrace else rng.uniform(0, 1.5)
            size = (w, h, length - (0.02 if terrace else rng.uniform(0, 3)))
            building(b, s * (plan.edge + setback + jump + w / 2), middle, size, 0.0, 0.0, -s)
            if setback > 2 and rng.random() < 0.7:
                _fence(Spot(b, s * (plan.edge + 0.6), middle), length * rng.uniform(0.6, 0.95))
        else:
            _trees(b, s, plan.edge + 1, plan.edge + 14, z, length, int(rng.integers(1, 4)))
            if rng.random() < 0.5:
                _fence(Spot(b, s * (plan.edge + rng.uniform(0.6, 2)), middle), length)
        z += length


def _suburb_side(b: Builder, s: int, plan: _Plan) -> None:
    """Detached houses in gardens."""
    rng = b.rng
    z = rng.uniform(-8, 0)
    while z < plan.end:
        length = rng.uniform(14, 24)
        back = plan.edge + rng.uniform(7, 14)
        if rng.random() < 0.85:
            house(Spot(b, s * back, z + length / 2, s * np.pi / 2 + rng.normal(0, 0.08)))
        _trees(b, s, plan.edge + 1, back + 6, z, length, int(rng.integers(1, 4)))
        for _ in range(int(rng.integers(0, 4))):
            bush(
                Spot(b, s * (plan.edge + rng.uniform(0.5, 5)), z + rng.uniform(0, length)),
                rng.uniform(0.5, 1.8),
            )
        if rng.random() < 0.65:
            _fence(
                Spot(b, s * (plan.edge + rng.uniform(0.4, 0.9)), z + length / 2),
                length * rng.uniform(0.5, 0.95),
            )
        z += length


def _country_side(b: Builder, s: int, plan: _Plan) -> None:
    """Meadows, bushes, woods' edges and a few far buildings."""
    rng = b.rng
    for _ in range(int(rng.integers(0, 10))):
        bush(Spot(b, s * (plan.edge + rng.exponential(4) + 0.8), rng.uniform(2, 50)), rng.uniform(0.4, 2.0))
    _trees(b, s, plan.edge + 1.5, plan.edge + 25, 4, plan.end, int(rng.integers(0, 7)))
    if rng.random() < 0.6:  # a bank or a wood beside the road
        away, long_ = plan.edge + rng.uniform(2.5, 20), rng.uniform(15, 60)
        tree_line(
            Spot(b, s * away, rng.uniform(5, 20) + long_ / 2, np.pi / 2),
            long_,
            rng.uniform(3, 10),
            int(long_ / 3.5),
        )
    if rng.random() < 0.5:
        half = (rng.uniform(8, 25), rng.uniform(0.5, 2.5), rng.uniform(15, 50))
        grass = surface_look(rng, "grass", pick(rng, "leaf", "dry", "moss"), macro=0.7)
        b.ball((s * (plan.edge + half[0] + 0.5), 0.05, rng.uniform(10, 60)), half, grass, fixed=True)
    for _ in range(int(rng.integers(0, 3))):
        x, z = s * (plan.edge + rng.uniform(15, 50)), rng.uniform(30, 110)
        building(
            b,
            x,
            z,
            (rng.uniform(8, 25), rng.uniform(3.5, 9), rng.uniform(8, 20)),
            0.0,
            rng.normal(0, 0.3),
            -s,
        )
    tree_line(Spot(b, s * 35, plan.end + rng.uniform(0, 30), rng.normal(0, 0.2)), 70, rng.uniform(4, 12), 14)


def _furnish(b: Builder, s: int, plan: _Plan) -> None:
    """Lamp posts or trees in a row, signs and people on one pavement."""
    rng = b.rng
    row, step, first = rng.random(), rng.uniform(9, 22), rng.uniform(2, 8)
    inner = plan.half_road + 0.7
    for k in range(6):
        spot = Spot(b, s * inner, first + k * step, 0.0 if s < 0 else np.pi, -plan.kerb)
        if row < 0.3:
            tree(spot, rng.uniform(4, 8), 11 if k < 3 else 5)
        elif row < 0.7:
            pole(spot, rng.uniform(5, 8), rng.uniform(0.8, 2.0))
    if 0.7 < row < 0.82:
        wires(Spot(b, s * inner, 0.0), 120, rng.uniform(6, 8), int(rng.integers(1, 4)))
    wide = max(plan.walk, 0.8)
    for _ in range(int(rng.integers(0, 4))):
        spot = Spot(b, s * (plan.half_road + 0.3 + rng.uniform(0, wide)), rng.uniform(4, 30), 0, -plan.kerb)
        pole(spot, rng.uniform(2.0, 3.2), sign=True)
    for _ in range(int(rng.integers(0, 3))):
        spot = Spot(
            b,
            s * (plan.half_road + 0.4 + rng.uniform(0, wide)),
            rng.uniform(4, 30),
            rng.uniform(-3, 3),
            -plan.kerb,
        )
        person(spot)


def _cars(b: Builder, plan: _Plan, parked: float) -> None:
    rng = b.rng
    for s in (-1, 1):
        if rng.random() < parked:
            z, gap = rng.uniform(2, 14), rng.uniform(5.2, 9)
            for _ in range(int(rng.integers(1, 9))):
                heading = rng.normal(0, 0.03) + (np.pi if s < 0 else 0)
                car(Spot(b, s * (plan.half_road - 1.0), z, heading))
                z += gap + rng.exponential(1.5)
    for _ in range(int(rng.integers(0, 3))):
        s = pick(rng, -1, 1)
        car(Spot(b, s * plan.half_road * 0.45, rng.uniform(7, 45), 0.0 if s > 0 else np.pi))


def _close_view(b: Builder, plan: _Plan) -> None:
    """The street bends or ends: houses or trees beyond."""
    rng = b.rng
    if rng.random() < 0.4:
        size = (rng.uniform(14, 40), rng.uniform(6, 16), 10)
        building(b, rng.normal(0, 6), plan.end + 8, size, 0.0)
    else:
        tree_line(
            Spot(b, rng.normal(0, 6), plan.end + rng.uniform(3, 20)),
            rng.uniform(25, 70),
            rng.uniform(5, 13),
            12,
        )


def street(rng: np.random.Generator, seed: int) -> Scene:
    """Draw a street."""
    b = Builder(rng)
    style = str(rng.choice(["town", "suburb", "country"], p=[0.42, 0.36, 0.22]))
    walk = 0.0 if style == "country" and rng.random() < 0.7 else rng.uniform(1.2, 3.5)
    half_road = rng.uniform(1.4, 3.6) if style == "country" else rng.uniform(2.8, 5.5)
    plan = _Plan(half_road, walk, rng.uniform(0.06, 0.15) if walk else 0.0, rng.uniform(45, 120))
    _ground(b, plan, {"town": 0.7, "suburb": 0.4, "country": 0.35}[style])
    side = {"town": _town_side, "suburb": _suburb_side, "country": _country_side}
    for s in (-1, 1):
        mixed = style if rng.random() < 0.8 else pick(rng, *side)
        side[mixed](b, s, plan)
        _furnish(b, s, plan)
    if rng.random() < 0.6:
        _close_view(b, plan)
    _cars(b, plan, {"town": 0.65, "suburb": 0.6, "country": 0.1}[style])
    if rng.random() < 0.15:  # overhanging foliage near the camera
        spot = Spot(b, pick(rng, -1, 1) * (plan.half_road + 0.5), rng.uniform(3, 8))
        b.ball((spot.x, -rng.uniform(2.5, 4), spot.z), rng.uniform(0.8, 2.0, 3), leaf_look(rng))
    on_walk = walk > 0 and rng.random() < 0.2
    tall = rng.uniform(1.4, 2.0) + (plan.kerb if on_walk else 0)
    if on_walk:
        x = float(rng.choice([-1, 1])) * (half_road + walk * 0.6)
        yaw = -np.sign(x) * rng.uniform(0, 0.5)
    else:
        x = rng.uniform(-0.1, 0.5) * half_road
        yaw = rng.normal(0, 0.07) + (rng.random() < 0.15) * rng.normal(0, 0.4)
    rest = daylight(b, "street", seed, rng.uniform(55, 88), (0.54, 0.54))
    pose = camera_pose(x, -tall, 0.0, yaw, np.radians(rng.normal(0.5, 2.0)), np.radians(rng.normal(0, 0.8)))
    return b.finish(pose, 0.9, **rest)
