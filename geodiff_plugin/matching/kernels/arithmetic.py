"""Arithmetic for Triton kernels with the same rounding as torch."""

from __future__ import annotations

import triton
import triton.language as tl

# Adding this constant to a float32 below 2^22 rounds it to the nearest integer, ties to even.
_ROUNDING = tl.constexpr(1.5 * 2.0**23)


@triton.jit
def rounded(x):
    """Compute ``torch.round`` of a float32 below 2^22."""
    return (x + _ROUNDING) - _ROUNDING


@triton.jit
def lerp(start, end, weight):
    """Compute ``torch.lerp`` with a single rounding: float64 holds the product of two float32 exactly."""
    near = weight < 0.5
    fraction = tl.where(near, weight, weight - 1.0).to(tl.float64)
    base = tl.where(near, start, end).to(tl.float64)
    return (fraction * (end - start).to(tl.float64) + base).to(tl.float32)
