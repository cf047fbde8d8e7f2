"""Triton kernels for ``median``: values and their weighted median, upsampled values, edge sharpness."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.algorithm.constants import HALF_WINDOW, WINDOW_SIGMA
from geodiff_plugin.geometry import image_size
from geodiff_plugin.result import constants
from geodiff_plugin.result.records import Voters

# Triton kernels can read module constants only as constexpr.
_HALF_WINDOW = tl.constexpr(HALF_WINDOW)
_SIDE = tl.constexpr(2 * HALF_WINDOW + 1)
_VOTERS = tl.constexpr(len(constants.WINDOW))
_SPREAD = tl.constexpr(2.0 * WINDOW_SIGMA**2)
_SPACING = tl.constexpr(constants.SPACING)
_ROW_WEIGHT = tl.constexpr(constants.ROW_WEIGHT)
_FILLED_WEIGHT = tl.constexpr(constants.FILLED_WEIGHT)
_MAX_VOTE_ERROR = tl.constexpr(constants.MAX_VOTE_ERROR)
_OUTLIER_ERRORS = tl.constexpr(constants.OUTLIER_ERRORS)
_BRIGHTNESS = tl.constexpr(constants.BRIGHTNESS)
_NEAR_PX = tl.constexpr(constants.NEAR_PX)
_ROUNDS = tl.constexpr(constants.ROUNDS)
_MEDIAN = tl.constexpr(constants.MEDIAN)
_IN_MEDIAN = tl.constexpr(constants.MEDIAN**2)
_MAP_VOTE = tl.constexpr(constants.MAP_VOTE)
_WEAK_PRIOR = tl.constexpr(constants.WEAK_PRIOR)
_MIN_ERROR = tl.constexpr(constants.MIN_ERROR)
_MAX_SOFT_ERROR = tl.constexpr(constants.MAX_SOFT_ERROR)
_SOFTNESS_POWER = tl.constexpr(constants.SOFTNESS_POWER)
_MIN_DEPTH_M = tl.constexpr(constants.MIN_DEPTH_M)
_STEP_PX = tl.constexpr(constants.STEP_PX)
_NEAR_RADIUS = tl.constexpr(constants.NEAR_RADIUS)
_WIDE_RADIUS = tl.constexpr(constants.WIDE_RADIUS)
_MIN_EDGE = tl.constexpr(constants.MIN_EDGE)
_MAX_RISE = tl.constexpr(constants.MAX_RISE)
_DISTANCE_DECAY = tl.constexpr(constants.DISTANCE_DECAY)
#: Pixels per program.
PIXELS = 1024
#: Pixels per program that holds their windows.
BLOCK = 64
#: Warps per program that holds windows.
WARPS = 8
#: Values per pixel, rounded up to a power of two: two per window position, and the map's own.
VALUES = triton.next_power_of_2(2 * len(constants.WINDOW) + 1)
#: Values around an upsampled pixel, rounded up to a power of two.
AROUND = 16
#: Values in the window of the median filter, rounded up to a power of two.
IN_MEDIAN = triton.next_power_of_2(constants.MEDIAN**2)


@triton.jit
def _inside(row, column, height, width):
    """Return the flat index of an image pixel; outside the image, of the nearest border pixel."""
    row = tl.minimum(tl.maximum(row, 0), height - 1)
    return row * width + tl.minimum(tl.maximum(column, 0), width - 1)


@triton.jit
def _mean_near_median(values, weight):
    """Compute ``median._mean_near_median`` along the second axis."""
    low, high, half = tl.min(values, 1), tl.max(values, 1), tl.sum(weight, 1) / 2.0
    for _ in tl.static_range(_ROUNDS):
        middle = 0.5 * (low + high)
        reached = tl.sum(tl.where(values <= middle[:, None], weight, 0.0), 1) >= half
        high, low = tl.where(reached, middle, high), tl.where(reached, low, middle)
    median = 0.5 * (low + high)
    away = values - median[:, None]
    near = away / _NEAR_PX
    near = 1.0 + near * near
    weight = weight / (near * near)
    return median + tl.sum(weight * away, 1) / tl.maximum(tl.sum(weight, 1), 1e-9)


@triton.jit
def _error_and_map_vote(error, sharpness):
    """Compute ``median._error_at_edges`` and the weight of the map's own value."""
    measured = tl.maximum(tl.load(error), _MIN_ERROR)
    soft = tl.exp(tl.log(tl.load(sharpness)) * _SOFTNESS_POWER)
    at_edges = tl.maximum(measured, tl.minimum(measured / soft, _MAX_SOFT_ERROR))
    better = tl.maximum(1.0 / at_edges * _WEAK_PRIOR, 1.0)
    return at_edges, better * better * better * _MAP_VOTE


@triton.jit(do_not_specialize=["height", "width"])
def vote_kernel(
    depth_m, inverse_depth, confidence, known, row_shift, certain, filled, image, error, sharpness, filtered,
    px, closeness, height, width, CHANNELS: tl.constexpr, BLOCK: tl.constexpr, VALUES: tl.constexpr,
):  # fmt: skip
    """Weight the values around every pixel and average those near their weighted median."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    exists = pixel < height * width
    own = tl.minimum(pixel, height * width - 1)
    vote = tl.arange(0, VALUES)
    place = 2 * (vote % _VOTERS)  # every second position of the window
    down, right = place // _SIDE - _HALF_WINDOW, place % _SIDE - _HALF_WINDOW
    v = (own // width)[:, None] + _SPACING * down[None, :]
    at = _inside(v, (own % width)[:, None] + _SPACING * right[None, :], height, width)
    of_row = (vote < _VOTERS)[None, :]

    know, sure = tl.load(known + at), tl.load(confidence + at)
    weight = tl.where(
        of_row,
        know * (tl.load(certain + at) * _ROW_WEIGHT + tl.load(filled + at) * _FILLED_WEIGHT),
        know * tl.minimum(tl.maximum(sure, 0.0), 1.0),
    )
    shift = px / tl.load(depth_m + at)  # of the map at the value's position
    values = tl.where(of_row, tl.load(row_shift + at), px * tl.load(inverse_depth + at))
    at_edges, map_vote = _error_and_map_vote(error, sharpness)
    noise = tl.minimum(at_edges, _MAX_VOTE_ERROR)
    difference = tl.log(tl.maximum(values, 0.1) / shift)
    difference = 1.0 + difference * difference / (
        (noise * noise + 1.0 / (shift * shift)) * (_OUTLIER_ERRORS * _OUTLIER_ERRORS)
    )
    colour_distance = tl.zeros_like(shift)
    for channel in tl.static_range(CHANNELS):
        layer = image + channel * height * width
        colour_distance += tl.abs(tl.load(layer + at) - tl.load(layer + own)[:, None])
    away = (down * down + right * right).to(tl.float32) / _SPREAD
    weight = (
        weight
        / (difference * difference)
        * tl.exp(-colour_distance / (CHANNELS * _BRIGHTNESS))
        * tl.exp(-away)[None, :]
    )

    own_shift = (px / tl.load(depth_m + own))[:, None]
    is_vote = (vote < 2 * _VOTERS)[None, :]
    weight = tl.where(is_vote, weight, tl.where(vote == 2 * _VOTERS, map_vote * closeness, 0.0)[None, :])
    tl.store(filtered + pixel, _mean_near_median(tl.where(is_vote, values, own_shift), weight), exists)


@triton.jit(do_not_specialize=["height", "width"])
def median_kernel(
    filtered, confidence, error, sharpness, smooth, height, width,
    BLOCK: tl.constexpr, IN_MEDIAN: tl.constexpr,
):  # fmt: skip
    """Apply the median filter at every pixel where matches outweigh the map and there is no known point."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    exists = pixel < height * width
    own = tl.minimum(pixel, height * width - 1)
    row, column = own // width, own % width
    place = tl.minimum(tl.arange(0, IN_MEDIAN), _IN_MEDIAN - 1)
    v = row[:, None] + (place // _MEDIAN - _MEDIAN // 2)[None, :]
    u = column[:, None] + (place % _MEDIAN - _MEDIAN // 2)[None, :]
    values = tl.load(filtered + _inside(v, u, height, width))
    counts = (tl.arange(0, IN_MEDIAN) < _IN_MEDIAN).to(tl.int32)[None, :]
    median = tl.full([BLOCK], float("inf"), tl.float32)
    for down in range(_MEDIAN):
        for right in range(_MEDIAN):
            at = _inside(row + (down - _MEDIAN // 2), column + (right - _MEDIAN // 2), height, width)
            value = tl.load(filtered + at)
            below = tl.sum(tl.where(values <= value[:, None], counts, 0), 1)
            median = tl.minimum(median, tl.where(2 * below > _IN_MEDIAN, value, float("inf")))
    _at_edges, map_vote = _error_and_map_vote(error, sharpness)
    # The confidence of a known point is above 1. Nothing is smoothed if the map outweighs its matches.
    limit = tl.where(map_vote < 1.0, 1.0, -1.0)
    smoothed = tl.load(confidence + own) <= limit
    tl.store(smooth + pixel, tl.where(smoothed, median, tl.load(filtered + own)), exists)


def filtered(given: Voters, left: Tensor, error: Tensor, sharpness: Tensor) -> Tensor:
    """Run ``median._filtered`` with kernels."""
    height, width = given.depth_m.shape
    of_rows = given.rows.shift, given.rows.certain, given.rows.filled
    maps = [each.contiguous() for each in (*given[:4], *of_rows, left)]
    raw, smooth = torch.empty_like(maps[0]), torch.empty_like(maps[0])
    grid = (triton.cdiv(height * width, BLOCK),)
    closeness = sum(math.exp(-(v**2 + u**2) / (2.0 * WINDOW_SIGMA**2)) for v, u in constants.WINDOW)
    launched_on(left, vote_kernel[grid])(
        *maps,
        error,
        sharpness,
        raw,
        float(given.px),
        closeness,
        height,
        width,
        CHANNELS=len(left),
        BLOCK=BLOCK,
        VALUES=VALUES,
        num_warps=WARPS,
    )
    launched_on(left, median_kernel[grid])(
        raw,
        maps[2],
        error,
        sharpness,
        smooth,
        height,
        width,
        BLOCK=BLOCK,
        IN_MEDIAN=IN_MEDIAN,
        num_warps=WARPS,
    )
    return smooth


@triton.jit
def fraction_kernel(depth_m, fraction, height, width, PIXELS: tl.constexpr):
    """Compute ``median._step_fractions`` of the whole map."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists = pixel < height * width
    row, column = pixel // width, pixel % width
    rim = tl.minimum(tl.minimum(row, height - 1 - row), tl.minimum(column, width - 1 - column))
    inner = exists & (rim >= _WIDE_RADIUS)
    lowest = tl.full([PIXELS], float("inf"), tl.float32)
    highest = tl.full([PIXELS], float("-inf"), tl.float32)
    low, high, step = lowest, highest, tl.zeros([PIXELS], tl.float32)
    for down in range(-_WIDE_RADIUS, _WIDE_RADIUS + 1):
        for right in range(-_WIDE_RADIUS, _WIDE_RADIUS + 1):
            depth = tl.load(depth_m + pixel + down * width + right, inner, 1.0)
            lowest, highest = tl.minimum(lowest, depth), tl.maximum(highest, depth)
    for down in range(-_NEAR_RADIUS, _NEAR_RADIUS + 1):
        for right in range(-_NEAR_RADIUS, _NEAR_RADIUS + 1):
            at = depth_m + pixel + down * width + right
            depth = tl.load(at, inner, 1.0)
            low, high = tl.minimum(low, depth), tl.maximum(high, depth)
            log_depth = tl.log(tl.maximum(depth, _MIN_DEPTH_M))
            across = log_depth - tl.log(tl.maximum(tl.load(at - _STEP_PX, inner, 1.0), _MIN_DEPTH_M))
            along = log_depth - tl.log(tl.maximum(tl.load(at - _STEP_PX * width, inner, 1.0), _MIN_DEPTH_M))
            step = tl.maximum(step, tl.maximum(tl.abs(across), tl.abs(along)))
    near = tl.log(tl.maximum(high, _MIN_DEPTH_M)) - tl.log(tl.maximum(low, _MIN_DEPTH_M))
    wide = tl.log(tl.maximum(highest, _MIN_DEPTH_M)) - tl.log(tl.maximum(lowest, _MIN_DEPTH_M))
    at_edge = inner & (near > _MIN_EDGE) & (wide < near * _MAX_RISE)
    tl.store(fraction + pixel, tl.where(at_edge, step / tl.where(at_edge, near, 1.0), float("nan")), exists)


def step_fractions(depth_m: Tensor) -> Tensor:
    """Run ``median._step_fractions`` with a kernel."""
    fraction = torch.empty_like(depth_m)
    launched_on(depth_m, fraction_kernel[(triton.cdiv(depth_m.numel(), PIXELS),)])(
        depth_m, fraction, *depth_m.shape, PIXELS=PIXELS, num_warps=WARPS
    )
    return fraction


@triton.jit
def _rounded(x):
    """Round to the nearest integer, ties to even, as a float."""
    below = tl.floor(x)
    part = x - below
    is_odd = below - 2.0 * tl.floor(below / 2.0)
    return below + tl.where((part > 0.5) | ((part == 0.5) & (is_odd > 0.5)), 1.0, 0.0)


@triton.jit(do_not_specialize=["rows", "columns", "height", "width"])
def upsample_kernel(
    filtered, image, whole, large, rows, columns, height, width,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr, AROUND: tl.constexpr,
):  # fmt: skip
    """Compute ``median._upsampled``. Grid: blocks of pixels."""
    pixel = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    pixels = height.to(tl.int64) * width
    exists = pixel < pixels
    own = tl.minimum(pixel, pixels - 1)
    y = ((own // width).to(tl.float32) + 0.5) * (rows / height) - 0.5
    x = ((own % width).to(tl.float32) + 0.5) * (columns / width) - 0.5
    vote = tl.arange(0, AROUND)
    is_vote = (vote < 9)[None, :]
    place = tl.minimum(vote, 8)
    v = _rounded(y)[:, None] + (place // 3 - 1).to(tl.float32)[None, :]
    u = _rounded(x)[:, None] + (place % 3 - 1).to(tl.float32)[None, :]
    at = _inside(v.to(tl.int32), u.to(tl.int32), rows, columns)
    colour_distance = tl.zeros_like(v)
    for channel in tl.static_range(CHANNELS):
        colour = tl.load(whole + channel * pixels + own)
        colour_distance += tl.abs(tl.load(image + channel * rows * columns + at) - colour[:, None])
    v, u = v - y[:, None], u - x[:, None]
    weight = tl.exp(-colour_distance / (CHANNELS * _BRIGHTNESS) - (v * v + u * u) * _DISTANCE_DECAY)
    result = _mean_near_median(tl.load(filtered + at), tl.where(is_vote, weight, 0.0))
    tl.store(large + pixel, result, exists)


def upsampled(filtered: Tensor, left: Tensor, whole: Tensor) -> Tensor:
    """Run ``median._upsampled`` with a kernel."""
    size = image_size(whole)
    large = filtered.new_empty(size)
    launched_on(filtered, upsample_kernel[(triton.cdiv(large.numel(), BLOCK),)])(
        filtered.contiguous(),
        left.contiguous(),
        whole.contiguous(),
        large,
        *image_size(left),
        *size,
        CHANNELS=len(whole),
        BLOCK=BLOCK,
        AROUND=AROUND,
    )
    return large
