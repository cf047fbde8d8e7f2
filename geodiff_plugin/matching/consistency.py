"""Matches that both views agree on: winner, left-right check, uniqueness, sub-plane position.

Data flow: ``CostVolume`` -> aggregated costs -> ``Matches`` (inverse depth and confidence on the left grid).
Paper: none; the evidence that a photometric loss does not have.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from geodiff_plugin.matching.aggregation import NEVER, PATHS, Room, aggregate
from geodiff_plugin.matching.alignment import AlignedView
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.sweep import UNSEEN_LEVEL, CostVolume

__all__ = [
    "LOG_ODDS",
    "RIGHT_WITHIN_PLANES",
    "SIGNS",
    "CheckedMatches",
    "checked_matches",
    "match_volume",
]

#: Planes of the truth within which a match counts as right.
RIGHT_WITHIN_PLANES = 3.0
#: Log-odds that a checked match is right, linear in ``_evidence``, by logistic regression on pairs with truth
#: (``python -m geodiff_plugin.evaluation.calibrate`` refits them).
LOG_ODDS = (5.8, 0.8, -5.9, -0.62)
#: Which sign each of them may have; 0 for any.
SIGNS = (0, 1, -1, -1)
#: Planes by which the matches of the two views may differ.
AGREEMENT_PLANES = 1.5
#: Half the window, px, over which a match's plane must be better than the mean plane, and by how much, as a
#: share of the largest cost, for full confidence. Else aggregation would carry matches across blank walls.
CONTRAST_REACH, LEAST_CONTRAST = 15, 0.03
# The right view is matched in every such row only.
_EVERY_ROW = 2
# A sum over the paths and its plane in one integer, so that one minimum finds both.
_PLANES = 1 << 12


@dataclass(frozen=True)
class _Winner:
    """Per pixel ``(H, W)``: the best plane, that between planes, and the ``(3, H, W)`` planes around it."""

    index: torch.Tensor
    position: torch.Tensor
    around: torch.Tensor
    best: torch.Tensor


def _winner(total: torch.Tensor) -> _Winner:
    """The best plane of sums over the paths, with a parabola through its neighbours."""
    keys = torch.full_like(total[0], NEVER, dtype=torch.int32).mul_(_PLANES)
    own = torch.empty_like(keys)
    for plane in range(len(total)):
        torch.minimum(keys, own.copy_(total[plane]).mul_(_PLANES).add_(plane), out=keys)
    index, last = (keys % _PLANES).long(), len(total) - 1
    around = (index + torch.arange(-1, 2, device=index.device)[:, None, None]).clamp_(0, last)
    below, best, above = total.gather(0, around).float()
    offset = 0.5 * (below - above) / (below + above - 2.0 * best).clamp_min(1e-6)
    inner = (index > 0) & (index < last)
    position = index + torch.where(inner, offset.clamp(-0.5, 0.5), torch.zeros_like(offset))
    return _Winner(index, position, around, best)


def _right_winners(volume: CostVolume, view: AlignedView, room: Room) -> torch.Tensor:
    """The position between planes that a right view takes for the best, ``(ceil(h / 2), w)`` of its canvas.

    Its costs are those of the same sweep, looked up along its own pixels, and aggregated along its own edges:
    an opinion of its own without a sweep of its own. Every second row is enough to ask it.
    """
    height, width = volume.size
    # One row and one column more: what a right view's pixel reads beside the left image.
    plane = volume.left_01.new_full((height + 1, width + 1), UNSEEN_LEVEL)
    rows, columns = view.sources(height, 1)[:, ::_EVERY_ROW], view.sources(width, 0)
    size = (rows.shape[1], columns.shape[1])
    levels = room.cells("levels", len(volume.levels), size, volume.levels)
    for k, own in enumerate(volume.levels):
        plane[:height, :width] = own
        levels[k] = plane.index_select(0, rows[k]).index_select(1, columns[k])
    return _winner(aggregate(levels, view.grey[::_EVERY_ROW], room=room)).position


def _disagreement(view: AlignedView, other: torch.Tensor, position: torch.Tensor) -> torch.Tensor:
    """Left-right difference ``(H, W)`` in planes; infinite where the right view does not see the match.

    Args:
        view: the right view.
        other: its own winners, ``_right_winners``.
        position: ``(H, W)`` winners of the left view, between planes.
    """
    device = position.device
    scale, shift = view.scale.to(device, torch.float32), view.shift.to(device, torch.float32)
    below = position.floor().long().clamp(0, len(scale) - 2)
    part = position - below
    at_scale = torch.lerp(scale[below], scale[below + 1], part)
    height, width = position.shape
    lines = (torch.arange(width, device=device), torch.arange(height, device=device)[:, None])
    found, inside = [], at_scale > 0
    for axis, line in enumerate(lines):
        at = (at_scale * line + torch.lerp(shift[below, axis], shift[below + 1, axis], part)).round()
        last = view.size[1 - axis] - 1
        inside = inside & (at >= 0) & (at <= last)
        found.append(at.clamp(0, last).long())
    column, row = found
    if view.valid is not None:
        inside = inside & view.valid[row, column]
    # Between two matched rows, their mean: at an edge it agrees with neither.
    before, after = row // _EVERY_ROW, ((row + _EVERY_ROW - 1) // _EVERY_ROW).clamp_max(len(other) - 1)
    difference = (0.5 * (other[before, column] + other[after, column]) - position).abs()
    return torch.where(inside, difference, torch.full_like(difference, torch.inf))


def _contrast(volume: CostVolume, index: torch.Tensor, reach: int) -> torch.Tensor:
    """How much better than the mean plane the chosen one is, before aggregation, averaged over a window."""
    total, seen = (torch.zeros_like(index, dtype=torch.int32) for _ in range(2))
    for levels, in_view in zip(volume.levels, volume.in_view, strict=True):
        total += levels
        seen += in_view
    mean = (total - UNSEEN_LEVEL * (len(volume.levels) - seen)).float() / seen.clamp_min(1)
    gain = (mean - volume.levels.gather(0, index[None])[0]).clamp_min(0.0)[None] / COST_LEVELS
    for window in ((2 * reach + 1, 1), (1, 2 * reach + 1)):
        padding = (window[0] // 2, window[1] // 2)
        gain = F.avg_pool2d(gain, window, 1, padding, count_include_pad=False)
    return gain[0]


@dataclass(frozen=True)
class _Candidates:
    """Per pixel ``(H, W)``: the winning plane, and how far each right view disagrees with it.

    Attributes:
        position: between planes.
        margin: least cost two planes away, less that of the winner; aggregated, in [0, 1] units.
        cost: of the winner, aggregated.
        contrast: ``_contrast``.
        differences: left-right differences in planes.
    """

    position: torch.Tensor
    margin: torch.Tensor
    cost: torch.Tensor
    contrast: torch.Tensor
    differences: Iterator[torch.Tensor]


def _find_candidates(volume: CostVolume, views: Sequence[AlignedView]) -> _Candidates:
    """Aggregate, take the winner, and compare it with the matches of right views."""
    room = Room()
    total = aggregate(volume.levels, volume.left_01[0], room=room)
    winner = _winner(total)
    second = total.scatter_(0, winner.around, NEVER).amin(dim=0)
    unit = 1.0 / (PATHS * COST_LEVELS)
    margin, cost = (second - winner.best) * unit, winner.best * unit
    differences = (_disagreement(view, _right_winners(volume, view, room), winner.position) for view in views)
    contrast = _contrast(volume, winner.index, CONTRAST_REACH)
    return _Candidates(winner.position, margin, cost, contrast, differences)


def _evidence(found: _Candidates, difference: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """1, log of the margin (0.03 + second best cost - best cost), best cost, left-right difference."""
    margin = found.margin.clamp(0.0, 0.5)
    ones = torch.ones_like(margin)
    differs = difference.clamp_max(AGREEMENT_PLANES)
    return ones, (margin + 0.03).log(), found.cost.clamp(0.0, 0.8), differs


def _confidence(found: _Candidates, difference: torch.Tensor) -> torch.Tensor:
    """Probability ``(H, W)`` that the winner is right, given the left-right difference in planes."""
    odds = torch.zeros_like(difference)
    for weight, x in zip(LOG_ODDS, _evidence(found, difference), strict=True):
        odds = odds + weight * x
    probability = torch.sigmoid(odds)
    probability = probability * (found.contrast / LEAST_CONTRAST).clamp_max(1.0)
    return torch.where(difference <= AGREEMENT_PLANES, probability, torch.zeros_like(probability))


@dataclass(frozen=True)
class CheckedMatches:
    """What the confidence of matches is fitted on.

    Attributes:
        inverse_depth: ``(H, W)`` float32, 1/m.
        evidence: ``(4, H, W)``, what their log-odds are linear in.
        checked: ``(H, W)`` bool: the right view agrees, and there is texture to agree on.
    """

    inverse_depth: torch.Tensor
    evidence: torch.Tensor
    checked: torch.Tensor


@torch.no_grad()
def checked_matches(volume: CostVolume) -> CheckedMatches:
    """Matches of a cost volume and their evidence, by its first right view."""
    found = _find_candidates(volume, volume.aligned[:1])
    (difference,) = found.differences
    checked = (difference <= AGREEMENT_PLANES) & (found.contrast >= LEAST_CONTRAST)
    inverse_depth = volume.inverse_depth[0] + found.position * volume.plane_step
    return CheckedMatches(inverse_depth, torch.stack(_evidence(found, difference)), checked)


@torch.no_grad()
def match_volume(volume: CostVolume) -> Matches:
    """Matches of a cost volume: aggregate, take the winner, and check it against every right view.

    Args:
        volume: of any number of right views.

    Returns:
        ``Matches``; zero confidence where no right view agrees, else about the probability that the match is
        within ``RIGHT_WITHIN_PLANES`` of the truth (that of the right view most sure of it).
    """
    found = _find_candidates(volume, volume.aligned)
    confidence = torch.zeros_like(found.cost)
    for difference in found.differences:
        confidence = torch.maximum(confidence, _confidence(found, difference))
    inverse_depth = volume.inverse_depth[0] + found.position * volume.plane_step
    return Matches(inverse_depth[None], confidence[None], volume.plane_step, volume.K, volume.size)
