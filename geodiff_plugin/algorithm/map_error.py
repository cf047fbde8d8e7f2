"""Finds where a given depth map is wrong: in regions whose matches explain the images better than the map.

One error for the whole map would reject the correct matches of such a region as outliers. Residuals alone
cannot separate a wrong map from wrong matches, because both are smooth in a region. The images can: a wrong
match in an occluded, textureless or repetitive region has no lower matching cost than the map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.constants import MAX_PRIOR_ERROR, MIN_PRIOR_ERROR
from geodiff_plugin.algorithm.match_fitting import MeasuredError
from geodiff_plugin.geometry import image_size
from geodiff_plugin.matching import CostVolume, Matches
from geodiff_plugin.matching.consistency import window_mean

#: Cost of the map minus the match's, as a fraction of the maximum cost, at which a match begins to
#: contradict the map, and at which it does.
EXCESS_COST = 0.03, 0.1
#: Fraction of a window's confidence in contradicting matches at which the map begins to be wrong there, and
#: at which it is. Lower ones include the matches that extend a near surface beyond its edge.
CONTRADICTED = 0.25, 0.5
#: Error of a region over the map's at which it begins to replace the map's, and at which it does.
LARGER = 2.0, 4.0
#: Half side of that window, as a fraction of the longer image side: half a held-out block.
WINDOW = 0.04
#: Cells across half a window; windows are averaged over cells, because averaging over pixels takes longer.
CELLS = 4
#: Confidence of a window that is added to its matches', so that a few matches contradict nothing.
PRIOR_CONFIDENCE = 0.2
#: Ratio of the contradicted areas with matches in front of the map and behind it, below which the matches
#: behind count less. A wrong map has both; transparent and reflecting surfaces have only matches behind.
FRONT_RATIO = 0.5
#: Bound of residuals, log depth.
LARGEST = 1.0
#: Standard deviation of a normal distribution over its mean absolute value.
SD_PER_MEAN = math.sqrt(math.pi / 2.0)


def _ramp(x: Tensor, ends: tuple[float, float]) -> Tensor:
    """Rise from 0 to 1 between two ends."""
    return ((x - ends[0]) / (ends[1] - ends[0])).clamp(0.0, 1.0)


@torch.no_grad()
def regional_error(measured: MeasuredError, target: Matches, volumes: Sequence[CostVolume]) -> Tensor:
    """Raise a map's error ``(B, 1, h, w)``, log depth, in the regions where the images contradict the map.

    The compared map is the one that the matches of other blocks predict, so an error that a fit corrects over
    wide regions contradicts nothing. A contradicted region has the standard deviation of its contradicting
    matches, if it is larger; other pixels keep ``measured.error``.

    Args:
        measured: ``measure_error`` of the map with these matches.
        target: matches ``(B, 1, h, w)``.
        volumes: cost volume of every sample, on the grid of the matches.
    """
    confidence = target.confidence.clamp_max(1.0)
    deviation = measured.deviation
    contradicting = confidence * _contradiction(deviation, target, volumes)
    size = deviation.abs().clamp_max(LARGEST)
    means = _window_means(contradicting, contradicting * (deviation < 0), contradicting * size, confidence)
    of_all, in_front, of_size, of_confidence = means.split(1, 1)
    local = (SD_PER_MEAN * of_size / of_all.clamp_min(1e-6)).clamp(MIN_PRIOR_ERROR, MAX_PRIOR_ERROR)
    larger = _ramp(local / measured.error, LARGER)

    def wrong_by(matches: Tensor) -> Tensor:
        return larger * _ramp(matches / (of_confidence + PRIOR_CONFIDENCE), CONTRADICTED)

    wrong, front, behind = wrong_by(of_all), wrong_by(in_front), wrong_by(of_all - in_front)
    front_area = (front * of_confidence).mean((2, 3), keepdim=True)
    behind_area = (behind * of_confidence).mean((2, 3), keepdim=True)
    weight_behind = (front_area / (FRONT_RATIO * behind_area).clamp_min(1e-6)).clamp_max(1.0)
    wrong = torch.where(behind > front, wrong * weight_behind, wrong)
    ratio = (local / measured.error).clamp_min(1.0) ** wrong
    return measured.error * F.interpolate(ratio, target.size, mode="bilinear", align_corners=False)


def _window_means(*layers: Tensor) -> Tensor:
    """Average layers ``(B, 1, h, w)`` over windows, ``(B, len(layers), cells down, cells across)``."""
    longer = max(image_size(layers[0]))
    cell = max(1, round(WINDOW / CELLS * longer))
    size = [math.ceil(side / cell) for side in image_size(layers[0])]
    radius = max(1, round(WINDOW * longer / cell))
    return window_mean(F.interpolate(torch.cat(layers, 1), size, mode="area"), radius)


def _contradiction(deviation: Tensor, target: Matches, volumes: Sequence[CostVolume]) -> Tensor:
    """Compute how clearly each match explains the images better than the map, ``(B, 1, h, w)`` in [0, 1].

    It is 0 where the map's depth is outside every right view.
    ``deviation`` is the log inverse depth of the map minus the match's.
    """
    matched = target.inverse_depth
    found = []
    for volume, of_match, of_map in zip(volumes, matched, matched * deviation.exp(), strict=True):
        cost, is_seen = volume.cost_at(of_map)
        found.append(_ramp(cost - volume.cost_at(of_match)[0], EXCESS_COST) * is_seen)
    return torch.stack(found)
