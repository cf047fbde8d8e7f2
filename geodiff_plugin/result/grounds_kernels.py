"""Triton kernel of what the confidence of a depth rests on; the reference is ``confidence._grounds_on_grid``.

This module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.window_kernels import TILE, in_window, tile_places, tiles
from geodiff_plugin.result import confidence

# A kernel reads constants of its module only as these.
_REACH = tl.constexpr(confidence.GROUNDS_REACH)
_FAR = tl.constexpr(confidence.FAR)
_FEW = tl.constexpr(confidence.FEW)
_STEADY = tl.constexpr(confidence.STEADY)
_MOVED = tl.constexpr(confidence.MOVED)
_LOG_MOVED = tl.constexpr(math.log(confidence.MOVED))
_EVEN_REACH = tl.constexpr(confidence.EVEN_REACH)


@triton.jit
def _range_around(log_depth, height, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """``correction.range_around`` of the tile of a program."""
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    column = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    highest = tl.full([ROWS, COLUMNS], float("-inf"), tl.float32)
    least = tl.full([ROWS, COLUMNS], float("inf"), tl.float32)
    for down in range(-_EVEN_REACH, _EVEN_REACH + 1):
        y = tl.minimum(tl.maximum(row + down, 0), height - 1)
        for right in range(-_EVEN_REACH, _EVEN_REACH + 1):
            x = tl.minimum(tl.maximum(column + right, 0), width - 1)
            value = tl.load(log_depth + y[:, None] * width + x[None, :])
            highest, least = tl.maximum(highest, value), tl.minimum(least, value)
    return highest - least


@triton.jit(do_not_specialize=["height", "width"])
def grounds_kernel(
    inverse_depth, confidence, log_depth, denoised, step, known, grounds, height, width,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Distance of the matches, change and range of log depth around every pixel of one image."""
    first, n = tl.program_id(0) * ROWS, height * width
    row, column = first + tl.arange(0, ROWS), tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    plane = tl.load(step)
    weight = tl.zeros([ROWS, COLUMNS], tl.float32)
    weighted, changed = weight, weight
    for y in range(tl.maximum(first - _REACH, 0), tl.minimum(first + ROWS + _REACH, height)):
        weight_of_row = tl.zeros([COLUMNS], tl.float32)
        weighted_of_row, changed_of_row = weight_of_row, weight_of_row
        for right in range(-_REACH, _REACH + 1):
            x = column + right
            there, at = (x >= 0) & (x < width), y * width + x
            here, sure = tl.load(log_depth + at, there, 0.0), tl.load(confidence + at, there, 0.0)
            away = tl.abs(tl.load(inverse_depth + at, there, 0.0) - tl.exp(-here)) / plane
            weight_of_row += sure
            weighted_of_row += sure * tl.minimum(away, _FAR)
            changed_of_row += tl.abs(here - tl.load(denoised + at, there, 0.0))
        near = (tl.abs(row - y) <= _REACH)[:, None]
        weight += tl.where(near, weight_of_row[None, :], 0.0)
        weighted += tl.where(near, weighted_of_row[None, :], 0.0)
        changed += tl.where(near, changed_of_row[None, :], 0.0)
    count = in_window(height, width, _REACH, ROWS, COLUMNS)
    p, inside = tile_places(height, width, ROWS, COLUMNS)
    tl.store(grounds + p, (weighted / count + _FEW * _FAR) / (weight / count + _FEW), inside)
    measured = tl.load(known)
    share = measured / (measured + _FEW)
    changed = tl.minimum(tl.maximum(changed / count, _STEADY), _MOVED)
    tl.store(grounds + n + p, tl.exp(tl.log(changed) * share + (1.0 - share) * _LOG_MOVED), inside)
    tl.store(grounds + 2 * n + p, _range_around(log_depth, height, width, ROWS, COLUMNS), inside)


def grounds_on_grid(log_depth: Tensor, denoised: Tensor, target: Matches) -> Tensor:
    """``confidence._grounds_on_grid``."""
    known = target.confidence.clamp_max(1.0).mean()
    grounds = log_depth.new_empty(1, 3, *target.size)
    launched_on(log_depth, grounds_kernel[tiles(target.size)])(
        target.inverse_depth.contiguous(), target.confidence.contiguous(), log_depth, denoised,
        target.plane_step, known, grounds, *target.size, ROWS=TILE[0], COLUMNS=TILE[1],
    )  # fmt: skip
    return grounds
