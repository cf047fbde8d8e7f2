"""Triton kernel for refining the scale, ``points.refine_to_matches``."""

from __future__ import annotations

import math

import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin._internal.statistics import SD_PER_MAD
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale import constants
from geodiff_plugin.scale.kernels.space import ends, forward, inverse
from geodiff_plugin.scale.sampling import sampling_stride

# Triton kernels can read module constants only as constexpr.
_FIT_NOISE = tl.constexpr(constants.FIT_NOISE)
_SD_PER_MAD = tl.constexpr(SD_PER_MAD)
_FIT_FLOOR = tl.constexpr(constants.FIT_FLOOR)
_FIT_CAUCHY = tl.constexpr(constants.FIT_CAUCHY)
_REFERENCE_DOUBT = tl.constexpr(constants.REFERENCE_DOUBT)
_MIN_DOUBT = tl.constexpr(constants.MIN_DOUBT)
_NEAR_FACTOR = tl.constexpr(math.exp(constants.NEAR_FACTOR))
_FAR_FACTOR = tl.constexpr(math.exp(constants.FAR_FACTOR))
_FULLEST = tl.constexpr(constants.FULLEST)
#: Minimum number of matches per block; a smaller one would compile another kernel for few matches.
_MIN_BLOCK = 1024
#: Number of matches whose equations are summed per iteration, fewer than in the median search.
CHUNK = 512
#: Number of matches per warp.
_MATCHES_PER_WARP = 256
#: Maximum number of warps per program.
_MAX_WARPS = 32
#: Bits of 1.0, the largest residual, as an integer.
_BITS_OF_ONE = tl.constexpr(0x3F800000)
#: Bisection steps that identify one of these floats.
_HALVINGS = tl.constexpr(31)


@triton.jit
def value_at(x, pixel, height, width, rows, columns):
    """Sample a map ``(rows, columns)`` at pixels of a grid of another size, as ``F.interpolate`` does."""
    v = tl.maximum(((pixel // width).to(tl.float32) + 0.5) * (rows / height) - 0.5, 0.0)
    u = tl.maximum(((pixel % width).to(tl.float32) + 0.5) * (columns / width) - 0.5, 0.0)
    top, left = tl.minimum(v.to(tl.int32), rows - 1), tl.minimum(u.to(tl.int32), columns - 1)
    down, right = v - top.to(tl.float32), u - left.to(tl.float32)
    below, next_left = tl.minimum(top + 1, rows - 1) * columns, tl.minimum(left + 1, columns - 1)
    top = top * columns
    above = (1.0 - right) * tl.load(x + top + left) + right * tl.load(x + top + next_left)
    under = (1.0 - right) * tl.load(x + below + left) + right * tl.load(x + below + next_left)
    return (1.0 - down) * above + down * under


@triton.jit
def _log_depth(v, FORM: tl.constexpr):
    """Compute the logarithm of ``forward``."""
    return tl.log(tl.maximum(forward(v, FORM), 1e-9))


@triton.jit
def _clamped_end(end, free, other_free, other_bound, low, high, gradient, coupling, other_end, curvature):
    """Return a new end within its bounds; if the other end is at its bound, solved for that bound."""
    given_other = end - (gradient + coupling * (other_bound - other_end)) / (curvature + 1e-20)
    bound = tl.minimum(tl.maximum(free, low), high)
    return tl.minimum(tl.maximum(tl.where(other_bound != other_free, given_other, bound), low), high)


@triton.jit
def _residual(x, matched, noise, e0, e1, FORM: tl.constexpr):
    """Compute the residuals of matches, the map's inverse depth plus noise, and the map's fraction of it."""
    mapped = tl.exp(-_log_depth((1.0 - x) * e0 + x * e1, FORM))
    above = mapped + noise
    return tl.minimum(tl.maximum(tl.log((matched + noise) / above), -1.0), 1.0), above, mapped / above


@triton.jit
def _weighted_median(values, weight, count, BLOCK: tl.constexpr):
    """Return the weighted median of values in [0, 1], exactly; ``values`` and ``weight`` are pointers.

    Floats >= 0 sort like their bits, so the bits are bisected.
    """
    k = tl.arange(0, BLOCK)
    inside = k < count
    bits = tl.load(values + k, inside, 0.0).to(tl.int32, bitcast=True)
    half = 0.5 * tl.sum(tl.load(weight + k, inside, 0.0), 0)
    below = tl.min(bits, 0) - 1
    reached = below * 0 + _BITS_OF_ONE
    for _ in range(_HALVINGS):
        middle = below + (reached - below) // 2
        enough = tl.sum(tl.load(weight + k, inside & (bits <= middle), 0.0), 0) >= half
        open_ended = reached - below > 1
        reached = tl.where(open_ended & enough, middle, reached)
        below = tl.where(open_ended & (enough == 0), middle, below)
    return tl.max(tl.where(bits <= reached, bits, 0), 0).to(tl.float32, bitcast=True)


@triton.jit
def _store_residuals(x_at, inverse, noise, e0, e1, size, count, FORM: tl.constexpr, CHUNK: tl.constexpr):
    """Store the absolute residual of every match and synchronize the program."""
    tl.debug_barrier()  # all threads have read the previous step's residuals
    for first in range(0, count, CHUNK):
        k = first + tl.arange(0, CHUNK)
        inside = k < count
        x, matched = tl.load(x_at + k, inside, 0.0), tl.load(inverse + k, inside, 1.0)
        residual, _above, _fraction = _residual(x, matched, noise, e0, e1, FORM)
        tl.store(size + k, tl.abs(residual), inside)
    tl.debug_barrier()


@triton.jit
def _normal_equations(
    x_at, inverse, confidence, deviation, noise, e0, e1, map_deviation, count, cauchy,
    FORM: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Sum the weighted normal equations for a change of the ends ``e0`` and ``e1`` over all matches.

    The ends are the values that 0 and 1 of the relative map ``x`` are mapped to. The residuals come from
    ``_residual``, weighted by confidence, variance and a Cauchy function of width ``cauchy``, in standard
    deviations. The slope of log depth is a central difference with step ``h``.

    Returns the matrix ``[[n00, n01], [n01, n11]]`` as ``n00, n01, n11``, and the gradient ``g0, g1``.
    """
    h = 1e-3 * tl.maximum(tl.abs(e1 - e0), 1e-2 * tl.maximum(tl.abs(e0), tl.abs(e1)))
    n00, n01, n11 = (
        tl.zeros([CHUNK], tl.float32),
        tl.zeros([CHUNK], tl.float32),
        tl.zeros([CHUNK], tl.float32),
    )
    g0, g1 = tl.zeros([CHUNK], tl.float32), tl.zeros([CHUNK], tl.float32)
    for first in range(0, count, CHUNK):
        k = first + tl.arange(0, CHUNK)
        inside = k < count
        x = tl.load(x_at + k, inside, 0.0)
        residual, above, fraction = _residual(x, tl.load(inverse + k, inside, 1.0), noise, e0, e1, FORM)
        v = (1.0 - x) * e0 + x * e1
        slope = fraction * (_log_depth(v + h, FORM) - _log_depth(v - h, FORM)) / (2.0 * h)
        spread = tl.load(deviation + k, inside, 1.0) * noise / above
        variance = spread * spread + map_deviation * map_deviation
        weight = tl.load(confidence + k, inside, 0.0)
        weight /= variance * (1.0 + residual * residual / (cauchy * cauchy * variance))
        j0, j1 = slope * (1.0 - x), slope * x
        n00 += weight * j0 * j0
        n01 += weight * j0 * j1
        n11 += weight * j1 * j1
        g0 += weight * j0 * residual
        g1 += weight * j1 * residual
    return tl.sum(n00, 0), tl.sum(n01, 0), tl.sum(n11, 0), tl.sum(g0, 0), tl.sum(g1, 0)


@triton.jit
def _gather(
    x, at, map_inverse, map_confidence, values, inverse_at, confidence, deviation, count, stride,
    height, width, rows, columns, CHUNK: tl.constexpr,
):  # fmt: skip
    """Gather the map's value and the match's data for every match into contiguous arrays."""
    for first in range(0, count, CHUNK):
        k = first + tl.arange(0, CHUNK)
        inside = k < count
        pixel = tl.load(at + k.to(tl.int64) * stride, inside, 0).to(tl.int32)
        match_confidence = tl.load(map_confidence + pixel)
        doubt = tl.maximum((1.0 - match_confidence) / _REFERENCE_DOUBT, _MIN_DOUBT)
        tl.store(values + k, value_at(x, pixel, height, width, rows, columns), inside)
        tl.store(inverse_at + k, tl.maximum(tl.load(map_inverse + pixel), 0.0), inside)
        tl.store(confidence + k, match_confidence, inside)
        tl.store(deviation + k, tl.sqrt(doubt), inside)


@triton.jit
def _bounds(near, far, FORM: tl.constexpr):
    """Return the lower and upper bounds of both ends in the fit."""
    low0, low1 = ends(near / _NEAR_FACTOR, far / _FAR_FACTOR, FORM)
    high0, high1 = ends(near * _NEAR_FACTOR, far * _FAR_FACTOR, FORM)
    low0, low1 = inverse(low0, FORM), inverse(low1, FORM)
    high0, high1 = inverse(high0, FORM), inverse(high1, FORM)
    return tl.minimum(low0, high0), tl.minimum(low1, high1), tl.maximum(low0, high0), tl.maximum(low1, high1)


@triton.jit(
    do_not_specialize=["count", "stride", "iterations"],
    do_not_specialize_on_alignment=["near_m", "far_m"],
)
def refine_kernel(
    x, at, map_inverse, map_confidence, step, near_m, far_m, scratch, refined,
    count, stride, height, width, rows, columns, iterations,
    FORM: tl.constexpr, BLOCK: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Run all reweighted Gauss-Newton steps (``points._refine_once``) of a map in one program."""
    row = tl.program_id(0)
    x += row * rows * columns
    scratch += row * 5 * count
    values, inverse_at, confidence = scratch, scratch + count, scratch + 2 * count
    deviation, size = scratch + 3 * count, scratch + 4 * count
    _gather(
        x, at, map_inverse, map_confidence, values, inverse_at, confidence, deviation, count, stride,
        height, width, rows, columns, CHUNK,
    )  # fmt: skip
    noise = tl.load(step) * _FIT_NOISE
    near, far = tl.load(near_m + row), tl.load(far_m + row)
    e0, e1 = ends(near, far, FORM)
    e0, e1 = inverse(e0, FORM), inverse(e1, FORM)
    low0, low1, high0, high1 = _bounds(near, far, FORM)
    for _ in range(iterations):
        _store_residuals(values, inverse_at, noise, e0, e1, size, count, FORM, CHUNK)
        median = _weighted_median(size, confidence, count, BLOCK)
        n00, n01, n11, g0, g1 = _normal_equations(
            values, inverse_at, confidence, deviation, noise, e0, e1,
            tl.maximum(median * _SD_PER_MAD, _FIT_FLOOR), count, _FIT_CAUCHY, FORM, CHUNK,
        )  # fmt: skip
        damping = 1e-12 * (n00 + n11) + 1e-20
        a00, a11 = n00 + 1e-4 * n00 + damping, n11 + 1e-4 * n11 + damping
        determinant = a00 * a11 - n01 * n01
        f0 = e0 - (a11 * g0 - n01 * g1) / determinant
        f1 = e1 - (a00 * g1 - n01 * g0) / determinant
        b0 = tl.minimum(tl.maximum(f0, low0), high0)
        b1 = tl.minimum(tl.maximum(f1, low1), high1)
        new0 = _clamped_end(e0, f0, f1, b1, low0, high0, g0, n01, e1, n00)
        e1 = _clamped_end(e1, f1, f0, b0, low1, high1, g1, n01, e0, n11)
        e0 = new0
    near, far = ends(forward(e0, FORM), forward(e1, FORM), FORM)
    tl.store(refined + row, tl.minimum(near, far * _FULLEST))
    tl.store(refined + tl.num_programs(0) + row, far)


def warps(block: int) -> int:
    """Return the number of warps for a block of matches."""
    return min(_MAX_WARPS, block // _MATCHES_PER_WARP)


def refined_ends(
    x: Tensor, matches: Matches, near_m: Tensor, far_m: Tensor, space: str
) -> tuple[Tensor, Tensor]:
    """Run ``points._refined_ends`` with a kernel."""
    at = matches.above(0.0)
    stride = sampling_stride(at)
    count = -(-len(at) // stride)
    x = x.float().contiguous()
    scratch, refined = x.new_empty(len(x), 5, count), x.new_empty(2, len(x))
    block = max(_MIN_BLOCK, triton.next_power_of_2(count))
    launched_on(x, refine_kernel[(len(x),)])(
        x,
        at,
        matches.inverse_depth.contiguous(),
        matches.confidence.contiguous(),
        matches.plane_step,
        near_m.contiguous(),
        far_m.contiguous(),
        scratch,
        refined,
        count,
        stride,
        *matches.size,
        *x.shape[-2:],
        constants.FIT_ITERATIONS,
        FORM=constants.KERNEL_FORMS[space],
        BLOCK=block,
        CHUNK=CHUNK,
        num_warps=warps(block),
    )
    nearest, farthest = refined.unbind()
    return nearest, farthest
