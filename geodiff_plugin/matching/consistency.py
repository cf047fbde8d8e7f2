"""Matches that both views agree on: winner, left-right check, uniqueness, position between planes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import use_kernel
from geodiff_plugin.geometry import to_device_of
from geodiff_plugin.matching.aggregation import PATHS, Buffers, aggregate
from geodiff_plugin.matching.alignment import AlignedView
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.sweep import CostVolume
from geodiff_plugin.matching.winner import UNSEEN_LEVEL, Winner, winner, winner_positions

#: Log-odds that a checked match is right, linear in its evidence, by logistic regression on pairs with truth
#: (``python -m tests.benchmarks.confidence`` refits them).
LOG_ODDS = (5.8, 0.8, -5.9, -0.62)
#: Difference in planes up to which matches of the two views agree.
AGREEMENT_PLANES = 1.5
#: For full confidence a match's cost, averaged over a window of this half width in px, lies below the mean
#: plane's by ``LEAST_CONTRAST``. Else aggregation would carry matches across blank walls.
CONTRAST_REACH = 15
#: The least such difference, as a share of the largest cost.
LEAST_CONTRAST = 0.03
#: Doubt, one less the probability of a match, at which its standard deviation is one plane: on pairs with
#: truth the error of matches grows with the root of their doubt.
DOUBT_OF_A_PLANE = 0.04
#: Sharpness, averaged like the contrast, below which the deviation grows in inverse proportion: where the
#: costs of near planes are alike, noise chooses among them.
LEAST_SHARPNESS = 0.1
#: Half width in px of the window over which the precision of matches is averaged: that of the contrast.
KNOWN_REACH = CONTRAST_REACH
#: Mean precision, one over squared planes, of a window in which the matches know enough.
ENOUGH_KNOWN = 0.3
#: Least deviation of a match, in planes, that counts: finer positions between planes are chance.
LEAST_DEVIATION = 0.5
#: Planes from infinity up to which an error of one plane is so large a share of the inverse depth that the
#: matches have to be more precise than ``ENOUGH_KNOWN``, in inverse proportion to their number.
FAR_PLANES = 50.0
#: It grows by this factor at most.
MOST_BLUR = 100.0
#: Only every second row of the right view is matched.
EVERY_ROW = 2


def _left_winner(volume: CostVolume, buffers: Buffers) -> Winner:
    total = aggregate(volume.levels, volume.left_01[0], buffers=buffers)
    if use_kernel(total):
        from geodiff_plugin.matching import kernels

        return kernels.winner(total, volume.levels, volume.in_view)
    return winner(total, volume.levels, volume.in_view)


def _positions(total: Tensor) -> Tensor:
    if use_kernel(total):
        from geodiff_plugin.matching import kernels

        return kernels.winner_positions(total)
    return winner_positions(total)


def _right_winners(volume: CostVolume, view: AlignedView, buffers: Buffers) -> Tensor:
    """The winners of a right view, positions between planes, ``(ceil(h / 2), w)`` of its canvas.

    The costs of the sweep are looked up for each pixel of the right view and aggregated along its edges.
    """
    height, width = volume.size
    rows, columns = view.sources(height, 1)[:, ::EVERY_ROW], view.sources(width, 0)
    if use_kernel(volume.levels):
        from geodiff_plugin.matching import kernels

        levels = kernels.looked_up(volume.levels, rows, columns)
    else:
        levels = _looked_up(volume.levels, rows, columns, buffers)
    return _positions(aggregate(levels, view.grey[::EVERY_ROW], buffers=buffers))


def _looked_up(levels: Tensor, rows: np.ndarray, columns: np.ndarray, buffers: Buffers) -> Tensor:
    """The costs ``(D, h, w)`` at the ``sources`` of another view; ``UNSEEN_LEVEL`` where it has none."""
    planes, height, width = levels.shape
    row, column = to_device_of(levels, rows), to_device_of(levels, columns)
    # The extra row and column are read by pixels of the other view that the left image does not show.
    plane = torch.full((height + 1, width + 1), UNSEEN_LEVEL, dtype=torch.float32, device=levels.device)
    found = buffers.empty("levels", planes, (rows.shape[1], columns.shape[1]), levels)
    for k, of_plane in enumerate(levels):
        plane[:height, :width] = of_plane
        found[k] = plane.index_select(0, row[k]).index_select(1, column[k])
    return found


def _disagreement(view: AlignedView, other: Tensor, position: Tensor) -> Tensor:
    """Left-right difference ``(H, W)`` in planes; infinite where the right view does not see the match.

    ``other`` are the right view's ``_right_winners``, ``position (H, W)`` those of the left view.
    """
    device = position.device
    scale, shift = (to_device_of(position, each.astype(np.float32)) for each in (view.scale, view.shift))
    below = position.floor().long().clamp(0, len(scale) - 2)
    part = position - below
    at_scale = torch.lerp(scale[below], scale[below + 1], part)
    height, width = position.shape
    lines = (torch.arange(width, device=device), torch.arange(height, device=device)[:, None])
    places, inside = [], at_scale > 0
    for axis, line in enumerate(lines):
        at = (at_scale * line + torch.lerp(shift[below, axis], shift[below + 1, axis], part)).round()
        last = view.size[1 - axis] - 1
        inside = inside & (at >= 0) & (at <= last)
        places.append(at.clamp(0, last).long())
    column, row = places
    if view.valid is not None:
        inside = inside & view.valid[row, column]
    # Between two matched rows, their mean: at an edge it agrees with neither.
    before, after = row // EVERY_ROW, ((row + EVERY_ROW - 1) // EVERY_ROW).clamp_max(len(other) - 1)
    difference = (0.5 * (other[before, column] + other[after, column]) - position).abs()
    return torch.where(inside, difference, torch.full_like(difference, torch.inf))


def window_mean(maps: Tensor, reach: int) -> Tensor:
    """Mean of maps ``(..., C, H, W)`` over what of a window of this half width lies inside the image."""
    for window in ((2 * reach + 1, 1), (1, 2 * reach + 1)):
        padding = (window[0] // 2, window[1] // 2)
        maps = F.avg_pool2d(maps, window, 1, padding, count_include_pad=False)
    return maps


class ViewEvidence(NamedTuple):
    """What one right view says about the winners of the left one."""

    features: Tensor  # (4, H, W), in which the log-odds of a match are linear
    difference: Tensor  # (H, W) left-right difference in planes; infinite where it does not see the match


class Candidates(NamedTuple):
    """The winners of the left view, and what is known of them."""

    inverse_depth: Tensor  # (H, W) 1/m
    contrast: Tensor  # (H, W) how far their cost is below the mean plane's, averaged over a window
    sharpness: Tensor  # (H, W) the same below the mean of near planes (``Winner.sharpness``)
    views: Iterator[ViewEvidence]  # of every right view, made as it is asked for


def _contrast_and_sharpness(found: Winner) -> Tensor:
    """Both of ``Candidates``, ``(2, H, W)``."""
    return window_mean(torch.stack([found.gain, found.sharpness]), CONTRAST_REACH)


def candidates(volume: CostVolume, views: Sequence[AlignedView]) -> Candidates:
    """The winners of a volume, with the evidence of these right views.

    Its features are 1, the logarithm of the margin to the best plane elsewhere, cost, and left-right
    difference. The cost that the contrast compares is the one before aggregation.
    """
    buffers = Buffers()
    found, unit = _left_winner(volume, buffers), 1.0 / (PATHS * COST_LEVELS)
    position, cost = found.position, (found.best * unit).clamp(0.0, 0.8)
    margin = ((found.runner_up - found.best) * unit).clamp(0.0, 0.5)

    def evidence() -> Iterator[ViewEvidence]:
        for view in views:
            difference = _disagreement(view, _right_winners(volume, view, buffers), position)
            differs = difference.clamp_max(AGREEMENT_PLANES)
            features = torch.stack([torch.ones_like(margin), (margin + 0.03).log(), cost, differs])
            yield ViewEvidence(features, difference)

    contrast, sharpness = _contrast_and_sharpness(found)
    inverse_depth = volume.inverse_depth[0] + position * volume.plane_step
    return Candidates(inverse_depth, contrast, sharpness, evidence())


@torch.no_grad()
def match_volume(volume: CostVolume) -> Matches:
    """Matches of a cost volume: aggregate, take the winner, and check it against every right view.

    Confidence is 0 where no right view agrees, else about the probability that the match is within
    three planes of the truth, by the right view that is most certain of it.
    """
    if use_kernel(volume.levels):
        return _match_by_kernels(volume)
    found = candidates(volume, volume.aligned)
    confidence = torch.zeros_like(found.inverse_depth)
    for features, difference in found.views:
        odds = torch.zeros_like(difference)
        for weight, x in zip(LOG_ODDS, features, strict=True):
            odds = odds + weight * x
        probability = torch.sigmoid(odds) * (found.contrast / LEAST_CONTRAST).clamp_max(1.0)
        agreed = torch.where(difference <= AGREEMENT_PLANES, probability, torch.zeros_like(probability))
        confidence = torch.maximum(confidence, agreed)
    deviation = _deviation(confidence, found.sharpness)
    step = to_device_of(confidence, volume.plane_step)
    return Matches(found.inverse_depth[None], confidence[None], step, deviation[None])


def _match_by_kernels(volume: CostVolume) -> Matches:
    """``match_volume`` with the evidence of a view weighed in one launch."""
    from geodiff_plugin.matching import kernels

    buffers = Buffers()
    found = _left_winner(volume, buffers)
    means = _contrast_and_sharpness(found)
    others = [_right_winners(volume, view, buffers) for view in volume.aligned]
    confidence, deviation, inverse_depth = kernels.weighed(volume, found, means, others)[:, None]
    return Matches(inverse_depth, confidence, to_device_of(confidence, volume.plane_step), deviation)


def _deviation(confidence: Tensor, sharpness: Tensor) -> Tensor:
    """Standard deviation of matches in planes, ``(H, W)``."""
    blur = LEAST_SHARPNESS / sharpness.clamp_min(LEAST_SHARPNESS / MOST_BLUR)
    return ((1.0 - confidence) / DOUBT_OF_A_PLANE).sqrt() * blur.clamp_min(1.0)


@torch.no_grad()
def known_share(matches: Matches) -> Tensor:
    """How much the matches around every pixel know, ``(B, 1, H, W)`` in [0, 1].

    It is the mean precision, one over the variance in planes and at most 1, of a window of matches, as a
    share of ``ENOUGH_KNOWN``; a pixel without a match has none, a known point that of the pixels that it
    stands for (see ``with_points``). 1 where no deviation is known.
    """
    if use_kernel(matches.confidence) and matches.deviation is not None:
        from geodiff_plugin.matching import window_kernels as kernels

        return kernels.known_share(matches.deviation, matches.confidence)
    return _mean_precision(matches, 1.0).clamp_max(1.0)


@torch.no_grad()
def known_shape(matches: Matches, inverse_depth: Tensor) -> Tensor:
    """How much the matches around every pixel know of the shape of a surface, ``(B, 1, H, W)`` in [0, 1].

    As ``known_share``, but more precise matches count for more, and fewer planes from infinity ask for more
    precise ones: an error of a plane bends a far wall more than a near one.

    Args:
        matches: of the images.
        inverse_depth: ``(B, 1, H, W)`` 1/m of the surfaces, on the grid of the matches.
    """
    planes = inverse_depth / matches.plane_step.view(-1, 1, 1, 1)
    return (_mean_precision(matches, LEAST_DEVIATION) * (planes / FAR_PLANES).clamp_max(1.0)).clamp_max(1.0)


def _mean_precision(matches: Matches, least_deviation: float) -> Tensor:
    """Mean precision of a window of matches as a share of ``ENOUGH_KNOWN``, ``(B, 1, H, W)`` >= 0.

    A match deviates by ``least_deviation`` planes at least.
    """
    if matches.deviation is None:
        return torch.ones_like(matches.confidence)
    precision = matches.deviation.clamp_min(least_deviation) ** -2 * matches.confidence.clamp_min(1.0)
    return window_mean(precision * (matches.confidence > 0), KNOWN_REACH) / ENOUGH_KNOWN
