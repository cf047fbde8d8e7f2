"""Triton kernel for edge sharpening; its reference is ``algorithm.edges.sharpen_edges``."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.algorithm.constants import (
    HALF_WINDOW,
    MIN_STEEPNESS,
    MIN_STEP,
    RAMP_BRIGHTNESS,
    SLOPE,
    SURFACE_DISTANCE,
    WINDOW_SIGMA,
)

# Triton kernels can read module constants only as constexpr.
_SURFACE_DISTANCE = tl.constexpr(SURFACE_DISTANCE)
_HALF = tl.constexpr(HALF_WINDOW)
_SIDE = tl.constexpr(2 * HALF_WINDOW + 1)
_SAMPLES = tl.constexpr((2 * HALF_WINDOW + 1) ** 2)
_RAMP_BRIGHTNESS = tl.constexpr(RAMP_BRIGHTNESS)
_SPREAD = tl.constexpr(2.0 * WINDOW_SIGMA**2)
_SLOPE = tl.constexpr(SLOPE)
_STEEPER = tl.constexpr(MIN_STEEPNESS)
_STEP = tl.constexpr(MIN_STEP)
#: Pixels per program: with 64 and 8 warps, Triton 3.9 spills registers on compute capability 12.0.
BLOCK = 32
#: Warps per program.
WARPS = 4
#: Samples of a window, rounded up to a power of two.
PADDED = triton.next_power_of_2((2 * HALF_WINDOW + 1) ** 2)


@triton.jit
def _inside(row, column, height, width):
    """Return the flat index of an image pixel; outside the image, of the nearest border pixel."""
    row = tl.minimum(tl.maximum(row, 0), height - 1)
    return row * width + tl.minimum(tl.maximum(column, 0), width - 1)


@triton.jit
def _inverse(depth, row, column, height, width):
    return 1.0 / tl.load(depth + _inside(row, column, height, width)).to(tl.float32)


@triton.jit
def _window_index(row, column, sample, height, width, spacing):
    """Return ``_inside`` of the samples around pixels, ``[BLOCK, PADDED]``."""
    v = row[:, None] + spacing * (sample // _SIDE - _HALF)[None, :]
    return _inside(v, column[:, None] + spacing * (sample % _SIDE - _HALF)[None, :], height, width)


@triton.jit
def _is_ramp(depth, row, column, height, width, spacing, DOWN: tl.constexpr, RIGHT: tl.constexpr):
    """Return whether pixels are on a ramp in one direction (``edges._Strip.on_ramp``)."""
    down, right = DOWN * spacing, RIGHT * spacing
    centre = _inverse(depth, row, column, height, width)
    ahead = _inverse(depth, row + down, column + right, height, width) - centre
    behind = centre - _inverse(depth, row - down, column - right, height, width)
    discontinuity = tl.minimum(tl.abs(ahead), tl.abs(behind)) > centre * _STEP
    steepest = tl.zeros_like(centre)
    for way in tl.static_range(-1, 2, 2):
        far, near = way * _SURFACE_DISTANCE + 1, way * _SURFACE_DISTANCE - 1
        difference = _inverse(depth, row + far * down, column + far * right, height, width)
        difference -= _inverse(depth, row + near * down, column + near * right, height, width)
        steepest = tl.maximum(steepest, tl.abs(difference))
    return (ahead * behind > 0) & discontinuity & (tl.abs(ahead + behind) > steepest * _STEEPER)


@triton.jit
def _weights(depth, image, row, column, sample, height, width, spacing, CHANNELS: tl.constexpr):
    """Compute the weights ``[BLOCK, PADDED]`` of the samples around pixels (``edges._Strip.median``)."""
    down, right = sample // _SIDE - _HALF, sample % _SIDE - _HALF
    v, u = row[:, None] + spacing * down[None, :], column[:, None] + spacing * right[None, :]
    across = _inverse(depth, v, u + spacing, height, width) - _inverse(depth, v, u - spacing, height, width)
    along = _inverse(depth, v + spacing, u, height, width) - _inverse(depth, v - spacing, u, height, width)
    depth_m = tl.load(depth + _inside(v, u, height, width)).to(tl.float32)
    slope = tl.sqrt(across * across + along * along) / 2.0 * depth_m / _SLOPE
    colour_distance = tl.zeros_like(slope)
    for channel in tl.static_range(CHANNELS):
        layer = image + channel * height * width
        centre = tl.load(layer + _inside(row, column, height, width)).to(tl.float32)
        colour_distance += tl.abs(
            tl.load(layer + _inside(v, u, height, width)).to(tl.float32) - centre[:, None]
        )
    away = (down * down + right * right).to(tl.float32) / _SPREAD
    weight = tl.exp(-colour_distance / (CHANNELS * _RAMP_BRIGHTNESS) - away[None, :]) / (1.0 + slope * slope)
    return tl.where(sample[None, :] < _SAMPLES, weight, 0.0)


@triton.jit
def sharpen_kernel(
    depth_m, image, sharp, height, width, spacing,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr, PADDED: tl.constexpr,
):  # fmt: skip
    """Sharpen pixels on ramps to the weighted median of their window. Grid: blocks of pixels, maps."""
    of_map = tl.program_id(1).to(tl.int64) * height * width
    depth, image = depth_m + of_map, image + CHANNELS * of_map
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    exists = pixel < height * width
    row, column = pixel // width, pixel % width
    on_ramp = _is_ramp(depth, row, column, height, width, spacing, 0, 1)
    on_ramp |= _is_ramp(depth, row, column, height, width, spacing, 1, 0)
    on_ramp |= _is_ramp(depth, row, column, height, width, spacing, 1, 1)
    on_ramp |= _is_ramp(depth, row, column, height, width, spacing, 1, -1)
    on_ramp = on_ramp & exists
    own = tl.load(depth + pixel, exists, 1.0)
    if tl.max(on_ramp.to(tl.int32), 0) > 0:
        sample = tl.arange(0, PADDED)
        weight = _weights(depth, image, row, column, sample, height, width, spacing, CHANNELS)
        values = tl.load(depth + _window_index(row, column, sample, height, width, spacing)).to(tl.float32)
        half = 0.5 * tl.sum(weight, 1)
        median = tl.full([BLOCK], float("inf"), tl.float32)
        for down in range(_SIDE):
            for right in range(_SIDE):
                v, u = row + spacing * (down - _HALF), column + spacing * (right - _HALF)
                value = tl.load(depth + _inside(v, u, height, width)).to(tl.float32)
                below = tl.sum(tl.where(values <= value[:, None], weight, 0.0), 1)
                median = tl.minimum(median, tl.where(below >= half, value, float("inf")))
        own = tl.where(on_ramp, median.to(own.dtype), own)
    tl.store(sharp + of_map + pixel, own, exists)


def sharpen_edges(depth_m: Tensor, left_01: Tensor, spacing: int = 1) -> Tensor:
    """Run ``edges.sharpen_edges`` with a kernel."""
    batch, _, height, width = depth_m.shape
    depth_m, left_01 = depth_m.contiguous(), left_01.contiguous()
    sharp = torch.empty_like(depth_m)
    launched_on(depth_m, sharpen_kernel[(triton.cdiv(height * width, BLOCK), batch)])(
        depth_m,
        left_01,
        sharp,
        height,
        width,
        spacing,
        CHANNELS=left_01.shape[1],
        BLOCK=BLOCK,
        PADDED=PADDED,
        num_warps=WARPS,
    )
    return sharp
