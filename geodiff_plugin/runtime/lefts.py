"""Left images of a guided call: checked as right images are, and made readable for the stock pipeline.

Data flow: ``image`` as the user gave it -> the same object, or what the stock call reads as it is meant.
Paper: none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from PIL import Image

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats import as_image_01

__all__ = ["check_lefts"]

#: Modes of PIL images that ``MarigoldImageProcessor`` reads; a palette's indices it takes for grey values.
STOCK_MODES = ("L", "RGB", "I;16")
STOCK_TYPES = (np.uint8, np.uint16, np.float16, np.float32, np.float64)


def check_lefts(image: Any) -> tuple[Any, int]:
    """Check left images as ``GeometryGuidance`` checks right ones, before anything is computed.

    Args:
        image: PIL image, numpy ``(H, W, C)``, ``(H, W)`` or ``(N, H, W, C)``, torch ``(C, H, W)``, ``(H, W)``
            or ``(N, C, H, W)``, or a list of them.

    Returns:
        The same object if the stock call reads it as it is meant, so that guidance changes nothing of what
        the prior sees; else (alpha, a palette, CMYK, a little overshoot) a ``(3, H, W)`` tensor in [0, 1], or
        a list of them. And the number of images.

    Raises:
        TypeError, ValueError: as ``as_image_01``, naming ``image`` or ``image[i]``; no image, or of several
            sizes.
    """
    named = _named(image, "image")
    if not named:
        bad_value("image", "an image or a list of images", "an empty one")
    read = [as_image_01(entry, name) for name, entry in named]
    size = read[0].shape
    for (name, _), own in zip(named, read, strict=True):
        if own.shape != size:
            expected = f"of {size[2]}x{size[1]} pixels, as {named[0][0]}"
            bad_value(name, expected, f"{own.shape[2]}x{own.shape[1]}", "Call once for every size.")
    # The stock check of sizes compares the last two axes, which of arrays may be columns and channels.
    kinds = {entry.ndim if isinstance(entry, np.ndarray) else 0 for _, entry in named}
    if len(kinds) == 1 and all(_stock_reads(entry) for _, entry in named):
        return image, len(named)
    return read if isinstance(image, list) or len(named) > 1 else read[0], len(named)


def _named(image: Any, name: str) -> list[tuple[str, Any]]:
    """Every single image with its name in messages; of a batch with its index."""
    several = isinstance(image, list)
    if isinstance(image, (np.ndarray, torch.Tensor)):
        several = image.ndim == 4
        image = image[None] if isinstance(image, torch.Tensor) and image.ndim == 2 else image
    if not several:
        return [(name, image)]
    return [pair for i, entry in enumerate(image) for pair in _named(entry, f"{name}[{i}]")]


def _stock_reads(image: Image.Image | np.ndarray | torch.Tensor) -> bool:
    """Whether the stock call reads a good image as ``as_image_01`` does."""
    if isinstance(image, Image.Image):
        return image.mode in STOCK_MODES
    if isinstance(image, torch.Tensor):
        if image.shape[0] == 4:
            return False
        return image.dtype == torch.uint8 or (image.is_floating_point() and _in_unit_range(image))
    if image.dtype not in STOCK_TYPES or (image.ndim == 3 and image.shape[-1] == 4):
        return False
    # torch takes no array that was flipped; integers are copied before.
    return image.dtype.kind == "u" or (min(image.strides) >= 0 and _in_unit_range(image))


def _in_unit_range(image: np.ndarray | torch.Tensor) -> bool:
    return bool(image.min() >= 0.0 and image.max() <= 1.0)
