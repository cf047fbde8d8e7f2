"""Triton kernel for ``winner.winner`` and ``winner.winner_positions``, on the sums of ``paths_kernel``."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.matching import constants
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.volume import Winner

# Triton kernels can read module constants only as constexpr.
_NEVER = tl.constexpr(constants.NEVER)
_PACKED_PLANES = tl.constexpr(constants.PACKED_PLANES)
_UNSEEN_LEVEL = tl.constexpr(constants.UNSEEN_LEVEL)
_NEIGHBOUR_PLANES = tl.constexpr(constants.NEIGHBOUR_PLANES)
_COST_LEVELS = tl.constexpr(COST_LEVELS)
# Number of sums per program, held in the registers of its four warps.
_SUMS_AT_ONCE = 1024


@triton.jit
def winner_kernel(
    total,
    levels,
    in_view,
    position_out,
    best_out,
    second_best_out,
    gain_out,
    sharpness_out,
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
    """Find the winners of BLOCK pixels; without EVIDENCE only their positions."""
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
        lower = tl.maximum(index - _NEIGHBOUR_PLANES, 0)[:, None]
        upper = tl.minimum(index + _NEIGHBOUR_PLANES, planes - 1)[:, None]
        both_sides = tl.sum(tl.where(plane == lower, cost, 0) + tl.where(plane == upper, cost, 0), 1)
        largest = tl.full([BLOCK], 2 * _COST_LEVELS, tl.float32)
        sharpness = tl.div_rn(both_sides.to(tl.float32) - 2.0 * own, largest)
        second_best = tl.min(tl.where((away < -1) | (away > 1), sums, _NEVER), 1)
        tl.store(best_out + pixel, best, mask=inside)
        tl.store(second_best_out + pixel, second_best.to(tl.float32), mask=inside)
        tl.store(gain_out + pixel, gain, mask=inside)
        tl.store(sharpness_out + pixel, sharpness, mask=inside)


def winner_positions(total: Tensor) -> Tensor:
    """Run ``winner.winner_positions`` with a kernel on the result of ``aggregate``."""
    return _winner(total, None)[0]


def winner(total: Tensor, levels: Tensor, in_view: Tensor) -> Winner:
    """Run ``winner.winner`` with a kernel on the result of ``aggregate``, which is kept."""
    return Winner(*_winner(total, (levels, in_view)))


def _winner(total: Tensor, evidence: tuple[Tensor, Tensor] | None) -> list[Tensor]:
    planes, height, width = total.shape
    padded = triton.next_power_of_2(planes)
    block = max(1, _SUMS_AT_ONCE // padded)
    # Without evidence these pointers are not used.
    levels, in_view = evidence or (total, total)
    maps = torch.empty(5 if evidence else 1, height, width, dtype=torch.float32, device=total.device)
    outputs = list(maps) if evidence else [maps[0]] * 5
    launched_on(total, winner_kernel[(triton.cdiv(height * width, block),)])(
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
