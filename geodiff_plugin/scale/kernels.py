"""Triton kernels of ``scale.space`` and of the scale's refinement, ``scale.points.refine_to_matches``.

This module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._certain import SD_PER_MAD
from geodiff_plugin._kernels import launched_on
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale import points
from geodiff_plugin.scale.space import FLOOR_EPS, KERNEL_FORMS, SQUARE, AffineState, MetricMap

# A kernel reads constants of its module only as these.
_FIT_NOISE = tl.constexpr(points.FIT_NOISE)
_SD_PER_MAD = tl.constexpr(SD_PER_MAD)
_FIT_FLOOR = tl.constexpr(points.FIT_FLOOR)
_FIT_CAUCHY = tl.constexpr(points.FIT_CAUCHY)
_REFERENCE_DOUBT = tl.constexpr(points.REFERENCE_DOUBT)
_LEAST_DOUBT = tl.constexpr(points.LEAST_DOUBT)
_NEAR_FACTOR = tl.constexpr(math.exp(points.NEAR_REACH))
_FAR_FACTOR = tl.constexpr(math.exp(points.FAR_REACH))
_FULLEST = tl.constexpr(points.FULLEST)
_EPS = tl.constexpr(FLOOR_EPS)
#: Pixels of a program that works on each by itself.
PIXELS = 1024
#: What such a program makes of a map: ``smooth_floor``.
FLOORED = 0
#: Metres.
METRIC = 1
#: The relative map of metres.
RELATIVE = 2
_FLOORED, _METRIC = tl.constexpr(FLOORED), tl.constexpr(METRIC)
#: Matches of a program that are held at once, at least: fewer would compile another kernel for few matches.
_LEAST_BLOCK = 1024
#: Matches whose equations are summed at once, fewer than are searched for their median.
CHUNK = 512
#: Matches for a warp.
_MATCHES_A_WARP = 256
#: Warps of a program at most.
_MOST_WARPS = 32
#: The bits of 1.0, the largest residual, as an integer.
_BITS_OF_ONE = tl.constexpr(0x3F800000)
#: Halvings that find one of so many numbers.
_HALVINGS = tl.constexpr(31)


@triton.jit
def forward(v, FORM: tl.constexpr):
    """``Space.forward`` at a global scale of 1."""
    if FORM == 0:
        depth = v
    elif FORM == 1:
        depth = 1.0 / v
    elif FORM == 2:
        depth = tl.exp(v)
    elif FORM == 3:
        depth = tl.exp(v) - 1.0
    else:
        depth = 1.0 / (v * v)
    return depth


@triton.jit
def inverse(depth, FORM: tl.constexpr):
    """``Space.inverse``."""
    if FORM == 0:
        v = depth
    elif FORM == 1:
        v = 1.0 / depth
    elif FORM == 2:
        v = tl.log(depth)
    elif FORM == 3:
        v = tl.log(1.0 + depth)
    else:
        v = 1.0 / tl.sqrt(depth)
    return v


@triton.jit
def ends(near, far, FORM: tl.constexpr):
    """``Space.ends``: disparities fall with depth."""
    if (FORM == 1) or (FORM == 4):
        at_zero, at_one = far, near
    else:
        at_zero, at_one = near, far
    return at_zero, at_one


@triton.jit
def floored_of(x, CLIPPED: tl.constexpr):
    """``space.smooth_floor``, or a map clipped to [0, 1]."""
    if CLIPPED:
        floored = tl.minimum(tl.maximum(x, 0.0), 1.0)
    else:
        root = tl.sqrt(x * x + 4.0 * _EPS * _EPS)
        floored = tl.where(x > 0.0, 0.5 * (x + root), 2.0 * _EPS * _EPS / (root - tl.minimum(x, 0.0)))
    return floored


@triton.jit
def _softplus(raw):
    """``F.softplus``; the log of 1 + e, e small, by the ratio in which its rounding cancels."""
    e = tl.exp(tl.minimum(raw, 20.0))
    above = 1.0 + e
    return tl.where(raw > 20.0, raw, tl.where(above == 1.0, e, tl.log(above) * (e / (above - 1.0))))


@triton.jit
def map_kernel(
    x, scale, shift, unit, made, pixels,
    MAKES: tl.constexpr, FORM: tl.constexpr, CLIPPED: tl.constexpr, RAW: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """``smooth_floor``, ``MetricMap.__call__`` or ``MetricMap.relative``. Grid: blocks of pixels, maps."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists, of_map = pixel < pixels, tl.program_id(1)
    at = of_map.to(tl.int64) * pixels + pixel
    value = tl.load(x + at, exists, 1.0)
    if MAKES == _FLOORED:
        value = floored_of(value, CLIPPED)
    else:
        s, t, g = tl.load(scale + of_map), tl.load(shift + of_map), tl.load(unit + of_map)
        if RAW:
            s, t = _softplus(s), _softplus(t)
        if MAKES == _METRIC:
            value = g * forward(s * floored_of(value, CLIPPED) + t, FORM)
        else:
            value = (inverse(value / g, FORM) - t) / s
            if CLIPPED:
                value = tl.minimum(tl.maximum(value, 0.0), 1.0)
            else:
                value = tl.maximum(value, 0.5 * _EPS)
                value = value - _EPS * _EPS / value
    tl.store(made + at, value, exists)


@triton.jit
def value_at(x, pixel, height, width, rows, columns):
    """A map ``(rows, columns)`` at pixels of a grid of another size, as ``torch`` interpolates."""
    v = tl.maximum(((pixel // width).to(tl.float32) + 0.5) * (rows / height) - 0.5, 0.0)
    u = tl.maximum(((pixel % width).to(tl.float32) + 0.5) * (columns / width) - 0.5, 0.0)
    top, left = tl.minimum(v.to(tl.int32), rows - 1), tl.minimum(u.to(tl.int32), columns - 1)
    down, right = v - top.to(tl.float32), u - left.to(tl.float32)
    below, beside = tl.minimum(top + 1, rows - 1) * columns, tl.minimum(left + 1, columns - 1)
    top = top * columns
    above = (1.0 - right) * tl.load(x + top + left) + right * tl.load(x + top + beside)
    under = (1.0 - right) * tl.load(x + below + left) + right * tl.load(x + below + beside)
    return (1.0 - down) * above + down * under


@triton.jit
def _log_depth(v, FORM: tl.constexpr):
    """The logarithm of ``forward``."""
    return tl.log(tl.maximum(forward(v, FORM), 1e-9))


@triton.jit
def _settled(end, free, other_free, other_bound, low, high, gradient, coupling, other_end, curvature):
    """A new end within its bounds; where the other one is stopped by its bound, solved for that."""
    alone = end - (gradient + coupling * (other_bound - other_end)) / (curvature + 1e-20)
    bound = tl.minimum(tl.maximum(free, low), high)
    return tl.minimum(tl.maximum(tl.where(other_bound != other_free, alone, bound), low), high)


@triton.jit
def _residual(x, matched, noise, e0, e1, FORM: tl.constexpr):
    """Residual of matches, inverse depth of the map with the noise added, and the share that is the map's."""
    mapped = tl.exp(-_log_depth((1.0 - x) * e0 + x * e1, FORM))
    above = mapped + noise
    return tl.minimum(tl.maximum(tl.log((matched + noise) / above), -1.0), 1.0), above, mapped / above


@triton.jit
def _weighted_median(values, weight, count, BLOCK: tl.constexpr):
    """The least of values in [0, 1] up to which half of the weight lies, exactly; both are pointers.

    Floats >= 0 have the order of their bits, so the bits are searched by halving.
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
    """Write the size of every match's residual, and let the whole program see them."""
    tl.debug_barrier()  # nobody reads those of the step before any more
    for first in range(0, count, CHUNK):
        k = first + tl.arange(0, CHUNK)
        inside = k < count
        x, matched = tl.load(x_at + k, inside, 0.0), tl.load(inverse + k, inside, 1.0)
        residual, _above, _share = _residual(x, matched, noise, e0, e1, FORM)
        tl.store(size + k, tl.abs(residual), inside)
    tl.debug_barrier()


@triton.jit
def _normal_equations(
    x_at, inverse, confidence, deviation, noise, e0, e1, left_over, count, cauchy,
    FORM: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Both sides of the weighted least squares for a change of both ends, summed over the matches."""
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
        residual, above, share = _residual(x, tl.load(inverse + k, inside, 1.0), noise, e0, e1, FORM)
        v = (1.0 - x) * e0 + x * e1
        slope = share * (_log_depth(v + h, FORM) - _log_depth(v - h, FORM)) / (2.0 * h)
        spread = tl.load(deviation + k, inside, 1.0) * noise / above
        variance = spread * spread + left_over * left_over
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
    """Write the value of the map at every match, and what is known of the match, side by side."""
    for first in range(0, count, CHUNK):
        k = first + tl.arange(0, CHUNK)
        inside = k < count
        pixel = tl.load(at + k.to(tl.int64) * stride, inside, 0).to(tl.int32)
        sure = tl.load(map_confidence + pixel)
        doubt = tl.maximum((1.0 - sure) / _REFERENCE_DOUBT, _LEAST_DOUBT)
        tl.store(values + k, value_at(x, pixel, height, width, rows, columns), inside)
        tl.store(inverse_at + k, tl.maximum(tl.load(map_inverse + pixel), 0.0), inside)
        tl.store(confidence + k, sure, inside)
        tl.store(deviation + k, tl.sqrt(doubt), inside)


@triton.jit
def _bounds(near, far, FORM: tl.constexpr):
    """The least and the largest end, for the near and the far reach of the fit."""
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
    """All reweighted Gauss-Newton steps (``points._refine_once``) of a map, by one program."""
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
        new0 = _settled(e0, f0, f1, b1, low0, high0, g0, n01, e1, n00)
        e1 = _settled(e1, f1, f0, b0, low1, high1, g1, n01, e0, n11)
        e0 = new0
    near, far = ends(forward(e0, FORM), forward(e1, FORM), FORM)
    tl.store(refined + row, tl.minimum(near, far * _FULLEST))
    tl.store(refined + tl.num_programs(0) + row, far)


def _made(x: Tensor, affine: AffineState | None, makes: int, metric: MetricMap) -> Tensor:
    """Maps made of other ones, each with its scale, shift and global scale, if these are needed."""
    x, batch, numbers, raw = x.contiguous(), 1, [x, x, x], False
    if affine is not None:
        raw, batch = affine.units is None, len(x)
        both = (affine.s_hat, affine.t_hat) if raw else (affine.scale, affine.shift)
        numbers = [each.contiguous() for each in (*both, affine.g_s)]  # one number of all maps is expanded
    made, pixels = torch.empty_like(x), x.numel() // batch
    launched_on(x, map_kernel[(triton.cdiv(pixels, PIXELS), batch)])(
        x,
        *numbers,
        made,
        pixels,
        MAKES=makes,
        FORM=KERNEL_FORMS[metric.space],
        CLIPPED=metric.positive == SQUARE,
        RAW=raw,
        PIXELS=PIXELS,
    )
    return made


def floored(x: Tensor) -> Tensor:
    """``space.smooth_floor``."""
    return _made(x, None, FLOORED, MetricMap())


def metric_depth(x: Tensor, affine: AffineState, metric: MetricMap) -> Tensor:
    """``MetricMap.__call__``."""
    return _made(x, affine, METRIC, metric)


def relative(depth_m: Tensor, affine: AffineState, metric: MetricMap) -> Tensor:
    """``MetricMap.relative``."""
    return _made(depth_m, affine, RELATIVE, metric)


def warps(block: int) -> int:
    """Of a program that holds so many matches."""
    return min(_MOST_WARPS, block // _MATCHES_A_WARP)


def refined_range(
    x: Tensor, matches: Matches, near_m: Tensor, far_m: Tensor, space: str
) -> tuple[Tensor, Tensor]:
    """``points.refine_to_matches``, where there is a match."""
    at = matches.above(0.0)
    stride = points.sampling_stride(at)
    count = -(-len(at) // stride)
    x = x.float().contiguous()
    scratch, refined = x.new_empty(len(x), 5, count), x.new_empty(2, len(x))
    block = max(_LEAST_BLOCK, triton.next_power_of_2(count))
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
        points.FIT_ITERATIONS,
        FORM=KERNEL_FORMS[space],
        BLOCK=block,
        CHUNK=CHUNK,
        num_warps=warps(block),
    )
    nearest, farthest = refined.unbind()
    return nearest, farthest
