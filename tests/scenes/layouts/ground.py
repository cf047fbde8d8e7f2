"""Flat patches on the ground, as fields and drives are: colour that changes, depth that does not.

Data flow: an area -> quads in a ``Builder``.
"""

from __future__ import annotations

import numpy as np

from tests.scenes.builder import Builder, Look
from tests.scenes.layouts.palettes import palette, pick, surface_look

__all__ = ["crossing", "drives", "parcels", "repairs"]

_LIFT_M = 0.004
"""Each patch is higher than the one before by this much, so that rays can distinguish them."""


def _soft(rng: np.random.Generator) -> Look:
    layer = pick(rng, "grass", "grass", "soil", "gravel", "leaves")
    return surface_look(rng, layer, pick(rng, "leaf", "moss", "dry", "soil"), (0.7, 2.0), macro=0.7)


def _hard(rng: np.random.Generator) -> Look:
    layer = pick(rng, "asphalt", "concrete", "paving", "gravel", "cobbles", "flagstones")
    return surface_look(rng, layer, pick(rng, "asphalt", "stone", "grey", "white", "soil"), macro=0.5)


def parcels(b: Builder, s: int, edge: float, ground: float, count: int) -> None:
    """Fields, lawns and yards next to a road that runs along z, on side ``s`` from ``edge`` outwards."""
    rng = b.rng
    for k in range(count):
        half = (rng.uniform(1.5, 25), rng.uniform(2, 40))
        x = s * (edge + rng.exponential(3) + half[0])
        look = _soft(rng) if rng.random() < 0.7 else _hard(rng)
        y = ground - _LIFT_M * (k + 1)
        b.quad((x, y, rng.uniform(2, 70)), *half, look, yaw=rng.normal(0, 0.1), fixed=True)


def drives(b: Builder, s: int, edge: float, ground: float, count: int) -> None:
    """Strips that lead off a road to the side."""
    rng, look = b.rng, _hard(b.rng)
    for k in range(count):
        long_ = rng.uniform(2, 9)
        centre = (s * (edge + long_), ground - _LIFT_M * (k + 1), rng.uniform(3, 40))
        b.quad(centre, long_, rng.uniform(1.2, 3.5), look, yaw=rng.normal(0, 0.08), fixed=True)


def repairs(b: Builder, half_width: float, ground: float, count: int) -> None:
    """Patches of another age, tar, covers and puddles on a road of the given half width."""
    rng = b.rng
    for k in range(count):
        half = (rng.uniform(0.2, 1.2), rng.uniform(0.3, 1.0) * pick(rng, 1, 1, 8))
        x = rng.uniform(-1, 1) * max(half_width - half[0], 0.1)
        layer, family = pick(rng, "asphalt", "concrete", "plain"), pick(rng, "asphalt", "dark", "grey")
        look = surface_look(rng, layer, family)
        b.quad((x, ground - _LIFT_M * (k + 1), 2 + rng.exponential(12)), *half, look, fixed=True)


def crossing(b: Builder, half_width: float, ground: float) -> None:
    """Bars across a road, or one stop line."""
    rng, white = b.rng, Look("plain", palette(b.rng, "white"), macro=0.4)
    z, y = rng.uniform(5, 30), ground - _LIFT_M * 12
    if rng.random() < 0.3:
        b.quad((half_width / 2, y, z), half_width / 2, 0.25, white, fixed=True)
        return
    for x in np.arange(-half_width + 0.5, half_width, 1.0):
        b.quad((x, y, z), 0.25, 1.6, white, fixed=True)
