"""Finds repeated patterns, whose matches may be off by whole periods, and settles them by the prior's depth.

A fence, a cot, tiles or blinds look the same one period further along the epipolar line, so the costs of a
window have two minima of similar depth. Aggregation does not resolve this: bars with a wall behind them
match one period away as well as they match at their own depth.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.statistics import MAX_SORTED
from geodiff_plugin.geometry import constant_like
from geodiff_plugin.matching.consistency import window_mean
from geodiff_plugin.matching.matches import RELIABLE, Matches
from geodiff_plugin.matching.volume import CostVolume

#: Pixels per cell of the grid on which repetition is found.
CELL = 8
#: Rows and columns between the costs that are averaged, pixels; fewer are enough.
STRIDE = 4, 2
#: Height and width of the window of averaged costs around a cell, in these strides: 20 pixels.
WINDOW = 5, 10
#: Minimum distance of two minima, planes: nearer ones belong to one wide minimum.
MIN_PERIOD = 7
#: Minimum rise of the costs on both sides of the second minimum, as a fraction of the first one's depth. The
#: costs of a saturated sky are low on all planes.
RISE = 0.3
#: Mean depth of the second minimum below the mean of all planes, relative to the first one's, at which a
#: pattern begins to repeat, and at which it does.
SIMILAR = 0.6, 0.75
#: Mean depth of the first minimum, levels, at which a pattern begins to count, and at which it does. Less
#: contrast is noise.
CONTRAST_LEVELS = 20.0, 30.0
#: Half width in cells of the window of these means. The two depths at an object's outline give two minima as
#: well, but only within ``WINDOW`` of it.
REGION = 2
#: Minimum fraction of the matches that are on a pattern. With fewer, the matches are left alone.
MIN_FRACTION = 0.03
#: Probability of a match on a repeated pattern: it, or one of its two neighbours.
CHANCE = 1.0 / 3.0
#: Half side of the window of the surroundings, as a fraction of the longer image side.
SURROUNDINGS = 0.08
#: Mean confidence in that window at which the surroundings count as much as the prior.
ENOUGH = 0.05
#: Bounds of the error of the prior's depth, log depth.
ERROR = 0.1, 0.5
#: Quantile of its residuals that measures the error: one standard deviation of a normal error.
ERROR_FRACTION = 0.68
#: Probability below which a match is rejected.
REJECTED = 0.1
#: Bound of differences in log depth.
LARGEST = 1.5


class Settled(NamedTuple):
    """Matches on repeated patterns, given a prior's depth, ``(B, 1, H, W)`` each; 1 elsewhere."""

    weight: Tensor  # factor on the confidence of a match
    certainty: Tensor  # probability of the most likely period, in [0, 1]


def _ramp(x: Tensor, ends: tuple[float, float]) -> Tensor:
    """Rise from 0 to 1 between two ends."""
    return ((x - ends[0]) / (ends[1] - ends[0])).clamp(0.0, 1.0)


def _cells(levels: Tensor) -> Tensor:
    """Average costs ``(D, H, W)`` over the window around every cell, ``(D, h, w)``."""
    costs = levels[:, :: STRIDE[0], :: STRIDE[1]].float()
    step = CELL // STRIDE[0], CELL // STRIDE[1]
    padding = (WINDOW[0] - step[0]) // 2, (WINDOW[1] - step[1]) // 2
    return F.avg_pool2d(costs, WINDOW, step, padding, ceil_mode=True, count_include_pad=False)


def _second_minimum(costs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the depths ``(h, w)`` of both minima below the mean, and the distance in planes to the nearest.

    ``costs (D, h, w)``. The distance is to the nearest minimum that is similarly deep, or 0.
    """
    mean, (lowest, first) = costs.mean(0), costs.min(0)
    away = (torch.arange(len(costs), device=costs.device)[:, None, None] - first).abs()
    is_minimum = (away >= MIN_PERIOD) & (_rise(costs) >= RISE * (mean - lowest))
    depth = torch.where(is_minimum, mean - costs, 0.0)
    similar = is_minimum & (depth >= SIMILAR[0] * (mean - lowest))
    period = torch.where(similar, away, len(costs)).amin(0)
    return mean - lowest, depth.amax(0), torch.where(period < len(costs), period, 0)


def _rise(costs: Tensor) -> Tensor:
    """Compute how far costs ``(D, h, w)`` rise on both sides within ``MIN_PERIOD``; -1 off a minimum."""
    highest, covered = costs, 1  # over the planes from each to the one ``covered - 1`` further
    while covered <= MIN_PERIOD:
        step = min(covered, MIN_PERIOD + 1 - covered)
        highest = torch.maximum(highest[:-step], highest[step:])
        covered += step
    rise = torch.full_like(costs, -1.0)
    inner = slice(MIN_PERIOD, -MIN_PERIOD)
    rise[inner] = torch.minimum(highest[:-MIN_PERIOD], highest[MIN_PERIOD:]) - costs[inner]
    is_lowest = (costs[1:-1] <= costs[:-2]) & (costs[1:-1] <= costs[2:])
    rise[1:-1] = torch.where(is_lowest, rise[1:-1], -1.0)
    return rise


@torch.no_grad()
def with_repetition(matches: Matches, volume: CostVolume) -> Matches:
    """Mark matches ``(1, H, W)`` of a volume that are on a repeated pattern, and lower their confidence."""
    first, second, period = _second_minimum(_cells(volume.levels))
    layers = torch.stack([first, second, period, (period > 0).float()])
    first, second, period, count = window_mean(layers, REGION)
    repeated = _ramp(second / first.clamp_min(1.0), SIMILAR) * _ramp(first, CONTRAST_LEVELS)
    cells = torch.stack([repeated, period / count.clamp_min(1e-6)])
    repeated, period = F.interpolate(cells[None], volume.size, mode="bilinear")[0, :, None]
    confidence = matches.confidence
    fraction = (confidence * repeated).sum() / confidence.sum().clamp_min(1e-6)
    repeated = torch.where(fraction < MIN_FRACTION, 0.0, repeated)
    return replace(
        matches,
        confidence=confidence * (1.0 - repeated * (1.0 - CHANCE)),
        repeated=repeated,
        period=period * matches.plane_step,
    )


def if_repeated(matches: Matches) -> Matches:
    """Drop the maps of repeated patterns if there are none; synchronizes with the device."""
    assert matches.repeated is not None  # searched
    return matches if bool(matches.repeated.any()) else replace(matches, repeated=None, period=None)


@torch.no_grad()
def settle(matches: Matches, depth_m: Tensor) -> Settled | None:
    """Judge matches on repeated patterns by a prior's first scaled depth ``(B, 1, H, W)``, on their grid.

    The expected depth of a pixel is the prior's, corrected by the matches around it that do not repeat. A
    match is right if it is the one of its period and its two neighbours that is nearest to this depth; with
    an error of ``e`` standard deviations the likelihood is ``1 / (1 + e^2)^2``. ``None`` without a pattern.
    """
    repeated, period, inverse_depth = matches.repeated, matches.period, matches.inverse_depth
    if repeated is None or period is None:
        return None
    expected, error = _expected(matches, depth_m)
    candidates = inverse_depth + constant_like(period, 0.0, -1.0, 1.0).view(-1, 1, 1, 1, 1) * period
    deviation = (candidates.clamp_min(1e-6).log() - expected) / error
    likelihood = torch.where(candidates > 0, (1.0 + deviation**2) ** -2.0, 0.0)
    probabilities = likelihood / likelihood.sum(0).clamp_min(1e-12)
    own = ((probabilities[0] - REJECTED) / (1.0 - REJECTED)).clamp_min(0.0)
    weight = (1.0 - repeated + repeated * own) / (1.0 - repeated * (1.0 - CHANCE))
    return Settled(weight, 1.0 - repeated * (1.0 - probabilities.amax(0)))


def _expected(matches: Matches, depth_m: Tensor) -> tuple[Tensor, Tensor]:
    """Return the log inverse depth ``(B, 1, H, W)`` expected at a pixel, and its error ``(B, 1, 1, 1)``."""
    assert matches.repeated is not None  # checked by the caller
    log_prior = -depth_m.clamp_min(1e-6).log()
    weight = matches.confidence * (matches.repeated == 0)
    residual = (matches.inverse_depth.clamp_min(1e-6).log() - log_prior).clamp(-LARGEST, LARGEST)
    layers = F.avg_pool2d(torch.cat([weight * residual, weight], 1), CELL, ceil_mode=True)
    radius = max(1, round(SURROUNDINGS * max(matches.size) / CELL))
    of_residual, of_weight = window_mean(layers, radius).split(1, 1)
    offset = F.interpolate(of_residual / (of_weight + ENOUGH), matches.size, mode="bilinear")
    counted = torch.where(weight > RELIABLE, (residual - offset).abs(), torch.nan).flatten(1)
    error = counted[:, :: 1 + counted.shape[1] // MAX_SORTED].nanquantile(ERROR_FRACTION, 1)
    return log_prior + offset, error.nan_to_num(ERROR[1]).clamp(*ERROR).view(-1, 1, 1, 1)
