"""Streets: a road with markings and kerbs, facades, parked and driving cars, poles, trees, hedges, people.

Hop: draws -> ``Scene`` of kind "street".
Paper: none.
"""

from __future__ import annotations

import numpy as np

from geodiff_plugin.synthetic.builder import Builder, Look
from geodiff_plugin.synthetic.layouts.outdoor import building, daylight
from geodiff_plugin.synthetic.layouts.palettes import palette, pick, surface_look
from geodiff_plugin.synthetic.layouts.parts import Spot, camera_pose
from geodiff_plugin.synthetic.patterns import TILE_M
from geodiff_plugin.synthetic.scene import Scene

__all__ = ["street"]


def _ground(b: Builder, half_road: float, walk: float, kerb: float) -> None:
    rng = b.rng
    verge = surface_look(rng, pick(rng, "grass", "grass", "soil", "paving"), pick(rng, "leaf", "dry", "stone"), macro=0.5)
    b.quad((0, 0.02, 150), 300, 300, verge, fixed=True)
    pal = palette(rng, "asphalt")
    pal[2] = palette(rng, "white")[0]
    if rng.random() < 0.7:
        road = Look("road", pal, (half_road * 2, rng.uniform(9, 14)), macro=0.35, origin=(0.5, rng.random()))
    else:
        road = Look(pick(rng, "asphalt", "asphalt", "cobbles"), pal, (TILE_M["asphalt"],) * 2, macro=0.5)
    b.quad((0, 0, 150), half_road, 250, road, fixed=True)
    pave = surface_look(rng, pick(rng, "paving", "flagstones", "concrete", "tiles"), pick(rng, "stone", "grey"), macro=0.3)
    stone = surface_look(rng, "concrete", "stone")
    for s in (-1, 1):
        b.box((s * (half_road + 0.09), -kerb / 2 + 0.05, 150), (0.18, kerb + 0.1, 500), stone, fixed=True)
        b.box((s * (half_road + 0.18 + walk / 2), -kerb / 2 + 0.05, 150), (walk, kerb + 0.09, 500), pave, fixed=True)


def _side(b: Builder, s: int, edge: float, walk: float, kerb: float, end: float) -> None:
    """One side of the street: houses, hedges, fences, gardens with trees."""
    rng = b.rng
    z = rng.uniform(-14, -4)
    built = rng.choice([0.95, 0.6, 0.15], p=[0.5, 0.3, 0.2])
    terrace = rng.random() < 0.5
    setback = rng.choice([0.0, rng.uniform(2, 7)])
    storeys = rng.uniform(2, 6)
    while z < end:
        length = rng.uniform(7, 20)
        if rng.random() < built:
            h = 3.0 * max(1, round(storeys + rng.normal(0, 0.8))) + rng.uniform(0.2, 1.2)
            w = rng.uniform(8, 12)
            x = s * (edge + setback + (0 if terrace else rng.uniform(0, 1.5)) + w / 2)
            building(b, x, z + length / 2, (w, h, length - (0.02 if terrace else rng.uniform(0, 3))), 0.0, 0.0, -s)
            if setback > 2 and rng.random() < 0.7:
                hedge = surface_look(rng, pick(rng, "hedge", "leaves", "brick", "planks"), pick(rng, "leaf", "leaf", "brick", "wood"))
                b.standing(s * (edge + 0.4), z + length / 2, 0.0, (0.5, rng.uniform(0.6, 1.8), length * rng.uniform(0.6, 0.95)), hedge)
        else:
            for _ in range(int(rng.integers(1, 4))):
                spot = Spot(b, s * (edge + rng.uniform(1, 14)), z + rng.uniform(0, length))
                near = spot.z < 45
                spot.tree(rng.uniform(4, 11), int(rng.integers(6, 12)) if near else 4)
            if rng.random() < 0.5:
                hedge = surface_look(rng, pick(rng, "hedge", "leaves", "blocks", "planks"), pick(rng, "leaf", "leaf", "stone", "wood"))
                b.standing(s * (edge + rng.uniform(0.3, 2)), z + length / 2, 0.0, (rng.uniform(0.2, 1.2), rng.uniform(0.6, 2.4), length), hedge)
        z += length
    row = rng.random()
    step = rng.uniform(9, 22)
    for k in range(6):  # trees or lamp posts in a row on the pavement
        spot = Spot(b, s * (edge - walk + 0.5), rng.uniform(2, 8) + k * step, 0.0 if s < 0 else np.pi, -kerb)
        if row < 0.35:
            spot.tree(rng.uniform(4, 7), 7 if k < 3 else 3)
        elif row < 0.75:
            spot.pole(rng.uniform(5, 8), rng.uniform(0.8, 2.0))
    for _ in range(int(rng.integers(0, 4))):
        Spot(b, s * (edge - walk + rng.uniform(0.3, max(0.4, walk - 0.3))), rng.uniform(4, 30), 0, -kerb).pole(rng.uniform(2.0, 3.2), sign=True)
    for _ in range(int(rng.integers(0, 3))):
        Spot(b, s * (edge - rng.uniform(0.4, max(0.5, walk - 0.2))), rng.uniform(4, 30), rng.uniform(-3, 3), -kerb).person()


def street(rng: np.random.Generator, seed: int) -> Scene:
    """Draw a street."""
    b = Builder(rng)
    half_road, walk, kerb = rng.uniform(2.8, 5.5), rng.uniform(1.2, 3.5), rng.uniform(0.06, 0.15)
    end = rng.uniform(45, 120)
    _ground(b, half_road, walk, kerb)
    for s in (-1, 1):
        _side(b, s, half_road + 0.18 + walk, walk, kerb, end)
    if rng.random() < 0.6:  # the street bends or ends: houses or trees close the view
        if rng.random() < 0.5:
            building(b, rng.normal(0, 6), end + 8, (rng.uniform(14, 40), rng.uniform(6, 16), 10), 0.0)
        else:
            for _ in range(7):
                Spot(b, rng.normal(0, 14), end + rng.uniform(2, 20)).tree(rng.uniform(6, 12), 4)
    lane = half_road / 2
    for s in (-1, 1):
        if rng.random() < 0.65:
            z = rng.uniform(3, 14)
            for _ in range(int(rng.integers(1, 6))):
                Spot(b, s * (half_road - 1.05), z, rng.normal(0, 0.03) + (np.pi if s < 0 else 0)).car()
                z += rng.uniform(5.2, 12)
    for _ in range(int(rng.integers(0, 3))):
        s = pick(rng, -1, 1)
        Spot(b, s * lane * 0.9, rng.uniform(7, 45), 0.0 if s > 0 else np.pi).car()
    tall = rng.uniform(1.4, 2.0)
    on_walk = rng.random() < 0.2
    x = rng.choice([-1, 1]) * (half_road + walk * 0.6) if on_walk else rng.uniform(-0.2, 0.8) * lane * 1.2
    yaw = -np.sign(x) * rng.uniform(0, 0.5) if on_walk else rng.normal(0, 0.07) + (rng.random() < 0.15) * rng.normal(0, 0.4)
    rest = daylight(b, "street", seed, rng.uniform(55, 88), (0.54, 0.54))
    pose = camera_pose(x, -tall - (kerb if on_walk else 0), 0.0, yaw, np.radians(rng.normal(0.5, 2.0)), np.radians(rng.normal(0, 0.8)))
    return b.finish(pose, 0.9, **rest)
