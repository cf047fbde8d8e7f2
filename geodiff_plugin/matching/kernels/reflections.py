"""Triton kernels for ``reflections.reject_reflections``, and quantiles of values sorted by torch."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.matching import constants
from geodiff_plugin.matching.matches import Matches

#: Pixels per program.
BLOCK = 512
# Triton kernels can read module constants only as constexpr.
_LARGEST = tl.constexpr(constants.LARGEST)
_SPREAD_CONFIDENCE = tl.constexpr(constants.SPREAD_CONFIDENCE)
_SPREAD_FRACTION = tl.constexpr(constants.SPREAD_FRACTION)
_NORMAL_QUANTILE = tl.constexpr(constants.NORMAL_QUANTILE)
_SPREADS = tl.constexpr(constants.SPREADS)
_MIN_DISTANCE = tl.constexpr(constants.MIN_DISTANCE)
_MULTIPLE = tl.constexpr(constants.MULTIPLE)
#: Bisection steps that locate an index among up to 2^31 values.
_HALVINGS = tl.constexpr(31)


@triton.jit
def count_below(ordered, n, limit):
    """Count how many of ``n`` sorted values, NaN last, are at most ``limit``."""
    low, high = n * 0, n
    for _ in range(_HALVINGS):
        middle = low + (high - low) // 2
        counts = (low < high) & (tl.load(ordered + tl.minimum(middle, n - 1)) <= limit)
        high = tl.where(counts, high, middle)
        low = tl.where(counts, middle + 1, low)
    return low


@triton.jit
def between(below, above, fraction):
    """Compute ``torch.lerp``."""
    ahead = above - below
    return tl.where(fraction < 0.5, below + fraction * ahead, above - ahead * (1.0 - fraction))


@triton.jit
def rank_of(count, fraction):
    """Return the indices around a quantile of ``count`` sorted values, and the fraction between them."""
    rank = tl.maximum((count - 1).to(tl.float32) * fraction, 0.0)
    below = tl.floor(rank).to(tl.int32)
    return below, tl.ceil(rank).to(tl.int32), rank - below.to(tl.float32)


@triton.jit
def quantile(ordered, count, fraction):
    """Compute ``torch.nanquantile`` of sorted values, ``count`` of which are not NaN; 1 for none.

    Values after the first ``count`` may be infinite, and the difference of two of them is invalid.
    """
    below, above, part = rank_of(count, fraction)
    some = count > 0
    return between(tl.load(ordered + below, some, 1.0), tl.load(ordered + above, some, 1.0), part)


@triton.jit
def median(ordered, count):
    """Compute ``torch.nanmedian``, the lower one of two middle values."""
    return tl.load(ordered + tl.maximum(count - 1, 0) // 2)


@triton.jit
def _distance_at(ordered, count, middle, rank):
    """Return the distance from ``middle`` with the given rank among the distances of all sorted values.

    The nearest values are consecutive. Bisection finds the first of them.
    """
    low, high = rank * 0, tl.maximum(count - 1 - rank, 0)
    for _ in range(_HALVINGS):
        first = low + (high - low) // 2
        after = tl.load(ordered + tl.minimum(first + rank + 1, tl.maximum(count - 1, 0)))
        nearer = (low < high) & (middle - tl.load(ordered + first) > after - middle)
        high = tl.where(nearer, high, first)
        low = tl.where(nearer, first + 1, low)
    last = tl.load(ordered + low + rank)
    return tl.maximum(tl.abs(tl.load(ordered + low) - middle), tl.abs(last - middle))


@triton.jit(do_not_specialize=["n"], do_not_specialize_on_alignment=["confidence", "counted"])
def behind_kernel(inverse_depth, confidence, depth_m, behind, counted, n, BLOCK: tl.constexpr):
    """Compute how far matches are behind a map, in log depth; NaN for those without sufficient confidence."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = p < n
    ratio = tl.load(inverse_depth + p, inside, 1.0) * tl.load(depth_m + p, inside, 1.0)
    away = tl.minimum(tl.maximum(-tl.log(tl.maximum(ratio, 1e-6)), -_LARGEST), _LARGEST)
    counts = tl.load(confidence + p, inside, 0.0) > _SPREAD_CONFIDENCE
    tl.store(behind + p, away, inside)
    tl.store(counted + p, tl.where(counts, away, float("nan")), inside)


@triton.jit(do_not_specialize=["n"])
def spread_kernel(ordered, spread, n):
    """Measure the deviation of a sample's sorted distances from their median. Grid: samples."""
    sample = tl.program_id(0)
    ordered += sample * n
    count = count_below(ordered, n, float("inf"))
    middle = median(ordered, count)
    below, above, part = rank_of(count, _SPREAD_FRACTION)
    near = _distance_at(ordered, count, middle, below)
    found = between(near, _distance_at(ordered, count, middle, above), part) / _NORMAL_QUANTILE
    tl.store(spread + sample, tl.where(count > 0, found, _LARGEST))


@triton.jit(
    do_not_specialize=["width", "radius", "n"], do_not_specialize_on_alignment=["confidence", "weights"]
)
def rows_kernel(behind, confidence, sums, weights, width, radius, n, BLOCK: tl.constexpr):
    """Sum weighted distances and weights over the ``2 radius + 1`` pixels of a row around every pixel.

    ``sums`` gets the sums of ``confidence * behind``, ``weights`` the sums of ``confidence``. Pixels outside
    the row count as 0. ``remaining_kernel`` adds these sums along the columns.
    """
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
    behind, sums, weights, spread, fraction, height, width, radius, n, BLOCK: tl.constexpr
):  # fmt: skip
    """Compute the remaining fraction of every match from the sums of the square around it."""
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, row = p < n, p // width % height
    total, known = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for down in range(-radius, radius + 1):
        there = inside & (row + down >= 0) & (row + down < height)
        total += tl.load(sums + p + down * width, there, 0.0)
        known += tl.load(weights + p + down * width, there, 0.0)
    of_sample = tl.load(spread + p // (height * width), inside, 1.0)
    away = tl.minimum(total / tl.maximum(known, 1.0), tl.load(behind + p, inside, 0.0))
    least = tl.maximum(of_sample * _SPREADS, _MIN_DISTANCE)
    rejected = (away / least - 1.0) / (_MULTIPLE - 1.0)
    tl.store(fraction + p, 1.0 - tl.minimum(tl.maximum(rejected, 0.0), 1.0), inside)


def remaining(matches: Matches, depth_m: Tensor, radius: int) -> Tensor:
    """Run ``reflections._remaining`` with kernels."""
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
    fraction = torch.empty_like(depth_m)
    launched_on(depth_m, remaining_kernel[grid])(
        behind, sums, weights, spread, fraction, height, width, radius, n, BLOCK=BLOCK
    )
    return fraction
