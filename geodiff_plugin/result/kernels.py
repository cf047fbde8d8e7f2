"""Triton kernels of act 3; each equals its reference, which its docstring names.

This module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import math

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.algorithm.edges import HALF, REACH
from geodiff_plugin.geometry import EDGE_PX, NEAREST_M, image_size, to_device_of
from geodiff_plugin.result import confidence, voting

# A kernel reads constants of its module only as these.
_HALF = tl.constexpr(HALF)
_SIDE = tl.constexpr(2 * HALF + 1)
_VOTERS = tl.constexpr(len(voting.WINDOW))
_SPREAD = tl.constexpr(2.0 * REACH**2)
_SPACING = tl.constexpr(voting.SPACING)
_ROWS = tl.constexpr(voting.ROWS)
_FILLED = tl.constexpr(voting.FILLED)
_ERROR_OF_VOTES = tl.constexpr(voting.ERROR_OF_VOTES)
_DIFFERS = tl.constexpr(voting.DIFFERS)
_BRIGHTNESS = tl.constexpr(voting.BRIGHTNESS)
_NEAR_PX = tl.constexpr(voting.NEAR_PX)
_ROUNDS = tl.constexpr(voting.ROUNDS)
_MEDIAN = tl.constexpr(voting.MEDIAN)
_IN_MEDIAN = tl.constexpr(voting.MEDIAN**2)
_MAP_VOTE = tl.constexpr(voting.MAP_VOTE)
_WEAK_PRIOR = tl.constexpr(voting.WEAK_PRIOR)
_LEAST_ERROR = tl.constexpr(voting.LEAST_ERROR)
_MOST_SOFT = tl.constexpr(voting.MOST_SOFT)
_SOFT = tl.constexpr(voting.SOFT)
_LEAST_M = tl.constexpr(voting.LEAST_M)
_STEP_PX = tl.constexpr(voting.STEP_PX)
_NEARBY = tl.constexpr(voting.NEARBY)
_WIDE = tl.constexpr(voting.WIDE)
_EDGE = tl.constexpr(voting.EDGE)
_RISE = tl.constexpr(voting.RISE)
_NEAREST = tl.constexpr(voting.NEAREST)
_EDGE_PX = tl.constexpr(EDGE_PX)
_NEAREST_M = tl.constexpr(NEAREST_M)
_CONSTANT = tl.constexpr(confidence.BY_EVIDENCE[0])
_CERTAINTY = tl.constexpr(confidence.BY_EVIDENCE[1])
_CLOSENESS = tl.constexpr(confidence.BY_EVIDENCE[2])
_STEADINESS = tl.constexpr(confidence.BY_EVIDENCE[3])
_EVENNESS = tl.constexpr(confidence.BY_EVIDENCE[4])
_SPREAD_COUNTS = tl.constexpr(confidence.BY_EVIDENCE[5])
_CLOSE = tl.constexpr(confidence.CLOSE)
_FAR = tl.constexpr(confidence.FAR)
_STEADY = tl.constexpr(confidence.STEADY)
_MOVED = tl.constexpr(confidence.MOVED)
_EVEN = tl.constexpr(confidence.EVEN)
_STEPPED = tl.constexpr(confidence.STEPPED)
_LEAST_LEFT = tl.constexpr(confidence.LEAST_LEFT)
_MOST_LEFT = tl.constexpr(confidence.MOST_LEFT)
_BEST = tl.constexpr(confidence.BEST)
_USELESS = tl.constexpr(confidence.USELESS)
_HALF_KNOWN = tl.constexpr(confidence.HALF_KNOWN)
#: Pixels of a program that works on each by itself.
PIXELS = 1024
#: Pixels of a program whose windows are held at once.
BLOCK = 64
#: Warps of such a program.
WARPS = 8
#: Votes of a pixel, as a power of two: two of every place in the window, and the map's own.
VOTES = triton.next_power_of_2(2 * len(voting.WINDOW) + 1)
#: Votes around a pixel that is enlarged to, as a power of two.
AROUND = 16
#: Values that a median is taken of, as a power of two.
IN_MEDIAN = triton.next_power_of_2(voting.MEDIAN**2)


@triton.jit
def _inside(row, column, height, width):
    """Flat index of the pixel of an image, whose outermost pixels are repeated around it."""
    row = tl.minimum(tl.maximum(row, 0), height - 1)
    return row * width + tl.minimum(tl.maximum(column, 0), width - 1)


@triton.jit
def _mean_near_median(votes, weight):
    """``voting._mean_near_median`` along the second axis."""
    low, high, half = tl.min(votes, 1), tl.max(votes, 1), tl.sum(weight, 1) / 2.0
    for _ in tl.static_range(_ROUNDS):
        middle = 0.5 * (low + high)
        reached = tl.sum(tl.where(votes <= middle[:, None], weight, 0.0), 1) >= half
        high, low = tl.where(reached, middle, high), tl.where(reached, low, middle)
    median = 0.5 * (low + high)
    away = votes - median[:, None]
    near = away / _NEAR_PX
    near = 1.0 + near * near
    weight = weight / (near * near)
    return median + tl.sum(weight * away, 1) / tl.maximum(tl.sum(weight, 1), 1e-9)


@triton.jit
def _error_and_map_vote(error, crispness):
    """``voting._error_at_edges``, and the weight of the map's own vote."""
    measured = tl.maximum(tl.load(error), _LEAST_ERROR)
    soft = tl.exp(tl.log(tl.load(crispness)) * _SOFT)
    at_edges = tl.maximum(measured, tl.minimum(measured / soft, _MOST_SOFT))
    better = tl.maximum(1.0 / at_edges * _WEAK_PRIOR, 1.0)
    return at_edges, better * better * better * _MAP_VOTE


@triton.jit(do_not_specialize=["height", "width"])
def vote_kernel(
    depth_m, inverse_depth, confidence, known, row_shift, certain, filled, image, error, crispness, voted,
    px, closeness, height, width, CHANNELS: tl.constexpr, BLOCK: tl.constexpr, VOTES: tl.constexpr,
):  # fmt: skip
    """The votes around every pixel, weighed, and the mean of those near their weighted median."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    exists = pixel < height * width
    own = tl.minimum(pixel, height * width - 1)
    vote = tl.arange(0, VOTES)
    place = 2 * (vote % _VOTERS)  # every second one of the window
    down, right = place // _SIDE - _HALF, place % _SIDE - _HALF
    v = (own // width)[:, None] + _SPACING * down[None, :]
    at = _inside(v, (own % width)[:, None] + _SPACING * right[None, :], height, width)
    of_row = (vote < _VOTERS)[None, :]

    know, sure = tl.load(known + at), tl.load(confidence + at)
    weight = tl.where(
        of_row,
        know * (tl.load(certain + at) * _ROWS + tl.load(filled + at) * _FILLED),
        know * tl.minimum(tl.maximum(sure, 0.0), 1.0),
    )
    shift = px / tl.load(depth_m + at)  # of the map there
    votes = tl.where(of_row, tl.load(row_shift + at), px * tl.load(inverse_depth + at))
    at_edges, map_vote = _error_and_map_vote(error, crispness)
    noise = tl.minimum(at_edges, _ERROR_OF_VOTES)
    apart = tl.log(tl.maximum(votes, 0.1) / shift)
    apart = 1.0 + apart * apart / ((noise * noise + 1.0 / (shift * shift)) * (_DIFFERS * _DIFFERS))
    unlike = tl.zeros_like(shift)
    for channel in tl.static_range(CHANNELS):
        layer = image + channel * height * width
        unlike += tl.abs(tl.load(layer + at) - tl.load(layer + own)[:, None])
    away = (down * down + right * right).to(tl.float32) / _SPREAD
    weight = weight / (apart * apart) * tl.exp(-unlike / (CHANNELS * _BRIGHTNESS)) * tl.exp(-away)[None, :]

    own_shift = (px / tl.load(depth_m + own))[:, None]
    is_vote = (vote < 2 * _VOTERS)[None, :]
    weight = tl.where(is_vote, weight, tl.where(vote == 2 * _VOTERS, map_vote * closeness, 0.0)[None, :])
    tl.store(voted + pixel, _mean_near_median(tl.where(is_vote, votes, own_shift), weight), exists)


@triton.jit(do_not_specialize=["height", "width"])
def median_kernel(
    voted, confidence, error, crispness, smooth, height, width,
    BLOCK: tl.constexpr, IN_MEDIAN: tl.constexpr,
):  # fmt: skip
    """The median of the square around every pixel, where matches outvote the map and nothing is known."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    exists = pixel < height * width
    own = tl.minimum(pixel, height * width - 1)
    row, column = own // width, own % width
    place = tl.minimum(tl.arange(0, IN_MEDIAN), _IN_MEDIAN - 1)
    v = row[:, None] + (place // _MEDIAN - _MEDIAN // 2)[None, :]
    u = column[:, None] + (place % _MEDIAN - _MEDIAN // 2)[None, :]
    values = tl.load(voted + _inside(v, u, height, width))
    counts = (tl.arange(0, IN_MEDIAN) < _IN_MEDIAN).to(tl.int32)[None, :]
    median = tl.full([BLOCK], float("inf"), tl.float32)
    for down in range(_MEDIAN):
        for right in range(_MEDIAN):
            at = _inside(row + (down - _MEDIAN // 2), column + (right - _MEDIAN // 2), height, width)
            value = tl.load(voted + at)
            below = tl.sum(tl.where(values <= value[:, None], counts, 0), 1)
            median = tl.minimum(median, tl.where(2 * below > _IN_MEDIAN, value, float("inf")))
    _at_edges, map_vote = _error_and_map_vote(error, crispness)
    # The confidence of a known point is above 1; none is smoothed where the map outvotes its matches.
    most = tl.where(map_vote < 1.0, 1.0, -1.0)
    smoothed = tl.load(confidence + own) <= most
    tl.store(smooth + pixel, tl.where(smoothed, median, tl.load(voted + own)), exists)


@triton.jit
def _in_units(value, least, most):
    """Minus the log of a value, within bounds, over the upper one."""
    return -tl.log(tl.minimum(tl.maximum(value, least), most) / most)


@triton.jit
def confidence_kernel(
    support, apart, moved, stepped, spread, prior_error, confident, pixels,
    SPREAD: tl.constexpr, PRIOR: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """``confidence.depth_confidence``. Grid: blocks of pixels, maps.

    SPREAD says whether there is one, PRIOR how many errors of the prior a map has: none, 1, or 2 for every
    pixel its own.
    """
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists, of_map = pixel < pixels, tl.program_id(1)
    at = of_map.to(tl.int64) * pixels + pixel
    supported = tl.load(support + at, exists, 0.0)
    log_useless = tl.log(tl.zeros_like(supported) + _USELESS)
    if PRIOR == 0:
        log_measured = log_useless
    else:
        where_measured = at if PRIOR == 2 else of_map + tl.zeros_like(pixel)
        measured = tl.load(prior_error + where_measured, exists, 1.0)
        log_measured = tl.log(tl.minimum(tl.maximum(measured, _BEST), _USELESS))
    share = supported / (supported + _HALF_KNOWN)
    left = (1.0 - supported) * tl.exp(share * log_measured + (1.0 - share) * log_useless)
    odds = _in_units(left, _LEAST_LEFT, _MOST_LEFT) * _CERTAINTY + _CONSTANT
    odds += _in_units(tl.load(apart + at, exists, 1.0), _CLOSE, _FAR) * _CLOSENESS
    odds += _in_units(tl.load(moved + at, exists, 1.0), _STEADY, _MOVED) * _STEADINESS
    odds += _in_units(tl.load(stepped + at, exists, 1.0), _EVEN, _STEPPED) * _EVENNESS
    if SPREAD:
        odds += tl.load(spread + at, exists, 0.0) * _SPREAD_COUNTS
    tl.store(confident + at, 1.0 / (1.0 + tl.exp(-odds)), exists)


def confidence_of(grounds: confidence.Grounds, spread: Tensor | None, prior_error: Tensor | None) -> Tensor:
    """``confidence.depth_confidence``; ``prior_error`` is a number a map, or has the size of the maps."""
    maps = [each.contiguous() for each in grounds]
    pixels, confident = maps[0][0].numel(), torch.empty_like(maps[0])
    further = [maps[0] if each is None else each.float().contiguous() for each in (spread, prior_error)]
    prior = 0 if prior_error is None else 1 if prior_error[0].numel() == 1 else 2
    launched_on(maps[0], confidence_kernel[(triton.cdiv(pixels, PIXELS), len(maps[0]))])(
        *maps, *further, confident, pixels, SPREAD=spread is not None, PRIOR=prior, PIXELS=PIXELS
    )
    return confident


@triton.jit
def warp_kernel(
    right, depth_m, cameras, warped, visible, height, width, rows, columns,
    CHANNELS: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """``geometry.warp_right_to_left`` of one image. Grid: blocks of pixels."""
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
    beside, below = tl.minimum(left + 1, columns - 1), tl.minimum(top + 1, rows - 1) * columns
    across, down = u - left.to(tl.float32), v - top.to(tl.float32)
    top = top * columns
    for channel in tl.static_range(CHANNELS):
        layer = right + channel * rows * columns
        above = (1.0 - across) * tl.load(layer + top + left) + across * tl.load(layer + top + beside)
        under = (1.0 - across) * tl.load(layer + below + left) + across * tl.load(layer + below + beside)
        tl.store(warped + channel * height * width + pixel, (1.0 - down) * above + down * under, exists)


def warped(
    right_01: Tensor, depth_m: Tensor, K_left: Tensor, K_right: Tensor, T_right_from_left: Tensor
) -> tuple[Tensor, Tensor]:
    """``confidence._warped``."""
    K, K_r, T = (
        each[0].numpy(force=True).astype(np.float64) for each in (K_left, K_right, T_right_from_left)
    )
    own = K[0, 2], K[1, 2], K[0, 0], K[1, 1], K[0, 1] / K[0, 0]
    cameras = np.concatenate([own, (K_r @ T[:3]).ravel()]).astype(np.float32)
    size, channels = image_size(depth_m), right_01.shape[1]
    image = right_01.new_empty(1, channels, *size)
    visible = torch.empty_like(depth_m, dtype=torch.bool)
    launched_on(depth_m, warp_kernel[(triton.cdiv(depth_m.numel(), PIXELS),)])(
        right_01.contiguous(),
        depth_m.contiguous(),
        to_device_of(depth_m, cameras),
        image,
        visible,
        *size,
        *image_size(right_01),
        CHANNELS=channels,
        PIXELS=PIXELS,
    )
    return image, visible


def voted(given: voting.Voters, left: Tensor, error: Tensor, crispness: Tensor) -> Tensor:
    """``voting._voted``."""
    height, width = given.depth_m.shape
    of_rows = given.rows.shift, given.rows.certain, given.rows.filled
    maps = [each.contiguous() for each in (*given[:4], *of_rows, left)]
    raw, smooth = torch.empty_like(maps[0]), torch.empty_like(maps[0])
    grid = (triton.cdiv(height * width, BLOCK),)
    closeness = sum(math.exp(-(v**2 + u**2) / (2.0 * REACH**2)) for v, u in voting.WINDOW)
    launched_on(left, vote_kernel[grid])(
        *maps,
        error,
        crispness,
        raw,
        float(given.px),
        closeness,
        height,
        width,
        CHANNELS=len(left),
        BLOCK=BLOCK,
        VOTES=VOTES,
        num_warps=WARPS,
    )
    launched_on(left, median_kernel[grid])(
        raw,
        maps[2],
        error,
        crispness,
        smooth,
        height,
        width,
        BLOCK=BLOCK,
        IN_MEDIAN=IN_MEDIAN,
        num_warps=WARPS,
    )
    return smooth


@triton.jit
def share_kernel(depth_m, share, height, width, PIXELS: tl.constexpr):
    """``voting._step_shares``, on the whole map."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists = pixel < height * width
    row, column = pixel // width, pixel % width
    rim = tl.minimum(tl.minimum(row, height - 1 - row), tl.minimum(column, width - 1 - column))
    inner = exists & (rim >= _WIDE)
    lowest = tl.full([PIXELS], float("inf"), tl.float32)
    highest = tl.full([PIXELS], float("-inf"), tl.float32)
    low, high, step = lowest, highest, tl.zeros([PIXELS], tl.float32)
    for down in range(-_WIDE, _WIDE + 1):
        for right in range(-_WIDE, _WIDE + 1):
            depth = tl.load(depth_m + pixel + down * width + right, inner, 1.0)
            lowest, highest = tl.minimum(lowest, depth), tl.maximum(highest, depth)
    for down in range(-_NEARBY, _NEARBY + 1):
        for right in range(-_NEARBY, _NEARBY + 1):
            at = depth_m + pixel + down * width + right
            depth = tl.load(at, inner, 1.0)
            low, high = tl.minimum(low, depth), tl.maximum(high, depth)
            log_depth = tl.log(tl.maximum(depth, _LEAST_M))
            across = log_depth - tl.log(tl.maximum(tl.load(at - _STEP_PX, inner, 1.0), _LEAST_M))
            along = log_depth - tl.log(tl.maximum(tl.load(at - _STEP_PX * width, inner, 1.0), _LEAST_M))
            step = tl.maximum(step, tl.maximum(tl.abs(across), tl.abs(along)))
    near = tl.log(tl.maximum(high, _LEAST_M)) - tl.log(tl.maximum(low, _LEAST_M))
    wide = tl.log(tl.maximum(highest, _LEAST_M)) - tl.log(tl.maximum(lowest, _LEAST_M))
    at_edge = inner & (near > _EDGE) & (wide < near * _RISE)
    tl.store(share + pixel, tl.where(at_edge, step / tl.where(at_edge, near, 1.0), float("nan")), exists)


def step_shares(depth_m: Tensor) -> Tensor:
    """``voting._step_shares``, with its rim."""
    share = torch.empty_like(depth_m)
    launched_on(depth_m, share_kernel[(triton.cdiv(depth_m.numel(), PIXELS),)])(
        depth_m, share, *depth_m.shape, PIXELS=PIXELS, num_warps=WARPS
    )
    return share


@triton.jit
def _rounded(x):
    """The nearest integer, of two the even one, as a float."""
    below = tl.floor(x)
    part = x - below
    is_odd = below - 2.0 * tl.floor(below / 2.0)
    return below + tl.where((part > 0.5) | ((part == 0.5) & (is_odd > 0.5)), 1.0, 0.0)


@triton.jit(do_not_specialize=["rows", "columns", "height", "width"])
def enlarge_kernel(
    voted, image, whole, large, rows, columns, height, width,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr, AROUND: tl.constexpr,
):  # fmt: skip
    """``voting._enlarged``. Grid: blocks of pixels."""
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
    unlike = tl.zeros_like(v)
    for channel in tl.static_range(CHANNELS):
        colour = tl.load(whole + channel * pixels + own)
        unlike += tl.abs(tl.load(image + channel * rows * columns + at) - colour[:, None])
    v, u = v - y[:, None], u - x[:, None]
    weight = tl.exp(-unlike / (CHANNELS * _BRIGHTNESS) - (v * v + u * u) * _NEAREST)
    result = _mean_near_median(tl.load(voted + at), tl.where(is_vote, weight, 0.0))
    tl.store(large + pixel, result, exists)


def enlarged(votes: Tensor, left: Tensor, whole: Tensor) -> Tensor:
    """``voting._enlarged``."""
    size = image_size(whole)
    large = votes.new_empty(size)
    launched_on(votes, enlarge_kernel[(triton.cdiv(large.numel(), BLOCK),)])(
        votes.contiguous(),
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
