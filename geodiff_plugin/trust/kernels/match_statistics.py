"""Triton kernels for ``match_statistics``."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.kernels.reflections import count_below, median, quantile
from geodiff_plugin.matching.matches import RELIABLE
from geodiff_plugin.trust.constants import RANGE_QUANTILES

#: Number of pixels per program.
BLOCK = 512
#: Names of the statistics, in output order.
NUMBERS = ("matched", "in_front", "log_range", "range_planes", "median_m", "log_deviation", "compared")
# A kernel can only read module constants of type ``tl.constexpr``.
_RELIABLE = tl.constexpr(RELIABLE)
_LOW, _HIGH = map(tl.constexpr, RANGE_QUANTILES)
#: The largest float32.
_FINITE = tl.constexpr(3.4028234663852886e38)


@triton.jit(do_not_specialize=["n"], do_not_specialize_on_alignment=["off"])
def marked_kernel(inverse_depth, confidence, step, depth_m, matched, off, n, BLOCK: tl.constexpr):
    """Write the values to sort: inverse depth and the deviation of the result; NaN for unused pixels.

    A confident match at or beyond infinity is written as ``inf``, above all finite values.
    """
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = p < n
    inverse = tl.load(inverse_depth + p, inside, 1.0)
    confident = tl.load(confidence + p, inside, 0.0) > _RELIABLE
    finite = tl.where(inverse > 0.0, inverse, float("inf"))
    tl.store(matched + p, tl.where(confident, finite, float("nan")), inside)
    compared = confident & (inverse > tl.load(step))
    ratio = tl.where(compared, tl.load(depth_m + p, inside, 1.0) * inverse, 1.0)
    tl.store(off + p, tl.where(compared, tl.abs(tl.log(ratio)), float("nan")), inside)


@triton.jit(do_not_specialize=["n"], do_not_specialize_on_alignment=["off"])
def numbers_kernel(matched, off, step, numbers, n):
    """Compute ``NUMBERS`` from the sorted output of ``marked_kernel``."""
    confident, in_front = count_below(matched, n, float("inf")), count_below(matched, n, _FINITE)
    tl.store(numbers, confident.to(tl.float32) / n.to(tl.float32))
    tl.store(numbers + 1, in_front.to(tl.float32))
    low, high = quantile(matched, in_front, _LOW), quantile(matched, in_front, _HIGH)
    nothing = in_front == 0  # the first sorted value is then not a match
    tl.store(numbers + 2, tl.where(nothing, float("nan"), tl.log(high / tl.maximum(low, 1e-9))))
    tl.store(numbers + 3, tl.where(nothing, float("nan"), (high - low) / tl.load(step)))
    tl.store(numbers + 4, tl.where(nothing, float("nan"), 1.0 / median(matched, in_front)))
    compared = count_below(off, n, float("inf"))
    tl.store(numbers + 5, median(off, compared))
    tl.store(numbers + 6, compared.to(tl.float32))


def of_grid(matches: Matches, depth_m: Tensor) -> dict[str, Tensor]:
    """Run ``match_statistics._of_grid`` for ``depth_m (1, H, W)`` on the grid of the matches."""
    n, step = depth_m.numel(), matches.plane_step
    marked, numbers = depth_m.new_empty(2, n), depth_m.new_empty(len(NUMBERS))
    launched_on(depth_m, marked_kernel[(triton.cdiv(n, BLOCK),)])(
        matches.inverse_depth.contiguous(), matches.confidence.contiguous(), step, depth_m.contiguous(),
        *marked.unbind(), n, BLOCK=BLOCK,
    )  # fmt: skip
    launched_on(depth_m, numbers_kernel[(1,)])(*marked.sort(1).values, step, numbers, n, num_warps=1)
    return dict(zip(NUMBERS, numbers.unbind(), strict=True))
