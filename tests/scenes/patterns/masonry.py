"""Built surfaces: bricks, planks, roofs, roads, facades, shops.

Data flow: a random generator -> a ``(TEXELS, TEXELS, 4)`` tile.
"""

from __future__ import annotations

import numpy as np

from tests.scenes.patterns.noise import TEXELS, TILE_X, TILE_Y, Bake, grid, pack, spectral
from tests.scenes.patterns.printed import print_lines

__all__ = ["facade", "masonry", "planks", "road", "roof", "shopfront"]


def masonry(
    rng: np.random.Generator,
    columns: int,
    rows: int,
    gap_u: float,
    gap_v: float,
    stagger: float,
    variety: float = 0.35,
    joint_tone: float = 1.0,
    rough: float = 0.25,
) -> np.ndarray:
    """Courses of bricks, blocks or tiles with joints."""
    column, row, _, _, joint = grid(columns, rows, gap_u, gap_v, stagger)
    tone = 0.5 + variety * (rng.random((int(rows), int(columns)))[row, column] - 0.5) * 2
    tone = tone + rough * (spectral(rng, 0.8, 4) - 0.5)
    return pack(np.clip(np.where(joint, joint_tone, tone * 0.75), 0, 1), shade=np.where(joint, 0.75, 1.0))


def planks(boards: int, gap: float) -> Bake:
    """Boards with grain and gaps."""

    def bake(rng):
        column, row, fu, fv, joint = grid(2, boards, 0.003, gap, stagger=0.37)
        grain = np.zeros((TEXELS, TEXELS))
        base, fine = spectral(rng, 1.2, 2, 100, stretch=0.08), spectral(rng, 0.4, 20, 128, stretch=0.04)
        grain = 0.6 * base + 0.4 * fine
        tone = np.clip(0.6 * grain + 0.5 * rng.random((boards, 2))[row, column] - 0.05, 0, 1)
        return pack(tone, 0, 0.1, np.where(joint, 0.45, 1.0))

    return bake


def roof(rng: np.random.Generator) -> np.ndarray:
    """Overlapping roof tiles."""
    column, row, fu, fv, _ = grid(12, 10, 0, 0, 0.5)
    tone = rng.random((10, 12))[row, column]
    return pack(
        0.7 * tone + 0.3 * spectral(rng, 1),
        0,
        0.02,
        0.45 + 0.55 * np.minimum(fv * 1.6, 1) * (0.7 + 0.3 * np.sin(np.pi * fu)),
    )


def road(rng: np.random.Generator) -> np.ndarray:
    """Across u the whole carriageway, along v twelve metres: dashes, edge lines, tyre tracks."""
    ground = 0.5 * spectral(rng, 0.4, 8) + 0.5 * spectral(rng, 1.5, 1, 30)
    wear = spectral(rng, 0.5, 4) > 0.3
    middle = (np.abs(TILE_X - 0.5) < 0.0085) & (TILE_Y < 0.45)
    edges = np.abs(np.minimum(TILE_X, 1 - TILE_X) - 0.03) < 0.0085
    track = np.exp(-(((np.abs(np.abs(TILE_X - 0.5) - 0.25) - 0.11) / 0.05) ** 2))
    return pack(ground, ((middle | edges) & wear) * 1.0, 0.04 * track, 1 - 0.12 * track)


def facade(
    rng: np.random.Generator,
    columns: int,
    rows: int,
    width: float,
    height: float,
    sill: bool,
    door: bool,
    panes: int,
) -> np.ndarray:
    """A wall with a window grid; gloss marks the panes so that they reflect the sky."""
    column, row, fu, fv, _ = grid(columns, rows, 0, 0)
    du, dv = np.abs(fu - 0.5), np.abs(fv - 0.5)
    inside = (du < width / 2) & (dv < height / 2)
    frame = (du < width / 2 + 0.035) & (dv < height / 2 + 0.03) & ~inside
    cross = inside & ((np.abs((fu - 0.5) / width * panes % 1 - 0.5) > 0.46) | (dv < 0.012))
    ledge = sill & (fv > 0.5 + height / 2 + 0.02) & (fv < 0.5 + height / 2 + 0.06) & (du < width / 2 + 0.06)
    lit = rng.random((rows, columns))[row, column]
    blind = (
        inside
        & (fv < 0.5 - height / 2 + height * rng.random((rows, columns))[row, column] * 0.7)
        & (lit > 0.6)
    )
    wall = 0.25 * spectral(rng, 1.2, 1) + 0.12 * spectral(rng, 0.3, 20)
    if door:
        band = fv > 0.94
        wall = np.where(band, wall + 0.25, wall)
    pane = inside & ~cross & ~blind
    accent = np.where(frame | cross | ledge, 1.0, np.where(blind, 0.7, 0.0))
    tone = np.where(pane, 1.0, wall)
    shade = np.where(pane, 0.12 + 0.25 * lit * (fv - 0.2), 1.0)
    shade = np.where(inside & (fv < 0.5 - height / 2 + 0.04), shade * 0.5, shade)
    shade = np.where(
        (fv > 0.5 + height / 2 + 0.06) & (fv < 0.5 + height / 2 + 0.10) & (du < width / 2 + 0.06), 0.7, shade
    )
    return pack(
        np.where(pane, 0.2, tone), np.where(pane, 0.0, accent), np.where(pane, 0.9, 0.0), np.clip(shade, 0, 1)
    )


def shopfront(rng: np.random.Generator) -> np.ndarray:
    """Shop windows under a sign."""
    column, row, fu, fv, _ = grid(3, 1, 0, 0)
    pane = (fv > 0.32) & (fv < 0.86) & (np.abs(fu - 0.5) < 0.42)
    sign = (fv > 0.1) & (fv < 0.26)
    inkline = print_lines(rng, 12, 0.02) * sign
    content = spectral(rng, 1.0, 3)
    return pack(
        np.where(pane, content, 0.3),
        np.where(sign, 1.0 - inkline, 0.0),
        np.where(pane, 0.7, 0),
        np.where(pane, 0.35, np.where(inkline > 0.3, 0.3, 1.0)),
    )
