"""Finds the scale of a relative map (S7.3) in this order (``fit_depth_range``).

1. ``search_scale`` looks near and far up in the cost volume, at the first step, or at every step if too few
   matches are reliable. Without a right view ``fit_to_points`` is used instead.
2. ``refine_to_matches``, then ``fit_to_points`` on reliable matches, choose among the minima of the search.
3. ``refine_to_matches`` fits within that minimum, first to the matches, then to the points.
4. ``ordered`` keeps near below far; both are clamped to a given range.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from geodiff_plugin.algorithm.terms import Given, Objective
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.affine import AffineState
from geodiff_plugin.scale.points import depth_span, fit_to_points, ordered, refine_to_matches
from geodiff_plugin.scale.space import DepthRange, MetricMap, smooth_floor
from geodiff_plugin.scale.volume_search import search_scale


def span_of_points(evidence: Sequence[Evidence]) -> DepthRange:
    """Return the nearest and the farthest point of every sample; all samples have points."""
    spans = [depth_span(points) for sample in evidence if (points := sample.points) is not None]
    nearest, farthest = map(torch.stack, zip(*spans, strict=True))
    return DepthRange(nearest, farthest, torch.zeros_like(nearest, dtype=torch.bool))


@torch.no_grad()
def search_one_number(x: Tensor, objective: Objective) -> tuple[AffineState, Tensor]:
    """Find the g_s of least photometric loss at s_hat = t_hat = 0, and whether it is on the range's edge."""
    config = objective.config
    zero = x.new_zeros(x.shape[0])
    low, high = config.g_s_range
    candidates = torch.linspace(low, high, config.g_s_candidates, dtype=torch.float32, device=x.device)

    def cost(g_s: Tensor) -> Tensor:
        affine = AffineState(zero, zero, g_s.expand_as(zero))
        loss = objective(x, Given(affine, affine, zero.view(-1, 1), zero.view(-1, 1)))
        # A scene outside every right view has zero loss and must not win.
        shown = (loss.visible_fraction > 0) & (loss.visible_fraction >= config.min_visible)
        return loss.terms["photometric"].where(shown, torch.inf)

    index = torch.stack([cost(g_s) for g_s in candidates]).argmin(0)  # S7.3, g_s* = argmin L_geo
    return AffineState(zero, zero, candidates[index]), (index == 0) | (index == len(candidates) - 1)


def fit_depth_range(
    x: Tensor,
    evidence: Evidence,
    metric: MetricMap,
    config: GuidanceConfig,
    current: DepthRange | None = None,
    valid: Tensor | None = None,
) -> DepthRange:
    """Fit the depth range of one image's maps ``x (B, 1, h, w)`` to its views and points.

    The ``current`` range, whose ``on_edge`` is ``None`` before the first search, is kept unless a better
    basin is found. Only ``valid (1, 1, h, w)`` pixels are compared.
    """
    space = metric.space
    floored = smooth_floor(x)
    reliable = evidence.reliable
    on_edge: Tensor | None
    if evidence.volume is None:
        assert evidence.points is not None  # without views there are points
        near, far = fit_to_points(x, evidence.points, metric, None if current is None else current[:2])
        on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
    elif current is not None and reliable is not None and current.on_edge is not None:
        # Later steps start from the first step's range; reliable matches show if its basin is still the best.
        near, far, on_edge = current.near_m, current.far_m, current.on_edge
    else:
        near, far, on_edge = search_scale(
            evidence.volume, floored, space, depth_range=config.depth_range, current=current, valid=valid
        )
    if reliable is not None and evidence.matches is not None:
        # For a poor prior the true basin is shallow in raw costs, but matches still separate the basins.
        near, far = refine_to_matches(floored, evidence.matches, near, far, space)
        near, far = fit_to_points(x, reliable, metric, (near, far))
    for target in (evidence.matches, evidence.points):
        if target is not None:
            near, far = refine_to_matches(floored, target, near, far, space)
    return DepthRange(*within_range(near, far, config), on_edge)


@torch.no_grad()
def refit_depth_range(
    x: Tensor, matches: Matches, metric: MetricMap, config: GuidanceConfig, current: DepthRange
) -> DepthRange:
    """Refine the ``current`` range of one image's maps ``x (B, 1, h, w)`` to its weighted matches."""
    near, far = refine_to_matches(smooth_floor(x), matches, current.near_m, current.far_m, metric.space)
    return DepthRange(*within_range(near, far, config), current.on_edge)


def within_range(near: Tensor, far: Tensor, config: GuidanceConfig) -> tuple[Tensor, Tensor]:
    """Clamp both ends to the given range, if any."""
    if config.depth_range is None:
        return near, far
    low, high = config.depth_range
    return ordered(near.clamp(low, high), far.clamp(low, high))
