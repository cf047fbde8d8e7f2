"""Plausible colours and surface looks, shared by all layouts.

Data flow: random draws -> ``Look``.
"""

from __future__ import annotations

import colorsys

import numpy as np

from tests.scenes.builder import Look
from tests.scenes.patterns import TILE_M
from tests.scenes.scene import Material

__all__ = ["colour", "object_look", "palette", "pick", "surface_look"]

# hue, saturation and value (sRGB) ranges of the base colour; how far tone B is in value; accent.
_FAMILIES = {
    "wall": ((0.05, 0.17), (0.0, 0.18), (0.7, 0.97), -0.08),
    "painted": ((0.0, 1.0), (0.1, 0.45), (0.55, 0.9), -0.08),
    "wood": ((0.05, 0.1), (0.3, 0.65), (0.3, 0.85), -0.22),
    "stone": ((0.05, 0.14), (0.02, 0.2), (0.35, 0.8), -0.2),
    "grey": ((0.5, 0.65), (0.0, 0.08), (0.15, 0.75), 0.12),
    "dark": ((0.0, 1.0), (0.0, 0.3), (0.04, 0.22), 0.08),
    "brick": ((0.0, 0.06), (0.3, 0.65), (0.45, 0.75), 0.25),
    "leaf": ((0.17, 0.34), (0.3, 0.7), (0.3, 0.62), 0.18),
    "moss": ((0.2, 0.36), (0.25, 0.6), (0.12, 0.35), 0.1),
    "dry": ((0.09, 0.16), (0.25, 0.5), (0.45, 0.75), 0.1),
    "soil": ((0.05, 0.1), (0.25, 0.5), (0.25, 0.5), 0.15),
    "vivid": ((0.0, 1.0), (0.45, 0.95), (0.35, 0.9), -0.25),
    "any": ((0.0, 1.0), (0.0, 0.8), (0.1, 0.95), 0.3),
    "white": ((0.08, 0.16), (0.0, 0.06), (0.85, 0.98), -0.06),
    "asphalt": ((0.55, 0.7), (0.0, 0.07), (0.25, 0.5), 0.12),
}

_NATURAL = frozenset({"leaf", "moss", "dry", "soil", "stone", "asphalt", "brick"})


def _linear(h: float, s: float, v: float) -> tuple[float, ...]:
    clip = (min(max(s, 0.0), 1.0), min(max(v, 0.0), 1.0))
    return tuple(c**2.2 for c in colorsys.hsv_to_rgb(h % 1.0, *clip))


def colour(h: float, s: float, v: float) -> np.ndarray:
    """Linear RGB of an HSV colour given in sRGB values."""
    return np.array(_linear(h, s, v))


def palette(rng: np.random.Generator, family: str) -> np.ndarray:
    """Base, second tone and accent, ``(3, 3)`` linear."""
    (h0, h1), (s0, s1), (v0, v1), shift = _FAMILIES[family]
    r = rng.random(9).tolist()
    h, s, v = h0 + (h1 - h0) * r[0], s0 + (s1 - s0) * r[1], v0 + (v1 - v0) * r[2]
    second = _linear(h + 0.05 * (r[3] - 0.5), s * (0.6 + 0.6 * r[4]), v + shift * (0.4 + 0.9 * r[5]))
    if family in _NATURAL:  # patches and dirt of about the same hue
        accent = _linear(h + 0.08 * (r[6] - 0.5), s * (0.4 + r[7]), v * (0.5 + 0.8 * r[8]))
    else:
        accent = _linear(r[6], 0.8 * r[7], 0.1 + 0.85 * r[8])
    return np.array((_linear(h, s, v), second, accent))


def pick(rng: np.random.Generator, *options):
    """One of the options."""
    return options[int(rng.random() * len(options))]


def surface_look(
    rng: np.random.Generator, layer: str, family: str, scale: tuple[float, float] = (0.8, 1.25), **rest
) -> Look:
    """A layer at about its natural size in colours of a family."""
    k = scale[0] + (scale[1] - scale[0]) * rng.random()
    return Look(layer, palette(rng, family), (TILE_M[layer] * k,) * 2, **rest)


_OBJECT_LAYERS = (
    "plain",
    "plain",
    "plaster",
    "fbm",
    "speckle",
    "wood",
    "marble",
    "stripes",
    "pinstripes",
    "diagonal",
    "dots",
    "fine_checker",
    "label_a",
    "label_b",
    "fabric",
    "poster_a",
    "poster_b",
    "document",
    "wallpaper",
    "mosaic",
)


def object_look(rng: np.random.Generator, size: float, special: float = 0.06) -> Look:
    """Materials of a small object; ``special`` is the chance of mirror or glass each."""
    layer = pick(rng, *_OBJECT_LAYERS)
    draw = rng.random()
    if draw < special:
        return Look("plain", palette(rng, "grey"), material=Material.MIRROR, gloss=1.0, macro=0.0)
    if draw < 2 * special:
        return Look("plain", palette(rng, "painted"), material=Material.GLASS, gloss=1.0, macro=0.0)
    gloss = rng.uniform(0.45, 0.95) if draw < 0.3 else rng.uniform(0, 0.2)
    family = pick(rng, "vivid", "any", "any", "painted", "grey", "white", "wood", "dark")
    fit = layer in ("label_a", "label_b", "poster_a", "poster_b", "document")
    tile = (size, size) if fit else (TILE_M[layer] * rng.uniform(0.3, 1.0),) * 2
    return Look(
        layer,
        palette(rng, family),
        tile,
        Material.GLOSSY if gloss > 0.45 else Material.DIFFUSE,
        gloss,
        0.15,
        origin=(0.5, 0.5) if fit else None,
    )
