"""Texture atlas: procedural layers baked once, sampled on the hit with a mip level that the distance sets.

Data flow: surface coordinates in metres + a primitive's layer and palette
    -> albedo, gloss and shade per pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from tests.scenes.patterns import LAYERS, TEXELS, bake_layer

__all__ = ["Atlas", "atlas", "sample_atlas"]


@dataclass(frozen=True)
class Atlas:
    """All layers and mip levels in one flat table.

    Attributes:
        texels: ``(M, 4)`` float32: tone between colours A and B, accent, gloss, shade; or r, g, b, 1.
        level_start: ``(levels,)`` int64, first row of each mip level.
        levels: number of mip levels; level ``k`` has ``TEXELS >> k`` texels a side.
        photo_from: index of the first layer with a photo.
        images: whether there are photos.
    """

    texels: torch.Tensor
    level_start: torch.Tensor
    levels: int
    photo_from: int
    images: bool


def _pyramid(base: np.ndarray) -> list[np.ndarray]:
    out = [base]
    while out[-1].shape[1] > 4:
        x = out[-1]
        out.append((x[:, 0::2, 0::2] + x[:, 1::2, 0::2] + x[:, 0::2, 1::2] + x[:, 1::2, 1::2]) / 4)
    return out


@lru_cache(maxsize=4)
def atlas(device: str = "cpu", images: bool = False) -> Atlas:
    """The baked atlas, made on the CPU and cached per device.

    Args:
        device: where the table lives.
        images: append the photos that scikit-image bundles (training only).
    """
    layers = [bake_layer(name, i) for i, name in enumerate(LAYERS)]
    if images:
        from tests.scenes.photos import photo_layers

        layers += list(photo_layers())
    levels = _pyramid(np.stack(layers).astype(np.float32))
    flat = np.concatenate([x.reshape(-1, 4) for x in levels])
    start = np.cumsum([0] + [x.shape[0] * x.shape[1] * x.shape[2] for x in levels[:-1]])
    rows, starts = torch.from_numpy(flat).to(device), torch.from_numpy(start).to(device)
    return Atlas(rows, starts, len(levels), len(LAYERS), images)


def sample_atlas(
    table: Atlas, layer: torch.Tensor, uv: torch.Tensor, footprint: torch.Tensor
) -> torch.Tensor:
    """Bilinear lookup at the nearest mip level, wrapping around.

    Args:
        table: the atlas.
        layer: ``(n,)`` int64.
        uv: ``(2, n)`` float, in tiles.
        footprint: ``(n,)`` width of the pixel on the surface, in tiles.

    Returns:
        ``(n, 4)`` float32 channels.
    """
    level = (footprint * TEXELS).clamp_min(1e-6).log2_().add_(0.25).round_().clamp_(0, table.levels - 1)
    side_f = torch.exp2(math.log2(TEXELS) - level)
    level, side = level.long(), side_f.long()
    xy = (uv - uv.floor()) * side_f - 0.5
    low = xy.floor()
    frac = xy - low
    x0, y0 = low.long().remainder(side)
    x1, y1 = (x0 + 1).remainder(side), (y0 + 1).remainder(side)
    base = table.level_start[level] + layer * side * side
    row0, row1 = base + y0 * side, base + y1 * side
    fx, fy = frac[0, :, None], frac[1, :, None]
    t = table.texels
    top = torch.lerp(t.index_select(0, row0 + x0), t.index_select(0, row0 + x1), fx)
    bottom = torch.lerp(t.index_select(0, row1 + x0), t.index_select(0, row1 + x1), fx)
    return torch.lerp(top, bottom, fy)
