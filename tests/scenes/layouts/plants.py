"""Vegetation and stones: pot plants, trees, tree lines, bushes, hedges, boulders.

Data flow: a place and a size -> primitives in a ``Builder``.
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Look
from tests.scenes.layouts.palettes import object_look, pick, surface_look
from tests.scenes.layouts.spot import Spot
from tests.scenes.scene import Shape

__all__ = ["bush", "leaf_look", "pot_plant", "rock", "thicket", "tree", "tree_line"]


def leaf_look(rng: np.random.Generator, scale: tuple[float, float] = (0.8, 1.6)) -> Look:
    """Foliage, green or dry."""
    family = pick(rng, "leaf", "leaf", "leaf", "moss", "moss", "moss", "dry")
    return surface_look(rng, pick(rng, "leaves", "hedge"), family, scale, macro=0.5)


def pot_plant(spot: Spot, height: float) -> None:
    """Pot with leaves."""
    rng = spot.rng
    r = height * 0.16
    spot.column(0, 0, 0, r, height * 0.3, object_look(rng, 0.3, 0), top=1.25)
    leaf = surface_look(rng, "leaves", pick(rng, "leaf", "moss"), (0.2, 0.5))
    long_leaves = rng.random() < 0.4
    for _ in range(int(rng.integers(5, 14))):
        a = rng.uniform(-np.pi, np.pi)
        at = (np.cos(a) * r * 0.9, np.sin(a) * r * 0.9, height * rng.uniform(0.4, 0.95))
        if long_leaves:
            half = height * np.array([0.03, rng.uniform(0.12, 0.25), 0.01])
            spot.moved(*at[:2], a).ball(
                0, 0, at[2], half, leaf, pitch=rng.normal(0, 0.6), roll=rng.normal(0, 0.6)
            )
        else:
            spot.ball(*at, height * rng.uniform(0.05, 0.18, 3), leaf)


def tree(spot: Spot, height: float, blobs: int) -> None:
    """Trunk and a crown of ``blobs`` ellipsoids of different sizes, or a conifer."""
    rng = spot.rng
    bark = surface_look(rng, pick(rng, "soil", "rock"), "soil", (0.3, 0.5))
    leaf = leaf_look(rng)
    trunk = height * 0.02 + 0.05
    if rng.random() < 0.15:
        spot.column(0, 0, 0, trunk, height * 0.4, bark, top=0.6)
        tiers = 3 if blobs < 6 else 5
        for k in range(tiers):
            part = k / tiers
            r = height * (0.24 - 0.17 * part)
            spot.column(0, 0, height * (0.12 + 0.8 * part), r, height * 1.25 / tiers, leaf, top=0.05)
        return
    low = rng.uniform(0.2, 0.42)
    wide = rng.uniform(0.7, 1.25)
    spot.column(0, 0, 0, trunk, height * (low + 0.35), bark, top=0.55)
    for k in range(blobs):
        a, part = k * 2.4 + rng.normal(0, 0.4), np.sqrt((k + 0.5) / blobs)
        up = low + (1 - low) * rng.uniform(0.1, 0.92)
        # Narrow at the bottom and at the top, wide in the middle.
        d = (
            height
            * 0.24
            * wide
            * part
            * np.sqrt(max(0.05, 1 - (2 * (up - low) / (1 - low) - 0.9) ** 2 * 0.8))
        )
        size = height * rng.uniform(0.07, 0.19) * (6 / (blobs + 2)) ** 0.25
        half = size * np.array([wide, rng.uniform(0.55, 1.0), wide])
        spot.ball(
            np.cos(a) * d,
            np.sin(a) * d,
            height * up,
            half,
            leaf,
            pitch=rng.normal(0, 0.3),
            roll=rng.normal(0, 0.3),
        )


def tree_line(spot: Spot, width: float, height: float, count: int) -> None:
    """A dense row of crowns along local x that reach to the ground, as a wood's edge or a hedge row."""
    rng = spot.rng
    looks = [leaf_look(rng) for _ in range(2)]
    for k in range(count):
        lx = ((k + rng.uniform(0.1, 0.9)) / count - 0.5) * width
        h = height * rng.uniform(0.5, 1.0)
        half = (width / count * rng.uniform(0.6, 1.2), h * rng.uniform(0.4, 0.55), rng.uniform(1.0, 3.0))
        spot.ball(lx, rng.normal(0, 1.0), h - half[1], half, looks[k % 2], roll=rng.normal(0, 0.15))
        if rng.random() < 0.6:
            top = np.asarray(half) * rng.uniform(0.35, 0.6)
            spot.ball(lx + rng.normal(0, 0.5), 0, h - top[1] * 0.4, top, looks[k % 2])


def thicket(spot: Spot, length: float, height: float, depth: float) -> None:
    """A ragged wall of leaves along local z, lit tops over dark gaps, with stems in front here and there."""
    rng = spot.rng
    looks = [leaf_look(rng) for _ in range(3)]
    bark = surface_look(rng, "rock", "soil", (0.3, 0.5))
    count = int(min(12 + 2 * length, 64))
    for k in range(count):
        lz = ((k + rng.random()) / count - 0.5) * length
        up = height * rng.random() ** 0.7
        half = rng.uniform(0.2, 0.75, 3) * (0.4 + 0.25 * height)
        turn = dict(pitch=rng.normal(0, 0.5), roll=rng.normal(0, 0.5))
        spot.ball(rng.uniform(-0.5, 0.5) * depth, lz, up, half, looks[int(rng.integers(3))], **turn)
    for _ in range(int(rng.integers(0, 6))):
        radius, lz = rng.uniform(0.04, 0.2), rng.uniform(-0.5, 0.5) * length
        spot.column(rng.uniform(-0.7, 0.7) * depth, lz, 0, radius, height, bark, top=0.6)


def bush(spot: Spot, size: float) -> None:
    """Low round foliage."""
    rng = spot.rng
    look = leaf_look(rng, (0.4, 1.0))
    for _ in range(int(rng.integers(3, 8))):
        half = size * rng.uniform(0.25, 0.6, 3)
        spot.ball(*rng.normal(0, 0.35 * size, 2), half[1] * rng.uniform(0.3, 0.9), half, look)


def rock(spot: Spot, size: float) -> None:
    """Boulder: an ellipsoid or a tilted block, partly in the ground."""
    rng = spot.rng
    layer, family = pick(rng, "rock", "concrete", "fbm"), pick(rng, "stone", "grey")
    look = surface_look(rng, layer, family, (0.4, 1.0), macro=0.6)
    half = size * rng.uniform(0.35, 0.6, 3)
    turn = dict(pitch=rng.normal(0, 0.3), roll=rng.normal(0, 0.3))
    if rng.random() < 0.6:
        spot.ball(0, 0, half[1] * 0.4, half, look, **turn)
    else:
        centre = (spot.x, spot.ground - half[1] * 0.5, spot.z)
        taper = tuple(rng.uniform(0.1, 0.6, 2))
        spot.b.add(Shape.TAPER, centre, half, look, yaw=spot.yaw, taper=taper, **turn)
