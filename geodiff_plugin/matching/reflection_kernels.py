"""Triton kernels of ``matches.reject_reflections``, and quantiles of values that torch has sorted.

This module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.matching import matches as reference
from geodiff_plugin.matching.matches import Matches

#: Pixels of a program.
BLOCK = 512
# A kernel reads constants of its module only as these.
_LARGEST = tl.constexpr(reference.LARGEST)
_SPREAD_CONFIDENCE = tl.constexpr(reference.SPREAD_CONFIDENCE)
_SPREAD_SHARE = tl.constexpr(reference.SPREAD_SHARE)
_NORMAL_QUANTILE = tl.constexpr(reference.NORMAL_QUANTILE)
_SPREADS = tl.constexpr(reference.SPREADS)
_LEAST_DISTANCE = tl.constexpr(reference.LEAST_DISTANCE)
_MULTIPLE = tl.constexpr(reference.MULTIPLE)
#: Halvings that find a place among as many values as 32 bits count.
_HALVINGS = tl.constexpr(31)


@triton.jit
def count_below(ordered, n, most):
    """How many of ``n`` sorted values, NaN last, are at most ``most``."""
    low, high = n * 0, n
    for _ in range(_HALVINGS):
        middle = low + (high - low) // 2
        counts = (low < high) & (tl.load(ordered + tl.minimum(middle, n - 1)) <= most)
        high = tl.where(counts, high, middle)
        low = tl.where(counts, middle + 1, low)
    return low


@triton.jit
def between(below, above, share):
    """``torch.lerp``."""
    ahead = above - below
    return tl.where(share < 0.5, below + share * ahead, above - ahead * (1.0 - share))


@triton.jit
def rank_of(count, share):
    """The place of a quantile among ``count`` sorted values: the two beside it, and how far it is between."""
    rank = tl.maximum((count - 1).to(tl.float32) * share, 0.0)
    below = tl.floor(rank).to(tl.int32)
    return below, tl.ceil(rank).to(tl.int32), rank - below.to(tl.float32)


@triton.jit
def quantile(ordered, count, share):
    """``torch.nanquantile`` of sorted values, of which ``count`` are no NaN."""
    below, above, part = rank_of(count, share)
    return between(tl.load(ordered + below), tl.load(ordered + above), part)


@triton.jit
def median(ordered, count):
    """``torch.nanmedian``, the lower one of two."""
    return tl.load(ordered + tl.maximum(count - 1, 0) // 2)


@triton.jit
def _distance_at(ordered, count, middle, place):
    """The distance from ``middle`` of sorted values that is at a place among all, sorted.

    The nearest ones lie side by side: where they begin is halved until none beside them is nearer.
    """
    low, high = place * 0, tl.maximum(count - 1 - place, 0)
    for _ in range(_HALVINGS):
        first = low + (high - low) // 2
        after = tl.load(ordered + tl.minimum(first + place + 1, tl.maximum(count - 1, 0)))
        nearer = (low < high) & (middle - tl.load(ordered + first) > after - middle)
        high = tl.where(nearer, high, first)
        low = tl.where(nearer, first + 1, low)
    last = tl.load(ordered + low + place)
    return tl.maximum(tl.abs(tl.load(ordered + low) - middle), tl.abs(last - middle))


@triton.jit(do_not_specialize=["n"], do_not_specialize_on_alignment=["confidence", "counted"])
def behind_kernel(inverse_depth, confidence, depth_m, behind, counted, n, BLOCK: tl.constexpr):
    """How far matches lie behind a map, in log depth; NaN for those that do not count for the spread."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = p < n
    ratio = tl.load(inverse_depth + p, inside, 1.0) * tl.load(depth_m + p, inside, 1.0)
    away = tl.minimum(tl.maximum(-tl.log(tl.maximum(ratio, 1e-6)), -_LARGEST), _LARGEST)
    counts = tl.load(confidence + p, inside, 0.0) > _SPREAD_CONFIDENCE
    tl.store(behind + p, away, inside)
    tl.store(counted + p, tl.where(counts, away, float("nan")), inside)


@triton.jit(do_not_specialize=["n"])
def spread_kernel(ordered, spread, n):
    """The spread of a sample's matches around their median, which are sorted. Grid: samples."""
    sample = tl.program_id(0)
    ordered += sample * n
    count = count_below(ordered, n, float("inf"))
    middle = median(ordered, count)
    below, above, part = rank_of(count, _SPREAD_SHARE)
    near = _distance_at(ordered, count, middle, below)
    found = between(near, _distance_at(ordered, count, middle, above), part) / _NORMAL_QUANTILE
    tl.store(spread + sample, tl.where(count > 0, found, _LARGEST))


@triton.jit(
    do_not_specialize=["width", "radius", "n"], do_not_specialize_on_alignment=["confidence", "weights"]
)
def rows_kernel(behind, confidence, sums, weights, width, radius, n, BLOCK: tl.constexpr):
    """Sums of distances and of weights over a part of the row around every pixel."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, column = p < n, p % width
    total, known = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for right in range(-radius, radius + 1):
        there = inside & (column + right >= 0) & (column + right < width)
        weight = tl.load(confidence + p + right, there, 0.0)
        total += weight * tl.load(behind + p + right, there, 0.0)
        known += weight
    tl.store(sums + p, total, inside)
    tl.store(weights + p, known, inside)


@triton.jit(do_not_specialize=["height", "width", "radius", "n"], do_not_specialize_on_alignment=["weights"])
def remaining_kernel(
    behind, sums, weights, spread, share, height, width, radius, n, BLOCK: tl.constexpr
):  # fmt: skip
    """The share of every match that remains, by those of the square around it."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, row = p < n, p // width % height
    total, known = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for down in range(-radius, radius + 1):
        there = inside & (row + down >= 0) & (row + down < height)
        total += tl.load(sums + p + down * width, there, 0.0)
        known += tl.load(weights + p + down * width, there, 0.0)
    of_sample = tl.load(spread + p // (height * width), inside, 1.0)
    away = tl.minimum(total / tl.maximum(known, 1.0), tl.load(behind + p, inside, 0.0))
    least = tl.maximum(of_sample * _SPREADS, _LEAST_DISTANCE)
    rejected = (away / least - 1.0) / (_MULTIPLE - 1.0)
    tl.store(share + p, 1.0 - tl.minimum(tl.maximum(rejected, 0.0), 1.0), inside)


def reject_reflections(matches: Matches, depth_m: Tensor, radius: int) -> Tensor:
    """``matches.reject_reflections``, of windows of ``radius``."""
    depth_m, confidence = depth_m.float().contiguous(), matches.confidence.float().contiguous()
    (height, width), n = depth_m.shape[-2:], depth_m.numel()
    grid = (triton.cdiv(n, BLOCK),)
    behind, counted = depth_m.new_empty(2, *depth_m.shape).unbind()
    launched_on(depth_m, behind_kernel[grid])(
        matches.inverse_depth.float().contiguous(), confidence, depth_m, behind, counted, n, BLOCK=BLOCK
    )
    ordered, spread = counted.flatten(1).sort(1).values, depth_m.new_empty(len(depth_m))
    launched_on(depth_m, spread_kernel[(len(depth_m),)])(ordered, spread, height * width, num_warps=1)
    sums, weights = depth_m.new_empty(2, *depth_m.shape).unbind()
    launched_on(depth_m, rows_kernel[grid])(behind, confidence, sums, weights, width, radius, n, BLOCK=BLOCK)
    share = torch.empty_like(depth_m)
    launched_on(depth_m, remaining_kernel[grid])(
        behind, sums, weights, spread, share, height, width, radius, n, BLOCK=BLOCK
    )
    return share
