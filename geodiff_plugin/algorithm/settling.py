"""The scale of a relative map (S7.3): by cost volume, matches and points, or the paper's single number."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from geodiff_plugin.algorithm.evidence import Evidence
from geodiff_plugin.algorithm.terms import Objective
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.scale.points import depth_span, fit_to_points, ordered, refine_to_matches
from geodiff_plugin.scale.space import AffineState, MetricMap, smooth_floor
from geodiff_plugin.scale.volume_search import argmin_over, search_scale

_Ends = tuple[Tensor, Tensor]
"""Metres ``(B,)`` of the nearest and of the farthest end of a map."""


def span_of_points(evidence: Sequence[Evidence]) -> _Ends:
    """The nearest and the farthest point of every sample, which all have some."""
    spans = [depth_span(points) for sample in evidence if (points := sample.points) is not None]
    nearest, farthest = zip(*spans, strict=True)
    return torch.stack(nearest), torch.stack(farthest)


def search_one_number(x: Tensor, objective: Objective) -> tuple[AffineState, Tensor]:
    """The paper's start, s_hat = t_hat = 0 and the g_s of least photometric loss; and whether it is on edge.

    ``x (B, 1, h, w)`` are float32 relative maps; the objective's configuration has the candidates.
    """
    config, zero = objective.config, x.new_zeros(x.shape[0])
    low, high = config.g_s_range
    candidates = torch.linspace(low, high, config.g_s_candidates, dtype=torch.float32, device=x.device)

    def cost(g_s: Tensor) -> Tensor:
        affine = AffineState(zero, zero, g_s.expand_as(zero))
        loss = objective(x, affine, affine, zero.view(-1, 1), zero.view(-1, 1), None)
        # What no right camera sees costs nothing, and must not win for that.
        shown = (loss.visible_fraction > 0) & (loss.visible_fraction >= config.min_visible)
        return loss.terms["photometric"].where(shown, torch.inf)

    best, on_edge = argmin_over(candidates, cost)
    return AffineState(zero, zero, best), on_edge


def settle_ends(
    x: Tensor,
    owners: Sequence[int],
    evidence: Sequence[Evidence],
    metric: MetricMap,
    config: GuidanceConfig,
    current: _Ends | None,
    on_edge: Tensor | None,
    valid: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Nearest and farthest depth of a map, by lookup, or by a fit to points where there is no right view.

    Args:
        x: ``(B, 1, h, w)`` float32 relative maps.
        owners: the image of every sample; those of an image side by side.
        evidence: of every sample.
        metric: the prior's metric parametrisation.
        config: hyperparameters.
        current: both ends in use, which stay unless a better basin shows up.
        on_edge: ``(B,)`` bool of the search before, ``None`` at the first.
        valid: ``(B, 1, H, W)`` bool, where the maps say something; ``None`` for everywhere.

    Returns:
        Metres ``(B,)`` of the nearest and the farthest end, and ``(B,)`` bool, whether they lie on the edge
        of the search's range.

    Source: S7.3; deviations in ``scale.volume_search``.
    """
    results = []
    for image in sorted(set(owners)):
        first = owners.index(image)
        members = slice(first, first + owners.count(image))
        before = None if current is None else (current[0][members], current[1][members])
        edge = None if on_edge is None else on_edge[members]
        where = None if valid is None else valid[first : first + 1]
        results.append(_ends_of_image(x[members], evidence[first], metric, config, before, edge, where))
    near, far, edges = (torch.cat(parts) for parts in zip(*results, strict=True))
    return near, far, edges


def _ends_of_image(
    x: Tensor,
    evidence: Evidence,
    metric: MetricMap,
    config: GuidanceConfig,
    current: _Ends | None,
    on_edge: Tensor | None,
    valid: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """``settle_ends`` of one image. Points have the last word: they are measured, matches inferred."""
    space, floored, reliable = metric.space, smooth_floor(x), evidence.reliable
    if evidence.volume is None:
        assert evidence.points is not None  # without views there are points
        ends = fit_to_points(x, evidence.points, metric, current)
        on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
    elif current is not None and reliable is not None and on_edge is not None:
        # Later steps start from the first one's ends; reliable matches tell whether that basin still holds.
        ends = current
    else:
        volume, bounds = evidence.volume, config.depth_range
        search = search_scale(volume, floored, space, depth_range=bounds, current=current, valid=valid)
        ends, on_edge = (search.near_m, search.far_m), search.on_edge
    if reliable is not None and evidence.matches is not None:
        # A poor prior's true basin is shallow in raw costs; matches tell basins apart at a prior's error.
        ends = refine_to_matches(floored, evidence.matches, *ends, space)
        ends = fit_to_points(x, reliable, metric, ends)
    for target in (evidence.matches, evidence.points):
        if target is not None:
            ends = refine_to_matches(floored, target, *ends, space)
    if config.depth_range is not None:
        low, high = config.depth_range
        ends = ordered(*(v.clamp(low, high) for v in ends))
    return *ends, on_edge
