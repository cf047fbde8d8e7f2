"""Soft census transform (Zabih and Woodfill 1994): an exposure-invariant descriptor of small integers."""

from __future__ import annotations

import torch
from torch import Tensor

from geodiff_plugin.geometry import constant_like

#: Half width of the window, which is the margin that an image needs around its pixels.
MARGIN_PX = 3
#: Neighbours along a side of the window: every second of 7.
SIDE = 4
# Brightness difference of a certain vote. Smaller ones vote in proportion, so noise has little effect.
_CONTRAST = 6.0 / 255.0
#: Value of a certain vote, the largest for which a cost fits a byte.
VOTE_LEVELS = 7
#: Cost of two descriptors that differ in every neighbour: 224.
COST_LEVELS = 2 * VOTE_LEVELS * SIDE * SIDE
#: Number of ``grey_levels`` from black to white.
GREY_LEVELS = VOTE_LEVELS / _CONTRAST
# Weights of red, green and blue (ITU-R BT.601).
_LUMA = 0.299, 0.587, 0.114


def grey(image_01: Tensor) -> Tensor:
    """Convert images ``(..., 3, H, W)`` to luma ``(..., 1, H, W)`` float32 in [0, 1]; grey ones are kept."""
    image_01 = image_01.float()
    if image_01.shape[-3] == 1:
        return image_01
    return (image_01 * constant_like(image_01, *_LUMA)[:, None, None]).sum(dim=-3, keepdim=True)


def grey_levels(grey_01: Tensor) -> Tensor:
    """Convert grey in [0, 1] to int16 levels, of which ``VOTE_LEVELS`` are a certain difference.

    An 8-bit level is about 1.2 of them.
    """
    return (grey_01 * GREY_LEVELS).round().to(torch.int16)


def census(levels: Tensor, out: Tensor | None = None) -> Tensor:
    """Compare the 16 neighbours of every pixel with it: ``(16, H, W)`` int16 in +-``VOTE_LEVELS``.

    ``levels (H + 6, W + 6)``, contiguous, from ``grey_levels``, have a margin of ``MARGIN_PX`` on all sides.
    The result is invariant to a brightness offset and nearly so to a gain. It is written to ``out``.
    """
    height, width = (side - 2 * MARGIN_PX for side in levels.shape)
    stride = levels.shape[1]
    neighbours = levels.as_strided((SIDE, SIDE, height, width), (2 * stride, 2, stride, 1))
    centre = levels[MARGIN_PX : MARGIN_PX + height, MARGIN_PX : MARGIN_PX + width]
    if out is None:
        out = levels.new_empty(SIDE * SIDE, height, width)
    torch.sub(neighbours, centre, out=out.view(neighbours.shape))
    return out.clamp_(-VOTE_LEVELS, VOTE_LEVELS)


def census_cost(left: Tensor, right: Tensor, out: Tensor | None = None) -> Tensor:
    """Compute the difference ``(H, W)`` uint8, 0 to ``COST_LEVELS``, of two ``census`` ``(16, H, W)``.

    Both are int8 or int16. Unrelated natural texture gives about 0.35 of the maximum, noise 0.5. ``out``, of
    the same shape and dtype, is a work buffer; it may be ``left``.
    """
    difference = torch.sub(left, right, out=out).abs_()
    if difference.dtype == torch.int8:
        return difference.view(torch.uint8).sum(dim=0, dtype=torch.uint8)
    return difference.sum(dim=0, dtype=torch.int16).to(torch.uint8)
