"""Small objects: boxes, books, papers, cups, bottles, leaflets, cloth.

Data flow: a place and a size -> primitives in a ``Builder``.
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Look
from tests.scenes.layouts.palettes import object_look, palette, pick, surface_look
from tests.scenes.layouts.spot import Spot

__all__ = ["cloth", "leaflet", "magazine", "thing"]


def thing(spot: Spot, lx: float, lz: float, bottom: float, size: float) -> None:
    """One small object of about a size, at rest at a height."""
    rng = spot.rng
    place = spot.moved(lx, lz, rng.uniform(-np.pi, np.pi), bottom)
    weights = (0.27, 0.14, 0.2, 0.1, 0.05, 0.07, 0.07, 0.05, 0.05)
    makers = (_boxes, _stack, _bottle, _ball, _cone, _tilted, _upright, _cup, _basket)
    makers[int(rng.choice(len(makers), p=weights))](place, size)


def _boxes(spot: Spot, size: float) -> None:
    rng = spot.rng
    dims = size * rng.uniform(0.35, 1.0, 3)
    spot.box(0, 0, 0, dims, object_look(rng, size))
    if rng.random() < 0.35:
        smaller = dims * rng.uniform(0.5, 0.9)
        spot.box(0, 0, dims[1], smaller, object_look(rng, size), turn=rng.normal(0, 0.3))


def _stack(spot: Spot, size: float) -> None:
    """Books and sheets of paper."""
    rng = spot.rng
    up = 0.0
    for _ in range(int(rng.integers(1, 5))):
        page = rng.random() < 0.35
        thick = 0.003 if page else rng.uniform(0.008, 0.045)
        if page:
            cover = Look(pick(rng, "document", "page"), palette(rng, "white"), (0.22, 0.3), origin=(0.5, 0.5))
        else:
            cover = object_look(rng, 0.25, 0)
        spot.box(*rng.normal(0, 0.01, 2), up, (0.2, thick, 0.28), cover, turn=rng.normal(0, 0.12))
        up += thick


def _bottle(spot: Spot, size: float) -> None:
    rng = spot.rng
    look = object_look(rng, size)
    r, h = size * rng.uniform(0.2, 0.4), size * rng.uniform(0.6, 1.3)
    spot.column(0, 0, 0, r, h, look, top=rng.uniform(0.75, 1.0))
    if rng.random() < 0.35:
        spot.column(0, 0, h, r * 0.75, h * 0.35, look, top=0.4)
        spot.column(0, 0, h * 1.35, r * 0.3, h * 0.2, look)


def _cup(spot: Spot, size: float) -> None:
    rng = spot.rng
    look = object_look(rng, 0.1, 0)
    spot.column(0, 0, 0, 0.04, 0.095, look, top=1.08)
    spot.column(0, 0, 0.0951, 0.035, 0.001, surface_look(rng, "plain", "dark"))
    for up in (0.02, 0.07):
        spot.box(0.055, 0, up, (0.035, 0.012, 0.012), look)
    spot.box(0.07, 0, 0.02, (0.012, 0.06, 0.012), look)


def _ball(spot: Spot, size: float) -> None:
    rng = spot.rng
    half = size * rng.uniform(0.25, 0.5) * np.array([1, rng.uniform(0.6, 1.3), rng.uniform(0.7, 1.2)])
    spot.ball(0, 0, half[1], half, object_look(rng, size))


def _cone(spot: Spot, size: float) -> None:
    spot.column(0, 0, 0, size * 0.4, size, object_look(spot.rng, size), top=spot.rng.uniform(0, 0.4))


def _tilted(spot: Spot, size: float) -> None:
    """A box at a random orientation, leaning on something unseen."""
    rng = spot.rng
    dims = size * rng.uniform(0.25, 1.0, 3)
    turn = dict(pitch=rng.uniform(-1.2, 1.2), roll=rng.uniform(-0.6, 0.6))
    spot.box(0, 0, 0.42 * size - dims[1] / 2, dims, object_look(rng, size), **turn)


def _upright(spot: Spot, size: float) -> None:
    leaflet(spot, size * spot.rng.uniform(0.8, 1.2))


def _basket(spot: Spot, size: float) -> None:
    """A bowl or crate with balls in it."""
    rng = spot.rng
    look = surface_look(
        rng, pick(rng, "fabric", "wood", "plain"), pick(rng, "wood", "vivid", "dark", "white")
    )
    if rng.random() < 0.5:
        spot.column(0, 0, 0, size * 0.4, size * 0.35, look, top=1.35)
    else:
        spot.box(0, 0, 0, (size, size * 0.35, size * 0.7), look)
    fruit = object_look(rng, 0.1, 0)
    for _ in range(int(rng.integers(3, 7))):
        a, d = rng.uniform(-np.pi, np.pi), size * rng.uniform(0, 0.28)
        spot.ball(np.cos(a) * d, np.sin(a) * d, size * 0.36, size * rng.uniform(0.1, 0.2, 3), fruit)


def leaflet(spot: Spot, height: float) -> None:
    """A printed card that stands, leaning back a little, facing local -z."""
    rng = spot.rng
    width = height * rng.uniform(0.6, 0.85)
    layer = pick(rng, "poster_a", "poster_b", "poster_c", "label_a", "document")
    family = "white" if layer == "document" else pick(rng, "any", "vivid", "white", "painted")
    face = Look(layer, palette(rng, family), (width, height), origin=(0.5, 0.5), macro=0)
    spot.box(0, 0, 0, (width, height, 0.004), face, pitch=rng.uniform(-0.05, 0.25))


def magazine(spot: Spot) -> None:
    """A printed sheet or magazine lying flat."""
    rng = spot.rng
    layer = pick(rng, "poster_a", "poster_b", "poster_c", "document", "page")
    family = "white" if layer in ("document", "page") else pick(rng, "any", "vivid", "white")
    face = Look(layer, palette(rng, family), (0.21, 0.29), origin=(0.5, 0.5), macro=0, gloss=0.1)
    spot.box(0, 0, 0, (0.21, rng.uniform(0.002, 0.008), 0.29), face)


def cloth(spot: Spot, size: float) -> None:
    """Crumpled fabric: overlapping flat ellipsoids at random orientations."""
    rng = spot.rng
    look = surface_look(
        rng, pick(rng, "fabric", "plain", "stripes", "dots"), pick(rng, "any", "vivid", "painted")
    )
    for _ in range(int(rng.integers(5, 10))):
        a, d = rng.uniform(-np.pi, np.pi), size * rng.uniform(0, 0.35)
        half = size * rng.uniform(0.12, 0.4, 3) * (1, 0.35, 1)
        spot.ball(
            np.cos(a) * d,
            np.sin(a) * d,
            half[1],
            half,
            look,
            pitch=rng.normal(0, 0.5),
            roll=rng.normal(0, 0.5),
        )
