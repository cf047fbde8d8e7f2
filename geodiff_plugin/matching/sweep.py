"""Plane sweep (S7.3): computes the cost of each inverse depth at each pixel, for any pose and view count."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin.cameras import PosedViews, eroded, is_rectified
from geodiff_plugin.geometry import image_size
from geodiff_plugin.matching.alignment import AlignedView, ComparedView, align_view
from geodiff_plugin.matching.census import MARGIN_PX, census, grey_levels
from geodiff_plugin.matching.constants import UNSEEN_LEVEL
from geodiff_plugin.matching.planes import Parallax, parallax_of
from geodiff_plugin.matching.volume import CostVolume, empty_volume, mean_cost


@torch.no_grad()
def sweep_planes(
    posed: PosedViews, inverse_depth: Tensor, parallax: tuple[Parallax, ...] | None = None
) -> CostVolume:
    """Compare the left view with the right views, all grey in [0, 1], on every plane.

    Images keep their resolution; right ones should have similar pixels per radian. A cost is the mean over
    the views that see the pixel; a census window that contains an invalid pixel has no cost.
    ``inverse_depth (D,)`` 1/m is ascending and evenly spaced, D >= 2. The reference computes planes one by
    one, so that it needs no more memory than the result: two bytes per pixel and plane. ``parallax`` is
    ``parallax_of`` for these views, if already known.
    """
    planes = inverse_depth.cpu()
    camera = posed.left.camera
    aligned = tuple(align_view(view, camera, planes) for view in posed.rights)
    left = grey_levels(F.pad(posed.left.image_01[None], (MARGIN_PX,) * 4, mode="replicate")[0, 0])
    levels, in_view = _sweep(left, aligned)
    valid = None if posed.left.valid is None else eroded(posed.left.valid, MARGIN_PX)
    if valid is not None:
        levels.masked_fill_(~valid, UNSEEN_LEVEL)
        in_view.logical_and_(valid)
    rectified = all(is_rectified(camera, view.camera, view.T_right_from_left) for view in posed.rights)
    parallax = parallax or parallax_of(posed)
    return CostVolume(levels, in_view, planes, posed.left.image_01, aligned, parallax, rectified, valid)


@has_kernel("matching.kernels.sweep.sweep")
def _sweep(left: Tensor, views: Sequence[AlignedView]) -> tuple[Tensor, Tensor]:
    """Compute ``CostVolume.levels`` and ``in_view`` from the left view's ``grey_levels`` with a margin."""
    described = census(left)
    compared = [ComparedView(described, view) for view in views]
    count = len(views[0].scale)
    size = image_size(described)
    levels = empty_volume(count, size, torch.uint8, left.device)
    in_view = left.new_empty(levels.shape, dtype=torch.bool)
    unseen = levels.new_full((), UNSEEN_LEVEL)
    for plane in range(count):
        costs, seen = [view.cost(plane) for view in compared], [view.seen(plane) for view in compared]
        cost, in_view[plane] = (costs[0], seen[0]) if len(costs) == 1 else mean_cost(costs, seen)
        levels[plane] = torch.where(in_view[plane], cost, unseen)
    return levels, in_view
