"""Matches that both views agree on: winner, left-right check, uniqueness, sub-plane position.

Hop: ``CostVolume`` -> aggregated costs -> ``Matches`` (inverse depth and confidence on the left grid).
Paper: none; the evidence that a photometric loss does not have.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from geodiff_plugin.geometry import invert_rigid, plane_rays, sample_at, warp_right_to_left
from geodiff_plugin.matching.aggregation import aggregate
from geodiff_plugin.matching.plane_sweep import CostVolume, RightView, sweep_planes

__all__ = ["Matches", "gate_matches", "match_volume"]

# Left and right may differ by this many planes.
_TOLERANCE = 1.5
# Log-odds that a checked match is within 3 planes of the truth: constant, log of the margin (0.03 + second
# best cost - best cost), best cost, left-right difference. Fitted on real pairs; what one half of them gives
# holds on the other.
_LOG_ODDS = (5.8, 0.8, -5.9, -0.62)
# Aggregation carries matches over blank walls for ever. Where, within this window, the best planes are no
# better than the average plane by this much, there is no evidence.
_WINDOW_PX, _LEAST_CONTRAST = 31, 0.03


@dataclass(frozen=True)
class Matches:
    """What the views alone say about depth, with how far to believe it.

    Attributes:
        inverse_depth: ``(1, H, W)`` float32, 1/m; defined everywhere, to be read where ``confidence > 0``.
        confidence: ``(1, H, W)`` float32 in [0, 1].
        plane_step: ``()`` float32, 1/m, the unit in which errors of matches are measured.
        K: ``(3, 3)`` pixels of this grid.
        size: ``(H, W)``.
    """

    inverse_depth: torch.Tensor
    confidence: torch.Tensor
    plane_step: torch.Tensor
    K: torch.Tensor
    size: tuple[int, int]


@dataclass(frozen=True)
class _Winner:
    """Per pixel ``(H, W)``: inverse depth, its cost, the least cost two planes away, and ``_contrast``."""

    inverse_depth: torch.Tensor
    cost: torch.Tensor
    second: torch.Tensor
    contrast: torch.Tensor


def _contrast(volume: CostVolume, index: torch.Tensor) -> torch.Tensor:
    """How much better than the mean plane the chosen one is, before aggregation, averaged over a window."""
    total = torch.zeros_like(volume.cost[0])
    for cost, in_view in zip(
        volume.cost, volume.in_view, strict=True
    ):  # one plane at a time: no second volume
        total += cost * in_view
    mean = total / volume.in_view.sum(dim=0).clamp_min(1)
    gain = (mean - volume.cost.gather(0, index[None])[0]).clamp_min(0.0)
    return F.avg_pool2d(gain[None], _WINDOW_PX, 1, _WINDOW_PX // 2, count_include_pad=False)[0]


def _winner(volume: CostVolume) -> _Winner:
    """Aggregate and take the best plane, with a parabola through its neighbours."""
    aggregated = aggregate(volume.cost, volume.left_01[0])
    last = aggregated.shape[0] - 1
    best, index = aggregated.min(dim=0)
    below = aggregated.gather(0, (index - 1).clamp_min(0)[None])[0]
    above = aggregated.gather(0, (index + 1).clamp_max(last)[None])[0]
    offset = 0.5 * (below - above) / (below + above - 2.0 * best).clamp_min(1e-6)
    inner = (index > 0) & (index < last)
    position = index + torch.where(inner, offset.clamp(-0.5, 0.5), torch.zeros_like(offset))
    near = (index[None] + torch.arange(-1, 2, device=index.device)[:, None, None]).clamp(0, last)
    second = aggregated.scatter_(0, near, torch.inf).amin(dim=0)
    inverse_depth = volume.inverse_depth[0] + position * volume.plane_step
    return _Winner(inverse_depth, best, second, _contrast(volume, index))


def _seen_from_right(volume: CostVolume, right: RightView) -> CostVolume:
    """The same sweep with the roles of the two views exchanged, over the same space."""
    image, K_right, T = right
    span = volume.inverse_depth[[0, -1]]
    rays = plane_rays(volume.K[None], K_right[None], T[None], volume.size)
    # z_right / z_left is the last row of A + inverse_depth * b; beyond a factor of 2 little would match.
    ratio = (rays.A[0, 2, :, None] + span * rays.b[0, 2]).clamp(0.5, 2.0)
    low, high = (span / ratio).amin(dim=0)[0], (span / ratio).amax(dim=0)[1]
    steps = torch.linspace(0.0, 1.0, len(volume.inverse_depth), device=span.device)
    back = (volume.left_01, volume.K, invert_rigid(T))
    return sweep_planes(image, [back], K_right, low + (high - low) * steps)


def _disagreement(volume: CostVolume, winner: _Winner, right: RightView) -> torch.Tensor:
    """Left-right difference ``(H, W)`` in planes; infinite where the right view does not see the match."""
    image, K_right, T = right
    other = _winner(_seen_from_right(volume, right)).inverse_depth
    depth_m = 1.0 / winner.inverse_depth.clamp_min(1e-3 * volume.plane_step)[None, None]
    cameras = (volume.K[None], K_right[None], T[None])
    warped = warp_right_to_left(other[None, None], depth_m, *cameras)
    read = sample_at(other[None, None], warped.uv, mode="nearest")[0, 0]
    difference = (read - 1.0 / warped.z_right[0]).abs() / volume.plane_step
    return torch.where(warped.visible[0, 0], difference, torch.full_like(difference, torch.inf))


def _confidence(winner: _Winner, difference: torch.Tensor) -> torch.Tensor:
    """Probability ``(H, W)`` that the winner is right, given the left-right difference in planes."""
    constant, by_margin, by_cost, by_difference = _LOG_ODDS
    margin = (winner.second - winner.cost).clamp(0.0, 0.5)
    odds = constant + by_margin * (margin + 0.03).log() + by_cost * winner.cost.clamp(0.0, 0.8)
    probability = torch.sigmoid(odds + by_difference * difference.clamp_max(_TOLERANCE))
    probability = probability * (winner.contrast / _LEAST_CONTRAST).clamp_max(1.0)
    return torch.where(difference <= _TOLERANCE, probability, torch.zeros_like(probability))


@torch.no_grad()
def match_volume(volume: CostVolume) -> Matches:
    """Matches of a cost volume: aggregate, take the winner, and ask every right view whether it agrees.

    Args:
        volume: of any number of right views. Each is swept once with the roles exchanged, so this costs one
            more volume a view; one at a time is in memory.

    Returns:
        ``Matches``; zero confidence where no right view agrees, else about the probability that the match is
        within 3 planes of the truth (that of the right view most sure of it).
    """
    winner = _winner(volume)
    confidence = torch.zeros_like(winner.cost)
    for right in volume.rights:
        confidence = torch.maximum(confidence, _confidence(winner, _disagreement(volume, winner, right)))
    return Matches(winner.inverse_depth[None], confidence[None], volume.plane_step, volume.K, volume.size)


def gate_matches(matches: Matches, depth_m: torch.Tensor, factor: float) -> torch.Tensor:
    """Confidence of the matches that a depth map does not contradict.

    Args:
        matches: of one image, or of a chunk of samples (``terms.MatchTarget``).
        depth_m: ``(B, 1, H, W)`` metres, > 0, on the matches' grid.
        factor: > 1; a match further than this factor from ``depth_m`` is dropped.

    Returns:
        ``(B, 1, H, W)`` in [0, 1].
    """
    ratio = matches.inverse_depth * depth_m
    return matches.confidence * ((ratio < factor) & (ratio > 1.0 / factor))
