"""Triton kernels for ``aggregation.aggregate``.

A program reads all planes of a pixel contiguously, so planes are innermost in memory.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.matching import constants
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.kernels.arithmetic import rounded
from geodiff_plugin.matching.volume import Buffers

# Triton kernels can read module constants only as constexpr.
_NEVER = tl.constexpr(constants.NEVER)
_COST_LEVELS = tl.constexpr(COST_LEVELS)
_STEP_PENALTY = tl.constexpr(constants.STEP_PENALTY)
_JUMP_PENALTY = tl.constexpr(constants.JUMP_PENALTY)
_JUMP_CONTRAST = tl.constexpr(constants.JUMP_CONTRAST)
#: Pixels per program for maps.
PIXELS = 256
# Number of planes of a path that fit the registers of one warp.
_PLANES_PER_WARP = 256


@triton.jit
def _line(number, down, across, height, width):
    """Return the first pixel's row and column of a line along an axis, and the steps to its last, or -1."""
    # Lines begin on the first row, from left to right, and then on the side opposite to the axis direction.
    side = tl.where(across < 0, width - 1, 0)
    on_top = (down > 0) & (number < width)
    row = tl.where(down > 0, tl.maximum(number - width + 1, 0), number)
    column = tl.where(on_top, number, side)
    exists = (row < height) & ((across != 0) | (number < width))
    to_bottom = tl.where(down > 0, height - row, width)
    to_side = tl.where(across > 0, width - column, tl.where(across < 0, column + 1, height))
    last = tl.where(exists, tl.minimum(to_bottom, to_side), 0) - 1
    return row, column, last


@triton.jit
def paths_kernel(
    levels,
    penalties,
    total,
    planes,
    height,
    width,
    levels_plane,
    levels_row,
    levels_column,
    step_penalty,
    DOWN: tl.constexpr,
    ACROSS: tl.constexpr,
    PADDED: tl.constexpr,
):
    """Add one path, in steps of (DOWN, ACROSS) forwards or backwards, to the total.

    Grid: lines of an axis, axes, directions. A vector holds the path's costs of all planes.
    """
    line, axis, back = tl.program_id(0), tl.program_id(1), tl.program_id(2) == 1
    down, across = 0, 0
    for each in tl.static_range(len(DOWN)):
        down = tl.where(axis == each, DOWN[each], down)
        across = tl.where(axis == each, ACROSS[each], across)
    row, column, last = _line(line, down, across, height, width)
    row = tl.where(back, row + last * down, row)
    column = tl.where(back, column + last * across, column)
    direction = tl.where(back, -1, 1)

    plane = tl.arange(0, PADDED)
    used = plane < tl.where(last >= 0, planes, 0)
    below, above = tl.maximum(plane - 1, 0), tl.minimum(plane + 1, PADDED - 1)
    cost_step = (direction * (down * levels_row + across * levels_column)).to(tl.int64)
    cost_at = levels + row.to(tl.int64) * levels_row + column.to(tl.int64) * levels_column
    cost_at += plane * levels_plane
    pixel = row * width + column
    pixel_step = direction * (down * width + across)
    total_at = total + pixel.to(tl.int64) * planes + plane
    total_step = pixel_step.to(tl.int64) * planes
    # The penalty between two pixels is stored at the later one in forward direction.
    penalty_at = penalties + axis * height * width + pixel + tl.where(back, 0, pixel_step)

    path = tl.where(used, tl.load(cost_at, mask=used, other=0).to(tl.int32), _NEVER)
    tl.atomic_add(total_at, path, mask=used, sem="relaxed")
    # Prefetch the data of the next two steps, which do not depend on the path.
    cost_1 = tl.load(cost_at + tl.minimum(1, last) * cost_step, mask=used, other=0)
    cost_2 = tl.load(cost_at + tl.minimum(2, last) * cost_step, mask=used, other=0)
    limit_1 = tl.load(penalty_at, mask=last >= 1, other=0)
    limit_2 = tl.load(penalty_at + pixel_step, mask=last >= 2, other=0)
    for n in range(1, last + 1):
        cost, limit = cost_1.to(tl.int32), limit_1.to(tl.int32)
        cost_1, limit_1 = cost_2, limit_2
        cost_2 = tl.load(cost_at + tl.minimum(n + 2, last) * cost_step, mask=used, other=0)
        limit_2 = tl.load(penalty_at + (n + 1) * pixel_step, mask=n + 2 <= last, other=0)
        least = tl.min(path, 0)
        step = tl.minimum(tl.gather(path, below, 0), tl.gather(path, above, 0)) + step_penalty
        path = cost + tl.minimum(tl.minimum(step, path), limit + least) - least
        path = tl.where(used, path, _NEVER)
        tl.atomic_add(total_at + n * total_step, path, mask=used, sem="relaxed")


@triton.jit
def penalties_kernel(
    grey,
    penalties,
    height,
    width,
    grey_row,
    DOWN: tl.constexpr,
    ACROSS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Compute the penalties of larger steps at BLOCK pixels, on each axis."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < height * width
    row, column = pixel // width, pixel % width
    own = tl.load(grey + row * grey_row + column, mask=inside, other=0.0)
    for axis in tl.static_range(len(DOWN)):
        other_row, other_column = row - DOWN[axis], column - ACROSS[axis]
        exists = inside & (other_row >= 0) & (other_column >= 0) & (other_column < width)
        other = tl.load(grey + other_row * grey_row + other_column, mask=exists, other=0.0)
        difference = tl.where(exists, tl.abs(own - other), 0.0)
        flat = tl.div_rn(difference, tl.full([BLOCK], _JUMP_CONTRAST, tl.float32)) + 1.0
        limit = tl.div_rn(tl.full([BLOCK], 1.0, tl.float32), flat) * _JUMP_PENALTY
        limit = tl.maximum(limit, 2.0 * _STEP_PENALTY)
        limit = tl.where(difference == difference, limit, 0.0)  # NaN: an invalid pixel
        at = penalties + axis * height * width + pixel
        tl.store(at, rounded(limit * _COST_LEVELS).to(tl.int16), mask=inside)


def jump_penalties(grey: Tensor, axes: Sequence[tuple[int, int]]) -> Tensor:
    """Run ``aggregation.jump_penalties`` with a kernel."""
    height, width = grey.shape
    penalties = torch.empty(len(axes), height, width, dtype=torch.int16, device=grey.device)
    launched_on(grey, penalties_kernel[(triton.cdiv(height * width, PIXELS),)])(
        grey,
        penalties,
        height,
        width,
        grey.stride(0),
        DOWN=tuple(down for down, _ in axes),
        ACROSS=tuple(across for _, across in axes),
        BLOCK=PIXELS,
        num_warps=4,
        enable_fp_fusion=False,
    )
    return penalties


def path_warps(planes: int) -> int:
    """Return the number of warps for a path with the given number of planes."""
    return max(1, triton.next_power_of_2(planes) // _PLANES_PER_WARP)


def aggregate(levels: Tensor, grey: Tensor, *, buffers: Buffers | None = None) -> Tensor:
    """Run ``aggregation.aggregate`` with kernels, as int32; needs no buffers."""
    penalties = jump_penalties(grey, constants.AXES)
    return sum_paths(levels, penalties, constants.STEP_LEVELS, constants.AXES)


def sum_paths(levels: Tensor, penalties: Tensor, step: int, axes: Sequence[tuple[int, int]]) -> Tensor:
    """Sum costs along any axes in both directions, ``(D, H, W)`` int32.

    ``penalties`` are the ``aggregation.jump_penalties`` of these axes, ``step`` is the penalty of one plane.
    Sums are added atomically, which requires 32 bits. The order does not change a sum of integers.
    """
    planes, height, width = levels.shape
    total = torch.zeros(height, width, planes, dtype=torch.int32, device=levels.device)
    diagonal = any(down and across for down, across in axes)
    lines = height + width - 1 if diagonal else max(height, width)
    launched_on(levels, paths_kernel[(lines, len(axes), 2)])(
        levels,
        penalties,
        total,
        planes,
        height,
        width,
        *levels.stride(),
        step,
        DOWN=tuple(down for down, _ in axes),
        ACROSS=tuple(across for _, across in axes),
        PADDED=triton.next_power_of_2(planes),
        num_warps=path_warps(planes),
    )
    return total.permute(2, 0, 1)
