"""Triton kernel for the half-precision group norm of a VAE; its reference is ``torch.nn.GroupNorm``."""

from __future__ import annotations

from collections.abc import Callable

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on

#: Number of values per program and iteration.
BLOCK = 2048
#: Maximum number of programs per group; each of them adds up the partial sums of all.
MAX_PARTS = 64
#: Number of programs that keep a large GPU busy.
BUSY = 2048


@triton.jit(do_not_specialize=["length", "part", "parts"])
def moments_kernel(x, sums, length, part, parts, BLOCK: tl.constexpr):
    """Sum the values and squares of one part of a group. Arguments as in ``normalize_kernel``."""
    group = tl.program_id(0)
    index = tl.program_id(1)
    base = x + group.to(tl.int64) * length
    values = tl.zeros([BLOCK], tl.float32)
    squares = tl.zeros([BLOCK], tl.float32)
    last = tl.minimum((index + 1) * part, length)
    for first in range(index * part, last, BLOCK):
        k = first + tl.arange(0, BLOCK)
        value = tl.load(base + k, k < last, 0.0).to(tl.float32)
        values += value
        squares += value * value
    tl.store(sums + (group * parts + index) * 2, tl.sum(values, 0))
    tl.store(sums + (group * parts + index) * 2 + 1, tl.sum(squares, 0))


@triton.jit(do_not_specialize=["length", "area", "channels", "groups", "part", "parts"])
def normalize_kernel(
    x, out, sums, weight, bias, length, area, channels, groups, part, parts, eps,
    PARTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Normalize one part of a group to mean 0 and variance 1, then apply the channel's weight and bias.

    Grid: the groups of all images, parts. An image has ``groups`` groups. A group has ``channels`` channels
    of ``area`` values, ``length`` values in all, and is split into ``parts`` parts of ``part`` values.
    """
    group = tl.program_id(0)
    index = tl.program_id(1)
    s = tl.arange(0, PARTS)
    at = sums + (group * parts + s) * 2
    mean = tl.sum(tl.load(at, s < parts, 0.0), 0) / length
    mean_square = tl.sum(tl.load(at + 1, s < parts, 0.0), 0) / length
    scale = tl.rsqrt(tl.maximum(mean_square - mean * mean, 0.0) + eps)
    base = group.to(tl.int64) * length
    last = tl.minimum((index + 1) * part, length)
    for first in range(index * part, last, BLOCK):
        k = first + tl.arange(0, BLOCK)
        inside = k < last
        channel = (group % groups) * channels + k // area
        gain = tl.load(weight + channel, inside, 0.0).to(tl.float32) * scale
        value = (tl.load(x + base + k, inside, 0.0).to(tl.float32) - mean) * gain
        value += tl.load(bias + channel, inside, 0.0).to(tl.float32)
        tl.store(out + base + k, value.to(out.dtype.element_ty), inside)


def group_norm(norm: torch.nn.GroupNorm, own: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Compute ``graphs._group_norm`` for a contiguous ``x (B, C, ...)``; sums are float32, as in torch."""
    groups = norm.num_groups
    channels, rows = x.shape[1] // groups, x.shape[0] * groups
    length = x.numel() // rows
    parts = max(1, min(MAX_PARTS, triton.cdiv(length, BLOCK), BUSY // rows))
    part = triton.cdiv(triton.cdiv(length, parts), BLOCK) * BLOCK
    parts = triton.cdiv(length, part)
    sums = torch.empty(rows, parts, 2, dtype=torch.float32, device=x.device)
    out = torch.empty_like(x)
    launched_on(x, moments_kernel[(rows, parts)])(x, sums, length, part, parts, BLOCK=BLOCK)
    launched_on(x, normalize_kernel[(rows, parts)])(
        x, out, sums, norm.weight, norm.bias, length, length // channels, channels, groups, part, parts,
        norm.eps, PARTS=MAX_PARTS, BLOCK=BLOCK,
    )  # fmt: skip
    return out
