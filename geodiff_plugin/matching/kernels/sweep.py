"""Triton kernels for the plane sweep, ``sweep._sweep``: samples of a right view, and their costs.

A program writes all planes of a pixel contiguously, so planes are innermost in memory.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.geometry import to_device_of
from geodiff_plugin.matching import constants
from geodiff_plugin.matching.alignment import AlignedView, even_shifts
from geodiff_plugin.matching.census import GREY_LEVELS, MARGIN_PX, SIDE, VOTE_LEVELS
from geodiff_plugin.matching.kernels.arithmetic import lerp, rounded
from geodiff_plugin.matching.volume import mean_cost

# Triton kernels can read module constants only as constexpr.
_UNSEEN_LEVEL = tl.constexpr(constants.UNSEEN_LEVEL)
_GREY_LEVELS = tl.constexpr(GREY_LEVELS)
#: Pixels per program for maps.
PIXELS = 256
#: Pixels and planes per program for cost volumes.
COST_BLOCK = 32, 16
# Number of right image samples interpolated at once: 128 MB.
_SAMPLES_AT_ONCE = 1 << 25


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
    """Sample grey levels of BLOCK pixels bilinearly, at positions from the image's row of ``lines``."""
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
    first = lerp(tl.load(above + before, mask=inside), tl.load(below + before, mask=inside), down)
    second = lerp(tl.load(above + behind, mask=inside), tl.load(below + behind, mask=inside), down)
    value = rounded(lerp(first, second, across) * _GREY_LEVELS)
    tl.store(levels + image.to(tl.int64) * rows * columns + pixel, value.to(tl.int16), mask=inside)


def _resampled(grey: Tensor, rows: np.ndarray, columns: np.ndarray) -> Tensor:
    """Run ``alignment._resampled`` for several images at once: ``rows (n, h)``, ``columns (n, w)``."""
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
    """Compute the census difference of BLOCK pixels on PLANES planes, from grey levels with a margin.

    ``starts`` is the offset in ``right`` of the first left pixel of each plane, margin included. ``lines
    (height + width, planes)`` holds the canvas lines nearest to rows and columns, -1 outside.
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


def sweep(left: Tensor, views: Sequence[AlignedView]) -> tuple[Tensor, Tensor]:
    """Run ``sweep._sweep`` with kernels, all planes at once."""
    compared = [_compare(left, view) for view in views]
    if len(compared) == 1:
        return compared[0]
    costs, seen = zip(*compared, strict=True)
    cost, in_view = mean_cost(costs, seen)
    return torch.where(in_view, cost, constants.UNSEEN_LEVEL), in_view


def _compare(left: Tensor, view: AlignedView) -> tuple[Tensor, Tensor]:
    """Compute ``ComparedView.cost`` and ``seen`` of all planes, ``(D, H, W)`` uint8 and bool.

    ``left (H + 6, W + 6)`` are the left view's ``grey_levels`` with a margin. The cost is ``UNSEEN_LEVEL``
    where the view does not see a plane.
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
    """Return the canvas rows, then columns, nearest to the left grid's, ``(H + W, D)``; -1 outside."""
    lines = []
    for axis in (1, 0):
        at = view.positions(size[1 - axis], axis)
        lines.append(np.where(view.inside(at, axis), view.nearest(at, axis), -1))
    return np.concatenate(lines, axis=1).T.astype(np.int32)


def _right_levels(view: AlignedView, size: tuple[int, int], planes: range) -> tuple[Tensor, Tensor]:
    """Sample the right view's grey levels ``(n, h, w)`` for some planes, and return each plane's offset.

    Planes that differ by shifts of whole pixels share an image.
    """
    shifts = even_shifts(view, size[1])
    if shifts is None:
        part = slice(planes.start, planes.stop)
        rows = view.positions(size[0], 1, MARGIN_PX)[part]
        columns = view.positions(size[1], 0, MARGIN_PX)[part]
        images, begins = list(range(len(planes))), [0] * len(planes)
    else:
        phases = sorted({shifts.phase(plane) for plane in planes})
        positions = [shifts.positions(phase, size[0]) for phase in phases]
        rows, columns = (np.stack(each) for each in zip(*positions, strict=True))
        images = [phases.index(shifts.phase(plane)) for plane in planes]
        begins = [shifts.begin(plane) for plane in planes]
    area = rows.shape[1] * columns.shape[1]
    starts = [area * image + begin for image, begin in zip(images, begins, strict=True)]
    levels = _resampled(view.grey, rows, columns)
    return levels, to_device_of(view.grey, np.array(starts, dtype=np.int32))
