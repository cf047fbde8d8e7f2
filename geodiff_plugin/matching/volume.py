"""Cost volumes, their buffers and their winners: records shared by several stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from geodiff_plugin.matching.alignment import AlignedView
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.planes import MIN_SHIFT_PX, Parallax


@dataclass(frozen=True)
class CostVolume:
    """Costs of fronto-parallel planes in the left view, uniform in inverse depth.

    A cost is the mean census difference to the right views that see the pixel, 0 to ``COST_LEVELS``; it is
    ``UNSEEN_LEVEL`` where no view does.
    """

    levels: Tensor  # (D, H, W) uint8
    in_view: Tensor  # (D, H, W) bool, whether a right view sees the pixel on this plane
    inverse_depth: Tensor  # (D,) float32, 1/m, ascending, evenly spaced, on the CPU like the cameras
    left_01: Tensor  # (1, H, W) grey left image on this grid
    aligned: tuple[AlignedView, ...]  # right views, rotated parallel to the left one
    parallax: tuple[Parallax, ...]  # of each right view, on this grid
    rectified: bool  # whether every right view is rectified with the left one
    valid: Tensor | None = None  # (H, W) bool, pixels of the left image that have costs; None for all

    def at_pixels(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``cost (D, P)`` in [0, 1] and ``in_view (D, P)`` of pixels ``row * W + column (P,)``."""
        row, column = index // self.size[1], index % self.size[1]
        return self.levels[:, row, column].float() / COST_LEVELS, self.in_view[:, row, column]

    def cost_at(self, inverse_depth: Tensor) -> tuple[Tensor, Tensor]:
        """Return the lower cost in [0, 1] of the two planes around ``inverse_depth (1, H, W)``, 1/m.

        The second map states whether a right view sees the pixel on both planes.
        """
        position = (inverse_depth - float(self.inverse_depth[0])) / float(self.plane_step)
        below = position.floor().long().clamp(0, len(self.levels) - 2)
        planes = torch.cat([below, below + 1])
        cost = self.levels.gather(0, planes).amin(0, keepdim=True) / COST_LEVELS
        return cost, self.in_view.gather(0, planes).all(0, keepdim=True)

    @property
    def guide(self) -> Tensor:
        """``(H, W)`` of ``left_01`` for the paths of the aggregation, NaN where a pixel is not valid."""
        grey = self.left_01[0]
        return grey if self.valid is None else torch.where(self.valid, grey, torch.nan)

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the grid."""
        return self.levels.shape[1], self.levels.shape[2]

    @cached_property
    def plane_step(self) -> Tensor:
        """Spacing of the planes, ``()`` float32, 1/m."""
        return self.inverse_depth[1] - self.inverse_depth[0]

    @cached_property
    def reach_m(self) -> tuple[float, float]:
        """Depths in metres of the nearest plane, and of a shift of 0.3 px, the limit of measurable depth."""
        farthest = max(1.0 / view.inverse_depth_at(MIN_SHIFT_PX) for view in self.parallax)
        return 1.0 / float(self.inverse_depth[-1]), farthest


def empty_volume(planes: int, size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Allocate ``(planes, N, M)`` for ``size = (N, M)``, uninitialised, laid out for vertical paths."""
    return torch.empty(size[0], planes, size[1], dtype=dtype, device=device).transpose(0, 1)


class Buffers:
    """Buffers reused between aggregations: allocating new memory costs as much as one path."""

    def __init__(self) -> None:
        self._held: dict[str, Tensor] = {}

    def empty(self, name: str, planes: int, size: tuple[int, int], like: Tensor) -> Tensor:
        """Return ``empty_volume`` in the buffer of this name, whose previous content is lost."""
        count = planes * size[0] * size[1]
        held = self._held.get(name)
        if held is None or held.numel() < count:
            held = self._held[name] = torch.empty(count, dtype=like.dtype, device=like.device)
        return held[:count].view(size[0], planes, size[1]).transpose(0, 1)


def mean_cost(costs: Sequence[Tensor], seen: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Average costs over the views that see a pixel, uint8; also returns whether any does."""
    total, count = (torch.zeros_like(costs[0], dtype=torch.float32) for _ in range(2))
    for cost, of_view in zip(costs, seen, strict=True):
        total += cost * of_view
        count += of_view
    return (total / count.clamp_min(1.0)).round().to(torch.uint8), count > 0


@dataclass(frozen=True)
class Winner:
    """The plane with the minimum sum at every pixel, and its evidence; each ``(H, W)`` float32."""

    position: Tensor  # in planes from 0, between planes by a parabola through three sums
    best: Tensor  # its sum over the paths
    second_best: Tensor  # second-best cost: minimum sum of a non-neighbouring plane, or ``NEVER``
    gain: Tensor  # mean cost of the visible planes minus its cost, relative to the maximum cost
    sharpness: Tensor  # the same for planes ``NEIGHBOUR_PLANES`` away; may be negative
