"""Triton kernels of the searches for a scale, by the references ``search_scale`` and ``fit_to_points``.

Candidates have numbers: 0 is the range in use, if there is one, and the others are pairs of a grid of near
and far, row by row. This module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.matching import CostVolume, Matches
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.scale import points, space, volume_search
from geodiff_plugin.scale.kernels import ends, floored_of, forward, inverse, value_at
from geodiff_plugin.scale.space import KERNEL_FORMS

# A kernel reads constants of its module only as these.
_BASIN_CAUCHY = tl.constexpr(points.BASIN_CAUCHY)
_BASIN_REACH = tl.constexpr(points.BASIN_REACH)
_COST_CLAMP = tl.constexpr(volume_search.COST_CLAMP)
_COST_LEVELS = tl.constexpr(COST_LEVELS)
_LEAST_SHARE = tl.constexpr(space.LEAST_SHARE)
#: Points, or groups of pixels, that a program holds at once.
BLOCK = 512
#: Pixels of a group that a program adds up at once.
GROUPED_PIXELS = 16
#: Planes for which it does.
GROUPED_PLANES = 64
#: Candidates of the coarsest grids, as a power of two.
PADDED = triton.next_power_of_2(max(points.BASIN_CANDIDATES, volume_search.COARSE_GRID) ** 2)
#: Arrays of one number a candidate or a map. They may begin anywhere: a kernel is not compiled anew for those
#: that begin at a multiple of 16 bytes.
_NUMBERS = [
    *("near_m", "far_m", "cost", "near_of", "far_of", "chosen"),
    *("before_cost", "before_near", "before_far", "cost_of", "size"),
]


class _Candidates(NamedTuple):
    """Candidates of every map, and what is known of them: number 0 is the range in use."""

    cost: Tensor  # (B, 1 + N * N)
    near_m: Tensor  # (B, 1 + N * N)
    far_m: Tensor  # (B, 1 + N * N)


def _room(batch: int, grid: int, like: Tensor) -> _Candidates:
    """Room for the pairs of a grid of so many values of near, and of far."""
    return _Candidates(*like.new_empty(3, batch, 1 + grid * grid).unbind())


@triton.jit
def _log1p(y):
    """The logarithm of 1 + y, exact for a small y >= 0."""
    above = 1.0 + y
    return tl.where(above == 1.0, y, y * tl.log(above) / tl.where(above == 1.0, 1.0, above - 1.0))


@triton.jit
def _scale_and_shift(near, far, FORM: tl.constexpr):
    """``Space.from_ends`` of a range, scale and shift bounded as in ``MetricMap.from_range``."""
    a, b = ends(near, far, FORM)
    if FORM == 0:
        g = b
        t = a / b
        s = (b - a) / b
    elif FORM == 1:
        g = tl.sqrt(a * b)
        t = g / a
        s = g / b - t
    elif FORM == 2:
        g = a * 0.9
        t = tl.log(a / g)
        s = tl.log(b / a)
    elif FORM == 3:
        g = tl.zeros_like(a) + 1.0
        t = tl.log(1.0 + a)
        s = tl.log(1.0 + b) - t
    else:
        g = tl.sqrt(a * b)
        t = tl.sqrt(g / a)
        s = tl.sqrt(g / b) - t
    return tl.maximum(s, _LEAST_SHARE), tl.maximum(t, _LEAST_SHARE), g


@triton.jit(
    do_not_specialize=["count", "stride", "height", "width", "rows", "columns", "in_use"],
    do_not_specialize_on_alignment=_NUMBERS,
)
def basin_kernel(
    x, at, map_inverse, step, extremes, near_m, far_m, cost, near_of, far_of,
    count, stride, height, width, rows, columns, in_use,
    FORM: tl.constexpr, CLIPPED: tl.constexpr, GRID: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The mean Cauchy cost of points under a candidate (``points.fit_to_points``). Grid: candidates, maps."""
    candidate, of_map = tl.program_id(0), tl.program_id(1)
    into = of_map * (GRID * GRID + 1) + candidate
    low = tl.log(1.0 / tl.load(extremes + 1) / _BASIN_REACH)
    high = tl.log(1.0 / tl.load(extremes) * _BASIN_REACH)
    i, j = (candidate - 1) // GRID, (candidate - 1) % GRID
    near = tl.exp(low + (high - low) * (i.to(tl.float32) / (GRID - 1)))
    far = tl.exp(low + (high - low) * (j.to(tl.float32) / (GRID - 1)))
    is_old = candidate == 0
    exists = tl.where(is_old, in_use > 0, i < j)
    near = tl.where(is_old, tl.load(near_m + of_map), near)
    far = tl.where(is_old, tl.load(far_m + of_map), far)
    s, t, g = _scale_and_shift(near, far, FORM)
    width_of_cost = tl.load(step) * _BASIN_CAUCHY
    total = tl.zeros([BLOCK], tl.float32)
    for first in range(0, tl.where(exists, count, 0), BLOCK):
        k = first + tl.arange(0, BLOCK)
        inside = k < count
        pixel = tl.load(at + k.to(tl.int64) * stride, inside, 0).to(tl.int32)
        v = value_at(x + of_map * rows * columns, pixel, height, width, rows, columns)
        depth = g * forward(s * floored_of(v, CLIPPED) + t, FORM)
        e = (1.0 / depth - tl.load(map_inverse + pixel)) / width_of_cost
        total += tl.where(inside, _log1p(e * e), 0.0)
    tl.store(cost + into, tl.where(exists, tl.sum(total, 0) / count, float("inf")))
    tl.store(near_of + into, near)
    tl.store(far_of + into, far)


@triton.jit
def group_kernel(
    levels, in_view, values, order, at, mean, size, seen, cost,
    pixels, each, groups, planes, width,
    levels_plane, levels_row, levels_column, view_plane, view_row, view_column,
    PIXELS: tl.constexpr, PLANES: tl.constexpr,
):  # fmt: skip
    """``volume_search.group_pixels`` of sorted values. Grid: groups, blocks of planes, maps."""
    group, of_map = tl.program_id(0), tl.program_id(2)
    plane = tl.program_id(1) * PLANES + tl.arange(0, PLANES)
    values += of_map * pixels
    order += of_map * pixels
    total = tl.zeros([PIXELS], tl.float32)
    in_sight, costs = tl.zeros([PIXELS, PLANES], tl.float32), tl.zeros([PIXELS, PLANES], tl.float32)
    last = tl.minimum(pixels, (group + 1) * each)
    of_plane = plane.to(tl.int64)[None, :]
    for first in range(group * each, last, PIXELS):
        k = first + tl.arange(0, PIXELS)
        inside = k < last
        pixel = tl.load(at + tl.load(order + k, inside, 0))[:, None]
        row, column = pixel // width, pixel % width
        used = inside[:, None] & (plane < planes)[None, :]
        where_seen = of_plane * view_plane + row * view_row + column * view_column
        where_level = of_plane * levels_plane + row * levels_row + column * levels_column
        sight = tl.load(in_view + where_seen, used, 0).to(tl.float32)
        level = tl.load(levels + where_level, used, 0).to(tl.float32)
        total += tl.load(values + k, inside, 0.0)
        in_sight += sight
        costs += tl.minimum(level / _COST_LEVELS, _COST_CLAMP) * sight
    count = (last - group * each).to(tl.float32)
    tl.store(mean + of_map * groups + group, tl.sum(total, 0) / count)
    tl.store(size + of_map * groups + group, count)
    into = (of_map * planes + plane) * groups + group
    tl.store(seen + into, tl.sum(in_sight, 0), plane < planes)
    tl.store(cost + into, tl.sum(costs, 0), plane < planes)


@triton.jit
def _least(cost, count, PADDED: tl.constexpr):
    """The number of the first candidate of a grid that costs least, and its cost."""
    k = 1 + tl.arange(0, PADDED)
    costs = tl.load(cost + k, k <= count, float("inf"))
    least = tl.min(costs, 0)
    return tl.min(tl.where(costs == least, k, count), 0), least


@triton.jit
def _look_up(
    mean, size, seen, cost, near, far, pixels, groups, used_groups, planes, first_plane, step,
    FORM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``volume_search.look_up`` of one candidate, by all groups or by none."""
    zero, one = ends(near, far, FORM)
    zero, one = inverse(zero, FORM), inverse(one, FORM)
    summed, counted = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for first in range(0, used_groups, BLOCK):
        k = first + tl.arange(0, BLOCK)
        used = k < groups
        depth = forward(zero + (one - zero) * tl.load(mean + k, used, 0.5), FORM)
        position = (1.0 / depth - first_plane) / step
        inside = (position >= 0.0) & (position <= planes - 1.0)
        position = tl.where(inside, position, 0.0)
        below = tl.minimum(position.to(tl.int32), planes - 2)
        part = position - below.to(tl.float32)
        at = below * groups + k
        low, high = tl.load(cost + at, used, 0.0), tl.load(cost + at + groups, used, 0.0)
        visible, next_visible = tl.load(seen + at, used, 0.0), tl.load(seen + at + groups, used, 0.0)
        of_group = tl.load(size + k, used, 0.0)
        summed += tl.where(inside, low + part * (high - low), _COST_CLAMP * of_group)
        counted += tl.where(inside, visible + part * (next_visible - visible), of_group)
    count = tl.sum(counted, 0)
    return tl.sum(summed, 0) / tl.maximum(count, 1.0), count / pixels


@triton.jit(
    do_not_specialize=["pixels", "groups", "planes", "before", "grid", "in_use"],
    do_not_specialize_on_alignment=_NUMBERS,
)
def level_kernel(
    mean, size, seen, cost, near_m, far_m, before_cost, before_near, before_far, cost_of, near_of, far_of,
    pixels, groups, planes, first_plane, step, least, low, high, reach, before, grid, in_use,
    FORM: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The cost of a candidate: of the coarse grid, or of a finer one around the best ``before``.

    Grid: candidates, maps.
    """
    candidate, of_map = tl.program_id(0), tl.program_id(1)
    into = of_map * (grid * grid + 1) + candidate
    i, j = (candidate - 1) // grid, (candidate - 1) % grid
    along, across = i.to(tl.float32) / (grid - 1), j.to(tl.float32) / (grid - 1)
    is_old = candidate == 0
    if before > 0:
        first = of_map * (before * before + 1)
        best, _cost = _least(before_cost + first, before * before, PADDED)
        near = tl.exp(tl.log(tl.load(before_near + first + best)) + reach * (2.0 * along - 1.0))
        far = tl.exp(tl.log(tl.load(before_far + first + best)) + reach * (2.0 * across - 1.0))
        near = tl.minimum(tl.maximum(near, low), high)
        far = tl.minimum(tl.maximum(far, low), high)
        exists = candidate > 0
    else:
        near = tl.exp(tl.log(low) + reach * along)
        far = tl.exp(tl.log(low) + reach * across)
        exists = i < j
    exists = tl.where(is_old, in_use > 0, exists)
    near = tl.where(is_old, tl.load(near_m + of_map), near)
    far = tl.where(is_old, tl.load(far_m + of_map), far)
    near, far = tl.minimum(near, far), tl.maximum(near, far)
    of_groups = of_map * groups
    found, share = _look_up(
        mean + of_groups, size + of_groups, seen + of_groups * planes, cost + of_groups * planes,
        near, far, pixels, groups, tl.where(exists, groups, 0), planes, first_plane, step, FORM, BLOCK,
    )  # fmt: skip
    found += tl.where(share < least, 1.0, 0.0)
    tl.store(cost_of + into, tl.where(exists, found, float("inf")))
    tl.store(near_of + into, near)
    tl.store(far_of + into, far)


@triton.jit(do_not_specialize=["count", "in_use"], do_not_specialize_on_alignment=_NUMBERS)
def choose_kernel(cost, near_of, far_of, chosen, factor, margin, count, in_use, PADDED: tl.constexpr):
    """The best candidate, or the range in use if that is nearly as good. Grid: maps."""
    of_map = tl.program_id(0)
    first = of_map * (count + 1)
    best, least = _least(cost + first, count, PADDED)
    stays = tl.where(in_use > 0, tl.load(cost + first) <= factor * least + margin, False)
    best = tl.where(stays, 0, best)
    tl.store(chosen + of_map, tl.load(near_of + first + best))
    tl.store(chosen + tl.num_programs(0) + of_map, tl.load(far_of + first + best))


def _chosen(found: _Candidates, in_use: bool, factor: float, margin: float) -> tuple[Tensor, Tensor]:
    """Metres ``(B,)`` of both ends."""
    batch, candidates = found.cost.shape
    chosen = found.cost.new_empty(2, batch)
    launched_on(chosen, choose_kernel[(batch,)])(
        *found, chosen, factor, margin, candidates - 1, int(in_use), PADDED=PADDED
    )
    nearest, farthest = chosen.unbind()
    return nearest, farthest


def basin(
    x: Tensor, known: Matches, of_space: str, clipped: bool, current: tuple[Tensor, Tensor] | None
) -> tuple[Tensor, Tensor]:
    """``points.fit_to_points``; ``clipped``: relative maps are clipped to [0, 1], and not floored."""
    at, x, grid = known.above(0.0), x.float().contiguous(), points.BASIN_CANDIDATES
    stride = points.basin_stride(at)
    extremes = torch.stack(known.inverse_depth.flatten()[at].aminmax())
    found = _room(len(x), grid, x)
    in_use = (x, x) if current is None else [end.contiguous() for end in current]
    launched_on(x, basin_kernel[(1 + grid * grid, len(x))])(
        x,
        at,
        known.inverse_depth.contiguous(),
        known.plane_step,
        extremes,
        *in_use,
        *found,
        -(-len(at) // stride),
        stride,
        *known.size,
        *x.shape[-2:],
        int(current is not None),
        FORM=KERNEL_FORMS[of_space],
        CLIPPED=clipped,
        GRID=grid,
        BLOCK=BLOCK,
    )
    return _chosen(found, current is not None, points.BASIN_KEEP, 0.0)


class _Grouped(NamedTuple):
    """``volume_search.Groups`` of every map."""

    mean: Tensor  # (B, K)
    size: Tensor  # (B, K)
    seen: Tensor  # (B, D, K)
    cost: Tensor  # (B, D, K)


def _grouped(volume: CostVolume, x: Tensor, at: Tensor) -> _Grouped:
    """Groups of the values ``x (B, P)`` at pixels ``at (P,)``."""
    values, order = x.sort(1)
    each = volume_search.group_size(len(at))
    groups, planes = -(-len(at) // each), len(volume.levels)
    flat = x.new_empty(2, len(x), groups)
    volumes = x.new_empty(2, len(x), planes, groups)
    made = _Grouped(*flat.unbind(), *volumes.unbind())
    launched_on(x, group_kernel[(groups, triton.cdiv(planes, GROUPED_PLANES), len(x))])(
        volume.levels,
        volume.in_view,
        values,
        order,
        at,
        *made,
        len(at),
        each,
        groups,
        planes,
        volume.size[1],
        *volume.levels.stride(),
        *volume.in_view.stride(),
        PIXELS=GROUPED_PIXELS,
        PLANES=GROUPED_PLANES,
    )
    return made


def best_range(
    volume: CostVolume,
    x: Tensor,
    at: Tensor,
    of_space: str,
    bounds: tuple[float, float],
    current: tuple[Tensor, Tensor] | None,
) -> tuple[Tensor, Tensor]:
    """``volume_search._best_range``."""
    grouped, (low, high) = _grouped(volume, x, at), bounds
    planes = volume.inverse_depth.numpy()
    cameras = len(planes), float(planes[0]), float((planes[-1] - planes[0]) / (len(planes) - 1))
    in_use = (x, x) if current is None else [end.contiguous() for end in current]
    before, last, reach = _Candidates(x, x, x), 0, math.log(high / low)
    for grid in (volume_search.COARSE_GRID, *volume_search.FINE_GRIDS):
        found = _room(len(x), grid, x)
        launched_on(x, level_kernel[(1 + grid * grid, len(x))])(
            *grouped,
            *in_use,
            *before,
            *found,
            len(at),
            grouped.mean.shape[1],
            *cameras,
            volume_search.least_in_view(volume),
            low,
            high,
            reach,
            last,
            grid,
            int(current is not None),
            FORM=KERNEL_FORMS[of_space],
            PADDED=PADDED,
            BLOCK=BLOCK,
        )
        # Of a finer grid, whose values lie to both sides, a step is twice as long.
        reach = reach / (grid - 1) * (2 if last else 1)
        before, last = found, grid
    return _chosen(before, current is not None, 1.0, volume_search.KEEP_MARGIN)
