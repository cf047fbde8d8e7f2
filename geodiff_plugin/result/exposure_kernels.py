"""Triton kernels of the photometric error of one image, whose reference is ``confidence._photometric_error``.

Sums over the image are made in parts, one a program, which torch adds up between two launches. This module is
imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.algorithm import terms
from geodiff_plugin.geometry import image_size

# A kernel reads constants of its module only as these.
_BLANK = tl.constexpr(terms.BLANK_SPREAD**2)
_LEAST_GAIN, _MOST_GAIN = map(tl.constexpr, terms.GAINS)
_CELL_ROWS, _CELL_COLUMNS = map(tl.constexpr, terms.CELLS)
_CELL_PRIOR = tl.constexpr(terms.CELL_PRIOR)
#: Pixels of a program.
PIXELS = 1024
#: Parts of a cell's sum.
PARTS = 16


@triton.jit
def sums_kernel(left, warped, visible, parts, pixels, CHANNELS: tl.constexpr, PIXELS: tl.constexpr):
    """Sums over what is visible: its number, and the values of each channel, of the left image first."""
    part = tl.program_id(0)
    pixel = part * PIXELS + tl.arange(0, PIXELS)
    weight = tl.load(visible + pixel, pixel < pixels, 0).to(tl.float32)
    parts += part * (1 + 2 * CHANNELS)
    tl.store(parts, tl.sum(weight, 0))
    for channel in tl.static_range(CHANNELS):
        at = channel * pixels + pixel
        tl.store(parts + 1 + channel, tl.sum(tl.load(left + at, pixel < pixels, 0.0) * weight, 0))
        right = tl.load(warped + at, pixel < pixels, 0.0)
        tl.store(parts + 1 + CHANNELS + channel, tl.sum(right * weight, 0))


@triton.jit
def squares_kernel(left, warped, visible, sums, parts, pixels, CHANNELS: tl.constexpr, PIXELS: tl.constexpr):
    """Sums of the squared distances from the means of ``sums_kernel``."""
    part = tl.program_id(0)
    pixel = part * PIXELS + tl.arange(0, PIXELS)
    weight = tl.load(visible + pixel, pixel < pixels, 0).to(tl.float32)
    total = tl.maximum(tl.load(sums), 1.0)
    parts += part * (2 * CHANNELS)
    for channel in tl.static_range(CHANNELS):
        at = channel * pixels + pixel
        away = tl.load(left + at, pixel < pixels, 0.0) - tl.load(sums + 1 + channel) / total
        tl.store(parts + channel, tl.sum(away * away * weight, 0))
        away = tl.load(warped + at, pixel < pixels, 0.0) - tl.load(sums + 1 + CHANNELS + channel) / total
        tl.store(parts + CHANNELS + channel, tl.sum(away * away * weight, 0))


@triton.jit
def _matched(values, sums, squares, channel, CHANNELS: tl.constexpr):
    """Values of the right image in the gain and bias of the left one."""
    total = tl.maximum(tl.load(sums), 1.0)
    mean_left = tl.load(sums + 1 + channel) / total
    mean_right = tl.load(sums + 1 + CHANNELS + channel) / total
    spread_left = tl.sqrt(tl.load(squares + channel) / total + _BLANK)
    spread_right = tl.sqrt(tl.load(squares + CHANNELS + channel) / total + _BLANK)
    gain = tl.minimum(tl.maximum(spread_left / spread_right, _LEAST_GAIN), _MOST_GAIN)
    return mean_left + gain * (values - mean_right)


@triton.jit
def _cell(i, j, height, width):
    """Upper row, left column, height and width of a cell, as ``adaptive_avg_pool2d`` divides an image."""
    top, side = i * height // _CELL_ROWS, j * width // _CELL_COLUMNS
    rows = ((i + 1) * height + (_CELL_ROWS - 1)) // _CELL_ROWS - top
    columns = ((j + 1) * width + (_CELL_COLUMNS - 1)) // _CELL_COLUMNS - side
    return top, side, rows, columns


@triton.jit(do_not_specialize=["height", "width"])
def cells_kernel(
    left, warped, visible, sums, squares, parts, height, width,
    CHANNELS: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Sums over the cells: what of them is visible, and the differences that remain. Grid: cells, parts."""
    cell, part = tl.program_id(0), tl.program_id(1)
    top, side, rows, columns = _cell(cell // _CELL_COLUMNS, cell % _CELL_COLUMNS, height, width)
    parts += (cell * tl.num_programs(1) + part) * (1 + CHANNELS)
    for channel in tl.static_range(CHANNELS):
        seen, differs = tl.zeros([PIXELS], tl.float32), tl.zeros([PIXELS], tl.float32)
        for first in range(part * PIXELS, rows * columns, tl.num_programs(1) * PIXELS):
            k = first + tl.arange(0, PIXELS)
            inside = k < rows * columns
            at = (top + k // columns) * width + side + k % columns
            weight = tl.load(visible + at, inside, 0).to(tl.float32)
            at += channel * height * width
            right = _matched(tl.load(warped + at, inside, 0.0), sums, squares, channel, CHANNELS)
            differs += (tl.load(left + at, inside, 0.0) - right) * weight
            seen += weight
        tl.store(parts + 1 + channel, tl.sum(differs, 0))
        tl.store(parts, tl.sum(seen, 0))


@triton.jit
def _shading(cells, i, j, channel, height, width, CHANNELS: tl.constexpr):
    """The mean difference in a cell, less where little of it is visible."""
    _, _, rows, columns = _cell(i, j, height, width)
    of_cell = cells + (i * _CELL_COLUMNS + j) * (1 + CHANNELS)
    counted = tl.load(of_cell) + (rows * columns).to(tl.float32) * _CELL_PRIOR
    return tl.load(of_cell + 1 + channel) / counted


@triton.jit
def error_kernel(
    left, warped, sums, squares, cells, error, height, width,
    CHANNELS: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """The mean absolute difference of the channels, in the left image's exposure and shading."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists = pixel < height * width
    own = tl.minimum(pixel, height * width - 1)
    v = tl.maximum(((own // width).to(tl.float32) + 0.5) * (1.0 * _CELL_ROWS / height) - 0.5, 0.0)
    u = tl.maximum(((own % width).to(tl.float32) + 0.5) * (1.0 * _CELL_COLUMNS / width) - 0.5, 0.0)
    i, j = tl.minimum(v.to(tl.int32), _CELL_ROWS - 1), tl.minimum(u.to(tl.int32), _CELL_COLUMNS - 1)
    down, across = v - i.to(tl.float32), u - j.to(tl.float32)
    below, beside = tl.minimum(i + 1, _CELL_ROWS - 1), tl.minimum(j + 1, _CELL_COLUMNS - 1)
    total = tl.zeros([PIXELS], tl.float32)
    for channel in tl.static_range(CHANNELS):
        above = (1.0 - across) * _shading(cells, i, j, channel, height, width, CHANNELS)
        above += across * _shading(cells, i, beside, channel, height, width, CHANNELS)
        under = (1.0 - across) * _shading(cells, below, j, channel, height, width, CHANNELS)
        under += across * _shading(cells, below, beside, channel, height, width, CHANNELS)
        at = channel * height * width + own
        right = _matched(tl.load(warped + at), sums, squares, channel, CHANNELS)
        total += tl.abs(right + (1.0 - down) * above + down * under - tl.load(left + at))
    tl.store(error + pixel, total / CHANNELS, exists)


def photometric_error(warped: Tensor, left_01: Tensor, seen: Tensor) -> Tensor:
    """``confidence._photometric_error``."""
    size, channels = image_size(left_01), left_01.shape[1]
    maps = [each.contiguous() for each in (left_01, warped, seen)]
    pixels = seen.numel()
    programs, sizes = triton.cdiv(pixels, PIXELS), {"CHANNELS": channels, "PIXELS": PIXELS}
    parts = warped.new_empty(programs, 1 + 2 * channels)
    launched_on(warped, sums_kernel[(programs,)])(*maps, parts, pixels, **sizes)
    sums, parts = parts.sum(0), warped.new_empty(programs, 2 * channels)
    launched_on(warped, squares_kernel[(programs,)])(*maps, sums, parts, pixels, **sizes)
    squares, parts = parts.sum(0), warped.new_empty(terms.CELLS[0] * terms.CELLS[1], PARTS, 1 + channels)
    launched_on(warped, cells_kernel[parts.shape[:2]])(*maps, sums, squares, parts, *size, **sizes)
    cells, error = parts.sum(1), warped.new_empty(1, 1, *size)
    launched_on(warped, error_kernel[(programs,)])(*maps[:2], sums, squares, cells, error, *size, **sizes)
    return error
