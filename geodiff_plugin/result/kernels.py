"""Triton kernels of act 3; each equals its reference, which its docstring names.

This module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.algorithm.edges import HALF, REACH
from geodiff_plugin.result import voting

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
#: Pixels of a program whose windows are held at once.
BLOCK = 64
#: Warps of such a program.
WARPS = 8
#: Votes of a pixel, as a power of two: two of every place in the window, and the map's own.
VOTES = triton.next_power_of_2(2 * len(voting.WINDOW) + 1)
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
def vote_kernel(
    depth_m, inverse_depth, confidence, known, row_shift, matched, filled, image, error, map_vote, voted,
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
        know * (tl.load(matched + at) * _ROWS + tl.load(filled + at) * _FILLED),
        know * tl.minimum(tl.maximum(sure, 0.0), 1.0),
    )
    shift = px / tl.load(depth_m + at)  # of the map there
    votes = tl.where(of_row, tl.load(row_shift + at), px * tl.load(inverse_depth + at))
    noise = tl.minimum(tl.load(error), _ERROR_OF_VOTES)
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
    weight = tl.where(
        is_vote, weight, tl.where(vote == 2 * _VOTERS, tl.load(map_vote) * closeness, 0.0)[None, :]
    )
    tl.store(voted + pixel, _mean_near_median(tl.where(is_vote, votes, own_shift), weight), exists)


@triton.jit
def median_kernel(
    voted, confidence, map_vote, smooth, height, width, BLOCK: tl.constexpr, IN_MEDIAN: tl.constexpr
):
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
    most = tl.where(tl.load(map_vote) < 1.0, 1.0, -1.0)
    smoothed = tl.load(confidence + own) <= most
    tl.store(smooth + pixel, tl.where(smoothed, median, tl.load(voted + own)), exists)


def voted(given: voting.Voters, left: Tensor, error: Tensor, map_vote: Tensor) -> Tensor:
    """``voting._voted``."""
    height, width = given.depth_m.shape
    maps = [each.contiguous() for each in (*given[:4], *given.rows[:3], left)]
    raw, smooth = torch.empty_like(maps[0]), torch.empty_like(maps[0])
    grid = (triton.cdiv(height * width, BLOCK),)
    closeness = sum(math.exp(-(v**2 + u**2) / (2.0 * REACH**2)) for v, u in voting.WINDOW)
    launched_on(left, vote_kernel[grid])(
        *maps,
        error,
        map_vote,
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
        raw, maps[2], map_vote, smooth, height, width, BLOCK=BLOCK, IN_MEDIAN=IN_MEDIAN, num_warps=WARPS
    )
    return smooth
