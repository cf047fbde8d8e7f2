"""The sides of a street: rows of blocks, houses in gardens, or open country.

Data flow: a cross-section and a side -> primitives in a ``Builder``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tests.scenes.builder import Builder
from tests.scenes.layouts.outdoor import building, house
from tests.scenes.layouts.palettes import pick, surface_look
from tests.scenes.layouts.plants import bush, tree, tree_line
from tests.scenes.layouts.spot import Spot

__all__ = ["Plan", "country_side", "suburb_side", "town_side"]


@dataclass(frozen=True)
class Plan:
    """Cross-section of the street in metres, and how far it goes."""

    half_road: float
    walk: float
    kerb: float
    end: float

    @property
    def edge(self) -> float:
        """From the middle to the far side of the pavement."""
        return self.half_road + 0.18 + self.walk


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


def town_side(b: Builder, s: int, plan: Plan) -> None:
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


def suburb_side(b: Builder, s: int, plan: Plan) -> None:
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


def country_side(b: Builder, s: int, plan: Plan) -> None:
    """Meadows, bushes, woods' edges and a few far buildings."""
    rng = b.rng
    for _ in range(int(rng.integers(0, 10))):
        bush(Spot(b, s * (plan.edge + rng.exponential(4) + 0.8), rng.uniform(2, 50)), rng.uniform(0.4, 2.0))
    _trees(b, s, plan.edge + 1.5, plan.edge + 25, 4, plan.end, int(rng.integers(0, 7)))
    if rng.random() < 0.6:  # a bank or a wood next to the road
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
