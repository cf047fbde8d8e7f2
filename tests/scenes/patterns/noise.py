"""Noise families and simple repeats: fractal, cellular, marble, wood, stripes, checkers, cloth.

Data flow: a random generator -> a ``(TEXELS, TEXELS, 4)`` tile that repeats without a seam.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

__all__ = [
    "TEXELS",
    "TILE_X",
    "TILE_Y",
    "Bake",
    "cells",
    "cellular",
    "checker",
    "clouds",
    "dots",
    "fabric",
    "foliage",
    "grid",
    "marble",
    "noise",
    "pack",
    "spectral",
    "stripes",
    "wallpaper",
    "wood",
]

TEXELS = 256
"""Side of a tile in texels."""

TILE_Y, TILE_X = np.mgrid[0:TEXELS, 0:TEXELS] / TEXELS
"""Coordinates over a tile in [0, 1): v down, u to the right."""

Bake = Callable[[np.random.Generator], np.ndarray]
"""Makes one tile; channels tone, accent, gloss, shade."""


def spectral(
    rng: np.random.Generator, beta: float, low: float = 1, high: float = 128, stretch: float = 1.0
) -> np.ndarray:
    """Periodic noise with spectrum ``1 / f**beta`` between two frequencies (cycles a tile), about [0, 1]."""
    fy = np.fft.fftfreq(TEXELS)[:, None] * TEXELS * stretch
    fx = np.fft.rfftfreq(TEXELS)[None] * TEXELS
    f = np.hypot(fx, fy)
    gain = np.where((f >= low) & (f <= high), np.maximum(f, 1) ** -beta, 0)
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((TEXELS, TEXELS))) * gain, s=(TEXELS, TEXELS))
    return np.clip(0.5 + 0.22 * field / (field.std() + 1e-9), 0, 1)


def cells(
    rng: np.random.Generator, count: int, jitter: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Periodic Worley noise of ``count**2`` points: distance, gap to the second, the nearest's value."""
    g = (np.stack(np.meshgrid(np.arange(count), np.arange(count)), -1).reshape(-1, 2) + 0.5) / count
    points = (g + rng.uniform(-0.5, 0.5, g.shape) * jitter / count) % 1.0
    d, i = cKDTree(points, boxsize=1.0).query(np.stack([TILE_X, TILE_Y], -1).reshape(-1, 2), k=2)
    value = rng.random(len(points))[i[:, 0]]
    shape = (TEXELS, TEXELS)
    return d[:, 0].reshape(shape) * count, (d[:, 1] - d[:, 0]).reshape(shape) * count, value.reshape(shape)


def pack(tone: np.ndarray, accent=0.0, gloss=0.0, shade=1.0) -> np.ndarray:
    """Stack four channels, each an array or a number, to ``(TEXELS, TEXELS, 4)``."""
    return np.stack(
        [np.broadcast_to(np.asarray(c, float), (TEXELS, TEXELS)) for c in (tone, accent, gloss, shade)], -1
    )


def grid(columns: float, rows: float, gap_u: float, gap_v: float, stagger: float = 0.0):
    """Cell indices of a masonry grid and a mask of the joints; ``gap`` in parts of a cell."""
    v = TILE_Y * rows
    row = np.floor(v).astype(int)
    u = TILE_X * columns + stagger * (row % 2)
    column = np.floor(u).astype(int) % int(columns)
    fu, fv = u - np.floor(u), v - row
    joint = (fu < gap_u) | (fu > 1 - gap_u) | (fv < gap_v) | (fv > 1 - gap_v)
    return column, row, fu, fv, joint


def noise(beta: float, low=1.0, high=128.0, stretch=1.0, contrast=1.0, dirt=0.0) -> Bake:
    """Noise between two frequencies: plaster, asphalt, soil; ``dirt`` adds patches of accent."""

    def bake(rng):
        tone = np.clip(0.5 + contrast * (spectral(rng, beta, low, high, stretch) - 0.5), 0, 1)
        return pack(
            tone, dirt * (spectral(rng, 1.5, 2) > 0.72), 0.0, 0.85 + 0.3 * (spectral(rng, 0.5, 16) - 0.5)
        )

    return bake


def cellular(count: int, edge: float, contrast: float = 1.0, jitter: float = 1.0) -> Bake:
    """Pebbles and flagstones: cells with dark gaps of width ``edge``."""

    def bake(rng):
        _, gap, value = cells(rng, count, jitter)
        tone = np.clip(0.5 + contrast * (value - 0.5) + 0.2 * (spectral(rng, 0.8, 4) - 0.5), 0, 1)
        return pack(tone, 0.0, 0.0, np.clip(gap / edge, 0.25, 1))

    return bake


def foliage(count: int, light: float) -> Bake:
    """Leaves or blades: bright cells in clumps, dark between."""

    def bake(rng):
        d, gap, value = cells(rng, count)
        clump = spectral(rng, 1.2, 2, 24)
        shade = np.clip(0.25 + 0.55 * (1 - d) + 0.9 * (clump - 0.5) + 0.3 * (value - 0.5), 0.06, 1) * light
        return pack(value, (value > 0.93) * 0.5, 0.03, shade)

    return bake


def marble(rng: np.random.Generator) -> np.ndarray:
    """Polished stone with veins."""
    vein = np.abs(np.sin(2 * np.pi * (2 * TILE_X + 1 * TILE_Y) + 7 * (spectral(rng, 1.8, 1, 60) - 0.5) * 2))
    return pack(np.clip(1 - vein**0.35 * 0.9 + 0.1 * spectral(rng, 1), 0, 1), 0, 0.25)


def wood(rng: np.random.Generator) -> np.ndarray:
    """Wood grain along u."""
    ring = spectral(rng, 1.6, 1, 60, stretch=0.08)
    grain = spectral(rng, 0.4, 20, 128, stretch=0.05)
    return pack(np.clip((np.sin(ring * 38) * 0.5 + 0.5) * 0.6 + 0.4 * grain, 0, 1), 0, 0.12)


def clouds(rng: np.random.Generator) -> np.ndarray:
    """Clouds: the tone is their cover."""
    soft = spectral(rng, 1.7, 1, 90)
    return pack(np.clip((soft - 0.45) * 2.6, 0, 1), 0, 0, spectral(rng, 1.3, 1, 60))


def stripes(freq_u: int, freq_v: int, duty: float) -> Bake:
    """Stripes, with whole numbers of periods along u and v."""
    return lambda rng: pack(
        (((TILE_X * freq_u + TILE_Y * freq_v) % 1) < duty) * 0.9 + 0.1 * spectral(rng, 0.5, 8),
        shade=0.9 + 0.1 * spectral(rng, 1.2),
    )


def checker(n: int) -> Bake:
    """A board of ``n`` by ``n`` squares."""
    return lambda rng: pack(
        ((np.floor(TILE_X * n) + np.floor(TILE_Y * n)) % 2) * 0.85 + 0.15 * spectral(rng, 0.8, 4), gloss=0.1
    )


def dots(rng: np.random.Generator) -> np.ndarray:
    """Polka dots."""
    _, _, fu, fv, _ = grid(6, 6, 0, 0)
    return pack(((fu - 0.5) ** 2 + (fv - 0.5) ** 2 < 0.07) * 1.0, shade=0.92 + 0.08 * spectral(rng, 1))


def fabric(threads: int, contrast: float) -> Bake:
    """Woven threads."""

    def bake(rng):
        weave = np.sin(2 * np.pi * threads * TILE_X) * np.sin(2 * np.pi * threads * TILE_Y)
        return pack(
            np.clip(0.5 + contrast * 0.5 * weave + 0.4 * (spectral(rng, 1.2, 1) - 0.5), 0, 1),
            shade=0.85 + 0.15 * weave,
        )

    return bake


def wallpaper(rng: np.random.Generator) -> np.ndarray:
    """A repeated ornament."""
    motif = np.sin(2 * np.pi * 4 * TILE_X) * np.sin(2 * np.pi * 4 * TILE_Y) + 0.5 * np.sin(
        2 * np.pi * 8 * (TILE_X + TILE_Y)
    ) * np.sin(2 * np.pi * 8 * (TILE_X - TILE_Y))
    return pack(np.clip(0.3 + 0.4 * (motif > 0.35), 0, 1), (np.abs(motif - 0.9) < 0.12) * 1.0)
