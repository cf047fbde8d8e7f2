"""The patterns of the texture atlas: noise families, masonry, wood, print, facades, vegetation.

Hop: a layer's name and number -> a ``(TEXELS, TEXELS, 4)`` tile that repeats without a seam.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

__all__ = ["LAYERS", "TEXELS", "TILE_M", "bake_layer"]

TEXELS = 256
_Y, _X = np.mgrid[0:TEXELS, 0:TEXELS] / TEXELS


def spectral(rng: np.random.Generator, beta: float, low: float = 1, high: float = 128, stretch: float = 1.0) -> np.ndarray:
    """Periodic noise with spectrum ``1 / f**beta`` between two frequencies (cycles a tile), about [0, 1]."""
    fy = np.fft.fftfreq(TEXELS)[:, None] * TEXELS * stretch
    fx = np.fft.rfftfreq(TEXELS)[None] * TEXELS
    f = np.hypot(fx, fy)
    gain = np.where((f >= low) & (f <= high), np.maximum(f, 1) ** -beta, 0)
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((TEXELS, TEXELS))) * gain, s=(TEXELS, TEXELS))
    return np.clip(0.5 + 0.22 * field / (field.std() + 1e-9), 0, 1)


def cells(rng: np.random.Generator, count: int, jitter: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Periodic Worley noise of ``count**2`` points: distance to the nearest, gap to the second, the nearest's value."""
    g = (np.stack(np.meshgrid(np.arange(count), np.arange(count)), -1).reshape(-1, 2) + 0.5) / count
    points = (g + rng.uniform(-0.5, 0.5, g.shape) * jitter / count) % 1.0
    d, i = cKDTree(points, boxsize=1.0).query(np.stack([_X, _Y], -1).reshape(-1, 2), k=2)
    value = rng.random(len(points))[i[:, 0]]
    shape = (TEXELS, TEXELS)
    return d[:, 0].reshape(shape) * count, (d[:, 1] - d[:, 0]).reshape(shape) * count, value.reshape(shape)


def _pack(tone: np.ndarray, accent=0.0, gloss=0.0, shade=1.0) -> np.ndarray:
    return np.stack([np.broadcast_to(np.asarray(c, float), (TEXELS, TEXELS)) for c in (tone, accent, gloss, shade)], -1)


def _grid(columns: float, rows: float, gap_u: float, gap_v: float, stagger: float = 0.0):
    """Cell indices of a masonry grid and a mask of the joints; ``gap`` in parts of a cell."""
    v = _Y * rows
    row = np.floor(v).astype(int)
    u = _X * columns + stagger * (row % 2)
    column = np.floor(u).astype(int) % int(columns)
    fu, fv = u - np.floor(u), v - row
    joint = (fu < gap_u) | (fu > 1 - gap_u) | (fv < gap_v) | (fv > 1 - gap_v)
    return column, row, fu, fv, joint


def _masonry(rng, columns, rows, gap_u, gap_v, stagger, variety=0.35, joint_tone=1.0, rough=0.25):
    column, row, _, _, joint = _grid(columns, rows, gap_u, gap_v, stagger)
    tone = 0.5 + variety * (rng.random((int(rows), int(columns)))[row, column] - 0.5) * 2
    tone = tone + rough * (spectral(rng, 0.8, 4) - 0.5)
    return _pack(np.clip(np.where(joint, joint_tone, tone * 0.75), 0, 1), shade=np.where(joint, 0.75, 1.0))


def _print(rng: np.random.Generator, lines: int, margin: float, density: float = 0.75) -> np.ndarray:
    """Lines of word-like marks."""
    ink = np.zeros((TEXELS, TEXELS))
    step = TEXELS / lines
    for k in range(lines):
        if rng.random() < 0.12:
            continue
        y0, y1 = int(k * step + 0.25 * step), max(int(k * step + 0.75 * step), int(k * step + 0.25 * step) + 1)
        x = margin * TEXELS
        end = TEXELS * (1 - margin) * (1 if rng.random() < 0.75 else rng.uniform(0.3, 0.9))
        while x < end:
            w = rng.uniform(0.6, 3.2) * step
            ink[y0:y1, int(x) : int(min(x + w, end))] = density * rng.uniform(0.75, 1)
            x += w + 0.45 * step
    if step > 8:  # large letters: break the words into glyphs
        ink *= spectral(rng, 0.1, 20, 60) > 0.42
    return ink


def _facade(rng, columns, rows, width, height, sill, door, panes):
    """A wall with a window grid; gloss marks the panes so that they reflect the sky."""
    column, row, fu, fv, _ = _grid(columns, rows, 0, 0)
    du, dv = np.abs(fu - 0.5), np.abs(fv - 0.5)
    inside = (du < width / 2) & (dv < height / 2)
    frame = (du < width / 2 + 0.035) & (dv < height / 2 + 0.03) & ~inside
    cross = inside & ((np.abs((fu - 0.5) / width * panes % 1 - 0.5) > 0.46) | (dv < 0.012))
    ledge = sill & (fv > 0.5 + height / 2 + 0.02) & (fv < 0.5 + height / 2 + 0.06) & (du < width / 2 + 0.06)
    lit = rng.random((rows, columns))[row, column]
    blind = inside & (fv < 0.5 - height / 2 + height * rng.random((rows, columns))[row, column] * 0.7) & (lit > 0.6)
    wall = 0.25 * spectral(rng, 1.2, 1) + 0.12 * spectral(rng, 0.3, 20)
    if door:
        band = (fv > 0.94)
        wall = np.where(band, wall + 0.25, wall)
    pane = inside & ~cross & ~blind
    accent = np.where(frame | cross | ledge, 1.0, np.where(blind, 0.7, 0.0))
    tone = np.where(pane, 1.0, wall)
    shade = np.where(pane, 0.12 + 0.25 * lit * (fv - 0.2), 1.0)
    shade = np.where(inside & (fv < 0.5 - height / 2 + 0.04), shade * 0.5, shade)
    shade = np.where((fv > 0.5 + height / 2 + 0.06) & (fv < 0.5 + height / 2 + 0.10) & (du < width / 2 + 0.06), 0.7, shade)
    return _pack(np.where(pane, 0.2, tone), np.where(pane, 0.0, accent), np.where(pane, 0.9, 0.0), np.clip(shade, 0, 1))


def _shopfront(rng):
    column, row, fu, fv, _ = _grid(3, 1, 0, 0)
    pane = (fv > 0.32) & (fv < 0.86) & (np.abs(fu - 0.5) < 0.42)
    sign = (fv > 0.1) & (fv < 0.26)
    inkline = _print(rng, 12, 0.02) * sign
    content = spectral(rng, 1.0, 3)
    return _pack(np.where(pane, content, 0.3), np.where(sign, 1.0 - inkline, 0.0), np.where(pane, 0.7, 0),
                 np.where(pane, 0.35, np.where(inkline > 0.3, 0.3, 1.0)))


def _poster(rng):
    tone, accent = np.full((TEXELS, TEXELS), rng.random()), np.zeros((TEXELS, TEXELS))
    for _ in range(rng.integers(5, 14)):
        cx, cy, r, s = rng.random(), rng.random(), rng.uniform(0.05, 0.35), rng.random()
        shape = (np.abs(_X - cx) < r) & (np.abs(_Y - cy) < r * rng.uniform(0.3, 1.5)) if rng.random() < 0.5 else (
            (_X - cx) ** 2 + (_Y - cy) ** 2 < r * r)
        tone = np.where(shape, s, tone)
        accent = np.where(shape, float(rng.random() < 0.35), accent)
    if rng.random() < 0.6:
        tone = tone * 0.5 + 0.5 * spectral(rng, 1.6, 1)
    ink = _print(rng, int(rng.integers(8, 30)), 0.08) * (_Y > rng.uniform(0.4, 0.7))
    edge = (np.minimum(_X, 1 - _X) < 0.02) | (np.minimum(_Y, 1 - _Y) < 0.02)
    return _pack(np.where(edge, 0.0, tone), accent * (1 - ink), 0.05, np.where(edge, 0.5, 1 - 0.8 * ink))


def _books(rng):
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
    above = _Y < top[None]
    tone = np.where(band > 0, 1 - tone[None], tone[None])
    return _pack(np.where(above, 0.2, tone), np.where(above, 0, accent[None]), 0.08, np.where(above, 0.08, shade[None]))


def _screen(rng):
    tone = 0.15 + 0.1 * _Y
    accent, ink = np.zeros((TEXELS, TEXELS)), np.zeros((TEXELS, TEXELS))
    for _ in range(rng.integers(1, 4)):
        x0, y0 = rng.uniform(0.02, 0.5, 2)
        box = (_X > x0) & (_X < x0 + rng.uniform(0.3, 0.6)) & (_Y > y0) & (_Y < y0 + rng.uniform(0.3, 0.6))
        tone = np.where(box, rng.uniform(0.6, 1.0), tone)
        accent = np.where(box & (_Y < y0 + 0.04), 1.0, accent)
        ink = np.where(box & (_Y > y0 + 0.05), _print(rng, 34, x0 + 0.02), ink)
    edge = (np.minimum(_X, 1 - _X) < 0.03) | (np.minimum(_Y, 1 - _Y) < 0.04)
    return _pack(tone, accent, 0.35, np.where(edge, 0.03, 1 - 0.7 * ink))


def _keyboard(rng):
    _, _, fu, fv, joint = _grid(15, 5, 0.12, 0.12)
    mark = (np.abs(fu - 0.4) < 0.1) & (np.abs(fv - 0.4) < 0.12)
    return _pack(np.where(joint, 0.0, 0.6), np.where(mark, 0.9, 0.0), 0.05, np.where(joint, 0.45, 1.0))


def _cabinet(rng):
    rows = int(rng.integers(1, 4))
    column, row, fu, fv, joint = _grid(2, rows, 0.018, 0.012 * rows)
    handle = (np.abs(fu - 0.5) < 0.12) & (np.abs(fv - 0.2) < 0.02 * rows)
    grain = spectral(rng, 1.0, 2, 100, stretch=0.12)
    return _pack(0.5 * grain, np.where(handle, 1.0, 0.0), np.where(handle, 0.5, 0.08), np.where(joint, 0.3, np.where(handle, 0.7, 1.0)))


def _door(rng):
    panel = (np.abs(_X - 0.5) < 0.34) & ((np.abs(_Y - 0.27) < 0.19) | (np.abs(_Y - 0.73) < 0.2))
    inner = (np.abs(_X - 0.5) < 0.31) & ((np.abs(_Y - 0.27) < 0.175) | (np.abs(_Y - 0.73) < 0.185))
    edge = (np.minimum(_X, 1 - _X) < 0.05) | (_Y < 0.03)
    handle = ((_X - 0.88) ** 2 + ((_Y - 0.53) * 2.2) ** 2 < 0.001)
    return _pack(np.where(edge, 0.9, 0.4 * spectral(rng, 1, 2, 90, 0.15)), np.where(handle, 1.0, 0), np.where(handle, 0.6, 0.06),
                 np.where(panel & ~inner, 0.7, 1.0))


def _window(rng):
    du, dv = np.abs(_X - 0.5), np.abs(_Y - 0.5)
    frame = (du > 0.45) | (dv > 0.46) | (du < 0.025) | (np.abs(_Y - 0.35) < 0.02)
    view = np.clip(1.0 - 0.5 * (_Y > 0.62 + 0.1 * (spectral(rng, 1.5, 1, 20) - 0.5)), 0, 1) * (0.8 + 0.2 * spectral(rng, 1.5, 1, 30))
    return _pack(np.where(frame, 0.0, view), np.where(frame, 1.0, 0), np.where(frame, 0, 0.3), np.where(frame, 0.35, 1.0))


def _road(rng):
    """Across u the whole carriageway, along v twelve metres: dashed middle, edge lines, tyre tracks, patches."""
    ground = 0.5 * spectral(rng, 0.4, 8) + 0.5 * spectral(rng, 1.5, 1, 30)
    wear = (spectral(rng, 0.5, 4) > 0.3)
    middle = (np.abs(_X - 0.5) < 0.0085) & (_Y < 0.45)
    edges = (np.abs(np.minimum(_X, 1 - _X) - 0.03) < 0.0085)
    track = np.exp(-(((np.abs(np.abs(_X - 0.5) - 0.25) - 0.11) / 0.05) ** 2))
    return _pack(ground, ((middle | edges) & wear) * 1.0, 0.04 * track, 1 - 0.12 * track)


def _stripes(freq_u: int, freq_v: int, duty: float):
    return lambda rng: _pack((((_X * freq_u + _Y * freq_v) % 1) < duty) * 0.9 + 0.1 * spectral(rng, 0.5, 8), shade=0.9 + 0.1 * spectral(rng, 1.2))


def _noise(beta: float, low=1, high=128, stretch=1.0, contrast=1.0, dirt=0.0):
    def bake(rng):
        tone = np.clip(0.5 + contrast * (spectral(rng, beta, low, high, stretch) - 0.5), 0, 1)
        return _pack(tone, dirt * (spectral(rng, 1.5, 2) > 0.72), 0.0, 0.85 + 0.3 * (spectral(rng, 0.5, 16) - 0.5))

    return bake


def _cellular(count: int, edge: float, contrast: float = 1.0, jitter: float = 1.0):
    def bake(rng):
        _, gap, value = cells(rng, count, jitter)
        tone = np.clip(0.5 + contrast * (value - 0.5) + 0.2 * (spectral(rng, 0.8, 4) - 0.5), 0, 1)
        return _pack(tone, 0.0, 0.0, np.clip(gap / edge, 0.25, 1))

    return bake


def _foliage(count: int, light: float):
    def bake(rng):
        d, gap, value = cells(rng, count)
        clump = spectral(rng, 1.2, 2, 24)
        shade = np.clip(0.25 + 0.55 * (1 - d) + 0.9 * (clump - 0.5) + 0.3 * (value - 0.5), 0.06, 1) * light
        return _pack(value, (value > 0.93) * 0.5, 0.03, shade)

    return bake


def _marble(rng):
    vein = np.abs(np.sin(2 * np.pi * (2 * _X + 1 * _Y) + 7 * (spectral(rng, 1.8, 1, 60) - 0.5) * 2))
    return _pack(np.clip(1 - vein**0.35 * 0.9 + 0.1 * spectral(rng, 1), 0, 1), 0, 0.25)


def _wood(rng):
    ring = spectral(rng, 1.6, 1, 60, stretch=0.08)
    grain = spectral(rng, 0.4, 20, 128, stretch=0.05)
    return _pack(np.clip((np.sin(ring * 38) * 0.5 + 0.5) * 0.6 + 0.4 * grain, 0, 1), 0, 0.12)


def _planks(boards: int, gap: float):
    def bake(rng):
        column, row, fu, fv, joint = _grid(2, boards, 0.003, gap, stagger=0.37)
        grain = np.zeros((TEXELS, TEXELS))
        base, fine = spectral(rng, 1.2, 2, 100, stretch=0.08), spectral(rng, 0.4, 20, 128, stretch=0.04)
        grain = 0.6 * base + 0.4 * fine
        tone = np.clip(0.6 * grain + 0.5 * rng.random((boards, 2))[row, column] - 0.05, 0, 1)
        return _pack(tone, 0, 0.1, np.where(joint, 0.45, 1.0))

    return bake


def _fabric(threads: int, contrast: float):
    def bake(rng):
        weave = np.sin(2 * np.pi * threads * _X) * np.sin(2 * np.pi * threads * _Y)
        return _pack(np.clip(0.5 + contrast * 0.5 * weave + 0.4 * (spectral(rng, 1.2, 1) - 0.5), 0, 1), shade=0.85 + 0.15 * weave)

    return bake


def _wallpaper(rng):
    motif = np.sin(2 * np.pi * 4 * _X) * np.sin(2 * np.pi * 4 * _Y) + 0.5 * np.sin(2 * np.pi * 8 * (_X + _Y)) * np.sin(2 * np.pi * 8 * (_X - _Y))
    return _pack(np.clip(0.3 + 0.4 * (motif > 0.35), 0, 1), (np.abs(motif - 0.9) < 0.12) * 1.0)


def _dots(rng):
    _, _, fu, fv, _ = _grid(6, 6, 0, 0)
    return _pack(((fu - 0.5) ** 2 + (fv - 0.5) ** 2 < 0.07) * 1.0, shade=0.92 + 0.08 * spectral(rng, 1))


def _checker(n: int):
    return lambda rng: _pack(((np.floor(_X * n) + np.floor(_Y * n)) % 2) * 0.85 + 0.15 * spectral(rng, 0.8, 4), gloss=0.1)


def _document(lines: int):
    def bake(rng):
        ink = _print(rng, lines, 0.1)
        picture = (np.abs(_X - 0.5) < 0.3) & (np.abs(_Y - rng.uniform(0.25, 0.75)) < 0.12) & (rng.random() < 0.6)
        return _pack(np.where(picture, spectral(rng, 1.2, 1), 0.0), np.where(picture, 0.6, 0), 0.03, np.where(picture, 1, 1 - ink))

    return bake


def _label(rng):
    band = (_Y > 0.25) & (_Y < 0.8)
    ink = _print(rng, 9, 0.05, 0.9) * band
    art = ((_X - 0.5) ** 2 + (_Y - 0.5) ** 2 < 0.03) | (np.abs(_Y - 0.3) < 0.03)
    return _pack(np.where(band, 1.0, 0.2 * spectral(rng, 1)), (art & band) * 1.0, 0.15, 1 - 0.85 * ink)


def _clouds(rng):
    soft = spectral(rng, 1.7, 1, 90)
    return _pack(np.clip((soft - 0.45) * 2.6, 0, 1), 0, 0, spectral(rng, 1.3, 1, 60))


def _roof(rng):
    column, row, fu, fv, _ = _grid(12, 10, 0, 0, 0.5)
    tone = rng.random((10, 12))[row, column]
    return _pack(0.7 * tone + 0.3 * spectral(rng, 1), 0, 0.02, 0.45 + 0.55 * np.minimum(fv * 1.6, 1) * (0.7 + 0.3 * np.sin(np.pi * fu)))


_CLASSES: dict[str, tuple[float, Callable[[np.random.Generator], np.ndarray]]] = {
    # name: (metres that one tile covers, bake)
    "plain": (1.2, _noise(1.4, contrast=0.35)),
    "plaster": (1.5, _noise(1.1, contrast=0.5)),
    "fbm": (1.0, _noise(1.6)),
    "speckle": (0.5, _noise(0.2, 20, contrast=1.6)),
    "concrete": (2.5, _noise(1.2, contrast=0.8, dirt=0.3)),
    "asphalt": (2.0, _noise(0.6, 2, contrast=0.9)),
    "grass": (1.6, _foliage(48, 1.0)),
    "soil": (2.0, _noise(1.0, 1, contrast=1.2, dirt=0.5)),
    "gravel": (1.0, _cellular(26, 0.35)),
    "cobbles": (1.8, _cellular(12, 0.22, 0.8, 0.5)),
    "flagstones": (2.4, _cellular(5, 0.06, 0.7)),
    "rock": (3.0, _noise(1.3, 1, contrast=1.6, dirt=0.6)),
    "leaves": (1.3, _foliage(26, 1.0)),
    "hedge": (1.0, _foliage(34, 0.9)),
    "marble": (1.5, _marble),
    "wood": (0.8, _wood),
    "planks": (1.4, _planks(10, 0.03)),
    "parquet": (1.0, _planks(14, 0.02)),
    "brick": (1.0, lambda rng: _masonry(rng, 4, 12, 0.025, 0.07, 0.5)),
    "blocks": (2.4, lambda rng: _masonry(rng, 6, 12, 0.015, 0.03, 0.5, 0.2)),
    "ashlar": (3.0, lambda rng: _masonry(rng, 4, 8, 0.015, 0.03, 0.5, 0.35, 0.1, 0.5)),
    "tiles": (1.2, lambda rng: _masonry(rng, 4, 4, 0.02, 0.02, 0, 0.15, 0.9, 0.12)),
    "mosaic": (0.6, lambda rng: _masonry(rng, 12, 12, 0.06, 0.06, 0, 0.5, 1.0, 0.1)),
    "paving": (2.4, lambda rng: _masonry(rng, 6, 6, 0.02, 0.02, 0.5, 0.25, 0.05, 0.35)),
    "checker": (0.6, _checker(2)),
    "fine_checker": (0.3, _checker(8)),
    "stripes": (0.5, _stripes(6, 0, 0.5)),
    "pinstripes": (0.5, _stripes(0, 14, 0.2)),
    "diagonal": (0.6, _stripes(4, 4, 0.5)),
    "dots": (0.4, _dots),
    "fabric": (0.12, _fabric(24, 0.7)),
    "carpet": (0.8, _noise(0.3, 8, contrast=1.0)),
    "wallpaper": (0.9, _wallpaper),
    "document": (0.25, _document(34)),
    "page": (0.25, _document(22)),
    "poster_a": (1.0, _poster),
    "poster_b": (1.0, _poster),
    "poster_c": (1.0, _poster),
    "label_a": (0.2, _label),
    "label_b": (0.2, _label),
    "books_a": (0.9, _books),
    "books_b": (0.9, _books),
    "screen_a": (0.5, _screen),
    "screen_b": (0.5, _screen),
    "keyboard": (0.45, _keyboard),
    "cabinet": (0.9, _cabinet),
    "drawers": (0.6, _cabinet),
    "door": (1.0, _door),
    "window": (1.2, _window),
    "facade_a": (12.0, lambda rng: _facade(rng, 4, 4, 0.36, 0.5, True, False, 2)),
    "facade_b": (12.0, lambda rng: _facade(rng, 6, 4, 0.42, 0.58, True, True, 2)),
    "facade_c": (13.0, lambda rng: _facade(rng, 3, 4, 0.62, 0.45, False, True, 4)),
    "facade_d": (14.0, lambda rng: _facade(rng, 8, 4, 0.86, 0.5, False, False, 1)),
    "shopfront": (9.0, _shopfront),
    "road": (7.0, _road),
    "roof": (3.0, _roof),
    "clouds": (1.0, _clouds),
}

LAYERS: dict[str, int] = {name: i for i, name in enumerate(_CLASSES)}
"""Layer names in atlas order."""

TILE_M: dict[str, float] = {name: metres for name, (metres, _) in _CLASSES.items()}
"""What one tile covers in the world: it makes texture frequency a cue for distance."""


def bake_layer(name: str, number: int) -> np.ndarray:
    """One layer, always the same for the same name and number.

    Args:
        name: a key of ``LAYERS``.
        number: seeds the noise.

    Returns:
        ``(TEXELS, TEXELS, 4)`` float, channels in [0, 1]: tone, accent, gloss, shade.
    """
    return np.clip(_CLASSES[name][1](np.random.default_rng(7000 + number)), 0, 1)
