"""The layers of the texture atlas: what each is, and how many metres one tile of it covers.

Data flow: a layer's name and number -> a ``(TEXELS, TEXELS, 4)`` tile that repeats without a seam.
"""

from __future__ import annotations

import numpy as np

from tests.scenes.patterns.masonry import facade, masonry, planks, road, roof, shopfront
from tests.scenes.patterns.noise import (
    TEXELS,
    Bake,
    cellular,
    checker,
    clouds,
    dots,
    fabric,
    foliage,
    marble,
    noise,
    stripes,
    wallpaper,
    wood,
)
from tests.scenes.patterns.printed import (
    books,
    cabinet,
    document,
    door,
    keyboard,
    label,
    poster,
    screen,
    window,
)

__all__ = ["LAYERS", "TEXELS", "TILE_M", "bake_layer"]


_CLASSES: dict[str, tuple[float, Bake]] = {
    # name: (metres that one tile covers, bake)
    "plain": (1.2, noise(1.4, contrast=0.35)),
    "plaster": (1.5, noise(1.1, contrast=0.5)),
    "fbm": (1.0, noise(1.6)),
    "speckle": (0.5, noise(0.2, 20, contrast=1.6)),
    "concrete": (2.5, noise(1.2, contrast=0.8, dirt=0.3)),
    "asphalt": (2.0, noise(0.6, 2, contrast=0.9)),
    "grass": (1.6, foliage(48, 1.0)),
    "soil": (2.0, noise(1.0, 1, contrast=1.2, dirt=0.5)),
    "gravel": (1.0, cellular(26, 0.35)),
    "cobbles": (1.8, cellular(12, 0.22, 0.8, 0.5)),
    "flagstones": (2.4, cellular(5, 0.06, 0.7)),
    "rock": (3.0, noise(1.3, 1, contrast=1.6, dirt=0.6)),
    "leaves": (1.3, foliage(26, 1.0)),
    "hedge": (1.0, foliage(34, 0.9)),
    "marble": (1.5, marble),
    "wood": (0.8, wood),
    "planks": (1.4, planks(10, 0.03)),
    "parquet": (1.0, planks(14, 0.02)),
    "brick": (1.0, lambda rng: masonry(rng, 4, 12, 0.025, 0.07, 0.5)),
    "blocks": (2.4, lambda rng: masonry(rng, 6, 12, 0.015, 0.03, 0.5, 0.2)),
    "ashlar": (3.0, lambda rng: masonry(rng, 4, 8, 0.015, 0.03, 0.5, 0.35, 0.1, 0.5)),
    "tiles": (1.2, lambda rng: masonry(rng, 4, 4, 0.02, 0.02, 0, 0.15, 0.9, 0.12)),
    "mosaic": (0.6, lambda rng: masonry(rng, 12, 12, 0.06, 0.06, 0, 0.5, 1.0, 0.1)),
    "paving": (2.4, lambda rng: masonry(rng, 6, 6, 0.02, 0.02, 0.5, 0.25, 0.05, 0.35)),
    "checker": (0.6, checker(2)),
    "fine_checker": (0.3, checker(8)),
    "stripes": (0.5, stripes(6, 0, 0.5)),
    "pinstripes": (0.5, stripes(0, 14, 0.2)),
    "diagonal": (0.6, stripes(4, 4, 0.5)),
    "dots": (0.4, dots),
    "fabric": (0.12, fabric(24, 0.7)),
    "carpet": (0.8, noise(0.3, 8, contrast=1.0)),
    "wallpaper": (0.9, wallpaper),
    "document": (0.25, document(34)),
    "page": (0.25, document(22)),
    "poster_a": (1.0, poster),
    "poster_b": (1.0, poster),
    "poster_c": (1.0, poster),
    "label_a": (0.2, label),
    "label_b": (0.2, label),
    "books_a": (0.9, books),
    "books_b": (0.9, books),
    "screen_a": (0.5, screen),
    "screen_b": (0.5, screen),
    "keyboard": (0.45, keyboard),
    "cabinet": (0.9, cabinet),
    "drawers": (0.6, cabinet),
    "door": (1.0, door),
    "window": (1.2, window),
    "facade_a": (12.0, lambda rng: facade(rng, 4, 4, 0.36, 0.5, True, False, 2)),
    "facade_b": (12.0, lambda rng: facade(rng, 6, 4, 0.42, 0.58, True, True, 2)),
    "facade_c": (13.0, lambda rng: facade(rng, 3, 4, 0.62, 0.45, False, True, 4)),
    "facade_d": (14.0, lambda rng: facade(rng, 8, 4, 0.86, 0.5, False, False, 1)),
    "shopfront": (9.0, shopfront),
    "road": (7.0, road),
    "roof": (3.0, roof),
    "clouds": (1.0, clouds),
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
