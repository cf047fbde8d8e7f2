"""Triton kernels for the scale searches; their references are ``search_scale`` and ``fit_to_points``.

Candidates are numbered: 0 is the current range, if any; the others are pairs from a grid of near and far, row
by row.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.matching import CostVolume, Matches
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.scale import constants
from geodiff_plugin.scale.affine import MetricForm
from geodiff_plugin.scale.kernels.points import value_at
from geodiff_plugin.scale.kernels.space import (
    DEPTH,
    DISPARITY,
    LOG,
    LOG1P,
    ends,
    floored_of,
    forward,
    inverse,
)
from geodiff_plugin.scale.sampling import basin_stride, group_size, min_in_view

# Triton kernels can read module constants only as constexpr.
_BASIN_CAUCHY = tl.constexpr(constants.BASIN_CAUCHY)
_BASIN_RADIUS = tl.constexpr(constants.BASIN_RADIUS)
_COST_CLAMP = tl.constexpr(constants.COST_CLAMP)
_COST_LEVELS = tl.constexpr(COST_LEVELS)
_MIN_FRACTION = tl.constexpr(constants.MIN_SHIFT_FRACTION)
#: Number of points, or groups of pixels, per iteration.
BLOCK = 512
#: Number of pixels of a group that are added per iteration.
GROUPED_PIXELS = 16
#: Number of planes per program that adds pixels of a group.
GROUPED_PLANES = 64
#: Number of candidates of the largest grid, rounded up to a power of two.
PADDED = triton.next_power_of_2(max(constants.BASIN_CANDIDATES, constants.COARSE_GRID) ** 2)
#: Arrays with one number per candidate or map. They may have any alignment: a kernel is not recompiled for
#: those that are aligned to 16 bytes.
_NUMBERS = [
    *("near_m", "far_m", "cost", "near_of", "far_of", "chosen"),
    *("before_cost", "before_near", "before_far", "cost_of", "size"),
]


class _Candidates(NamedTuple):
    """Costs and ends of the candidates of every map; number 0 is the current range."""

    cost: Tensor  # (B, 1 + N * N)
    near_m: Tensor  # (B, 1 + N * N)
    far_m: Tensor  # (B, 1 + N * N)


def _allocate(batch: int, grid: int, like: Tensor) -> _Candidates:
    """Allocate the candidates of a grid with ``grid`` values of near, and of far."""
    return _Candidates(*like.new_empty(3, batch, 1 + grid * grid).unbind())


@triton.jit
def _log1p(y):
    """Compute log(1 + y), accurate for small y >= 0."""
    above = 1.0 + y
    return tl.where(above == 1.0, y, y * tl.log(above) / tl.where(above == 1.0, 1.0, above - 1.0))


@triton.jit
def _scale_and_shift(near, far, FORM: tl.constexpr):
    """Compute ``Space.from_ends`` of a range, with scale and shift clamped as in ``MetricMap.from_range``."""
    at_zero, at_one = ends(near, far, FORM)
    if FORM == DEPTH:
        g = at_one
        t = at_zero / at_one
        s = (at_one - at_zero) / at_one
    elif FORM == DISPARITY:
        g = tl.sqrt(at_zero * at_one)
        t = g / at_zero
        s = g / at_one - t
    elif FORM == LOG:
        g = at_zero * 0.9  # the shift must stay positive, as in the reference
        t = tl.log(at_zero / g)
        s = tl.log(at_one / at_zero)
    elif FORM == LOG1P:
        g = tl.zeros_like(at_zero) + 1.0
        t = tl.log(1.0 + at_zero)
        s = tl.log(1.0 + at_one) - t
    else:
        g = tl.sqrt(at_zero * at_one)
        t = tl.sqrt(g / at_zero)
        s = tl.sqrt(g / at_one) - t
    return tl.maximum(s, _MIN_FRACTION), tl.maximum(t, _MIN_FRACTION), g


@triton.jit(
    do_not_specialize=["count", "stride", "height", "width", "rows", "columns", "has_current"],
    do_not_specialize_on_alignment=_NUMBERS,
)
def basin_kernel(
    x, at, map_inverse, step, extremes, near_m, far_m, cost, near_of, far_of,
    count, stride, height, width, rows, columns, has_current,
    FORM: tl.constexpr, CLIPPED: tl.constexpr, GRID: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Compute the mean Cauchy cost of points for a candidate (``fit_to_points``). Grid: candidates, maps."""
    candidate, of_map = tl.program_id(0), tl.program_id(1)
    into = of_map * (GRID * GRID + 1) + candidate
    low = tl.log(1.0 / tl.load(extremes + 1) / _BASIN_RADIUS)
    high = tl.log(1.0 / tl.load(extremes) * _BASIN_RADIUS)
    i, j = (candidate - 1) // GRID, (candidate - 1) % GRID
    near = tl.exp(low + (high - low) * (i.to(tl.float32) / (GRID - 1)))
    far = tl.exp(low + (high - low) * (j.to(tl.float32) / (GRID - 1)))
    is_current = candidate == 0
    exists = tl.where(is_current, has_current > 0, i < j)
    near = tl.where(is_current, tl.load(near_m + of_map), near)
    far = tl.where(is_current, tl.load(far_m + of_map), far)
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
    """Compute ``volume_search.group_pixels`` of sorted values. Grid: groups, blocks of planes, maps."""
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
    """Return the number of the first candidate of a grid with the lowest cost, and that cost."""
    k = 1 + tl.arange(0, PADDED)
    costs = tl.load(cost + k, k <= count, float("inf"))
    least = tl.min(costs, 0)
    return tl.min(tl.where(costs == least, k, count), 0), least


@triton.jit
def _look_up(
    mean, size, seen, cost, near, far, pixels, groups, used_groups, planes, first_plane, step,
    FORM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Compute ``volume_search.look_up`` of one candidate, with all groups or none."""
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
    do_not_specialize=["pixels", "groups", "planes", "before", "grid", "has_current"],
    do_not_specialize_on_alignment=_NUMBERS,
)
def level_kernel(
    mean, size, seen, cost, near_m, far_m, before_cost, before_near, before_far, cost_of, near_of, far_of,
    pixels, groups, planes, first_plane, step, least, low, high, radius, before, grid, has_current,
    FORM: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Compute a candidate's cost, in the coarse grid or a finer grid around the best of ``before``.

    Grid: candidates, maps.
    """
    candidate, of_map = tl.program_id(0), tl.program_id(1)
    into = of_map * (grid * grid + 1) + candidate
    i, j = (candidate - 1) // grid, (candidate - 1) % grid
    along, across = i.to(tl.float32) / (grid - 1), j.to(tl.float32) / (grid - 1)
    is_current = candidate == 0
    if before > 0:
        first = of_map * (before * before + 1)
        best, _cost = _least(before_cost + first, before * before, PADDED)
        near = tl.exp(tl.log(tl.load(before_near + first + best)) + radius * (2.0 * along - 1.0))
        far = tl.exp(tl.log(tl.load(before_far + first + best)) + radius * (2.0 * across - 1.0))
        near = tl.minimum(tl.maximum(near, low), high)
        far = tl.minimum(tl.maximum(far, low), high)
        exists = candidate > 0
    else:
        near = tl.exp(tl.log(low) + radius * along)
        far = tl.exp(tl.log(low) + radius * across)
        exists = i < j
    exists = tl.where(is_current, has_current > 0, exists)
    near = tl.where(is_current, tl.load(near_m + of_map), near)
    far = tl.where(is_current, tl.load(far_m + of_map), far)
    near, far = tl.minimum(near, far), tl.maximum(near, far)
    of_groups = of_map * groups
    found, fraction = _look_up(
        mean + of_groups, size + of_groups, seen + of_groups * planes, cost + of_groups * planes,
        near, far, pixels, groups, tl.where(exists, groups, 0), planes, first_plane, step, FORM, BLOCK,
    )  # fmt: skip
    found += tl.where(fraction < least, 1.0, 0.0)
    tl.store(cost_of + into, tl.where(exists, found, float("inf")))
    tl.store(near_of + into, near)
    tl.store(far_of + into, far)


@triton.jit(do_not_specialize=["count", "has_current"], do_not_specialize_on_alignment=_NUMBERS)
def choose_kernel(cost, near_of, far_of, chosen, factor, margin, count, has_current, PADDED: tl.constexpr):
    """Choose the best candidate, or the current range if it is nearly as good. Grid: maps."""
    of_map = tl.program_id(0)
    first = of_map * (count + 1)
    best, least = _least(cost + first, count, PADDED)
    stays = tl.where(has_current > 0, tl.load(cost + first) <= factor * least + margin, False)
    best = tl.where(stays, 0, best)
    tl.store(chosen + of_map, tl.load(near_of + first + best))
    tl.store(chosen + tl.num_programs(0) + of_map, tl.load(far_of + first + best))


def _choose(found: _Candidates, has_current: bool, factor: float, margin: float) -> tuple[Tensor, Tensor]:
    """Choose both ends, metres ``(B,)``."""
    batch, candidates = found.cost.shape
    chosen = found.cost.new_empty(2, batch)
    launched_on(chosen, choose_kernel[(batch,)])(
        *found, chosen, factor, margin, candidates - 1, int(has_current), PADDED=PADDED
    )
    nearest, farthest = chosen.unbind()
    return nearest, farthest


def fit_to_points(
    x: Tensor, points: Matches, metric: MetricForm, current: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Run ``points.fit_to_points`` with kernels."""
    at, x, grid = points.above(0.0), x.float().contiguous(), constants.BASIN_CANDIDATES
    stride = basin_stride(at)
    extremes = torch.stack(points.inverse_depth.flatten()[at].aminmax())
    found = _allocate(len(x), grid, x)
    current_ends = (x, x) if current is None else [end.contiguous() for end in current]
    launched_on(x, basin_kernel[(1 + grid * grid, len(x))])(
        x,
        at,
        points.inverse_depth.contiguous(),
        points.plane_step,
        extremes,
        *current_ends,
        *found,
        -(-len(at) // stride),
        stride,
        *points.size,
        *x.shape[-2:],
        int(current is not None),
        FORM=constants.KERNEL_FORMS[metric.space],
        CLIPPED=metric.positive == constants.SQUARE,
        GRID=grid,
        BLOCK=BLOCK,
    )
    return _choose(found, current is not None, constants.BASIN_KEEP, 0.0)


class _Grouped(NamedTuple):
    """``volume_search.Groups`` of every map."""

    mean: Tensor  # (B, K)
    size: Tensor  # (B, K)
    seen: Tensor  # (B, D, K)
    cost: Tensor  # (B, D, K)


def _group(volume: CostVolume, x: Tensor, at: Tensor) -> _Grouped:
    """Group the values ``x (B, P)`` at pixels ``at (P,)``."""
    values, order = x.sort(1)
    each = group_size(len(at))
    groups, planes = -(-len(at) // each), len(volume.levels)
    flat = x.new_empty(2, len(x), groups)
    volumes = x.new_empty(2, len(x), planes, groups)
    out = _Grouped(*flat.unbind(), *volumes.unbind())
    launched_on(x, group_kernel[(groups, triton.cdiv(planes, GROUPED_PLANES), len(x))])(
        volume.levels,
        volume.in_view,
        values,
        order,
        at,
        *out,
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
    return out


def best_range(
    volume: CostVolume,
    x: Tensor,
    at: Tensor,
    space: str,
    bounds: tuple[float, float],
    current: tuple[Tensor, Tensor] | None,
) -> tuple[Tensor, Tensor]:
    """Run ``volume_search._best_range`` with kernels."""
    grouped, (low, high) = _group(volume, x, at), bounds
    planes = volume.inverse_depth.numpy()
    cameras = len(planes), float(planes[0]), float((planes[-1] - planes[0]) / (len(planes) - 1))
    current_ends = (x, x) if current is None else [end.contiguous() for end in current]
    before, last, radius = _Candidates(x, x, x), 0, math.log(high / low)
    for grid in (constants.COARSE_GRID, *constants.FINE_GRIDS):
        found = _allocate(len(x), grid, x)
        launched_on(x, level_kernel[(1 + grid * grid, len(x))])(
            *grouped,
            *current_ends,
            *before,
            *found,
            len(at),
            grouped.mean.shape[1],
            *cameras,
            min_in_view(volume),
            low,
            high,
            radius,
            last,
            grid,
            int(current is not None),
            FORM=constants.KERNEL_FORMS[space],
            PADDED=PADDED,
            BLOCK=BLOCK,
        )
        # A finer grid has values on both sides of the best, so its step is twice as long.
        radius = radius / (grid - 1) * (2 if last else 1)
        before, last = found, grid
    return _choose(before, current is not None, 1.0, constants.KEEP_MARGIN)
