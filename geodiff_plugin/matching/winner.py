"""The winner of every pixel, the plane of least aggregated cost, and the evidence for it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from geodiff_plugin.matching.census import COST_LEVELS

#: Above any sum over the paths; marks a plane that must not win.
NEVER = 20_000
#: Cost where no right view sees the pixel on a plane: that of unrelated texture, neither good nor bad.
UNSEEN_LEVEL = 78
#: Packs a sum over the paths and its plane into one integer, so that one minimum finds both.
PACKED_PLANES = 1 << 12
#: Planes to both sides of the winner whose costs say how sharp it is: beyond the width of a textured minimum.
BESIDE_PLANES = 4


@dataclass(frozen=True)
class Winner:
    """The plane of least sum at every pixel, and the evidence for it; each ``(H, W)`` float32."""

    position: Tensor  # in planes from 0, between two planes where a parabola through three sums says so
    best: Tensor  # its sum over the paths
    runner_up: Tensor  # the least sum of a plane that is not its neighbour; ``NEVER`` where there is none
    gain: Tensor  # how far its cost is below the mean of the planes that are seen, as a share of the largest
    sharpness: Tensor  # the same below the mean of the planes ``BESIDE_PLANES`` away; may be negative


def _around(total: Tensor) -> tuple[Tensor, Tensor]:
    """The plane of least sum ``(H, W)``, and with it the planes below and above ``(3, H, W)``."""
    keys = torch.full_like(total[0], NEVER, dtype=torch.int32).mul_(PACKED_PLANES)
    plane_keys = torch.empty_like(keys)
    for plane in range(len(total)):
        torch.minimum(keys, plane_keys.copy_(total[plane]).mul_(PACKED_PLANES).add_(plane), out=keys)
    index = (keys % PACKED_PLANES).long()
    steps = torch.arange(-1, 2, device=index.device)[:, None, None]
    return index, (index + steps).clamp_(0, len(total) - 1)


def _position(index: Tensor, sums: Tensor, last: int) -> Tensor:
    """Between planes, ``(H, W)``, from the sums ``(3, H, W)`` of ``_around``."""
    below, best, above = sums
    offset = 0.5 * (below - above) / (below + above - 2.0 * best)  # half a plane at most, as best is least
    inner = (index > 0) & (index < last)
    return index + torch.where(inner, offset, 0.0)


def winner_positions(total: Tensor) -> Tensor:
    """``Winner.position`` alone, of sums over the paths ``(D, H, W)``."""
    index, around = _around(total)
    return _position(index, total.gather(0, around).float(), len(total) - 1)


def winner(total: Tensor, levels: Tensor, in_view: Tensor) -> Winner:
    """The winner of sums over the paths ``(D, H, W)`` int16, which it overwrites.

    ``levels`` and ``in_view`` are the costs before aggregation, and where they were seen.
    """
    index, around = _around(total)
    sums = total.gather(0, around).float()
    runner_up = total.scatter_(0, around, NEVER).amin(dim=0).float()
    position = _position(index, sums, len(total) - 1)
    gain, sharpness = _gain(index, levels, in_view), _sharpness(index, levels)
    return Winner(position, sums[1], runner_up, gain, sharpness)


def _gain(index: Tensor, levels: Tensor, in_view: Tensor) -> Tensor:
    total, seen = (torch.zeros_like(index, dtype=torch.int32) for _ in range(2))
    for of_plane, seen_on_plane in zip(levels, in_view, strict=True):
        total += of_plane
        seen += seen_on_plane
    mean = (total - UNSEEN_LEVEL * (len(levels) - seen)).float() / seen.clamp_min(1)
    return (mean - levels.gather(0, index[None])[0]).clamp_min(0.0) / COST_LEVELS


def _sharpness(index: Tensor, levels: Tensor) -> Tensor:
    steps = torch.tensor([0, -BESIDE_PLANES, BESIDE_PLANES], device=index.device)[:, None, None]
    own, below, above = levels.gather(0, (index + steps).clamp_(0, len(levels) - 1)).float()
    return (below + above - 2.0 * own) / (2 * COST_LEVELS)
