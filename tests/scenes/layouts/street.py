"""Streets in towns, suburbs and the country: road and kerbs, facades, gardens, cars, poles, trees, people.

Data flow: draws -> ``Scene`` of kind "street".
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Builder, Look
from tests.scenes.layouts.ground import crossing, drives, parcels, repairs
from tests.scenes.layouts.outdoor import building, daylight
from tests.scenes.layouts.palettes import palette, pick, surface_look
from tests.scenes.layouts.plants import leaf_look, thicket, tree, tree_line
from tests.scenes.layouts.roadside import Plan, country_side, suburb_side, town_side
from tests.scenes.layouts.spot import Spot, camera_pose
from tests.scenes.layouts.traffic import car, person, pole, wires
from tests.scenes.patterns import TILE_M
from tests.scenes.scene import Scene

__all__ = ["street"]


def _ground(b: Builder, plan: Plan, marked: float) -> None:
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


def _furnish(b: Builder, s: int, plan: Plan) -> None:
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


def _cars(b: Builder, plan: Plan, parked: float) -> None:
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


def _close_view(b: Builder, plan: Plan) -> None:
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


def _ground_marks(b: Builder, plan: Plan, style: str) -> None:
    """What changes the ground's colour and nothing else, or every edge on the ground would be a step."""
    rng = b.rng
    if rng.random() < 0.5:
        repairs(b, plan.half_road, 0.0, int(rng.integers(1, 6)))
    if rng.random() < 0.15:
        crossing(b, plan.half_road, 0.0)
    for s in (-1, 1):
        if rng.random() < 0.6:
            parcels(b, s, plan.edge, 0.0, int(rng.integers(1, 5)))
        if style != "town" and rng.random() < 0.5:
            drives(b, s, plan.edge, -0.02, int(rng.integers(1, 4)))


def _green_walls(b: Builder, plan: Plan, chance: float) -> None:
    """Hedges gone wild and the edges of woods, close to the road."""
    rng = b.rng
    for s in (-1, 1):
        if rng.random() < chance:
            z = rng.uniform(-2, 12)
            for _ in range(int(rng.integers(1, 4))):
                length, deep = rng.uniform(5, 30), rng.uniform(0.8, 3)
                x = s * (plan.edge + 0.4 + deep / 2 + rng.exponential(1.5))
                thicket(Spot(b, x, z + length / 2), length, rng.uniform(1, 7), deep)
                z += length + rng.exponential(6)


def _parking(b: Builder, plan: Plan) -> None:
    """Cars side by side in bays at a right angle to the road."""
    rng = b.rng
    s, z, pitch = pick(rng, -1, 1), rng.uniform(4, 12), rng.uniform(2.5, 3.0)
    turn = s * np.pi / 2 + pick(rng, 0, np.pi)
    for _ in range(int(rng.integers(2, 9))):
        car(Spot(b, s * (plan.edge + 2.6), z, turn + rng.normal(0, 0.04)))
        z += pitch * pick(rng, 1, 1, 1, 2)


def street(rng: np.random.Generator, seed: int) -> Scene:
    """Draw a street."""
    b = Builder(rng)
    style = str(rng.choice(["town", "suburb", "country"], p=[0.42, 0.36, 0.22]))
    walk = 0.0 if style == "country" and rng.random() < 0.7 else rng.uniform(1.2, 3.5)
    half_road = rng.uniform(1.4, 3.6) if style == "country" else rng.uniform(2.8, 5.5)
    plan = Plan(half_road, walk, rng.uniform(0.06, 0.15) if walk else 0.0, rng.uniform(45, 120))
    _ground(b, plan, {"town": 0.7, "suburb": 0.4, "country": 0.35}[style])
    side = {"town": town_side, "suburb": suburb_side, "country": country_side}
    for s in (-1, 1):
        mixed = style if rng.random() < 0.8 else pick(rng, *side)
        side[mixed](b, s, plan)
        _furnish(b, s, plan)
    if rng.random() < 0.6:
        _close_view(b, plan)
    _cars(b, plan, {"town": 0.65, "suburb": 0.6, "country": 0.1}[style])
    _ground_marks(b, plan, style)
    _green_walls(b, plan, {"town": 0.12, "suburb": 0.3, "country": 0.5}[style])
    if style != "country" and rng.random() < 0.15:
        _parking(b, plan)
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
