"""Triton kernels for ``confidence``: confidence features, and the probability of a correct depth."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.algorithm.constants import MAX_PRIOR_ERROR, MIN_PRIOR_ERROR
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.kernels.windows import TILE, in_window, tile_places, tiles
from geodiff_plugin.result import constants
from geodiff_plugin.result.records import ConfidenceFeatures

# Triton kernels can read module constants only as constexpr.
_RADIUS = tl.constexpr(constants.FEATURE_RADIUS)
_PSEUDO_CONFIDENCE = tl.constexpr(constants.PSEUDO_CONFIDENCE)
_LOG_MAX_CHANGE = tl.constexpr(math.log(constants.MAX_CHANGE))
_DISCONTINUITY_RADIUS = tl.constexpr(constants.DISCONTINUITY_RADIUS)
_CONSTANT = tl.constexpr(constants.DEPTH_LOG_ODDS[0])
_CERTAINTY = tl.constexpr(constants.DEPTH_LOG_ODDS[1])
_CLOSENESS = tl.constexpr(constants.DEPTH_LOG_ODDS[2])
_STABILITY = tl.constexpr(constants.DEPTH_LOG_ODDS[3])
_EVENNESS = tl.constexpr(constants.DEPTH_LOG_ODDS[4])
_SPREAD_WEIGHT = tl.constexpr(constants.DEPTH_LOG_ODDS[5])
_MIN_RESIDUAL = tl.constexpr(constants.MIN_RESIDUAL)
_MAX_RESIDUAL = tl.constexpr(constants.MAX_RESIDUAL)
_MIN_CHANGE = tl.constexpr(constants.MIN_CHANGE)
_MAX_CHANGE = tl.constexpr(constants.MAX_CHANGE)
_MIN_DISCONTINUITY = tl.constexpr(constants.MIN_DISCONTINUITY)
_MAX_DISCONTINUITY = tl.constexpr(constants.MAX_DISCONTINUITY)
_MIN_REMAINING_ERROR = tl.constexpr(constants.MIN_REMAINING_ERROR)
_MAX_REMAINING_ERROR = tl.constexpr(constants.MAX_REMAINING_ERROR)
_MIN_PRIOR_ERROR = tl.constexpr(MIN_PRIOR_ERROR)
_MAX_PRIOR_ERROR = tl.constexpr(MAX_PRIOR_ERROR)
_HALF_SUPPORT = tl.constexpr(constants.HALF_SUPPORT)
#: Pixels per program.
PIXELS = 1024


@triton.jit
def _range_around(log_depth, height, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Compute ``match_fitting.range_around`` of a program's tile."""
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    column = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    highest = tl.full([ROWS, COLUMNS], float("-inf"), tl.float32)
    least = tl.full([ROWS, COLUMNS], float("inf"), tl.float32)
    for down in range(-_DISCONTINUITY_RADIUS, _DISCONTINUITY_RADIUS + 1):
        y = tl.minimum(tl.maximum(row + down, 0), height - 1)
        for right in range(-_DISCONTINUITY_RADIUS, _DISCONTINUITY_RADIUS + 1):
            x = tl.minimum(tl.maximum(column + right, 0), width - 1)
            value = tl.load(log_depth + y[:, None] * width + x[None, :])
            highest, least = tl.maximum(highest, value), tl.minimum(least, value)
    return highest - least


@triton.jit(do_not_specialize=["height", "width"])
def features_kernel(
    inverse_depth, confidence, log_depth, denoised, step, known, features, height, width,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Compute match residual, change and range of log depth around every pixel of one image."""
    first, n = tl.program_id(0) * ROWS, height * width
    row, column = first + tl.arange(0, ROWS), tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    plane = tl.load(step)
    weight = tl.zeros([ROWS, COLUMNS], tl.float32)
    weighted, changed = weight, weight
    for y in range(tl.maximum(first - _RADIUS, 0), tl.minimum(first + ROWS + _RADIUS, height)):
        weight_of_row = tl.zeros([COLUMNS], tl.float32)
        weighted_of_row, changed_of_row = weight_of_row, weight_of_row
        for right in range(-_RADIUS, _RADIUS + 1):
            x = column + right
            there, at = (x >= 0) & (x < width), y * width + x
            here, sure = tl.load(log_depth + at, there, 0.0), tl.load(confidence + at, there, 0.0)
            away = tl.abs(tl.load(inverse_depth + at, there, 0.0) - tl.exp(-here)) / plane
            weight_of_row += sure
            weighted_of_row += sure * tl.minimum(away, _MAX_RESIDUAL)
            changed_of_row += tl.abs(here - tl.load(denoised + at, there, 0.0))
        near = (tl.abs(row - y) <= _RADIUS)[:, None]
        weight += tl.where(near, weight_of_row[None, :], 0.0)
        weighted += tl.where(near, weighted_of_row[None, :], 0.0)
        changed += tl.where(near, changed_of_row[None, :], 0.0)
    count = in_window(height, width, _RADIUS, ROWS, COLUMNS)
    p, inside = tile_places(height, width, ROWS, COLUMNS)
    tl.store(
        features + p,
        (weighted / count + _PSEUDO_CONFIDENCE * _MAX_RESIDUAL) / (weight / count + _PSEUDO_CONFIDENCE),
        inside,
    )
    measured = tl.load(known)
    fraction = measured / (measured + _PSEUDO_CONFIDENCE)
    changed = tl.minimum(tl.maximum(changed / count, _MIN_CHANGE), _MAX_CHANGE)
    tl.store(
        features + n + p, tl.exp(tl.log(changed) * fraction + (1.0 - fraction) * _LOG_MAX_CHANGE), inside
    )
    tl.store(features + 2 * n + p, _range_around(log_depth, height, width, ROWS, COLUMNS), inside)


def features_on_grid(log_depth: Tensor, denoised: Tensor, target: Matches) -> Tensor:
    """Run ``confidence._features_on_grid`` with a kernel."""
    known = target.confidence.clamp_max(1.0).mean()
    features = log_depth.new_empty(1, 3, *target.size)
    launched_on(log_depth, features_kernel[tiles(target.size)])(
        target.inverse_depth.contiguous(), target.confidence.contiguous(), log_depth, denoised,
        target.plane_step, known, features, *target.size, ROWS=TILE[0], COLUMNS=TILE[1],
    )  # fmt: skip
    return features


@triton.jit
def _in_units(value, least, most):
    """Compute minus the log of a clamped value relative to its upper bound."""
    return -tl.log(tl.minimum(tl.maximum(value, least), most) / most)


@triton.jit
def confidence_kernel(
    support, residual, change, discontinuity, spread, prior_error, confident, pixels,
    SPREAD: tl.constexpr, PRIOR: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Compute ``confidence.depth_confidence``. Grid: blocks of pixels, maps.

    SPREAD: whether there is an ensemble spread. PRIOR: number of prior errors per map, 0 for none, 1 for one,
        2 for one per pixel.
    """
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists, of_map = pixel < pixels, tl.program_id(1)
    at = of_map.to(tl.int64) * pixels + pixel
    supported = tl.load(support + at, exists, 0.0)
    log_useless = tl.log(tl.zeros_like(supported) + _MAX_PRIOR_ERROR)
    if PRIOR == 0:
        log_measured = log_useless
    else:
        where_measured = at if PRIOR == 2 else of_map + tl.zeros_like(pixel)
        measured = tl.load(prior_error + where_measured, exists, 1.0)
        log_measured = tl.log(tl.minimum(tl.maximum(measured, _MIN_PRIOR_ERROR), _MAX_PRIOR_ERROR))
    fraction = supported / (supported + _HALF_SUPPORT)
    left = (1.0 - supported) * tl.exp(fraction * log_measured + (1.0 - fraction) * log_useless)
    odds = _in_units(left, _MIN_REMAINING_ERROR, _MAX_REMAINING_ERROR) * _CERTAINTY + _CONSTANT
    odds += _in_units(tl.load(residual + at, exists, 1.0), _MIN_RESIDUAL, _MAX_RESIDUAL) * _CLOSENESS
    odds += _in_units(tl.load(change + at, exists, 1.0), _MIN_CHANGE, _MAX_CHANGE) * _STABILITY
    odds += (
        _in_units(tl.load(discontinuity + at, exists, 1.0), _MIN_DISCONTINUITY, _MAX_DISCONTINUITY)
        * _EVENNESS
    )
    if SPREAD:
        odds += tl.load(spread + at, exists, 0.0) * _SPREAD_WEIGHT
    tl.store(confident + at, 1.0 / (1.0 + tl.exp(-odds)), exists)


def confidence(features: ConfidenceFeatures, spread: Tensor | None, prior_error: Tensor | None) -> Tensor:
    """Run ``confidence._confidence`` with a kernel."""
    maps = [each.contiguous() for each in features]
    pixels, confident = maps[0][0].numel(), torch.empty_like(maps[0])
    further = [maps[0] if each is None else each.float().contiguous() for each in (spread, prior_error)]
    prior = 0 if prior_error is None else 1 if prior_error[0].numel() == 1 else 2
    launched_on(maps[0], confidence_kernel[(triton.cdiv(pixels, PIXELS), len(maps[0]))])(
        *maps, *further, confident, pixels, SPREAD=spread is not None, PRIOR=prior, PIXELS=PIXELS
    )
    return confident
