"""Triton kernels for ``planar``; the solves between them have their own kernel."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.constants import FAR_PLANES, MIN_DEVIATION
from geodiff_plugin.matching.kernels.windows import TILE, mean_precision, tile_places, tiles
from geodiff_plugin.result import constants
from geodiff_plugin.result.records import KnownMaps

#: Pixels per program.
BLOCK = 512
# Triton kernels can read module constants only as constexpr.
_MIN_SLOPE_WEIGHT = tl.constexpr(constants.MIN_SLOPE_WEIGHT)
_SLOPES = tl.constexpr(constants.SLOPES)
_MIN_VALUE_WEIGHT = tl.constexpr(constants.MIN_VALUE_WEIGHT)
_MAX_VALUE_WEIGHT = tl.constexpr(constants.MAX_VALUE_WEIGHT)
_MIN_INVERSE = tl.constexpr(constants.MIN_INVERSE)
_MIN_DEVIATION = tl.constexpr(MIN_DEVIATION)
_FAR_PLANES = tl.constexpr(FAR_PLANES)


@triton.jit(
    do_not_specialize=["height", "width"],
    do_not_specialize_on_alignment=["deviation", "confidence", "shape", "held", "weight"],
)
def known_kernel(
    deviation, confidence, log_depth, step, mean_log_depth, prior_weight, inverse, shape, held, weight,
    height, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Compute ``planar._known_maps``. Grid: tiles down, tiles across."""
    p, inside = tile_places(height, width, ROWS, COLUMNS)
    known = mean_precision(deviation, confidence, _MIN_DEVIATION, height, width, ROWS, COLUMNS)
    away = tl.load(log_depth + p, inside, 0.0)
    planes = tl.exp(-away) / tl.load(step)
    known = tl.minimum(known * tl.minimum(planes / _FAR_PLANES, 1.0), 1.0)
    value_weight = tl.minimum(known * known / tl.maximum(1.0 - known, 1e-6), _MAX_VALUE_WEIGHT)
    about_one = tl.exp(tl.load(mean_log_depth) - away)
    least = tl.maximum(about_one, _MIN_INVERSE)
    tl.store(inverse + p, about_one, inside)
    tl.store(shape + p, known, inside)
    tl.store(held + p, value_weight, inside)
    tl.store(weight + p, (value_weight + tl.load(prior_weight) * _MIN_VALUE_WEIGHT) / (least * least), inside)


def known_maps(target: Matches, log_depth: Tensor, mean_log_depth: Tensor, prior_weight: Tensor) -> KnownMaps:
    """Run ``planar._known_maps`` with a kernel, for matches with a deviation."""
    assert target.deviation is not None
    maps = log_depth.new_empty(4, *log_depth.shape).unbind()
    launched_on(log_depth, known_kernel[tiles(target.size)])(
        target.deviation.contiguous(), target.confidence.contiguous(), log_depth.contiguous(),
        target.plane_step, mean_log_depth, prior_weight, *maps, *target.size, ROWS=TILE[0], COLUMNS=TILE[1],
    )  # fmt: skip
    return KnownMaps(*maps)


@triton.jit
def _slope(inverse, at, away, linked):
    """Compute the slopes of inverse depth from pixels to those at the offset ``away``, 0 at the last ones."""
    return tl.load(inverse + at + away, linked, 0.0) - tl.load(inverse + at, linked, 0.0)


@triton.jit(do_not_specialize=["height", "width"], do_not_specialize_on_alignment=["weight", "rhs"])
def slopes_kernel(inverse, known, across, down, weight, rhs, height, width, BLOCK: tl.constexpr):
    """Compute weight and right-hand side for the slopes of a block of pixels, as in ``_smoothed``."""
    n, p = height * width, tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, row = p < n, p // width
    right, lower = inside & (p - row * width < width - 1), p < n - width
    of_known = tl.load(known + p, inside, 0.0)
    own = of_known * of_known + _MIN_SLOPE_WEIGHT
    counted = tl.load(across + p - row, right, 0.0) * own + 1e-6
    tl.store(weight + p, counted, inside)
    tl.store(rhs + p, counted * _slope(inverse, p, 1, right), inside)
    counted = tl.load(down + p, lower, 0.0) * own + 1e-6
    tl.store(weight + n + p, counted, inside)
    tl.store(rhs + n + p, counted * _slope(inverse, p, width, lower), inside)


@triton.jit
def _force(inverse, smoothed, link, at, away, linked):
    """Compute the weighted difference between smoothed and actual slopes at two pixels."""
    return tl.load(link, linked, 0.0) * (
        tl.load(smoothed + at, linked, 0.0) - _slope(inverse, at, away, linked)
    )


@triton.jit(do_not_specialize=["height", "width"])
def forces_kernel(inverse, smoothed, across, down, rhs, height, width, BLOCK: tl.constexpr):
    """Compute the right-hand side for the values of a block of pixels, from the slopes on all sides."""
    n, p = height * width, tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, row = p < n, p // width
    column = p - row * width
    to_right, to_left = inside & (column < width - 1), inside & (column > 0)
    link, below = across + p - row, smoothed + n
    force = _force(inverse, smoothed, link - 1, p - 1, 1, to_left)
    force -= _force(inverse, smoothed, link, p, 1, to_right)
    force += _force(inverse, below, down + p - width, p - width, width, inside & (row > 0))
    force -= _force(inverse, below, down + p, p, width, p < n - width)
    tl.store(rhs + p, force * _SLOPES, inside)


def slopes(inverse: Tensor, known: Tensor, affinities: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Compute weight and right-hand side ``(2, 1, h, w)`` for the slopes of a map ``(1, 1, h, w)``."""
    height, width = inverse.shape[-2:]
    weight, rhs = inverse.new_empty(2, 2, 1, height, width).unbind()
    launched_on(inverse, slopes_kernel[(triton.cdiv(height * width, BLOCK),)])(
        inverse, known.contiguous(), *affinities, weight, rhs, height, width, BLOCK=BLOCK
    )
    return weight, rhs


def values_rhs(inverse: Tensor, smoothed: Tensor, affinities: tuple[Tensor, Tensor]) -> Tensor:
    """Run ``planar._values_rhs`` with a kernel."""
    (height, width), rhs = inverse.shape[-2:], torch.empty_like(inverse)
    launched_on(inverse, forces_kernel[(triton.cdiv(height * width, BLOCK),)])(
        inverse, smoothed, *affinities, rhs, height, width, BLOCK=BLOCK
    )
    return rhs
