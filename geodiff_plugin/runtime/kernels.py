"""Triton kernel of the group norm of a VAE in half precision, whose reference is ``torch.nn.GroupNorm``.

This module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on

#: Values that a program holds at once.
BLOCK = 2048
#: Programs of a group at most, because each of them adds up the sums of all.
MOST_PARTS = 64
#: Programs that keep a large card busy.
BUSY = 2048


@triton.jit(do_not_specialize=["length", "part", "parts"])
def moments_kernel(x, sums, length, part, parts, BLOCK: tl.constexpr):
    """Sum, and sum of squares, of one part of a group."""
    group, which = tl.program_id(0), tl.program_id(1)
    base = x + group.to(tl.int64) * length
    one, two = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    last = tl.minimum((which + 1) * part, length)
    for first in range(which * part, last, BLOCK):
        k = first + tl.arange(0, BLOCK)
        value = tl.load(base + k, k < last, 0.0).to(tl.float32)
        one += value
        two += value * value
    tl.store(sums + (group * parts + which) * 2, tl.sum(one, 0))
    tl.store(sums + (group * parts + which) * 2 + 1, tl.sum(two, 0))


@triton.jit(do_not_specialize=["length", "area", "channels", "groups", "part", "parts"])
def normalise_kernel(
    x, out, sums, weight, bias, length, area, channels, groups, part, parts, eps,
    PARTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One part of a group with mean 0 and variance 1, times the weight of its channel, plus the bias."""
    group, which, s = tl.program_id(0), tl.program_id(1), tl.arange(0, PARTS)
    at = sums + (group * parts + s) * 2
    mean = tl.sum(tl.load(at, s < parts, 0.0), 0) / length
    square = tl.sum(tl.load(at + 1, s < parts, 0.0), 0) / length
    scale = tl.rsqrt(tl.maximum(square - mean * mean, 0.0) + eps)
    base, last = group.to(tl.int64) * length, tl.minimum((which + 1) * part, length)
    for first in range(which * part, last, BLOCK):
        k = first + tl.arange(0, BLOCK)
        inside, channel = k < last, (group % groups) * channels + k // area
        gain = tl.load(weight + channel, inside, 0.0).to(tl.float32) * scale
        value = (tl.load(x + base + k, inside, 0.0).to(tl.float32) - mean) * gain
        value += tl.load(bias + channel, inside, 0.0).to(tl.float32)
        tl.store(out + base + k, value.to(out.dtype.element_ty), inside)


def group_norm(x: Tensor, groups: int, weight: Tensor, bias: Tensor, eps: float) -> Tensor:
    """``F.group_norm`` of ``x (B, C, ...)``, contiguous; sums are in float32, as in torch."""
    channels, rows = x.shape[1] // groups, x.shape[0] * groups
    length = x.numel() // rows
    parts = max(1, min(MOST_PARTS, triton.cdiv(length, BLOCK), BUSY // rows))
    part = triton.cdiv(triton.cdiv(length, parts), BLOCK) * BLOCK
    parts = triton.cdiv(length, part)
    sums = torch.empty(rows, parts, 2, dtype=torch.float32, device=x.device)
    out = torch.empty_like(x)
    launched_on(x, moments_kernel[(rows, parts)])(x, sums, length, part, parts, BLOCK=BLOCK)
    launched_on(x, normalise_kernel[(rows, parts)])(
        x, out, sums, weight, bias, length, length // channels, channels, groups, part, parts, eps,
        PARTS=MOST_PARTS, BLOCK=BLOCK,
    )  # fmt: skip
    return out
