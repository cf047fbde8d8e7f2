"""Triton kernels of the matching; each equals its reference, which its docstring names.

Volumes lie in memory with their planes innermost: a program reads the planes of a pixel in one piece. This
module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.winner import NEVER, PACKED_PLANES, UNSEEN_LEVEL, Winner

# A kernel reads constants of its module only as these.
_NEVER = tl.constexpr(NEVER)
_PACKED_PLANES = tl.constexpr(PACKED_PLANES)
_UNSEEN_LEVEL = tl.constexpr(UNSEEN_LEVEL)
_COST_LEVELS = tl.constexpr(COST_LEVELS)
# Sums that a program of the winner holds at once, in registers of its four warps.
_SUMS_AT_ONCE = 1024


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
    """Add one path, from its start pixel by steps of (DOWN, ACROSS) or back, to the total.

    Grid: lines of an axis, axes, ways. A vector holds the path's costs of all planes.
    """
    line, axis, back = tl.program_id(0), tl.program_id(1), tl.program_id(2) == 1
    down, across = 0, 0
    for each in tl.static_range(len(DOWN)):
        down = tl.where(axis == each, DOWN[each], down)
        across = tl.where(axis == each, ACROSS[each], across)
    # Lines begin on the first row, from left to right, and then on the side that the axis comes from.
    side = tl.where(across < 0, width - 1, 0)
    on_top = (down > 0) & (line < width)
    row = tl.where(down > 0, tl.maximum(line - width + 1, 0), line)
    column = tl.where(on_top, line, side)
    exists = (row < height) & ((across != 0) | (line < width))
    to_bottom = tl.where(down > 0, height - row, width)
    to_side = tl.where(across > 0, width - column, tl.where(across < 0, column + 1, height))
    last = tl.where(exists, tl.minimum(to_bottom, to_side), 0) - 1
    row = tl.where(back, row + last * down, row)
    column = tl.where(back, column + last * across, column)
    way = tl.where(back, -1, 1)

    plane = tl.arange(0, PADDED)
    used = plane < tl.where(last >= 0, planes, 0)
    below, above = tl.maximum(plane - 1, 0), tl.minimum(plane + 1, PADDED - 1)
    cost_step = (way * (down * levels_row + across * levels_column)).to(tl.int64)
    cost_at = levels + row.to(tl.int64) * levels_row + column.to(tl.int64) * levels_column
    cost_at += plane * levels_plane
    pixel = row * width + column
    pixel_step = way * (down * width + across)
    total_at = total + pixel.to(tl.int64) * planes + plane
    total_step = pixel_step.to(tl.int64) * planes
    # The penalty between two pixels stands at the later one of the way forward.
    penalty_at = penalties + axis * height * width + pixel + tl.where(back, 0, pixel_step)

    path = tl.where(used, tl.load(cost_at, mask=used, other=0).to(tl.int32), _NEVER)
    tl.atomic_add(total_at, path, mask=used, sem="relaxed")
    # What the next two steps need is loaded ahead: it does not depend on the path.
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


def aggregate(levels: Tensor, penalties: Tensor, step: int, axes: Sequence[tuple[int, int]]) -> Tensor:
    """``aggregation.aggregate`` along any axes, each both ways, as ``(D, H, W)`` int32.

    ``penalties`` are the ``aggregation.jump_penalties`` of these axes, ``step`` is the penalty of a plane.
    Sums are added atomically, for which a card needs 32 bits: no order changes a sum of integers.
    """
    planes, height, width = levels.shape
    total = torch.zeros(height, width, planes, dtype=torch.int32, device=levels.device)
    diagonal = any(down and across for down, across in axes)
    lines = height + width - 1 if diagonal else max(height, width)
    paths_kernel[(lines, len(axes), 2)](
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
        num_warps=1,
    )
    return total.permute(2, 0, 1)


@triton.jit
def winner_kernel(
    total,
    levels,
    in_view,
    position_out,
    best_out,
    runner_up_out,
    gain_out,
    planes,
    pixels,
    width,
    levels_plane,
    levels_row,
    levels_column,
    view_plane,
    view_row,
    view_column,
    EVIDENCE: tl.constexpr,
    BLOCK: tl.constexpr,
    PADDED: tl.constexpr,
):
    """Winner of BLOCK pixels; with EVIDENCE all of it, else the position alone."""
    pixel = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    plane = tl.arange(0, PADDED)[None, :]
    used = inside[:, None] & (plane < planes)
    sums = tl.load(total + pixel[:, None] * planes + plane, mask=used, other=_NEVER)
    key = tl.min(sums * _PACKED_PLANES + plane, 1)
    index, best = key % _PACKED_PLANES, (key // _PACKED_PLANES).to(tl.float32)
    away = plane - index[:, None]
    below = tl.sum(tl.where(away == -1, sums, 0), 1).to(tl.float32)
    above = tl.sum(tl.where(away == 1, sums, 0), 1).to(tl.float32)
    inner = (index > 0) & (index < planes - 1)
    bend = tl.where(inner, tl.maximum(below + above - 2.0 * best, 1e-6), 1.0)
    offset = tl.minimum(tl.maximum(tl.div_rn(0.5 * (below - above), bend), -0.5), 0.5)
    tl.store(position_out + pixel, index.to(tl.float32) + tl.where(inner, offset, 0.0), mask=inside)
    if EVIDENCE:
        row, column = (pixel // width)[:, None], (pixel % width)[:, None]
        at = levels + row * levels_row + column * levels_column + plane * levels_plane
        cost = tl.load(at, mask=used, other=0).to(tl.int32)
        at = in_view + row * view_row + column * view_column + plane * view_plane
        seen = tl.sum(tl.load(at, mask=used, other=0).to(tl.int32), 1)
        of_seen = (tl.sum(cost, 1) - _UNSEEN_LEVEL * (planes - seen)).to(tl.float32)
        mean = tl.div_rn(of_seen, tl.maximum(seen, 1).to(tl.float32))
        own = tl.sum(tl.where(away == 0, cost, 0), 1).to(tl.float32)
        gain = tl.div_rn(tl.maximum(mean - own, 0.0), tl.full([BLOCK], _COST_LEVELS, tl.float32))
        runner_up = tl.min(tl.where((away < -1) | (away > 1), sums, _NEVER), 1)
        tl.store(best_out + pixel, best, mask=inside)
        tl.store(runner_up_out + pixel, runner_up.to(tl.float32), mask=inside)
        tl.store(gain_out + pixel, gain, mask=inside)


def winner_positions(total: Tensor) -> Tensor:
    """``winner.winner_positions`` of the result of ``aggregate``."""
    return _winner(total, None)[0]


def winner(total: Tensor, levels: Tensor, in_view: Tensor) -> Winner:
    """``winner.winner`` of the result of ``aggregate``, which it leaves as it is."""
    return Winner(*_winner(total, (levels, in_view)))


def _winner(total: Tensor, evidence: tuple[Tensor, Tensor] | None) -> list[Tensor]:
    planes, height, width = total.shape
    padded = triton.next_power_of_2(planes)
    block = max(1, _SUMS_AT_ONCE // padded)
    # Without evidence its pointers are not used.
    levels, in_view = evidence or (total, total)
    maps = torch.empty(4 if evidence else 1, height, width, dtype=torch.float32, device=total.device)
    outputs = list(maps) if evidence else [maps[0]] * 4
    winner_kernel[(triton.cdiv(height * width, block),)](
        total,
        levels,
        in_view,
        *outputs,
        planes,
        height * width,
        width,
        *levels.stride(),
        *in_view.stride(),
        EVIDENCE=evidence is not None,
        BLOCK=block,
        PADDED=padded,
        num_warps=4,
    )
    return list(maps)
