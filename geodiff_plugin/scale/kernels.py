"""Triton kernel of the scale's refinement, whose reference is ``scale.points.refine_to_matches``.

This module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.scale.points import KERNEL_FORMS, FitTarget

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
def _log_depth(v, FORM: tl.constexpr):
    """``Space.forward`` at a global scale of 1, its logarithm."""
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
    return tl.log(tl.maximum(depth, 1e-9))


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


@triton.jit(do_not_specialize=["count", "iterations"])
def refine_kernel(
    ends, lower, upper, residuals, values, inverse, confidence, deviation, noise_of_match,
    count, iterations, floor, cauchy,
    FORM: tl.constexpr, BLOCK: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """All reweighted Gauss-Newton steps (``points._refine_once``) of a map, by one program."""
    row = tl.program_id(0)
    x_at, size = values + row * count, residuals + row * count
    noise = tl.load(noise_of_match)
    e0, e1 = tl.load(ends + 2 * row), tl.load(ends + 2 * row + 1)
    low0, low1 = tl.load(lower + 2 * row), tl.load(lower + 2 * row + 1)
    high0, high1 = tl.load(upper + 2 * row), tl.load(upper + 2 * row + 1)
    for _ in range(iterations):
        _store_residuals(x_at, inverse, noise, e0, e1, size, count, FORM, CHUNK)
        median = _weighted_median(size, confidence, count, BLOCK)
        n00, n01, n11, g0, g1 = _normal_equations(
            x_at, inverse, confidence, deviation, noise, e0, e1, tl.maximum(1.4826 * median, floor),
            count, cauchy, FORM, CHUNK,
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
    tl.store(ends + 2 * row, e0)
    tl.store(ends + 2 * row + 1, e1)


def warps(block: int) -> int:
    """Of a program that holds so many matches."""
    return min(_MOST_WARPS, block // _MATCHES_A_WARP)


def refined_ends(
    space: str,
    ends: Tensor,
    values: Tensor,
    target: FitTarget,
    bounds: tuple[Tensor, Tensor],
    limits: tuple[int, float, float],
) -> Tensor:
    """``ends (B, 2)`` after all steps; arguments as ``points._refine_once`` takes them.

    ``limits`` are the number of steps, the least residual of a map, and the width of the Cauchy weight.
    """
    rows, count = values.shape
    block = max(_LEAST_BLOCK, triton.next_power_of_2(count))
    refined = ends.float().clone().contiguous()
    launched_on(values, refine_kernel[(rows,)])(
        refined,
        *(bound.float().contiguous() for bound in bounds),
        torch.empty_like(values, dtype=torch.float32, memory_format=torch.contiguous_format),
        values.float().contiguous(),
        target.inverse_depth.float().contiguous(),
        target.confidence.float().contiguous(),
        target.deviation.float().contiguous(),
        torch.as_tensor(target.noise).float().reshape(1),
        count,
        *limits,
        FORM=KERNEL_FORMS[space],
        BLOCK=block,
        CHUNK=CHUNK,
        num_warps=warps(block),
    )
    return refined
