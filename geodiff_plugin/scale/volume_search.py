"""Search for the scale of a relative map, by lookup in a plane-sweep volume (S7.3).

The paper's search over one number, x = g_s x_rel, prefers depths at which every pixel leaves the right image.
A joint search for (near, far) on pixels that stay in view does not (docs/reference/paper-map.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.matching import CostVolume
from geodiff_plugin.scale.space import SPACES, DepthRange

#: Cost beyond which a pixel is an outlier: occluded, a reflection, or wrong in the prior.
COST_CLAMP = 0.35
#: Pixels of the search; number of groups of similar value that stand for them, at most.
SAMPLES, GROUPS = 6000, 512
#: Values of near, and of far, in the coarse grid, and in each of the two finer ones.
COARSE_GRID, FINE_GRID = 48, 13
#: The current state stays if its cost is this close to the best: a new one restarts scale and shift.
KEEP_MARGIN = 2e-3
#: Least share of the pixels that must stay in view of a rectified pair, and of a posed pair: at the true
#: depth some posed pairs share only .3 of them.
IN_VIEW_RECTIFIED, IN_VIEW_POSED = 0.6, 0.25


def group_pixels(x: Tensor, cost: Tensor, in_view: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Values ``x (P,)``, with ``cost`` and ``in_view (D, P)``, sorted and put into ``K`` groups of one size.

    A candidate is then tested by ``K`` lookups. Returns the mean value and the number of pixels of every
    group, ``(K,)``; on each plane how many of them a right view sees, and their clamped costs, ``(D, K)``.
    """
    order, each = x.argsort(), -(-len(x) // GROUPS)

    def summed(values: Tensor) -> Tensor:
        return F.pad(values[..., order], (0, -len(x) % each)).unflatten(-1, (-1, each)).sum(-1)

    seen, size = in_view.to(cost), summed(torch.ones_like(x))
    return summed(x) / size, size, summed(seen), summed(cost.clamp_max(COST_CLAMP) * seen)


def _lookup(
    size: Tensor, in_view: Tensor, cost: Tensor, inverse_depth: Tensor, depth_m: Tensor
) -> tuple[Tensor, Tensor]:
    """Mean clamped cost and share in view ``(M,)`` of candidate depths ``(M, K)``, linear between planes.

    ``size (K,)``, ``in_view`` and ``cost (D, K)`` are those of ``group_pixels``.
    """
    planes = inverse_depth.shape[0]
    step = (inverse_depth[-1] - inverse_depth[0]) / (planes - 1)
    position = (1.0 / depth_m - inverse_depth[0]) / step
    inside = (position >= 0) & (position <= planes - 1)
    # NaN cannot be an index; ``algorithm.gradients.FiniteWatch`` reports its origin after the loop.
    position = position.clamp(0, planes - 1).nan_to_num(0.0)
    below = position.floor().clamp_max(planes - 2).long()
    weight = position - below

    def between(table: Tensor) -> Tensor:
        return torch.lerp(table.gather(0, below), table.gather(0, below + 1), weight)

    # Beyond the nearest plane the cost is unknown: it counts as an outlier, not as out of view.
    summed = torch.where(inside, between(cost), COST_CLAMP * size).sum(1)
    count = torch.where(inside, between(in_view), size).sum(1)
    return summed / count.clamp_min(1.0), count / size.sum()


@torch.no_grad()
def search_scale(
    volume: CostVolume,
    x: Tensor,
    space: str,
    *,
    depth_range: tuple[float, float] | None = None,
    current: DepthRange | None = None,
    valid: Tensor | None = None,
) -> DepthRange:
    """Depths of the two ends of relative maps that the two views agree on best, ``(B,)`` metres each.

    1128 pairs (near, far), log-spaced, then two finer grids around the best. With them comes whether the best
    pair touches the far end of the range, or the near end of a given range.

    Args:
        volume: plane-sweep costs of the image.
        x: ``(B, 1, h, w)`` relative maps of that image, about [0, 1], >= 0.
        space: what ``x`` is affine in, key of ``SPACES``.
        depth_range: metres, bounds of the search; by default ``volume.reach_m``.
        current: the range in use, kept unless a better basin shows up.
        valid: ``(1, 1, H, W)`` bool, the pixels of the maps that count; ``None`` for all.

    Source: S7.3. Deviation: two numbers instead of one, clamped census cost instead of L_geo.
    """
    low, high = volume.reach_m if depth_range is None else depth_range
    height, width = volume.size
    stride = max(1, round((height * width / SAMPLES) ** 0.5))
    rows, columns = (torch.arange(stride // 2, side, stride, device=x.device) for side in volume.size)
    at = (rows[:, None] * width + columns[None]).flatten()
    if valid is not None:
        inside = F.interpolate(valid.float(), (height, width), mode="nearest-exact").flatten()[at] > 0
        at = at[inside] if bool(inside.any()) else at
    cost, in_view = volume.at_pixels(at)
    least = IN_VIEW_RECTIFIED if volume.rectified else IN_VIEW_POSED
    values = F.interpolate(x.float(), (height, width), mode="bilinear", align_corners=False).flatten(1)[:, at]

    def best_of(
        groups: tuple[Tensor, Tensor, Tensor, Tensor], near: Tensor, far: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The best of candidate ends ``(M,)`` for the values of one map, and its cost, ``(1,)`` each."""
        mean_x, size, seen, costs = groups
        depth = SPACES[space].depth_at(mean_x[None], near[:, None], far[:, None])
        mean, share = _lookup(size, seen, costs, volume.inverse_depth, depth)
        mean = mean + (share < least) * 1.0  # so one of these wins only if no pair keeps enough in view
        k = mean.argmin(keepdim=True)  # a 0-d index would be read back from the device
        return near[k], far[k], mean[k]

    results = []
    for b, row in enumerate(values):
        groups = group_pixels(row, cost, in_view)
        near, far, mean = _coarse_to_fine(partial(best_of, groups), low, high, row)
        if current is not None:
            a, c = (v[b : b + 1] for v in current[:2])
            now = best_of(groups, torch.minimum(a, c), torch.maximum(a, c))
            kept = now[2] <= mean + KEEP_MARGIN
            near, far, mean = (
                torch.where(kept, old, new) for old, new in zip(now, (near, far, mean), strict=True)
            )
        # The volume's near end lies nearer than any match, so only a given range can cut the scene off.
        on_edge = (far >= high * 0.98) | ((near <= low * 1.02) & (depth_range is not None))
        results.append((near, far, on_edge))
    return DepthRange(*(torch.cat(column) for column in zip(*results, strict=True)))


def _coarse_to_fine(
    best_of: Callable[..., tuple[Tensor, Tensor, Tensor]], low: float, high: float, like: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Near and far in [low, high], and their cost, ``(1,)`` each: a coarse grid, then two finer ones."""
    grid = torch.linspace(0, 1, COARSE_GRID, dtype=like.dtype, device=like.device)
    log_low, log_span = math.log(low), math.log(high / low)
    i, j = torch.triu_indices(COARSE_GRID, COARSE_GRID, 1, device=like.device)
    offsets = torch.linspace(-1, 1, FINE_GRID, dtype=like.dtype, device=like.device)
    ends = (torch.exp(log_low + log_span * grid[k]) for k in (i, j))
    near, far, mean = best_of(*ends)
    reach = log_span / (COARSE_GRID - 1)
    for _ in range(2):
        n = near.log() + reach * offsets.repeat_interleave(FINE_GRID)
        f = far.log() + reach * offsets.repeat(FINE_GRID)
        n, f = n.exp().clamp(low, high), f.exp().clamp(low, high)
        near, far, mean = best_of(torch.minimum(n, f), torch.maximum(n, f))
        reach = reach / (FINE_GRID - 1) * 2
    return near, far, mean
