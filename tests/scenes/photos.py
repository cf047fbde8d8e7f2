"""Photos as textures, only on request and only for training: those that scikit-image bundles.

Data flow: files of the installed scikit-image -> atlas layers; a ``Scene`` -> some surfaces re-covered.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from PIL import Image

from tests.scenes.patterns import LAYERS, TEXELS
from tests.scenes.scene import Scene

__all__ = ["PHOTOS", "cover_with_photos", "photo_layers"]

PHOTOS: tuple[str, ...] = (
    "astronaut.png",
    "brick.png",
    "camera.png",
    "chelsea.png",
    "coffee.png",
    "coins.png",
    "color.png",
    "grass.png",
    "gravel.png",
    "hubble_deep_field.jpg",
    "ihc.png",
    "moon.png",
    "page.png",
    "retina.jpg",
    "rocket.jpg",
    "text.png",
)
"""Files in ``skimage/data``. Never the ``motorcycle_*`` pair: it belongs to a benchmark."""


@lru_cache(maxsize=1)
def photo_layers() -> tuple[np.ndarray, ...]:
    """Return one atlas layer per photo, mirrored so that it tiles; linear red, green, blue and 1.

    Returns:
        ``(TEXELS, TEXELS, 4)`` float arrays in [0, 1].

    Raises:
        ImportError: scikit-image is not installed (``pip install geodiff-plugin[train]``).
    """
    from skimage import data_dir

    layers = []
    for name in PHOTOS:
        with Image.open(f"{data_dir}/{name}") as image:
            small = image.convert("RGB").resize((TEXELS // 2, TEXELS // 2), Image.Resampling.BOX)
        rgb = (np.asarray(small, dtype=np.float64) / 255) ** 2.2
        wide = np.concatenate([rgb, rgb[:, ::-1]], 1)
        full = np.concatenate([wide, wide[::-1]], 0)
        layers.append(np.concatenate([full, np.ones_like(full[..., :1])], -1))
    return tuple(layers)


def cover_with_photos(scene: Scene, rng: np.random.Generator, fraction: float) -> Scene:
    """Use photos as textures of some diffuse surfaces.

    Args:
        scene: any scene.
        rng: source of randomness.
        fraction: probability for each primitive that is neither a mirror nor a lamp.
    """
    count = scene.layer.shape[0]
    chosen = torch.from_numpy(rng.random(count) < fraction) & (scene.material <= 1) & (scene.emission <= 0)
    layer = torch.from_numpy(len(LAYERS) + rng.integers(len(PHOTOS), size=count))
    # A photo covers about the whole face of a small object and repeats every two metres on a large one.
    size = (2 * scene.half.median(1).values[:, None]).clamp(0.1, 2.0) * 2
    palette = scene.palette.clone()
    palette[:, 0] = torch.where(
        chosen[:, None], torch.from_numpy(rng.uniform(0.4, 1.2, (count, 1))).float(), palette[:, 0]
    )
    return replace(
        scene,
        layer=torch.where(chosen, layer, scene.layer),
        tile_m=torch.where(chosen[:, None], size.expand(-1, 2), scene.tile_m),
        palette=palette,
    )
