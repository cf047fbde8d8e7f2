"""Seats: chairs, slatted garden chairs, benches, sofas.

Data flow: a place and a size -> primitives in a ``Builder``.
"""

from __future__ import annotations

from tests.scenes.builder import Look
from tests.scenes.layouts.palettes import object_look, pick, surface_look
from tests.scenes.layouts.spot import Spot

__all__ = ["bench", "chair", "lounger", "sofa"]


def chair(spot: Spot) -> None:
    """Chair facing local -z: with four legs, on castors, or a wooden one with a slatted back."""
    rng = spot.rng
    seat = surface_look(
        rng, pick(rng, "fabric", "wood", "plain", "stripes"), pick(rng, "any", "dark", "wood", "vivid")
    )
    leg = surface_look(rng, "plain", pick(rng, "grey", "dark", "wood"), gloss=0.3)
    kind = rng.random()
    if kind < 0.35:
        spot.box(0, 0, 0.42, (0.44, 0.06, 0.44), seat)
        spot.box(0, 0.2, 0.48, (0.42, 0.45, 0.05), seat, pitch=-0.12)
        _legs(spot, 0.19, 0.42, leg)
    elif kind < 0.65:
        spot.ball(0, 0, 0.45, (0.25, 0.06, 0.25), seat)
        spot.ball(0, 0.22, 0.78, (0.22, 0.3, 0.05), seat)
        spot.column(0, 0, 0.08, 0.03, 0.35, leg)
        for k in range(5):
            spot.moved(0, 0, k * 1.2566).box(0, 0.15, 0.03, (0.04, 0.05, 0.3), leg)
    else:
        wood = surface_look(rng, "wood", pick(rng, "wood", "wood", "dark", "white"))
        spot.box(0, 0, 0.42, (0.44, 0.035, 0.42), wood if rng.random() < 0.6 else seat)
        _legs(spot, 0.2, 0.42, wood)
        for s in (-1, 1):
            spot.box(s * 0.2, 0.2, 0.42, (0.045, 0.5, 0.04), wood)
        count = int(rng.integers(2, 5))
        for k in range(count):
            spot.box(
                0, 0.2, 0.55 + 0.34 * k / max(1, count - 1), (0.38, rng.uniform(0.04, 0.08), 0.025), wood
            )


def _legs(spot: Spot, spread: float, height: float, look: Look) -> None:
    for sx in (-spread, spread):
        for sz in (-spread, spread):
            spot.box(sx, sz, 0, (0.035, height, 0.035), look)


def lounger(spot: Spot) -> None:
    """Garden chair of slats: a sloping seat, a fanned back and wide arms."""
    rng = spot.rng
    wood = surface_look(rng, pick(rng, "wood", "plain"), pick(rng, "wood", "painted", "white", "any"))
    count = int(rng.integers(5, 8))
    for k in range(count):
        lx = (k - (count - 1) / 2) * 0.52 / count
        spot.box(lx, -0.05, 0.28, (0.46 / count, 0.02, 0.52), wood, pitch=0.2)
        tall = 0.85 - 0.25 * abs(k - (count - 1) / 2) / count
        spot.box(lx, 0.33, 0.2, (0.46 / count, tall, 0.02), wood, pitch=-0.45)
    for s in (-1, 1):
        spot.box(s * 0.34, 0, 0.56, (0.13, 0.025, 0.7), wood)
        spot.box(s * 0.3, -0.3, 0, (0.08, 0.56, 0.03), wood)
        spot.box(s * 0.3, 0.28, 0, (0.08, 0.56, 0.03), wood)


def bench(spot: Spot, width: float) -> None:
    """Bench of slats, facing local -z."""
    wood = surface_look(
        spot.rng, pick(spot.rng, "wood", "plain"), pick(spot.rng, "wood", "grey", "painted", "white")
    )
    for k in range(4):
        spot.box(0, -0.15 + 0.1 * k, 0.43, (width, 0.025, 0.08), wood)
        spot.box(0, 0.22, 0.52 + 0.1 * k, (width, 0.075, 0.025), wood)
    for s in (-1, 1):
        spot.box(s * (width / 2 - 0.15), 0, 0, (0.06, 0.43, 0.4), wood)
        spot.box(s * (width / 2 - 0.15), 0.23, 0, (0.06, 0.9, 0.04), wood)


def sofa(spot: Spot, width: float) -> None:
    """Sofa or arm chair facing local -z."""
    rng = spot.rng
    family = pick(rng, "any", "grey", "dark", "painted", "wall")
    look = surface_look(rng, pick(rng, "fabric", "plain", "stripes"), family)
    spot.box(0, 0, 0.08, (width, 0.34, 0.85), look)
    spot.box(0, 0.33, 0.3, (width, 0.5, 0.2), look)
    for sx in (-1, 1):
        spot.box(sx * (width / 2 - 0.09), 0, 0.1, (0.18, 0.5, 0.85), look)
    for _ in range(int(rng.integers(0, 4))):
        place = rng.uniform(-0.35, 0.35) * width, 0.15, 0.58
        spot.ball(*place, (0.22, 0.2, 0.08), object_look(rng, 0.4, 0), pitch=-0.4)
