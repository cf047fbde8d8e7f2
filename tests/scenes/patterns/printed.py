"""Printed and manufactured objects: text, posters, books, screens, keyboards, cupboards, doors, windows.

Data flow: a random generator -> a ``(TEXELS, TEXELS, 4)`` tile.
"""

from __future__ import annotations

import numpy as np

from tests.scenes.patterns.noise import TEXELS, TILE_X, TILE_Y, Bake, grid, pack, spectral

__all__ = [
    "books",
    "cabinet",
    "document",
    "door",
    "keyboard",
    "label",
    "poster",
    "print_lines",
    "screen",
    "window",
]


def print_lines(rng: np.random.Generator, lines: int, margin: float, density: float = 0.75) -> np.ndarray:
    """Lines of word-like marks."""
    ink = np.zeros((TEXELS, TEXELS))
    step = TEXELS / lines
    for k in range(lines):
        if rng.random() < 0.12:
            continue
        y0, y1 = (
            int(k * step + 0.25 * step),
            max(int(k * step + 0.75 * step), int(k * step + 0.25 * step) + 1),
        )
        x = margin * TEXELS
        end = TEXELS * (1 - margin) * (1 if rng.random() < 0.75 else rng.uniform(0.3, 0.9))
        while x < end:
            w = rng.uniform(0.6, 3.2) * step
            ink[y0:y1, int(x) : int(min(x + w, end))] = density * rng.uniform(0.75, 1)
            x += w + 0.45 * step
    if step > 8:  # large letters: break the words into glyphs
        ink *= spectral(rng, 0.1, 20, 60) > 0.42
    return ink


def poster(rng: np.random.Generator) -> np.ndarray:
    """Random shapes, a title and lines of text inside a border."""
    tone, accent = np.full((TEXELS, TEXELS), rng.random()), np.zeros((TEXELS, TEXELS))
    for _ in range(rng.integers(5, 14)):
        cx, cy, r, s = rng.random(), rng.random(), rng.uniform(0.05, 0.35), rng.random()
        shape = (
            (np.abs(TILE_X - cx) < r) & (np.abs(TILE_Y - cy) < r * rng.uniform(0.3, 1.5))
            if rng.random() < 0.5
            else ((TILE_X - cx) ** 2 + (TILE_Y - cy) ** 2 < r * r)
        )
        tone = np.where(shape, s, tone)
        accent = np.where(shape, float(rng.random() < 0.35), accent)
    if rng.random() < 0.6:
        tone = tone * 0.5 + 0.5 * spectral(rng, 1.6, 1)
    ink = print_lines(rng, int(rng.integers(8, 30)), 0.08) * (rng.uniform(0.4, 0.7) < TILE_Y)
    edge = (np.minimum(TILE_X, 1 - TILE_X) < 0.02) | (np.minimum(TILE_Y, 1 - TILE_Y) < 0.02)
    return pack(np.where(edge, 0.0, tone), accent * (1 - ink), 0.05, np.where(edge, 0.5, 1 - 0.8 * ink))


def books(rng: np.random.Generator) -> np.ndarray:
    """A row of spines: a tile is one shelf bay."""
    x, tone, accent, shade, top = 0.0, np.zeros(TEXELS), np.zeros(TEXELS), np.ones(TEXELS), np.zeros(TEXELS)
    band = np.zeros((TEXELS, TEXELS))
    while x < 1:
        w = rng.uniform(0.02, 0.06)
        a, b = int(x * TEXELS), max(int(min(x + w, 1) * TEXELS), int(x * TEXELS) + 1)
        tone[a:b], accent[a:b], top[a:b] = rng.random(), rng.random() ** 2, rng.uniform(0.02, 0.3)
        shade[a:b] = rng.uniform(0.4, 1.0)
        shade[a] *= 0.35
        for _ in range(rng.integers(0, 3)):
            c = rng.uniform(0.35, 0.9)
            band[int(c * TEXELS) : int((c + rng.uniform(0.02, 0.2)) * TEXELS), a + 1 : b - 1] = 1
        x += w
    above = top[None] > TILE_Y
    tone = np.where(band > 0, 1 - tone[None], tone[None])
    return pack(
        np.where(above, 0.2, tone), np.where(above, 0, accent[None]), 0.08, np.where(above, 0.08, shade[None])
    )


def screen(rng: np.random.Generator) -> np.ndarray:
    """Windows with text on a desktop."""
    tone = 0.15 + 0.1 * TILE_Y
    accent, ink = np.zeros((TEXELS, TEXELS)), np.zeros((TEXELS, TEXELS))
    for _ in range(rng.integers(1, 4)):
        x0, y0 = rng.uniform(0.02, 0.5, 2)
        box = (
            (x0 < TILE_X)
            & (x0 + rng.uniform(0.3, 0.6) > TILE_X)
            & (y0 < TILE_Y)
            & (y0 + rng.uniform(0.3, 0.6) > TILE_Y)
        )
        tone = np.where(box, rng.uniform(0.6, 1.0), tone)
        accent = np.where(box & (y0 + 0.04 > TILE_Y), 1.0, accent)
        ink = np.where(box & (y0 + 0.05 < TILE_Y), print_lines(rng, 34, x0 + 0.02), ink)
    edge = (np.minimum(TILE_X, 1 - TILE_X) < 0.03) | (np.minimum(TILE_Y, 1 - TILE_Y) < 0.04)
    return pack(tone, accent, 0.35, np.where(edge, 0.03, 1 - 0.7 * ink))


def keyboard(rng: np.random.Generator) -> np.ndarray:
    """Keys with marks."""
    _, _, fu, fv, joint = grid(15, 5, 0.12, 0.12)
    mark = (np.abs(fu - 0.4) < 0.1) & (np.abs(fv - 0.4) < 0.12)
    return pack(np.where(joint, 0.0, 0.6), np.where(mark, 0.9, 0.0), 0.05, np.where(joint, 0.45, 1.0))


def cabinet(rng: np.random.Generator) -> np.ndarray:
    """Fronts of doors or drawers, with handles."""
    rows = int(rng.integers(1, 4))
    column, row, fu, fv, joint = grid(2, rows, 0.018, 0.012 * rows)
    handle = (np.abs(fu - 0.5) < 0.12) & (np.abs(fv - 0.2) < 0.02 * rows)
    grain = spectral(rng, 1.0, 2, 100, stretch=0.12)
    return pack(
        0.5 * grain,
        np.where(handle, 1.0, 0.0),
        np.where(handle, 0.5, 0.08),
        np.where(joint, 0.3, np.where(handle, 0.7, 1.0)),
    )


def door(rng: np.random.Generator) -> np.ndarray:
    """A door with two panels and a handle."""
    panel = (np.abs(TILE_X - 0.5) < 0.34) & ((np.abs(TILE_Y - 0.27) < 0.19) | (np.abs(TILE_Y - 0.73) < 0.2))
    inner = (np.abs(TILE_X - 0.5) < 0.31) & (
        (np.abs(TILE_Y - 0.27) < 0.175) | (np.abs(TILE_Y - 0.73) < 0.185)
    )
    edge = (np.minimum(TILE_X, 1 - TILE_X) < 0.05) | (TILE_Y < 0.03)
    handle = (TILE_X - 0.88) ** 2 + ((TILE_Y - 0.53) * 2.2) ** 2 < 0.001
    return pack(
        np.where(edge, 0.9, 0.4 * spectral(rng, 1, 2, 90, 0.15)),
        np.where(handle, 1.0, 0),
        np.where(handle, 0.6, 0.06),
        np.where(panel & ~inner, 0.7, 1.0),
    )


def window(rng: np.random.Generator) -> np.ndarray:
    """Panes with a bright view, frame and bars."""
    du, dv = np.abs(TILE_X - 0.5), np.abs(TILE_Y - 0.5)
    frame = (du > 0.45) | (dv > 0.46) | (du < 0.025) | (np.abs(TILE_Y - 0.35) < 0.02)
    view = np.clip(1.0 - 0.5 * (0.62 + 0.1 * (spectral(rng, 1.5, 1, 20) - 0.5) < TILE_Y), 0, 1) * (
        0.8 + 0.2 * spectral(rng, 1.5, 1, 30)
    )
    return pack(
        np.where(frame, 0.0, view),
        np.where(frame, 1.0, 0),
        np.where(frame, 0, 0.3),
        np.where(frame, 0.35, 1.0),
    )


def document(lines: int) -> Bake:
    """A printed page of ``lines`` lines, perhaps with a figure."""

    def bake(rng):
        ink = print_lines(rng, lines, 0.1)
        image = (
            (np.abs(TILE_X - 0.5) < 0.3)
            & (np.abs(TILE_Y - rng.uniform(0.25, 0.75)) < 0.12)
            & (rng.random() < 0.6)
        )
        return pack(
            np.where(image, spectral(rng, 1.2, 1), 0.0),
            np.where(image, 0.6, 0),
            0.03,
            np.where(image, 1, 1 - ink),
        )

    return bake


def label(rng: np.random.Generator) -> np.ndarray:
    """A label around a package."""
    band = (TILE_Y > 0.25) & (TILE_Y < 0.8)
    ink = print_lines(rng, 9, 0.05, 0.9) * band
    art = ((TILE_X - 0.5) ** 2 + (TILE_Y - 0.5) ** 2 < 0.03) | (np.abs(TILE_Y - 0.3) < 0.03)
    return pack(np.where(band, 1.0, 0.2 * spectral(rng, 1)), (art & band) * 1.0, 0.15, 1 - 0.85 * ink)
