"""Triton kernels of flat walls, whose reference is ``result.flattening``; the solves between have their own.

This module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.matching import Matches, consistency
from geodiff_plugin.matching.window_kernels import TILE, mean_precision, tile_places, tiles
from geodiff_plugin.result import flattening

#: Pixels of a program.
BLOCK = 512
# A kernel reads constants of its module only as these.
_LEAST_SLOPE_WEIGHT = tl.constexpr(flattening.LEAST_SLOPE_WEIGHT)
_SLOPES = tl.constexpr(flattening.SLOPES)
_LEAST_VALUE_WEIGHT = tl.constexpr(flattening.LEAST_VALUE_WEIGHT)
_MOST_VALUE_WEIGHT = tl.constexpr(flattening.MOST_VALUE_WEIGHT)
_LEAST_INVERSE = tl.constexpr(flattening.LEAST_INVERSE)
_LEAST_DEVIATION = tl.constexpr(consistency.LEAST_DEVIATION)
_FAR_PLANES = tl.constexpr(consistency.FAR_PLANES)


@triton.jit(
    do_not_specialize=["height", "width"],
    do_not_specialize_on_alignment=["deviation", "confidence", "shape", "held", "weight"],
)
def known_kernel(
    deviation, confidence, log_depth, step, unit, good, inverse, shape, held, weight, height, width,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """``flattening._known_of``. Grid: tiles down, tiles across."""
    p, inside = tile_places(height, width, ROWS, COLUMNS)
    known = mean_precision(deviation, confidence, _LEAST_DEVIATION, height, width, ROWS, COLUMNS)
    away = tl.load(log_depth + p, inside, 0.0)
    planes = tl.exp(-away) / tl.load(step)
    known = tl.minimum(known * tl.minimum(planes / _FAR_PLANES, 1.0), 1.0)
    firmly = tl.minimum(known * known / tl.maximum(1.0 - known, 1e-6), _MOST_VALUE_WEIGHT)
    about_one = tl.exp(tl.load(unit) - away)
    least = tl.maximum(about_one, _LEAST_INVERSE)
    tl.store(inverse + p, about_one, inside)
    tl.store(shape + p, known, inside)
    tl.store(held + p, firmly, inside)
    tl.store(weight + p, (firmly + tl.load(good) * _LEAST_VALUE_WEIGHT) / (least * least), inside)


def known_of(
    target: Matches, deviation: Tensor, log_depth: Tensor, unit: Tensor, good: Tensor
) -> tuple[Tensor, ...]:
    """The maps of ``flattening._known_of``, for matches whose deviation is known."""
    maps = log_depth.new_empty(4, *log_depth.shape).unbind()
    launched_on(log_depth, known_kernel[tiles(target.size)])(
        deviation.contiguous(), target.confidence.contiguous(), log_depth.contiguous(), target.plane_step,
        unit, good, *maps, *target.size, ROWS=TILE[0], COLUMNS=TILE[1],
    )  # fmt: skip
    return maps


@triton.jit
def _slope(inverse, at, away, linked):
    """Slopes of inverse depth from pixels to those that lie ``away``, 0 at the last ones."""
    return tl.load(inverse + at + away, linked, 0.0) - tl.load(inverse + at, linked, 0.0)


@triton.jit(do_not_specialize=["height", "width"], do_not_specialize_on_alignment=["weight", "pull"])
def slopes_kernel(inverse, known, across, down, weight, pull, height, width, BLOCK: tl.constexpr):
    """Weight and pull of the slopes across and down, as ``_smoothed`` makes them, of a block of pixels."""
    n, p = height * width, tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, row = p < n, p // width
    right, lower = inside & (p - row * width < width - 1), p < n - width
    of_known = tl.load(known + p, inside, 0.0)
    own = of_known * of_known + _LEAST_SLOPE_WEIGHT
    counted = tl.load(across + p - row, right, 0.0) * own + 1e-6
    tl.store(weight + p, counted, inside)
    tl.store(pull + p, counted * _slope(inverse, p, 1, right), inside)
    counted = tl.load(down + p, lower, 0.0) * own + 1e-6
    tl.store(weight + n + p, counted, inside)
    tl.store(pull + n + p, counted * _slope(inverse, p, width, lower), inside)


@triton.jit
def _force(inverse, smoothed, link, at, away, linked):
    """What draws the pixels at both ends of slopes towards the smoothed ones."""
    return tl.load(link, linked, 0.0) * (
        tl.load(smoothed + at, linked, 0.0) - _slope(inverse, at, away, linked)
    )


@triton.jit(do_not_specialize=["height", "width"])
def forces_kernel(inverse, smoothed, across, down, pull, height, width, BLOCK: tl.constexpr):
    """The pull of the values of a block of pixels, from the slopes on all sides."""
    n, p = height * width, tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, row = p < n, p // width
    column = p - row * width
    to_right, to_left = inside & (column < width - 1), inside & (column > 0)
    link, below = across + p - row, smoothed + n
    force = _force(inverse, smoothed, link - 1, p - 1, 1, to_left)
    force -= _force(inverse, smoothed, link, p, 1, to_right)
    force += _force(inverse, below, down + p - width, p - width, width, inside & (row > 0))
    force -= _force(inverse, below, down + p, p, width, p < n - width)
    tl.store(pull + p, force * _SLOPES, inside)


def slopes(inverse: Tensor, known: Tensor, links: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Weight and pull ``(2, 1, h, w)`` of the slopes across and down of a map ``(1, 1, h, w)``."""
    height, width = inverse.shape[-2:]
    weight, pull = inverse.new_empty(2, 2, 1, height, width).unbind()
    launched_on(inverse, slopes_kernel[(triton.cdiv(height * width, BLOCK),)])(
        inverse, known.contiguous(), *links, weight, pull, height, width, BLOCK=BLOCK
    )
    return weight, pull


def forces(inverse: Tensor, smoothed: Tensor, links: tuple[Tensor, Tensor]) -> Tensor:
    """The pull ``(1, 1, h, w)`` of the values towards the smoothed slopes ``(2, 1, h, w)``."""
    (height, width), pull = inverse.shape[-2:], torch.empty_like(inverse)
    launched_on(inverse, forces_kernel[(triton.cdiv(height * width, BLOCK),)])(
        inverse, smoothed, *links, pull, height, width, BLOCK=BLOCK
    )
    return pull
