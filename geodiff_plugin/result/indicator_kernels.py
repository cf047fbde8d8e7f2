"""Triton kernels of the indicators that matches are measured for; the reference is in ``result.indicators``.

This module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.reflection_kernels import count_below, median, quantile
from geodiff_plugin.result import indicators

#: Pixels of a program.
BLOCK = 512
#: The numbers, in the order in which they are written.
NUMBERS = ("matched", "in_front", "spread", "planes_apart", "scene_m", "off_matches", "off_where")
# A kernel reads constants of its module only as these.
_CONFIDENT = tl.constexpr(indicators.CONFIDENT)
_LOW, _HIGH = map(tl.constexpr, indicators.ENDS)
#: The largest float.
_FINITE = tl.constexpr(3.4028234663852886e38)


@triton.jit(do_not_specialize=["n"], do_not_specialize_on_alignment=["off"])
def marked_kernel(inverse_depth, confidence, step, depth_m, matched, off, n, BLOCK: tl.constexpr):
    """What of matches is sorted, and NaN elsewhere: inverse depth, and how far the result is from it.

    A confident match at infinity is one beyond all finite numbers.
    """
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = p < n
    inverse = tl.load(inverse_depth + p, inside, 1.0)
    confident = tl.load(confidence + p, inside, 0.0) > _CONFIDENT
    finite = tl.where(inverse > 0.0, inverse, float("inf"))
    tl.store(matched + p, tl.where(confident, finite, float("nan")), inside)
    compared = confident & (inverse > tl.load(step))
    ratio = tl.where(compared, tl.load(depth_m + p, inside, 1.0) * inverse, 1.0)
    tl.store(off + p, tl.where(compared, tl.abs(tl.log(ratio)), float("nan")), inside)


@triton.jit(do_not_specialize=["n"], do_not_specialize_on_alignment=["off"])
def numbers_kernel(matched, off, step, numbers, n):
    """``NUMBERS``, of what ``marked_kernel`` marks, sorted."""
    confident, in_front = count_below(matched, n, float("inf")), count_below(matched, n, _FINITE)
    tl.store(numbers, confident.to(tl.float32) / n.to(tl.float32))
    tl.store(numbers + 1, in_front.to(tl.float32))
    low, high = quantile(matched, in_front, _LOW), quantile(matched, in_front, _HIGH)
    nothing = in_front == 0  # what is sorted first then is none of them
    tl.store(numbers + 2, tl.where(nothing, float("nan"), tl.log(high / tl.maximum(low, 1e-9))))
    tl.store(numbers + 3, tl.where(nothing, float("nan"), (high - low) / tl.load(step)))
    tl.store(numbers + 4, tl.where(nothing, float("nan"), 1.0 / median(matched, in_front)))
    compared = count_below(off, n, float("inf"))
    tl.store(numbers + 5, median(off, compared))
    tl.store(numbers + 6, compared.to(tl.float32))


def of_matches(matches: Matches, depth_m: Tensor) -> dict[str, Tensor]:
    """``indicators._of_matches_and_depth``, for ``depth_m (1, H, W)`` on the grid of the matches."""
    n, step = depth_m.numel(), matches.plane_step
    marked, numbers = depth_m.new_empty(2, n), depth_m.new_empty(len(NUMBERS))
    launched_on(depth_m, marked_kernel[(triton.cdiv(n, BLOCK),)])(
        matches.inverse_depth.contiguous(), matches.confidence.contiguous(), step, depth_m.contiguous(),
        *marked.unbind(), n, BLOCK=BLOCK,
    )  # fmt: skip
    launched_on(depth_m, numbers_kernel[(1,)])(*marked.sort(1).values, step, numbers, n, num_warps=1)
    return dict(zip(NUMBERS, numbers.unbind(), strict=True))
