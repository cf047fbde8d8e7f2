"""Searches the scale of a relative map by lookup in a plane-sweep volume (S7.3).

The paper's search over one number, x = g_s x_rel, prefers depths at which every pixel leaves the right image.
A joint search for (near, far) on pixels that stay in view does not (docs/explanation/method.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin.geometry import to_device_of
from geodiff_plugin.matching import CostVolume
from geodiff_plugin.scale.constants import COARSE_GRID, COST_CLAMP, FINE_GRIDS, KEEP_MARGIN, KERNEL_FORMS
from geodiff_plugin.scale.sampling import group_size, min_in_view
from geodiff_plugin.scale.space import SPACES, DepthRange

#: Maximum number of pixels in the search; each costs one lookup.
SAMPLES = 6000
#: Fraction of the end of a range within which a depth touches it.
EDGE = 0.02


class Groups(NamedTuple):
    """Sampled pixels of a relative map in ``K`` groups of similar value, evaluated by ``K`` lookups."""

    mean: Tensor  # (K,) mean value
    size: Tensor  # (K,) number of pixels
    seen: Tensor  # (D, K) number of pixels that a right view sees, on each plane
    cost: Tensor  # (D, K) sum of their clamped costs


class _Best(NamedTuple):
    """The best candidate: both ends in metres and its mean cost, ``(1,)`` each."""

    near_m: Tensor
    far_m: Tensor
    cost: Tensor


def group_pixels(x: Tensor, cost: Tensor, in_view: Tensor) -> Groups:
    """Sort values ``x (P,)``, with ``cost`` and ``in_view (D, P)``, into groups of equal size."""
    order = x.argsort()
    pixels_per_group = group_size(len(x))
    count = math.ceil(len(x) / pixels_per_group)
    padding = count * pixels_per_group - len(x)  # only the last group is smaller

    def sum_of_groups(values: Tensor) -> Tensor:
        padded = F.pad(values[..., order], (0, padding))
        return padded.unflatten(-1, (count, pixels_per_group)).sum(-1)

    seen = in_view.to(cost)
    size = sum_of_groups(torch.ones_like(x))
    return Groups(
        mean=sum_of_groups(x) / size,
        size=size,
        seen=sum_of_groups(seen),
        cost=sum_of_groups(cost.clamp_max(COST_CLAMP) * seen),
    )


def look_up(groups: Groups, inverse_depth: Tensor, depth_m: Tensor) -> tuple[Tensor, Tensor]:
    """Look up mean clamped cost and fraction in view ``(M,)`` of candidate depths ``(M, K)``.

    ``inverse_depth (D,)`` are the planes, evenly spaced; costs are linear between planes.
    """
    planes = inverse_depth.shape[0]
    step = (inverse_depth[-1] - inverse_depth[0]) / (planes - 1)
    position = (depth_m.reciprocal() - inverse_depth[0]) / step
    inside = (position >= 0) & (position <= planes - 1)
    # NaN is not a valid index; ``algorithm.optimizers.FiniteWatch`` reports its origin after the loop.
    position = position.clamp(0, planes - 1).nan_to_num(0.0)
    below = position.floor().clamp_max(planes - 2).long()
    weight = position - below

    def between(table: Tensor) -> Tensor:
        return torch.lerp(table.gather(0, below), table.gather(0, below + 1), weight)

    # Beyond the nearest plane the cost is unknown; it counts as an outlier, not as out of view.
    summed = torch.where(inside, between(groups.cost), COST_CLAMP * groups.size).sum(1)
    count = torch.where(inside, between(groups.seen), groups.size).sum(1)
    return summed / count.clamp_min(1.0), count / groups.size.sum()


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
    """Find the depths of both ends of relative maps at which the two views agree best.

    With ``z_p`` the depth that a pair (near, far) gives pixel ``p``, ``c_p`` its cost in the volume and ``S``
    the pixels in view, the pair minimizes ``mean_{p in S} min(c_p(z_p), COST_CLAMP)`` among pairs that keep
    enough pixels in view: 1128 log-spaced pairs, then two finer grids around the best. It is on the edge if
    it touches the far end of the range, or the near end of a given range.

    Args:
        volume: plane-sweep costs of the image.
        x: ``(B, 1, h, w)`` relative maps of that image, about [0, 1], >= 0.
        space: space in which ``x`` is affine, key of ``SPACES``.
        depth_range: bounds of the search, metres; by default ``volume.reach_m``.
        current: the current range, kept unless a better basin is found.
        valid: ``(1, 1, H, W)`` bool, the pixels of the maps to use; ``None`` for all.

    Source: S7.3. Deviation: two numbers instead of one, clamped census cost instead of L_geo.
    """
    low, high = volume.reach_m if depth_range is None else depth_range
    at = _sampled(volume.size, valid, x)
    values = F.interpolate(x.float(), volume.size, mode="bilinear", align_corners=False).flatten(1)[:, at]
    in_use = None if current is None else current[:2]
    near_m, far_m = _best_range(volume, values, at, space, (low, high), in_use)
    on_edge = far_m >= high * (1 - EDGE)
    if depth_range is not None:  # the volume's near end is nearer than any match
        on_edge |= near_m <= low * (1 + EDGE)
    return DepthRange(near_m, far_m, on_edge)


@has_kernel(
    "scale.kernels.search.best_range",
    when=lambda volume, x, at, space, bounds, current: space in KERNEL_FORMS,
)
def _best_range(
    volume: CostVolume,
    x: Tensor,
    at: Tensor,
    space: str,
    bounds: tuple[float, float],
    current: tuple[Tensor, Tensor] | None,
) -> tuple[Tensor, Tensor]:
    """Search the best ends, metres ``(B,)``, within bounds for values ``x (B, P)`` at pixels ``at (P,)``.

    The ``current`` ends are kept unless others are better by ``KEEP_MARGIN``.
    """
    (cost, in_view), ranges = volume.at_pixels(at), []
    for b, row in enumerate(x):
        best_of = partial(_best_of, group_pixels(row, cost, in_view), volume, space)
        best = _coarse_to_fine(best_of, *bounds, row)
        if current is not None:
            a, c = (v[b : b + 1] for v in current)
            now = best_of(torch.minimum(a, c), torch.maximum(a, c))
            stays = now.cost <= best.cost + KEEP_MARGIN
            best = _Best(*(torch.where(stays, old, new) for old, new in zip(now, best, strict=True)))
        ranges.append(best)
    near_m, far_m, _ = (torch.cat(column) for column in zip(*ranges, strict=True))
    return near_m, far_m


def _sampled(size: tuple[int, int], valid: Tensor | None, like: Tensor) -> Tensor:
    """Return flat indices of about ``SAMPLES`` pixels of a grid ``(H, W)``, valid ones if there are any."""
    stride = max(1, round((size[0] * size[1] / SAMPLES) ** 0.5))
    rows, columns = (np.arange(stride // 2, side, stride) for side in size)
    at = to_device_of(like, (rows[:, None] * size[1] + columns[None]).ravel())
    if valid is None:
        return at
    inside = F.interpolate(valid.float(), size, mode="nearest-exact").flatten()[at] > 0
    return at[inside] if bool(inside.any()) else at


def _best_of(groups: Groups, volume: CostVolume, space: str, near_m: Tensor, far_m: Tensor) -> _Best:
    """Return the best of candidate ends ``(M,)`` for one map."""
    depth_m = SPACES[space].depth_at(groups.mean[None], near_m[:, None], far_m[:, None])
    mean, fraction = look_up(groups, volume.inverse_depth, depth_m)
    # A pair that keeps too few pixels in view wins only if no pair keeps enough.
    mean = mean + (fraction < min_in_view(volume)) * 1.0
    k = mean.argmin(keepdim=True)  # a 0-d index would be read back from the device
    return _Best(near_m[k], far_m[k], mean[k])


def _coarse_to_fine(
    best_of: Callable[[Tensor, Tensor], _Best], low: float, high: float, like: Tensor
) -> _Best:
    """Search the best ends in [low, high] on a coarse grid, then on two finer ones."""
    grid = torch.linspace(0, 1, COARSE_GRID, dtype=like.dtype, device=like.device)
    log_low = math.log(low)
    log_span = math.log(high / low)
    i, j = torch.triu_indices(COARSE_GRID, COARSE_GRID, 1, device=like.device)
    best = best_of(*(torch.exp(log_low + log_span * grid[k]) for k in (i, j)))
    radius = log_span / (COARSE_GRID - 1)
    for values in FINE_GRIDS:
        offsets = torch.linspace(-1, 1, values, dtype=like.dtype, device=like.device)
        log_near = best.near_m.log() + radius * offsets.repeat_interleave(values)
        log_far = best.far_m.log() + radius * offsets.repeat(values)
        near, far = (each.exp().clamp(low, high) for each in (log_near, log_far))
        best = best_of(torch.minimum(near, far), torch.maximum(near, far))
        radius = radius / (values - 1) * 2
    return best
