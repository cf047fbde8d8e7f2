"""Finds the winner of every pixel, the plane of minimum aggregated cost, and its evidence."""

from __future__ import annotations

import torch
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.constants import NEIGHBOUR_PLANES, NEVER, PACKED_PLANES, UNSEEN_LEVEL
from geodiff_plugin.matching.volume import Winner


def _neighbourhood(total: Tensor) -> tuple[Tensor, Tensor]:
    """Return the plane of minimum sum ``(H, W)``, and the planes below and above it ``(3, H, W)``."""
    keys = torch.full_like(total[0], NEVER, dtype=torch.int32).mul_(PACKED_PLANES)
    plane_keys = torch.empty_like(keys)
    for plane in range(len(total)):
        torch.minimum(keys, plane_keys.copy_(total[plane]).mul_(PACKED_PLANES).add_(plane), out=keys)
    index = (keys % PACKED_PLANES).long()
    steps = torch.arange(-1, 2, device=index.device)[:, None, None]
    return index, (index + steps).clamp_(0, len(total) - 1)


def _position(index: Tensor, sums: Tensor, last: int) -> Tensor:
    """Compute the subplane position ``(H, W)`` from the sums ``(3, H, W)`` of ``_neighbourhood``."""
    below, best, above = sums
    offset = 0.5 * (below - above) / (below + above - 2.0 * best)  # at most half a plane
    inner = (index > 0) & (index < last)
    return index + torch.where(inner, offset, 0.0)


@has_kernel("matching.kernels.winner.winner_positions")
def winner_positions(total: Tensor) -> Tensor:
    """Compute only ``Winner.position`` from path sums ``(D, H, W)``."""
    index, around = _neighbourhood(total)
    return _position(index, total.gather(0, around).float(), len(total) - 1)


@has_kernel("matching.kernels.winner.winner")
def winner(total: Tensor, levels: Tensor, in_view: Tensor) -> Winner:
    """Find the winners of path sums ``(D, H, W)`` int16, which are overwritten.

    ``levels`` and ``in_view`` are the costs before aggregation and their visibility.
    """
    index, around = _neighbourhood(total)
    sums = total.gather(0, around).float()
    second_best = total.scatter_(0, around, NEVER).amin(dim=0).float()
    position = _position(index, sums, len(total) - 1)
    gain = _gain(index, levels, in_view)
    sharpness = _sharpness(index, levels)
    return Winner(position, sums[1], second_best, gain, sharpness)


def _gain(index: Tensor, levels: Tensor, in_view: Tensor) -> Tensor:
    total, seen = (torch.zeros_like(index, dtype=torch.int32) for _ in range(2))
    for of_plane, seen_on_plane in zip(levels, in_view, strict=True):
        total += of_plane
        seen += seen_on_plane
    mean = (total - UNSEEN_LEVEL * (len(levels) - seen)).float() / seen.clamp_min(1)
    return (mean - levels.gather(0, index[None])[0]).clamp_min(0.0) / COST_LEVELS


def _sharpness(index: Tensor, levels: Tensor) -> Tensor:
    steps = torch.tensor([0, -NEIGHBOUR_PLANES, NEIGHBOUR_PLANES], device=index.device)[:, None, None]
    own, below, above = levels.gather(0, (index + steps).clamp_(0, len(levels) - 1)).float()
    return (below + above - 2.0 * own) / (2 * COST_LEVELS)
