"""Triton kernels for ``confidence.reprojection``: the warp of a right image, and its photometric error.

Sums over the image are computed as partial sums, one per program, which torch adds between two launches.
"""

from __future__ import annotations

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.algorithm import terms
from geodiff_plugin.cameras import Camera, View
from geodiff_plugin.geometry import EDGE_PX, NEAREST_M, image_size, to_device_of

# Triton kernels can read module constants only as constexpr.
_EDGE_PX = tl.constexpr(EDGE_PX)
_NEAREST_M = tl.constexpr(NEAREST_M)
_BLANK = tl.constexpr(terms.BLANK_SPREAD**2)
_MIN_GAIN, _MAX_GAIN = map(tl.constexpr, terms.GAINS)
_CELL_ROWS, _CELL_COLUMNS = map(tl.constexpr, terms.CELLS)
_CELL_PRIOR = tl.constexpr(terms.CELL_PRIOR)
#: Pixels per program.
PIXELS = 1024
#: Number of partial sums per cell.
PARTS = 16


@triton.jit
def warp_kernel(
    right, depth_m, cameras, warped, visible, height, width, rows, columns,
    CHANNELS: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Compute ``geometry.warp_right_to_left`` of one image. Grid: blocks of pixels."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists = pixel < height * width
    y = ((pixel // width).to(tl.float32) - tl.load(cameras + 1)) / tl.load(cameras + 3)
    x = ((pixel % width).to(tl.float32) - tl.load(cameras)) / tl.load(cameras + 2)
    x -= tl.load(cameras + 4) * y
    z = tl.load(depth_m + pixel, exists, 1.0)
    to_right = cameras + 5  # three rows of four numbers
    u = z * (tl.load(to_right + 2) + tl.load(to_right + 1) * y + tl.load(to_right) * x) + tl.load(
        to_right + 3
    )
    to_right += 4
    v = z * (tl.load(to_right + 2) + tl.load(to_right + 1) * y + tl.load(to_right) * x) + tl.load(
        to_right + 3
    )
    to_right += 4
    z = z * (tl.load(to_right + 2) + tl.load(to_right + 1) * y + tl.load(to_right) * x) + tl.load(
        to_right + 3
    )
    in_front = z > _NEAREST_M
    z = tl.where(in_front, z, 1.0)
    u, v = tl.where(in_front, u / z, -1.0), tl.where(in_front, v / z, -1.0)
    seen = (
        (u >= -_EDGE_PX) & (u <= columns - 1.0 + _EDGE_PX) & (v >= -_EDGE_PX) & (v <= rows - 1.0 + _EDGE_PX)
    )
    tl.store(visible + pixel, seen & in_front, exists)
    u, v = tl.minimum(tl.maximum(u, 0.0), columns - 1.0), tl.minimum(tl.maximum(v, 0.0), rows - 1.0)
    left, top = u.to(tl.int32), v.to(tl.int32)
    right_of, below = tl.minimum(left + 1, columns - 1), tl.minimum(top + 1, rows - 1) * columns
    across, down = u - left.to(tl.float32), v - top.to(tl.float32)
    top = top * columns
    for channel in tl.static_range(CHANNELS):
        layer = right + channel * rows * columns
        above = (1.0 - across) * tl.load(layer + top + left) + across * tl.load(layer + top + right_of)
        under = (1.0 - across) * tl.load(layer + below + left) + across * tl.load(layer + below + right_of)
        tl.store(warped + channel * height * width + pixel, (1.0 - down) * above + down * under, exists)


def warped(right: View, depth_m: Tensor, left: Camera) -> tuple[Tensor, Tensor]:
    """Run ``confidence._warped`` with a kernel; returns the warped image and its visibility.

    The kernel gets 17 numbers of the cameras: cx, cy, fx, fy and skew / fx of the left one, then the rows of
    the ``3x4`` matrix that projects points of the left camera into the right image.
    """
    matrices = left.K, right.camera.K, right.T_right_from_left
    K, K_r, T = (each.astype(np.float64) for each in matrices)
    own = K[0, 2], K[1, 2], K[0, 0], K[1, 1], K[0, 1] / K[0, 0]
    cameras = np.concatenate([own, (K_r @ T[:3]).ravel()]).astype(np.float32)
    right_01, size = right.image_01, image_size(depth_m)
    image = right_01.new_empty(1, len(right_01), *size)
    visible = torch.empty_like(depth_m, dtype=torch.bool)
    launched_on(depth_m, warp_kernel[(triton.cdiv(depth_m.numel(), PIXELS),)])(
        right_01.contiguous(),
        depth_m.contiguous(),
        to_device_of(depth_m, cameras),
        image,
        visible,
        *size,
        *image_size(right_01),
        CHANNELS=len(right_01),
        PIXELS=PIXELS,
    )
    return image, visible


@triton.jit
def sums_kernel(left, warped, visible, parts, pixels, CHANNELS: tl.constexpr, PIXELS: tl.constexpr):
    """Sum over visible pixels: their number, and the values of each channel, left image first."""
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
    """Sum the squared deviations of visible pixels from their channel's mean, left image first.

    ``sums`` holds the totals of ``sums_kernel``: the number of visible pixels, then the sum of each channel.
    """
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
    """Adjust values of the right image to the gain and bias of the left one."""
    total = tl.maximum(tl.load(sums), 1.0)
    mean_left = tl.load(sums + 1 + channel) / total
    mean_right = tl.load(sums + 1 + CHANNELS + channel) / total
    spread_left = tl.sqrt(tl.load(squares + channel) / total + _BLANK)
    spread_right = tl.sqrt(tl.load(squares + CHANNELS + channel) / total + _BLANK)
    gain = tl.minimum(tl.maximum(spread_left / spread_right, _MIN_GAIN), _MAX_GAIN)
    return mean_left + gain * (values - mean_right)


@triton.jit
def _cell(i, j, height, width):
    """Return upper row, left column, height and width of a cell, as in ``adaptive_avg_pool2d``."""
    top, side = i * height // _CELL_ROWS, j * width // _CELL_COLUMNS
    rows = ((i + 1) * height + (_CELL_ROWS - 1)) // _CELL_ROWS - top
    columns = ((j + 1) * width + (_CELL_COLUMNS - 1)) // _CELL_COLUMNS - side
    return top, side, rows, columns


@triton.jit(do_not_specialize=["height", "width"])
def cells_kernel(
    left, warped, visible, sums, squares, parts, height, width,
    CHANNELS: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Sum visibility and remaining differences over the cells. Grid: cells, parts."""
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
    """Compute the mean difference in a cell, reduced if little of it is visible."""
    _, _, rows, columns = _cell(i, j, height, width)
    of_cell = cells + (i * _CELL_COLUMNS + j) * (1 + CHANNELS)
    counted = tl.load(of_cell) + (rows * columns).to(tl.float32) * _CELL_PRIOR
    return tl.load(of_cell + 1 + channel) / counted


@triton.jit
def error_kernel(
    left, warped, sums, squares, cells, error, height, width,
    CHANNELS: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Average the absolute differences of the channels, in the left image's exposure and shading."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists = pixel < height * width
    own = tl.minimum(pixel, height * width - 1)
    v = tl.maximum(((own // width).to(tl.float32) + 0.5) * (1.0 * _CELL_ROWS / height) - 0.5, 0.0)
    u = tl.maximum(((own % width).to(tl.float32) + 0.5) * (1.0 * _CELL_COLUMNS / width) - 0.5, 0.0)
    i, j = tl.minimum(v.to(tl.int32), _CELL_ROWS - 1), tl.minimum(u.to(tl.int32), _CELL_COLUMNS - 1)
    down, across = v - i.to(tl.float32), u - j.to(tl.float32)
    below, right_of = tl.minimum(i + 1, _CELL_ROWS - 1), tl.minimum(j + 1, _CELL_COLUMNS - 1)
    total = tl.zeros([PIXELS], tl.float32)
    for channel in tl.static_range(CHANNELS):
        above = (1.0 - across) * _shading(cells, i, j, channel, height, width, CHANNELS)
        above += across * _shading(cells, i, right_of, channel, height, width, CHANNELS)
        under = (1.0 - across) * _shading(cells, below, j, channel, height, width, CHANNELS)
        under += across * _shading(cells, below, right_of, channel, height, width, CHANNELS)
        at = channel * height * width + own
        right = _matched(tl.load(warped + at), sums, squares, channel, CHANNELS)
        total += tl.abs(right + (1.0 - down) * above + down * under - tl.load(left + at))
    tl.store(error + pixel, total / CHANNELS, exists)


def photometric_error(warped: Tensor, left_01: Tensor, seen: Tensor) -> Tensor:
    """Run ``confidence._photometric_error`` with kernels."""
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
