"""Triton kernels of the matching; each equals its reference, which its docstring names.

Volumes lie in memory with their planes innermost: a program reads the planes of a pixel in one piece. This
module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.geometry import to_device_of
from geodiff_plugin.matching.alignment import AlignedView, even_shifts
from geodiff_plugin.matching.census import COST_LEVELS, MARGIN_PX, SIDE, VOTE_LEVELS, grey_levels
from geodiff_plugin.matching.winner import BESIDE_PLANES, NEVER, PACKED_PLANES, UNSEEN_LEVEL, Winner

# A kernel reads constants of its module only as these.
_NEVER = tl.constexpr(NEVER)
_PACKED_PLANES = tl.constexpr(PACKED_PLANES)
_UNSEEN_LEVEL = tl.constexpr(UNSEEN_LEVEL)
_BESIDE_PLANES = tl.constexpr(BESIDE_PLANES)
_COST_LEVELS = tl.constexpr(COST_LEVELS)
#: Pixels and planes of a program of the sweep.
COST_BLOCK = 32, 16
# Samples of the right images that are interpolated at once: 128 MB.
_SAMPLES_AT_ONCE = 1 << 25
# Planes of a path that fit the registers of a warp.
_PLANES_A_WARP = 256
# Sums that a program of the winner holds at once, in registers of its four warps.
_SUMS_AT_ONCE = 1024


@triton.jit
def _line(number, down, across, height, width):
    """Row and column of the first pixel of a line of an axis, and the steps to its last; -1: no such line."""
    # Lines begin on the first row, from left to right, and then on the side that the axis comes from.
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
    """Add one path, from its start pixel by steps of (DOWN, ACROSS) or back, to the total.

    Grid: lines of an axis, axes, ways. A vector holds the path's costs of all planes.
    """
    line, axis, back = tl.program_id(0), tl.program_id(1), tl.program_id(2) == 1
    down, across = 0, 0
    for each in tl.static_range(len(DOWN)):
        down = tl.where(axis == each, DOWN[each], down)
        across = tl.where(axis == each, ACROSS[each], across)
    row, column, last = _line(line, down, across, height, width)
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


def path_warps(planes: int) -> int:
    """Warps of a path of so many planes."""
    return max(1, triton.next_power_of_2(planes) // _PLANES_A_WARP)


def aggregate(levels: Tensor, penalties: Tensor, step: int, axes: Sequence[tuple[int, int]]) -> Tensor:
    """``aggregation.aggregate`` along any axes, each both ways, as ``(D, H, W)`` int32.

    ``penalties`` are the ``aggregation.jump_penalties`` of these axes, ``step`` is the penalty of a plane.
    Sums are added atomically, for which a card needs 32 bits: no order changes a sum of integers.
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


@triton.jit
def winner_kernel(
    total,
    levels,
    in_view,
    position_out,
    best_out,
    runner_up_out,
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
        lower = tl.maximum(index - _BESIDE_PLANES, 0)[:, None]
        upper = tl.minimum(index + _BESIDE_PLANES, planes - 1)[:, None]
        beside = tl.sum(tl.where(plane == lower, cost, 0) + tl.where(plane == upper, cost, 0), 1)
        largest = tl.full([BLOCK], 2 * _COST_LEVELS, tl.float32)
        sharpness = tl.div_rn(beside.to(tl.float32) - 2.0 * own, largest)
        runner_up = tl.min(tl.where((away < -1) | (away > 1), sums, _NEVER), 1)
        tl.store(best_out + pixel, best, mask=inside)
        tl.store(runner_up_out + pixel, runner_up.to(tl.float32), mask=inside)
        tl.store(gain_out + pixel, gain, mask=inside)
        tl.store(sharpness_out + pixel, sharpness, mask=inside)


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


@triton.jit
def census_cost_kernel(
    left,
    right,
    starts,
    cost_out,
    planes,
    pixels,
    width,
    left_row,
    right_row,
    cost_pixel,
    SIDE: tl.constexpr,
    MARGIN: tl.constexpr,
    VOTE: tl.constexpr,
    BLOCK: tl.constexpr,
    PLANES: tl.constexpr,
):
    """Census difference of BLOCK pixels on PLANES planes, from grey levels with a margin.

    ``starts`` say where in ``right`` the first left pixel of each plane lies, margin included.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    plane = tl.program_id(1) * PLANES + tl.arange(0, PLANES)
    inside, exists = pixel < pixels, plane < planes
    used = inside[:, None] & exists[None, :]
    row, column = pixel // width, pixel % width
    own = left + row * left_row + column
    start = tl.load(starts + plane, mask=exists, other=0)
    other = right + start[None, :] + (row * right_row + column)[:, None]
    own_centre = tl.load(own + MARGIN * left_row + MARGIN, mask=inside, other=0).to(tl.int32)
    other_centre = tl.load(other + MARGIN * right_row + MARGIN, mask=used, other=0).to(tl.int32)
    cost = tl.zeros([BLOCK, PLANES], tl.int32)
    for down in tl.static_range(0, 2 * SIDE, 2):
        for across in tl.static_range(0, 2 * SIDE, 2):
            vote = tl.load(own + down * left_row + across, mask=inside, other=0).to(tl.int32) - own_centre
            vote = tl.minimum(tl.maximum(vote, -VOTE), VOTE)
            there = tl.load(other + down * right_row + across, mask=used, other=0).to(tl.int32) - other_centre
            there = tl.minimum(tl.maximum(there, -VOTE), VOTE)
            cost += tl.abs(vote[:, None] - there)
    at = pixel.to(tl.int64)[:, None] * cost_pixel + plane[None, :]
    tl.store(cost_out + at, cost.to(tl.uint8), mask=used)


def census_costs(left: Tensor, view: AlignedView) -> Tensor:
    """``alignment.ComparedView.cost`` of all planes, ``(D, H, W)`` uint8.

    ``left (H + 6, W + 6)`` are ``grey_levels`` of the left view with a margin.
    """
    height, width = (side - 2 * MARGIN_PX for side in left.shape)
    planes, pixels = len(view.scale), height * width
    cost = torch.empty(height, width, planes, dtype=torch.uint8, device=left.device)
    at_once = max(1, _SAMPLES_AT_ONCE // (left.shape[0] * view.size[1]))
    for first in range(0, planes, at_once):
        part = range(first, min(planes, first + at_once))
        right, starts = _right_levels(view, (height, width), part)
        grid = triton.cdiv(pixels, COST_BLOCK[0]), triton.cdiv(len(part), COST_BLOCK[1])
        launched_on(left, census_cost_kernel[grid])(
            left,
            right,
            starts,
            cost[..., first:],
            len(part),
            pixels,
            width,
            left.stride(0),
            right.stride(1),
            planes,
            SIDE=SIDE,
            MARGIN=MARGIN_PX,
            VOTE=VOTE_LEVELS,
            BLOCK=COST_BLOCK[0],
            PLANES=COST_BLOCK[1],
            num_warps=4,
        )
    return cost.permute(2, 0, 1)


def _right_levels(view: AlignedView, size: tuple[int, int], planes: range) -> tuple[Tensor, Tensor]:
    """Grey levels ``(n, h, w)`` of a right view that some planes need, and where in them each plane begins.

    Planes that are plain shifts by whole pixels from one another share an image.
    """
    shifts = even_shifts(view, size[1])
    if shifts is None:
        part = slice(planes.start, planes.stop)
        rows = view.positions(size[0], 1, MARGIN_PX)[part]
        columns = view.positions(size[1], 0, MARGIN_PX)[part]
        images, begins = list(range(len(planes))), [0] * len(planes)
    else:
        phases = sorted({shifts.phase(plane) for plane in planes})
        lines = [shifts.lines(phase, size[0]) for phase in phases]
        rows, columns = (np.stack(each) for each in zip(*lines, strict=True))
        images = [phases.index(shifts.phase(plane)) for plane in planes]
        begins = [shifts.begin(plane) for plane in planes]
    area = rows.shape[1] * columns.shape[1]
    starts = [area * image + begin for image, begin in zip(images, begins, strict=True)]
    levels = _resampled(view.grey, *(to_device_of(view.grey, each) for each in (rows, columns)))
    return levels, to_device_of(view.grey, np.array(starts, dtype=np.int32))


def _resampled(grey: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """``alignment._resampled`` of several images at once: ``rows (n, h)``, ``columns (n, w)``."""
    last_row, last_column = (side - 1 for side in grey.shape)
    rows, columns = rows.clamp(0, last_row), columns.clamp(0, last_column)
    first = rows.floor()
    after = (first + 1.0).clamp_max(last_row)
    mixed = torch.lerp(grey[first.long()], grey[after.long()], (rows - first)[..., None])
    first = columns.floor()
    around = (first, (first + 1.0).clamp_max(last_column))
    before, behind = (mixed.gather(2, at.long()[:, None].expand(-1, len(mixed[0]), -1)) for at in around)
    return grey_levels(torch.lerp(before, behind, (columns - first)[:, None]))


def seen(view: AlignedView, size: tuple[int, int]) -> Tensor:
    """``alignment.ComparedView.seen`` of all planes, ``(D, H, W)`` bool."""
    lines = view.positions(size[0], 1), view.positions(size[1], 0)
    rows, columns = (
        to_device_of(view.grey, view.inside(at, axis).T) for at, axis in zip(lines, (1, 0), strict=True)
    )
    found = rows[:, None] & columns
    if view.valid is not None:
        row, column = (
            to_device_of(view.grey, view.nearest(at, axis).T) for at, axis in zip(lines, (1, 0), strict=True)
        )
        found &= view.valid[row[:, None], column]
    return found.permute(2, 0, 1)


@triton.jit
def look_up_kernel(
    levels,
    rows,
    columns,
    found,
    planes,
    pixels,
    width,
    levels_height,
    levels_width,
    levels_plane,
    levels_row,
    levels_column,
    BLOCK: tl.constexpr,
    PLANES: tl.constexpr,
):
    """Costs of BLOCK pixels on PLANES planes at their ``rows (h, D)`` and ``columns (w, D)``."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)[:, None]
    plane = tl.program_id(1) * PLANES + tl.arange(0, PLANES)[None, :]
    used = (pixel < pixels) & (plane < planes)
    row = tl.load(rows + (pixel // width) * planes + plane, mask=used, other=0)
    column = tl.load(columns + (pixel % width) * planes + plane, mask=used, other=0)
    shown = used & (row < levels_height) & (column < levels_width)
    at = row.to(tl.int64) * levels_row + column.to(tl.int64) * levels_column + plane * levels_plane
    cost = tl.load(levels + at, mask=shown, other=_UNSEEN_LEVEL)
    tl.store(found + pixel.to(tl.int64) * planes + plane, cost, mask=used)


def looked_up(levels: Tensor, rows: np.ndarray, columns: np.ndarray) -> Tensor:
    """``consistency._looked_up`` of costs ``(D, H, W)`` at ``AlignedView.sources``."""
    planes, *size = levels.shape
    height, width = rows.shape[1], columns.shape[1]
    found = torch.empty(height, width, planes, dtype=levels.dtype, device=levels.device)
    at = (to_device_of(levels, each.T.astype(np.int32)) for each in (rows, columns))
    grid = triton.cdiv(height * width, COST_BLOCK[0]), triton.cdiv(planes, COST_BLOCK[1])
    launched_on(levels, look_up_kernel[grid])(
        levels,
        *at,
        found,
        planes,
        height * width,
        width,
        *size,
        *levels.stride(),
        BLOCK=COST_BLOCK[0],
        PLANES=COST_BLOCK[1],
        num_warps=4,
    )
    return found.permute(2, 0, 1)
