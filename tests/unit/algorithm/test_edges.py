"""Sharpened edges against a reference in NumPy that visits pixel after pixel."""

import itertools

import numpy as np
import pytest
import torch

from geodiff_plugin.algorithm import edges
from geodiff_plugin.algorithm.edges import sharpen_edges


def reference(depth_m: np.ndarray, image: np.ndarray, s: int) -> tuple[np.ndarray, np.ndarray]:
    """A map ``(h, w)`` with the depth of a surface on its ramps, and where these are.

    Samples lie ``s`` pixels apart, and the border is repeated. A pixel is on a ramp if in one of four
    directions it lies between its two neighbours, with a step of more than 2 % to each, and the change over
    two samples is more than twice that over two samples around the places three samples away.
    """
    height, width = depth_m.shape
    inverse, ramps, out = 1.0 / depth_m, np.zeros(depth_m.shape, bool), depth_m.copy()

    def at(array, v, u):
        return array[..., min(max(v, 0), height - 1), min(max(u, 0), width - 1)]

    def slope(v, u):
        across = at(inverse, v, u + s) - at(inverse, v, u - s)
        down = at(inverse, v + s, u) - at(inverse, v - s, u)
        return np.hypot(across, down) / 2.0 * at(depth_m, v, u)

    for v, u in np.ndindex(height, width):
        for dv, du in ((0, 1), (1, 0), (1, 1), (1, -1)):
            line = [at(inverse, v + k * s * dv, u + k * s * du) for k in range(-4, 5)]
            ahead, behind = line[5] - line[4], line[4] - line[3]
            discontinuity = min(abs(ahead), abs(behind)) > 0.02 * line[4]
            beside = max(abs(line[8] - line[6]), abs(line[2] - line[0]))
            ramps[v, u] |= ahead * behind > 0 and discontinuity and abs(line[5] - line[3]) > 2.0 * beside
        if not ramps[v, u]:
            continue
        window = []
        for dv, du in itertools.product(range(-2, 3), repeat=2):
            y, x = v + dv * s, u + du * s
            unlike = np.abs(at(image, y, x) - at(image, v, u)).mean() / 0.12
            flat = 1.0 / (1.0 + (slope(y, x) / 0.04) ** 2)
            weight = flat * np.exp(-unlike - (dv**2 + du**2) / (2.0 * 1.5**2))
            window.append((at(depth_m, y, x), weight))
        window.sort()
        below = np.cumsum([weight for _, weight in window])
        out[v, u] = window[int(np.searchsorted(below, 0.5 * below[-1]))][0]
    return out, ramps


def scene(height: int, width: int, seed: int, s: int) -> tuple[np.ndarray, np.ndarray]:
    """Smooth ramps ``s`` pixels wide between slanted surfaces along slanted borders, and an image of them."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width].astype(float)
    inverse = 0.2 + 0.002 * v + 0.001 * u
    image = np.full((3, height, width), 0.3) + 0.02 * rng.normal(size=(3, height, width))
    for k in range(3):
        angle, at = rng.uniform(0, np.pi), rng.uniform(0.3, 0.7, 2) * (height, width)
        away = (np.cos(angle) * (u - at[1]) + np.sin(angle) * (v - at[0])) / s
        fraction = 1 / (1 + np.exp(-(1.5 + k) * away))
        inverse = inverse + rng.uniform(0.2, 0.6) * fraction
        image += 0.15 * rng.normal() * (fraction > 0.5)
    return (1.0 / inverse).astype(np.float32), image.clip(0, 1).astype(np.float32)


@pytest.mark.parametrize(("size", "s", "strip"), [((23, 31), 1, None), ((26, 19), 2, 6 * 19)])
def test_ramps_get_the_weighted_median_of_their_window(monkeypatch, size, s, strip):
    """Two different maps at once, also in strips of six rows, at the border of the map and within it."""
    if strip is not None:
        monkeypatch.setattr("geodiff_plugin._internal.strips.STRIP_PIXELS", strip)
        monkeypatch.setattr(edges, "STRIP", 5)
    pairs = [scene(*size, seed, s) for seed in (1, 5)]
    depth_m, image = (torch.from_numpy(np.stack(each)) for each in zip(*pairs, strict=True))
    found = sharpen_edges(depth_m[:, None], image, s)
    for b, (one, its_image) in enumerate(pairs):
        expected, ramps = reference(one, its_image, s)
        changed = (found[b, 0].numpy() != one).mean()
        assert ramps.mean() > 0.05 and changed > 0.02
        # Rounding decides where two samples of a window weigh the same.
        off = ~np.isclose(found[b, 0], expected, rtol=1e-5)
        assert off.sum() <= 1


def test_sharpening_keeps_no_graph():
    depth_m, image = (torch.from_numpy(each)[None] for each in scene(12, 14, 2, 1))
    assert not sharpen_edges(depth_m[None].requires_grad_(), image, 1).requires_grad
