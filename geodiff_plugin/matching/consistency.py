"""Selects matches that both views agree on: winner, left-right check, uniqueness, subplane position."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel, launch_bound
from geodiff_plugin.geometry import to_device_of
from geodiff_plugin.matching.aggregation import aggregate
from geodiff_plugin.matching.alignment import AlignedView
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.constants import (
    AGREEMENT_PLANES,
    CONTRAST_RADIUS,
    DOUBT_OF_A_PLANE,
    ENOUGH_KNOWN,
    EVERY_ROW,
    FAR_PLANES,
    KNOWN_RADIUS,
    LOG_ODDS,
    MAX_BLUR,
    MIN_CONTRAST,
    MIN_DEVIATION,
    MIN_SHARPNESS,
    PATHS,
    UNSEEN_LEVEL,
)
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.volume import Buffers, CostVolume, Winner
from geodiff_plugin.matching.winner import winner, winner_positions


def _right_winners(volume: CostVolume, view: AlignedView, buffers: Buffers) -> Tensor:
    """Find the winners of a right view, subplane positions, ``(ceil(h / 2), w)`` of its canvas.

    The sweep's costs are looked up for each pixel of the right view and aggregated along its edges.
    """
    height, width = volume.size
    rows = view.sources(height, 1)[:, ::EVERY_ROW]
    columns = view.sources(width, 0)
    levels = _look_up(volume.levels, rows, columns, buffers)
    return winner_positions(aggregate(levels, view.guide[::EVERY_ROW], buffers=buffers))


@has_kernel("matching.kernels.consistency.look_up")
def _look_up(levels: Tensor, rows: np.ndarray, columns: np.ndarray, buffers: Buffers) -> Tensor:
    """Look up the costs ``(D, h, w)`` at the ``sources`` of another view; ``UNSEEN_LEVEL`` without source."""
    planes, height, width = levels.shape
    row, column = to_device_of(levels, rows), to_device_of(levels, columns)
    # Pixels of the other view that the left image does not show read the extra row and column.
    plane = torch.full((height + 1, width + 1), UNSEEN_LEVEL, dtype=torch.float32, device=levels.device)
    found = buffers.empty("levels", planes, (rows.shape[1], columns.shape[1]), levels)
    for k, of_plane in enumerate(levels):
        plane[:height, :width] = of_plane
        found[k] = plane.index_select(0, row[k]).index_select(1, column[k])
    return found


def _disagreement(view: AlignedView, other: Tensor, position: Tensor) -> Tensor:
    """Compute the left-right difference ``(H, W)`` in planes; infinite if not visible in the right view.

    ``other`` has the right view's ``_right_winners``, ``position (H, W)`` the left view's.
    """
    device = position.device
    scale, shift = (to_device_of(position, each.astype(np.float32)) for each in (view.scale, view.shift))
    below = position.floor().long().clamp(0, len(scale) - 2)
    part = position - below
    at_scale = torch.lerp(scale[below], scale[below + 1], part)
    height, width = position.shape
    lines = (torch.arange(width, device=device), torch.arange(height, device=device)[:, None])
    places = []
    inside = at_scale > 0
    for axis, line in enumerate(lines):
        at = (at_scale * line + torch.lerp(shift[below, axis], shift[below + 1, axis], part)).round()
        last = view.size[1 - axis] - 1
        inside = inside & (at >= 0) & (at <= last)
        places.append(at.clamp(0, last).long())
    column, row = places
    if view.valid is not None:
        inside = inside & view.valid[row, column]
    # Use the mean of the two neighbouring matched rows; at an edge it agrees with neither.
    before = row // EVERY_ROW
    after = ((row + EVERY_ROW - 1) // EVERY_ROW).clamp_max(len(other) - 1)
    difference = (0.5 * (other[before, column] + other[after, column]) - position).abs()
    return torch.where(inside, difference, torch.full_like(difference, torch.inf))


def window_mean(maps: Tensor, radius: int) -> Tensor:
    """Average maps ``(..., C, H, W)`` over a window of this half width, clipped to the image."""
    length = 2 * radius + 1
    if launch_bound(maps):
        for window in ((length, 1), (1, length)):
            padding = (window[0] // 2, window[1] // 2)
            maps = F.avg_pool2d(maps, window, 1, padding, count_include_pad=False)
        return maps
    sums = _sums(_sums(F.pad(maps, (radius,) * 4), length, -2), length, -1)
    rows, columns = (_in_window(size, radius).to(maps) for size in maps.shape[-2:])
    return sums / (rows[:, None] * columns)


def _in_window(size: int, radius: int) -> Tensor:
    """Count the positions of an axis within ``radius`` of each one, ``(size,)``."""
    at = torch.arange(size, device="cpu")
    return (at + radius).clamp_max(size - 1) - (at - radius).clamp_min(0) + 1


def _sums(values: Tensor, length: int, axis: int) -> Tensor:
    """Sum each ``length`` consecutive values along an axis by doubling, so in about ``2 log2(length)`` steps.

    ``avg_pool2d`` takes ``length`` steps, on one thread without vector instructions.
    """
    count = values.shape[axis] - length + 1
    total = values.new_zeros(())
    start, block = 0, 1  # ``values`` are sums of ``block`` consecutive ones
    while True:
        if length & block:
            total = total + values.narrow(axis, start, count)
            start += block
        if 2 * block > length:
            return total
        kept = values.shape[axis] - block
        values = values.narrow(axis, 0, kept) + values.narrow(axis, block, kept)
        block *= 2


def _means_of_valid(maps: Tensor, valid: Tensor | None) -> Tensor:
    """``window_mean`` of maps ``(C, H, W)`` over the valid pixels ``(H, W)`` of a window."""
    if valid is None:
        return window_mean(maps, CONTRAST_RADIUS)
    weight = valid.to(maps)[None]
    *means, covered = window_mean(torch.cat([maps * weight, weight]), CONTRAST_RADIUS)
    return torch.stack(means) / covered.clamp_min(1e-6)


class ViewEvidence(NamedTuple):
    """Evidence of one right view for the winners of the left one."""

    features: Tensor  # (4, H, W), features of the log-odds of a match, which are linear in them
    difference: Tensor  # (H, W) left-right difference in planes; infinite if the view does not see the match


class Candidates(NamedTuple):
    """Winners of the left view, and the data that they are checked against."""

    found: Winner
    means: Tensor  # (2, H, W) window means of gain and sharpness
    others: Sequence[Tensor]  # winners of every right view, subplane positions, on every second row


def candidates(volume: CostVolume) -> Candidates:
    """Find the winners of a volume and of its right views.

    The contrast uses the costs before aggregation.
    """
    buffers = Buffers()
    total = aggregate(volume.levels, volume.guide, buffers=buffers)
    found = winner(total, volume.levels, volume.in_view)
    means = _means_of_valid(torch.stack([found.gain, found.sharpness]), volume.valid)
    return Candidates(found, means, [_right_winners(volume, view, buffers) for view in volume.aligned])


def view_evidence(view: AlignedView, other: Tensor, found: Winner) -> ViewEvidence:
    """Compute the evidence of a right view, with winners ``other``, for the winners of the left one.

    The features are 1, the log margin to the best plane elsewhere, the cost, and the left-right difference.
    """
    unit = 1.0 / (PATHS * COST_LEVELS)
    cost = (found.best * unit).clamp(0.0, 0.8)
    margin = ((found.second_best - found.best) * unit).clamp(0.0, 0.5)
    difference = _disagreement(view, other, found.position)
    differs = difference.clamp_max(AGREEMENT_PLANES)
    features = torch.stack([torch.ones_like(margin), (margin + 0.03).log(), cost, differs])
    return ViewEvidence(features, difference)


@torch.no_grad()
def match_volume(volume: CostVolume) -> Matches:
    """Match a cost volume: aggregate, select the winners, and check them against every right view.

    Confidence is 0 if no right view agrees. Otherwise it is approximately the probability that the match is
    within three planes of ground truth, from the right view with the highest one.
    """
    confidence, deviation, inverse_depth = _assess(volume, *candidates(volume))[:, None]
    matches = Matches(inverse_depth, confidence, to_device_of(confidence, volume.plane_step), deviation)
    return matches if volume.valid is None else matches.within(volume.valid[None])


@has_kernel("matching.kernels.consistency.assess")
def _assess(volume: CostVolume, found: Winner, means: Tensor, others: Sequence[Tensor]) -> Tensor:
    """Compute confidence, deviation and inverse depth ``(3, H, W)`` of ``Candidates``."""
    contrast, sharpness = means
    confidence = torch.zeros_like(contrast)
    for view, other in zip(volume.aligned, others, strict=True):
        features, difference = view_evidence(view, other, found)
        odds = torch.zeros_like(difference)
        for weight, x in zip(LOG_ODDS, features, strict=True):
            odds = odds + weight * x
        probability = torch.sigmoid(odds) * (contrast / MIN_CONTRAST).clamp_max(1.0)
        agreed = torch.where(difference <= AGREEMENT_PLANES, probability, torch.zeros_like(probability))
        confidence = torch.maximum(confidence, agreed)
    inverse_depth = volume.inverse_depth[0] + found.position * volume.plane_step
    return torch.stack([confidence, _deviation(confidence, sharpness), inverse_depth])


def _deviation(confidence: Tensor, sharpness: Tensor) -> Tensor:
    """Compute the standard deviation of matches in planes, ``(H, W)``."""
    blur = MIN_SHARPNESS / sharpness.clamp_min(MIN_SHARPNESS / MAX_BLUR)
    return ((1.0 - confidence) / DOUBT_OF_A_PLANE).sqrt() * blur.clamp_min(1.0)


@torch.no_grad()
@has_kernel("matching.kernels.windows.known_fraction", when=lambda matches: matches.deviation is not None)
def known_fraction(matches: Matches) -> Tensor:
    """Compute how well the matches around every pixel determine its depth, ``(B, 1, H, W)`` in [0, 1].

    This is the mean precision of the matches in a window, as a fraction of ``ENOUGH_KNOWN``. Precision is one
    over the variance in planes, at most 1. A pixel without a match has none; a known point has the sum
    over all pixels it represents (see ``with_points``). The result is 1 if no deviation is known.
    """
    return _mean_precision(matches, 1.0).clamp_max(1.0)


@torch.no_grad()
def known_shape(matches: Matches, inverse_depth: Tensor) -> Tensor:
    """Compute how well the matches around every pixel determine shape, ``(B, 1, H, W)`` in [0, 1].

    Like ``known_fraction``, but more precise matches count more, and surfaces few planes from infinity need
    more precise matches: an error of one plane bends a far wall more than a near one.

    Args:
        matches: matches of the images.
        inverse_depth: ``(B, 1, H, W)`` 1/m of the surfaces, on the grid of the matches.
    """
    planes = inverse_depth / matches.plane_step.view(-1, 1, 1, 1)
    return (_mean_precision(matches, MIN_DEVIATION) * (planes / FAR_PLANES).clamp_max(1.0)).clamp_max(1.0)


def _mean_precision(matches: Matches, min_deviation: float) -> Tensor:
    """Compute the mean precision of a window of matches relative to ``ENOUGH_KNOWN``, ``(B, 1, H, W)`` >= 0.

    ``min_deviation`` is the minimum standard deviation of a match, planes.
    """
    if matches.deviation is None:
        return torch.ones_like(matches.confidence)
    precision = matches.deviation.clamp_min(min_deviation) ** -2 * matches.confidence.clamp_min(1.0)
    return window_mean(precision * (matches.confidence > 0), KNOWN_RADIUS) / ENOUGH_KNOWN
