"""Soft census transform (Zabih and Woodfill 1994): an exposure-invariant descriptor in small integers."""

from __future__ import annotations

import torch
from torch import Tensor

from geodiff_plugin.geometry import constant_like

#: Half the window: the margin that an image needs around the pixels whose census is taken.
MARGIN_PX = 3
#: Neighbours along a side of the window: every second one of 7.
SIDE = 4
# A difference of this counts as certain; a smaller one in proportion, so that noise hardly votes.
_CONTRAST = 6.0 / 255.0
#: A certain vote; the largest for which a cost still fits into a byte.
VOTE_LEVELS = 7
#: The cost of two descriptors that differ in everything: 224.
COST_LEVELS = 2 * VOTE_LEVELS * SIDE * SIDE
#: Levels of ``grey_levels`` from black to white.
GREY_LEVELS = VOTE_LEVELS / _CONTRAST
# Weights of red, green and blue (ITU-R BT.601).
_LUMA = 0.299, 0.587, 0.114


def grey(image_01: Tensor) -> Tensor:
    """Luma ``(..., 1, H, W)`` float32 in [0, 1] of images ``(..., 3, H, W)``, or of what is grey already."""
    image_01 = image_01.float()
    if image_01.shape[-3] == 1:
        return image_01
    return (image_01 * constant_like(image_01, *_LUMA)[:, None, None]).sum(dim=-3, keepdim=True)


def grey_levels(grey_01: Tensor) -> Tensor:
    """Grey in [0, 1] as int16 levels, of which ``VOTE_LEVELS`` count as a certain difference.

    About 1.2 of them are an 8-bit level.
    """
    return (grey_01 * GREY_LEVELS).round().to(torch.int16)


def census(levels: Tensor, out: Tensor | None = None) -> Tensor:
    """How the 16 neighbours of every pixel compare with it, ``(16, H, W)`` int16 up to ``VOTE_LEVELS``.

    ``levels (H + 6, W + 6)``, contiguous, of ``grey_levels``, have a margin of ``MARGIN_PX`` all around. The
    result is unchanged by an offset in brightness, nearly so by a gain; it is written to ``out``.
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
    """Difference ``(H, W)`` uint8, 0 to ``COST_LEVELS``, between two results ``(16, H, W)`` of ``census``.

    Both are int8 or int16. About 0.35 of the largest for unrelated natural texture, 0.5 for noise. ``out``,
    of the same shape and type, is worked in; it may be ``left``.
    """
    apart = torch.sub(left, right, out=out).abs_()
    if apart.dtype == torch.int8:
        return apart.view(torch.uint8).sum(dim=0, dtype=torch.uint8)
    return apart.sum(dim=0, dtype=torch.int16).to(torch.uint8)
