"""Plane sweep (S7.3): cost of each inverse depth at each pixel, for any pose and any number of views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import use_kernel
from geodiff_plugin.geometry import image_size, is_rectified
from geodiff_plugin.matching.aggregation import empty_volume
from geodiff_plugin.matching.alignment import AlignedView, ComparedView, align_view
from geodiff_plugin.matching.census import COST_LEVELS, MARGIN_PX, census, grey_levels
from geodiff_plugin.matching.planes import LEAST_SHIFT_PX, Parallax, parallax_of
from geodiff_plugin.matching.winner import UNSEEN_LEVEL
from geodiff_plugin.types import PosedViews


@dataclass(frozen=True)
class CostVolume:
    """Costs of fronto-parallel planes in the left view, uniform in inverse depth.

    A cost is the mean census difference to the right views that see the pixel, 0 to ``COST_LEVELS``, and
    ``UNSEEN_LEVEL`` where none does.
    """

    levels: Tensor  # (D, H, W) uint8
    in_view: Tensor  # (D, H, W) bool, at least one right view sees the pixel on this plane
    inverse_depth: Tensor  # (D,) float32, 1/m, ascending and evenly spaced; on the CPU, as every camera here
    left_01: Tensor  # (1, H, W) grey left image on this grid
    aligned: tuple[AlignedView, ...]  # the right ones, turned parallel to it
    parallax: tuple[Parallax, ...]  # of each right view, on this grid
    rectified: bool  # whether every right view is rectified with the left one

    def at_pixels(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """``cost (D, P)`` in [0, 1] and ``in_view (D, P)`` bool of pixels ``(P,)``: ``row * W + column``."""
        row, column = index // self.size[1], index % self.size[1]
        return self.levels[:, row, column].float() / COST_LEVELS, self.in_view[:, row, column]

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the grid."""
        return self.levels.shape[1], self.levels.shape[2]

    @cached_property
    def plane_step(self) -> Tensor:
        """``()`` float32, 1/m between neighbouring planes."""
        return self.inverse_depth[1] - self.inverse_depth[0]

    @cached_property
    def reach_m(self) -> tuple[float, float]:
        """Metres of the nearest plane, and of a shift of 0.3 px, beyond which depth cannot be measured."""
        farthest = max(1.0 / view.inverse_depth_at(LEAST_SHIFT_PX) for view in self.parallax)
        return 1.0 / float(self.inverse_depth[-1]), farthest


@torch.no_grad()
def sweep_planes(
    posed: PosedViews, inverse_depth: Tensor, parallax: tuple[Parallax, ...] | None = None
) -> CostVolume:
    """Compare the left view with the right views, all grey in [0, 1], on every plane.

    Images keep their resolution; the right ones should have about as many pixels per radian. A cost is the
    mean over the views that see the pixel. ``inverse_depth (D,)`` 1/m is ascending and even, D >= 2. The
    reference computes planes one by one, so that memory is that of the result, two bytes per pixel and plane.
    ``parallax`` is ``parallax_of`` these views, where it is known already.
    """
    planes, K = inverse_depth.cpu(), posed.K_left.cpu()
    aligned = tuple(align_view(view, K, posed.size, planes) for view in posed.views)
    left = grey_levels(F.pad(posed.left_01[None], (MARGIN_PX,) * 4, mode="replicate")[0, 0])
    compare = _all_planes if use_kernel(left) else _plane_by_plane
    levels, in_view = compare(left, aligned)
    rectified = all(bool(is_rectified(K, view.K, view.T_right_from_left)) for view in posed.views)
    parallax = parallax or parallax_of(posed)
    return CostVolume(levels, in_view, planes, posed.left_01, aligned, parallax, rectified)


def _plane_by_plane(left: Tensor, views: Sequence[AlignedView]) -> tuple[Tensor, Tensor]:
    """``CostVolume.levels`` and ``CostVolume.in_view`` of ``grey_levels`` of the left view with a margin."""
    described = census(left)
    compared = [ComparedView(described, view) for view in views]
    count, size = len(views[0].scale), image_size(described)
    levels = empty_volume(count, size, torch.uint8, left.device)
    in_view = left.new_empty(levels.shape, dtype=torch.bool)
    unseen = levels.new_full((), UNSEEN_LEVEL)
    for plane in range(count):
        costs, seen = [view.cost(plane) for view in compared], [view.seen(plane) for view in compared]
        cost, in_view[plane] = (costs[0], seen[0]) if len(costs) == 1 else _mean(costs, seen)
        levels[plane] = torch.where(in_view[plane], cost, unseen)
    return levels, in_view


def _all_planes(left: Tensor, views: Sequence[AlignedView]) -> tuple[Tensor, Tensor]:
    """``_plane_by_plane`` by the kernel, all planes at once."""
    from geodiff_plugin.matching import kernels

    swept = [kernels.swept(left, view) for view in views]
    if len(swept) == 1:
        return swept[0]
    costs, seen = zip(*swept, strict=True)
    cost, in_view = _mean(costs, seen)
    return torch.where(in_view, cost, UNSEEN_LEVEL), in_view


def _mean(costs: Sequence[Tensor], seen: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Mean cost over the views that see a pixel, uint8, and whether any does."""
    total, count = (torch.zeros_like(costs[0], dtype=torch.float32) for _ in range(2))
    for cost, of_view in zip(costs, seen, strict=True):
        total += cost * of_view
        count += of_view
    return (total / count.clamp_min(1.0)).round().to(torch.uint8), count > 0
