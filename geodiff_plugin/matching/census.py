"""Soft census: a description of a pixel's surroundings that exposure does not change.

Hop: grey image -> 16 comparisons a pixel; two of them -> matching cost.
Paper: none (Zabih and Woodfill 1994, "Non-parametric local transforms for computing visual correspondence").
"""

from __future__ import annotations

import torch
import torch.nn.functional as F

__all__ = ["census", "census_cost", "grey"]

# 7 x 7 window, every second offset.
_OFFSETS = [(row, column) for row in (-3, -1, 1, 3) for column in (-3, -1, 1, 3)]
# A difference in brightness of this counts as certain; below it the vote is proportional, so that noise on
# flat surfaces hardly votes.
_CONTRAST = 6.0 / 255.0


def grey(image_01: torch.Tensor) -> torch.Tensor:
    """Luma of an image.

    Args:
        image_01: ``(3, H, W)`` or already ``(1, H, W)``, float in [0, 1].

    Returns:
        ``(1, H, W)`` float32 in [0, 1].
    """
    image_01 = image_01.float()
    if image_01.shape[0] == 1:
        return image_01
    return (image_01 * image_01.new_tensor([0.299, 0.587, 0.114])[:, None, None]).sum(dim=0, keepdim=True)


def _padded(images: torch.Tensor) -> torch.Tensor:
    """``(N, H + 6, W + 6)``, edges repeated, in units of the contrast that counts as certain."""
    return F.pad(images[:, None], (3, 3, 3, 3), mode="replicate")[:, 0] * (1.0 / _CONTRAST)


def census(images: torch.Tensor) -> torch.Tensor:
    """How the 16 neighbours of every pixel compare with it.

    Args:
        images: ``(N, H, W)`` float grey in [0, 1].

    Returns:
        ``(N, 16, H, W)`` in [-1, 1]; unchanged by an offset in brightness, nearly so by a gain.
    """
    height, width = images.shape[-2:]
    padded = _padded(images)
    centre = padded[:, 3 : 3 + height, 3 : 3 + width]
    bits = images.new_empty(images.shape[0], len(_OFFSETS), height, width)
    for i, (row, column) in enumerate(_OFFSETS):
        other = padded[:, 3 + row : 3 + row + height, 3 + column : 3 + column + width]
        torch.sub(other, centre, out=bits[:, i])
    return bits.clamp_(-1.0, 1.0)


def census_cost(bits: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
    """Mean difference between one census and that of many images, without holding theirs in memory.

    Args:
        bits: ``(16, H, W)``, one image's ``census``.
        images: ``(N, H, W)`` float grey in [0, 1], of the same size.

    Returns:
        ``(N, H, W)`` in [0, 1]; about 0.35 for unrelated natural texture, 0.5 for unrelated noise.
    """
    height, width = images.shape[-2:]
    padded = _padded(images)
    centre = padded[:, 3 : 3 + height, 3 : 3 + width]
    cost, bit = torch.zeros_like(images), torch.empty_like(images)
    for i, (row, column) in enumerate(_OFFSETS):
        other = padded[:, 3 + row : 3 + row + height, 3 + column : 3 + column + width]
        torch.sub(other, centre, out=bit)
        cost += bit.clamp_(-1.0, 1.0).sub_(bits[i]).abs_()
    return cost.mul_(0.5 / len(_OFFSETS))
