"""Triton kernels for ``algorithm.match_fitting``: affinities, weights and errors of the match fit."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.algorithm import constants
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.constants import MAX_SORTED

#: Pixels per program.
BLOCK = 512
#: Number of matches processed per iteration.
CHUNK = 2048
#: Warps of the program that measures a standard deviation.
SPREAD_WARPS = 8
# Triton kernels can read module constants only as constexpr.
_MIN_AFFINITY = tl.constexpr(constants.MIN_AFFINITY)
_IMAGE_EDGE = tl.constexpr(constants.IMAGE_EDGE)
_DEPTH_EDGE = tl.constexpr(constants.DEPTH_EDGE)
_EDGE_STEP = tl.constexpr(constants.EDGE_STEP)
_EDGE_ERROR = tl.constexpr(constants.EDGE_ERROR)
_MATCHED_FRACTION = tl.constexpr(constants.MATCHED_FRACTION)
_NORMAL_QUANTILE = tl.constexpr(constants.NORMAL_QUANTILE)
_MIN_PRIOR_ERROR = tl.constexpr(constants.MIN_PRIOR_ERROR)
_MAX_PRIOR_ERROR = tl.constexpr(constants.MAX_PRIOR_ERROR)
_REFERENCE_ERROR = tl.constexpr(constants.REFERENCE_ERROR)
_POWER = tl.constexpr(constants.STIFFNESS_POWER)
_MIN_SMOOTHNESS = tl.constexpr(constants.MIN_SMOOTHNESS)
_MAX_SMOOTHNESS = tl.constexpr(constants.MAX_SMOOTHNESS)
_BROAD_SMOOTHNESS = tl.constexpr(constants.BROAD_SMOOTHNESS)
_TIKHONOV = tl.constexpr(constants.TIKHONOV)
_MAX_TIKHONOV = tl.constexpr(constants.MAX_TIKHONOV)
_LOG_BROAD_TIKHONOV = tl.constexpr(math.log(constants.BROAD_TIKHONOV))
_LOG_MIN_TIKHONOV = tl.constexpr(math.log(constants.MIN_TIKHONOV))
_PASSES = tl.constexpr(constants.PASSES)
#: Bisection steps that identify one non-negative float among all.
_HALVINGS = tl.constexpr(32)
#: Bits of infinity as an integer.
_BITS_OF_INFINITY = tl.constexpr(0x7F800000)


@triton.jit
def _link(guide, log_depth, p, away, here, n, scale, linked, CHANNELS: tl.constexpr):
    """Compute the affinities between pixels and the pixels at the offset ``away``."""
    step = tl.zeros_like(here)
    for channel in tl.static_range(CHANNELS):
        of_channel = guide + channel * n + p
        step += tl.abs(tl.load(of_channel + away, linked, 0.0) - tl.load(of_channel, linked, 0.0))
    jump = tl.abs(tl.load(log_depth + p + away, linked, 0.0) - here) / _DEPTH_EDGE
    unlike = step / CHANNELS / _IMAGE_EDGE + jump
    return scale * scale * tl.maximum(tl.exp(-scale * unlike), _MIN_AFFINITY)


@triton.jit(do_not_specialize=["height", "width"])
def affinities_kernel(
    guide, log_depth, across, down, height, width, scale, CHANNELS: tl.constexpr, BLOCK: tl.constexpr
):
    """Compute ``edge_affinities`` of a block of pixels and their right and lower neighbours."""
    sample, n = tl.program_id(1), height * width
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row = p // width
    right, lower = (p < n) & (p - row * width < width - 1), p < n - width
    guide += sample * CHANNELS * n
    log_depth += sample * n
    here = tl.load(log_depth + p, p < n, 0.0)
    to_right = _link(guide, log_depth, p, 1, here, n, scale, right, CHANNELS)
    tl.store(across + sample * (n - height) + p - row, to_right, right)
    to_lower = _link(guide, log_depth, p, width, here, n, scale, lower, CHANNELS)
    tl.store(down + sample * (n - width) + p, to_lower, lower)


def edge_affinities(guide: Tensor, log_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Run ``match_fitting.edge_affinities`` with a kernel."""
    batch, channels, height, width = guide.shape
    across = log_depth.new_empty(batch, 1, height, width - 1)
    down = log_depth.new_empty(batch, 1, height - 1, width)
    launched_on(guide, affinities_kernel[(triton.cdiv(height * width, BLOCK), batch)])(
        guide.contiguous(), log_depth.contiguous(), across, down, height, width,
        max(height, width) / constants.REFERENCE_SIDE, CHANNELS=channels, BLOCK=BLOCK,
    )  # fmt: skip
    return across, down


@triton.jit(
    do_not_specialize=["n", "steps"],
    do_not_specialize_on_alignment=["matched", "confidence", "residual", "noise", "weight"],
)
def observe_kernel(
    log_depth, matched, confidence, plane_step, residual, noise, weight, n, steps, match_sigma,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Compute ``_residuals`` of a block of pixels."""
    sample, p = tl.program_id(1), tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, p = p < n, sample * n + p
    inverse = tl.maximum(tl.load(matched + p, inside, 1.0), 1e-9)
    relative = tl.load(plane_step + sample % steps) / inverse
    deviation = tl.sqrt(relative * relative + match_sigma * match_sigma)
    fraction = match_sigma / deviation
    counted = tl.load(confidence + p, inside, 0.0) * (fraction * fraction)
    difference = tl.where(counted > 0, tl.log(inverse) + tl.load(log_depth + p, inside, 0.0), 0.0)
    tl.store(residual + p, difference, inside)
    tl.store(noise + p, deviation, inside)
    tl.store(weight + p, counted, inside)


def residuals(log_depth: Tensor, target: Matches, match_sigma: float) -> tuple[Tensor, Tensor, Tensor]:
    """Run ``match_fitting._residuals`` with a kernel."""
    batch, n = len(log_depth), log_depth[0].numel()
    residual, noise, weight = log_depth.new_empty(3, *log_depth.shape).unbind()
    launched_on(log_depth, observe_kernel[(triton.cdiv(n, BLOCK), batch)])(
        log_depth, target.inverse_depth.contiguous(), target.confidence.contiguous(), target.plane_step,
        residual, noise, weight, n, target.plane_step.numel(), match_sigma, BLOCK=BLOCK,
    )  # fmt: skip
    return residual, noise, weight


@triton.jit
def _quantile(values, weight, fraction, n, every, CHUNK: tl.constexpr):
    """Compute the exact ``weighted_quantile`` of absolute values: floats >= 0 sort like their bits."""
    count = tl.cdiv(n, every)
    total = tl.zeros([CHUNK], tl.float32)
    for first in range(0, count, CHUNK):
        k = first + tl.arange(0, CHUNK)
        total += tl.load(weight + k * every, k < count, 0.0)
    wanted = fraction * tl.sum(total, 0)
    below, reached = wanted.to(tl.int32) * 0 - 1, wanted.to(tl.int32) * 0 + _BITS_OF_INFINITY
    for _ in range(_HALVINGS):
        middle = below + (reached - below) // 2
        total = tl.zeros([CHUNK], tl.float32)
        some = tl.zeros([CHUNK], tl.int32)
        for first in range(0, count, CHUNK):
            k = first + tl.arange(0, CHUNK)
            value = tl.abs(tl.load(values + k * every, k < count, 0.0)).to(tl.int32, bitcast=True)
            under = (k < count) & (value <= middle)
            total += tl.load(weight + k * every, under, 0.0)
            some += under.to(tl.int32)
        enough = (tl.sum(total, 0) >= wanted) & (tl.sum(some, 0) > 0)
        below = tl.where(enough, below, middle)
        reached = tl.where(enough & (middle > below), middle, reached)
    return reached.to(tl.float32, bitcast=True)


@triton.jit(
    do_not_specialize=["n", "every"],
    do_not_specialize_on_alignment=["residual", "noise", "weight", "confidence"],
)
def spread_kernel(residual, noise, weight, confidence, spread, n, every, CHUNK: tl.constexpr):
    """Compute ``_spread`` of a sample."""
    sample = tl.program_id(0)
    residual += sample * n
    noise += sample * n
    weight += sample * n
    confidence += sample * n
    known, right = tl.zeros([CHUNK], tl.float32), tl.zeros([CHUNK], tl.float32)
    for first in range(0, n, CHUNK):
        p = first + tl.arange(0, CHUNK)
        counted = tl.load(weight + p, p < n, 0.0)
        known += counted
        right += counted * tl.minimum(tl.load(confidence + p, p < n, 0.0), 1.0)
    weights = tl.sum(known, 0)
    fraction = tl.sum(right, 0) / tl.maximum(weights, 1e-9) * _MATCHED_FRACTION
    largest = _quantile(residual, weight, fraction, n, every, CHUNK) / _NORMAL_QUANTILE
    of_match = _quantile(noise, weight, 0.5, n, every, CHUNK)
    excess = tl.sqrt(tl.maximum(largest * largest - of_match * of_match / 4.0, 0.0))
    excess = tl.where(weights > 0, excess, _MAX_PRIOR_ERROR)
    tl.store(spread + sample, tl.minimum(tl.maximum(excess, _MIN_PRIOR_ERROR), _MAX_PRIOR_ERROR))


def spread(residual: Tensor, noise: Tensor, weight: Tensor, confidence: Tensor) -> Tensor:
    """Run ``match_fitting._spread`` with a kernel."""
    found, n = residual.new_empty(len(residual), 1, 1, 1), residual[0].numel()
    launched_on(residual, spread_kernel[(len(residual),)])(
        residual.contiguous(), noise, weight, confidence.contiguous(), found, n, max(1, n // MAX_SORTED),
        CHUNK=CHUNK, num_warps=SPREAD_WARPS,
    )  # fmt: skip
    return found


@triton.jit(do_not_specialize=["count"], do_not_specialize_on_alignment=["smoothness", "tikhonov"])
def levels_kernel(error, smoothness, tikhonov, count, reference_smoothness, BLOCK: tl.constexpr):
    """Compute ``_levels`` of a block of errors."""
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    stiff = tl.exp(tl.log(tl.load(error + k, k < count, 1.0) / _REFERENCE_ERROR) * -_POWER)
    last = tl.minimum(tl.maximum(reference_smoothness * stiff, _MIN_SMOOTHNESS), _MAX_SMOOTHNESS)
    broad, held = tl.maximum(last, _BROAD_SMOOTHNESS), tl.minimum(stiff * _TIKHONOV, _MAX_TIKHONOV)
    for index in tl.static_range(_PASSES):
        fraction = index / (_PASSES - 1)
        between = tl.exp(tl.log(broad) * (1.0 - fraction) + tl.log(last) * fraction)
        least = (1.0 - fraction) * _LOG_BROAD_TIKHONOV + fraction * _LOG_MIN_TIKHONOV
        tl.store(smoothness + index * count + k, between, k < count)
        tl.store(tikhonov + index * count + k, tl.maximum(held, tl.exp(held * 0.0 + least)), k < count)


def levels(error: Tensor, config: GuidanceConfig) -> tuple[Tensor, Tensor]:
    """Run ``match_fitting._levels`` with a kernel."""
    smoothness, tikhonov = error.new_empty(2, constants.PASSES, *error.shape).unbind()
    count = error.numel()
    launched_on(error, levels_kernel[(triton.cdiv(count, BLOCK),)])(
        error.contiguous(), smoothness, tikhonov, count, config.smoothness, BLOCK=BLOCK
    )
    return smoothness, tikhonov


@triton.jit(do_not_specialize=["height", "width", "radius", "local"])
def off_edges_kernel(log_depth, confidence, error, out, height, width, radius, local, BLOCK: tl.constexpr):
    """Compute ``off_edges`` of a block of pixels."""
    sample, n = tl.program_id(1), height * width
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, row, column = p < n, p // width, p % width
    log_depth += sample * n
    highest = tl.load(log_depth + p, inside, 0.0)
    least = highest
    for window in range((2 * radius + 1) * (2 * radius + 1)):
        y = row + window // (2 * radius + 1) - radius
        x = column + window % (2 * radius + 1) - radius
        y, x = tl.minimum(tl.maximum(y, 0), height - 1), tl.minimum(tl.maximum(x, 0), width - 1)
        value = tl.load(log_depth + y * width + x, inside, 0.0)
        highest, least = tl.maximum(highest, value), tl.minimum(least, value)
    of_prior = tl.load(error + sample * (1 + (n - 1) * local) + p * local, inside, 1.0)
    factor = tl.maximum(of_prior / _EDGE_ERROR, 1.0)
    ratio = (highest - least) / (factor * factor * factor * _EDGE_STEP)
    found = tl.load(confidence + sample * n + p, inside, 0.0) / (1.0 + ratio * ratio)
    tl.store(out + sample * n + p, found, inside)


def off_edges(confidence: Tensor, log_depth: Tensor, error: Tensor, radius: int) -> Tensor:
    """Compute the confidence of ``match_fitting.off_edges``; ``error`` is on the grid or one per sample."""
    (batch, _, height, width), found = log_depth.shape, torch.empty_like(log_depth)
    local = error.shape[-2:] != (1, 1)
    launched_on(log_depth, off_edges_kernel[(triton.cdiv(height * width, BLOCK), batch)])(
        log_depth, confidence.contiguous(), error.expand(batch, -1, -1, -1).contiguous(), found,
        height, width, radius, int(local), BLOCK=BLOCK,
    )  # fmt: skip
    return found
