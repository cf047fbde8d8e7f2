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
from geodiff_plugin.matching.aggregation import JUMP_CONTRAST, JUMP_PENALTY, PATHS, STEP_PENALTY
from geodiff_plugin.matching.alignment import AlignedView, even_shifts
from geodiff_plugin.matching.census import COST_LEVELS, GREY_LEVELS, MARGIN_PX, SIDE, VOTE_LEVELS
from geodiff_plugin.matching.consistency import (
    AGREEMENT_PLANES,
    DOUBT_OF_A_PLANE,
    EVERY_ROW,
    LEAST_CONTRAST,
    LEAST_SHARPNESS,
    LOG_ODDS,
    MOST_BLUR,
)
from geodiff_plugin.matching.sweep import CostVolume
from geodiff_plugin.matching.winner import BESIDE_PLANES, NEVER, PACKED_PLANES, UNSEEN_LEVEL, Winner

# A kernel reads constants of its module only as these.
_NEVER = tl.constexpr(NEVER)
_PACKED_PLANES = tl.constexpr(PACKED_PLANES)
_UNSEEN_LEVEL = tl.constexpr(UNSEEN_LEVEL)
_BESIDE_PLANES = tl.constexpr(BESIDE_PLANES)
_COST_LEVELS = tl.constexpr(COST_LEVELS)
_GREY_LEVELS = tl.constexpr(GREY_LEVELS)
_STEP_PENALTY = tl.constexpr(STEP_PENALTY)
_JUMP_PENALTY = tl.constexpr(JUMP_PENALTY)
_JUMP_CONTRAST = tl.constexpr(JUMP_CONTRAST)
_LOG_ODDS = tl.constexpr(LOG_ODDS)
_AGREEMENT_PLANES = tl.constexpr(AGREEMENT_PLANES)
_LEAST_CONTRAST = tl.constexpr(LEAST_CONTRAST)
_LEAST_SHARPNESS = tl.constexpr(LEAST_SHARPNESS)
_MOST_BLUR = tl.constexpr(MOST_BLUR)
_DOUBT_OF_A_PLANE = tl.constexpr(DOUBT_OF_A_PLANE)
# A float32 below 2^22 to which this is added keeps no fraction: it is rounded to nearest, halves to even.
_ROUNDING = tl.constexpr(1.5 * 2.0**23)
#: Pixels of a program that works on maps.
PIXELS = 256
#: Pixels and planes of a program of the sweep.
COST_BLOCK = 32, 16
# Samples of the right images that are interpolated at once: 128 MB.
_SAMPLES_AT_ONCE = 1 << 25
# Planes of a path that fit the registers of a warp.
_PLANES_A_WARP = 256
# Sums that a program of the winner holds at once, in registers of its four warps.
_SUMS_AT_ONCE = 1024


@triton.jit
def _rounded(x):
    return (x + _ROUNDING) - _ROUNDING


@triton.jit
def _lerp(start, end, weight):
    """``torch.lerp``, which rounds once: float64 holds the product of two float32."""
    near = weight < 0.5
    share = tl.where(near, weight, weight - 1.0).to(tl.float64)
    base = tl.where(near, start, end).to(tl.float64)
    return (share * (end - start).to(tl.float64) + base).to(tl.float32)


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
    """The penalty of a jump at BLOCK pixels, on each axis."""
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
        at = penalties + axis * height * width + pixel
        tl.store(at, _rounded(limit * _COST_LEVELS).to(tl.int16), mask=inside)


def jump_penalties(grey: Tensor, axes: Sequence[tuple[int, int]]) -> Tensor:
    """``aggregation.jump_penalties``."""
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
def resample_kernel(
    grey,
    lines,
    levels,
    images,
    rows,
    columns,
    height,
    width,
    grey_row,
    BLOCK: tl.constexpr,
):
    """Grey levels of BLOCK pixels of an image, bilinear at its row of ``lines``: rows, then columns."""
    pixel, image = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.program_id(1)
    inside = pixel < rows * columns
    row = tl.load(lines + image * rows + pixel // columns, mask=inside, other=0.0)
    column = tl.load(lines + images * rows + image * columns + pixel % columns, mask=inside, other=0.0)
    row = tl.minimum(tl.maximum(row, 0.0), height - 1.0)
    column = tl.minimum(tl.maximum(column, 0.0), width - 1.0)
    top, left = tl.floor(row), tl.floor(column)
    down, across = row - top, column - left
    above, before = grey + top.to(tl.int32) * grey_row, left.to(tl.int32)
    below = grey + tl.minimum(top + 1.0, height - 1.0).to(tl.int32) * grey_row
    behind = tl.minimum(left + 1.0, width - 1.0).to(tl.int32)
    first = _lerp(tl.load(above + before, mask=inside), tl.load(below + before, mask=inside), down)
    second = _lerp(tl.load(above + behind, mask=inside), tl.load(below + behind, mask=inside), down)
    value = _rounded(_lerp(first, second, across) * _GREY_LEVELS)
    tl.store(levels + image.to(tl.int64) * rows * columns + pixel, value.to(tl.int16), mask=inside)


def _resampled(grey: Tensor, rows: np.ndarray, columns: np.ndarray) -> Tensor:
    """``alignment._resampled`` of several images at once: ``rows (n, h)``, ``columns (n, w)``."""
    images, height, width = len(rows), rows.shape[1], columns.shape[1]
    levels = torch.empty(images, height, width, dtype=torch.int16, device=grey.device)
    lines = to_device_of(grey, np.concatenate([rows.ravel(), columns.ravel()]))
    launched_on(grey, resample_kernel[(triton.cdiv(height * width, PIXELS), images)])(
        grey,
        lines,
        levels,
        images,
        height,
        width,
        *grey.shape,
        grey.stride(0),
        BLOCK=PIXELS,
        num_warps=4,
        enable_fp_fusion=False,
    )
    return levels


@triton.jit
def census_cost_kernel(
    left,
    right,
    starts,
    lines,
    valid,
    levels_out,
    seen_out,
    planes,
    pixels,
    height,
    width,
    left_row,
    right_row,
    valid_row,
    planes_in_all,
    HAS_VALID: tl.constexpr,
    SIDE: tl.constexpr,
    MARGIN: tl.constexpr,
    VOTE: tl.constexpr,
    BLOCK: tl.constexpr,
    PLANES: tl.constexpr,
):
    """Census difference of BLOCK pixels on PLANES planes, from grey levels with a margin.

    ``starts`` say where in ``right`` the first left pixel of each plane lies, margin included; ``lines
    (height + width, planes)`` are the lines of the canvas nearest to rows and columns, -1 outside.
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
    at_row = tl.load(lines + row[:, None] * planes_in_all + plane[None, :], mask=used, other=-1)
    at_column = tl.load(
        lines + (height + column)[:, None] * planes_in_all + plane[None, :], mask=used, other=-1
    )
    seen = (at_row >= 0) & (at_column >= 0)
    if HAS_VALID:
        seen &= tl.load(valid + at_row * valid_row + at_column, mask=seen, other=0) != 0
    at = pixel.to(tl.int64)[:, None] * planes_in_all + plane[None, :]
    tl.store(levels_out + at, tl.where(seen, cost, _UNSEEN_LEVEL).to(tl.uint8), mask=used)
    tl.store(seen_out + at, seen, mask=used)


def swept(left: Tensor, view: AlignedView) -> tuple[Tensor, Tensor]:
    """``alignment.ComparedView.cost`` and ``seen`` of all planes, ``(D, H, W)`` uint8 and bool.

    ``left (H + 6, W + 6)`` are ``grey_levels`` of the left view with a margin. ``UNSEEN_LEVEL`` stands where
    the view does not see a plane.
    """
    height, width = (side - 2 * MARGIN_PX for side in left.shape)
    planes, pixels = len(view.scale), height * width
    levels = torch.empty(height, width, planes, dtype=torch.uint8, device=left.device)
    in_view = torch.empty_like(levels, dtype=torch.bool)
    lines = to_device_of(left, _canvas_lines(view, (height, width)))
    valid = in_view if view.valid is None else view.valid
    at_once = max(1, _SAMPLES_AT_ONCE // (left.shape[0] * view.size[1]))
    for first in range(0, planes, at_once):
        part = range(first, min(planes, first + at_once))
        right, starts = _right_levels(view, (height, width), part)
        grid = triton.cdiv(pixels, COST_BLOCK[0]), triton.cdiv(len(part), COST_BLOCK[1])
        launched_on(left, census_cost_kernel[grid])(
            left,
            right,
            starts,
            lines[:, first:],
            valid,
            levels[..., first:],
            in_view[..., first:],
            len(part),
            pixels,
            height,
            width,
            left.stride(0),
            right.stride(1),
            valid.stride(0),
            planes,
            HAS_VALID=view.valid is not None,
            SIDE=SIDE,
            MARGIN=MARGIN_PX,
            VOTE=VOTE_LEVELS,
            BLOCK=COST_BLOCK[0],
            PLANES=COST_BLOCK[1],
            num_warps=4,
        )
    return levels.permute(2, 0, 1), in_view.permute(2, 0, 1)


def _canvas_lines(view: AlignedView, size: tuple[int, int]) -> np.ndarray:
    """Rows, then columns, of the canvas that the left grid's are nearest to, ``(H + W, D)``; -1 outside."""
    lines = []
    for axis in (1, 0):
        at = view.positions(size[1 - axis], axis)
        lines.append(np.where(view.inside(at, axis), view.nearest(at, axis), -1))
    return np.concatenate(lines, axis=1).T.astype(np.int32)


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
    levels = _resampled(view.grey, rows, columns)
    return levels, to_device_of(view.grey, np.array(starts, dtype=np.int32))


@triton.jit
def look_up_kernel(
    levels,
    lines,
    found,
    planes,
    pixels,
    height,
    width,
    levels_height,
    levels_width,
    levels_plane,
    levels_row,
    levels_column,
    BLOCK: tl.constexpr,
    PLANES: tl.constexpr,
):
    """Costs of BLOCK pixels on PLANES planes, at their rows and columns in ``lines (height + width, D)``."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)[:, None]
    plane = tl.program_id(1) * PLANES + tl.arange(0, PLANES)[None, :]
    used = (pixel < pixels) & (plane < planes)
    row = tl.load(lines + (pixel // width) * planes + plane, mask=used, other=0)
    column = tl.load(lines + (height + pixel % width) * planes + plane, mask=used, other=0)
    shown = used & (row < levels_height) & (column < levels_width)
    at = row.to(tl.int64) * levels_row + column.to(tl.int64) * levels_column + plane * levels_plane
    cost = tl.load(levels + at, mask=shown, other=_UNSEEN_LEVEL)
    tl.store(found + pixel.to(tl.int64) * planes + plane, cost, mask=used)


def looked_up(levels: Tensor, rows: np.ndarray, columns: np.ndarray) -> Tensor:
    """``consistency._looked_up`` of costs ``(D, H, W)`` at ``AlignedView.sources``."""
    planes, *size = levels.shape
    height, width = rows.shape[1], columns.shape[1]
    found = torch.empty(height, width, planes, dtype=levels.dtype, device=levels.device)
    lines = to_device_of(levels, np.concatenate([rows, columns], axis=1).T.astype(np.int32))
    grid = triton.cdiv(height * width, COST_BLOCK[0]), triton.cdiv(planes, COST_BLOCK[1])
    launched_on(levels, look_up_kernel[grid])(
        levels,
        lines,
        found,
        planes,
        height * width,
        height,
        width,
        *size,
        *levels.stride(),
        BLOCK=COST_BLOCK[0],
        PLANES=COST_BLOCK[1],
        num_warps=4,
    )
    return found.permute(2, 0, 1)


@triton.jit
def weigh_kernel(
    position_in, best_in, runner_up_in, contrast_in, sharpness_in, other, warp, valid, made,
    planes, pixels, width, other_rows, other_row, canvas_height, canvas_width, valid_row,
    first_inverse_depth, plane_step, sum_unit,
    FIRST: tl.constexpr, HAS_VALID: tl.constexpr, EVERY_ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """What a right view says about the winners of BLOCK pixels, and by it and those before their result.

    ``made`` are confidence, deviation and inverse depth; ``warp (3, planes)`` is the scale of every plane,
    and its shift along columns and rows.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    used = pixel < pixels
    row, column = (pixel // width).to(tl.float32), (pixel % width).to(tl.float32)
    position = tl.load(position_in + pixel, mask=used, other=0.0)
    below = tl.minimum(tl.maximum(tl.floor(position).to(tl.int32), 0), planes - 2)
    part = position - below.to(tl.float32)
    scale = _lerp(tl.load(warp + below), tl.load(warp + below + 1), part)
    to_side = _lerp(tl.load(warp + planes + below), tl.load(warp + planes + below + 1), part)
    down = _lerp(tl.load(warp + 2 * planes + below), tl.load(warp + 2 * planes + below + 1), part)
    at_column, at_row = _rounded(scale * column + to_side), _rounded(scale * row + down)
    inside = used & (scale > 0) & (at_column >= 0) & (at_column <= canvas_width - 1)
    inside &= (at_row >= 0) & (at_row <= canvas_height - 1)
    there = tl.where(inside, at_column, 0.0).to(tl.int32)
    line = tl.where(inside, at_row, 0.0).to(tl.int32)
    if HAS_VALID:
        inside &= tl.load(valid + line * valid_row + there, mask=inside, other=0) != 0
    before, after = line // EVERY_ROW, tl.minimum((line + EVERY_ROW - 1) // EVERY_ROW, other_rows - 1)
    there_before = tl.load(other + before * other_row + there, mask=inside, other=0.0)
    there_after = tl.load(other + after * other_row + there, mask=inside, other=0.0)
    difference = tl.where(inside, tl.abs(0.5 * (there_before + there_after) - position), float("inf"))

    best = tl.load(best_in + pixel, mask=used, other=0.0)
    runner_up = tl.load(runner_up_in + pixel, mask=used, other=0.0)
    contrast = tl.load(contrast_in + pixel, mask=used, other=0.0)
    sharpness = tl.load(sharpness_in + pixel, mask=used, other=0.0)
    cost = tl.minimum(tl.maximum(best * sum_unit, 0.0), 0.8)
    margin = tl.minimum(tl.maximum((runner_up - best) * sum_unit, 0.0), 0.5)
    odds = tl.log(margin + 0.03) * _LOG_ODDS[1] + _LOG_ODDS[0] + cost * _LOG_ODDS[2]
    odds += tl.minimum(difference, _AGREEMENT_PLANES) * _LOG_ODDS[3]
    probability = tl.sigmoid(odds) * tl.minimum(contrast / _LEAST_CONTRAST, 1.0)
    confidence = tl.where(difference <= _AGREEMENT_PLANES, probability, 0.0)
    if not FIRST:
        confidence = tl.maximum(confidence, tl.load(made + pixel, mask=used, other=0.0))
    blur = 1.0 / tl.maximum(sharpness / _LEAST_SHARPNESS, 1.0 / _MOST_BLUR)
    deviation = tl.sqrt((1.0 - confidence) / _DOUBT_OF_A_PLANE) * tl.maximum(blur, 1.0)
    tl.store(made + pixel, confidence, mask=used)
    tl.store(made + pixels + pixel, deviation, mask=used)
    tl.store(made + 2 * pixels + pixel, first_inverse_depth + position * plane_step, mask=used)


def weighed(volume: CostVolume, found: Winner, means: Tensor, others: Sequence[Tensor]) -> Tensor:
    """Confidence, deviation and inverse depth of ``consistency.match_volume``, ``(3, H, W)``.

    ``found`` are the winners of the left view, ``means (2, H, W)`` their contrast and sharpness, and
    ``others`` the winners of the right views.
    """
    made = torch.empty(3, *volume.size, dtype=torch.float32, device=means.device)
    pixels = volume.size[0] * volume.size[1]
    for number, (view, other) in enumerate(zip(volume.aligned, others, strict=True)):
        warp = np.concatenate([view.scale[None], view.shift.T]).astype(np.float32)
        valid = made if view.valid is None else view.valid
        launched_on(made, weigh_kernel[(triton.cdiv(pixels, PIXELS),)])(
            found.position,
            found.best,
            found.runner_up,
            means[0],
            means[1],
            other,
            to_device_of(made, warp),
            valid,
            made,
            len(view.scale),
            pixels,
            volume.size[1],
            len(other),
            other.stride(0),
            *view.size,
            valid.stride(0),
            float(volume.inverse_depth[0]),
            float(volume.plane_step),
            1.0 / (PATHS * COST_LEVELS),
            FIRST=number == 0,
            HAS_VALID=view.valid is not None,
            EVERY_ROW=EVERY_ROW,
            BLOCK=PIXELS,
            num_warps=4,
            enable_fp_fusion=False,
        )
    return made
