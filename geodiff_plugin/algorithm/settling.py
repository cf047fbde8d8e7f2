"""The scale of a relative map: depths of its two ends, from cost volume, matches and points."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from geodiff_plugin.algorithm.evidence import Evidence
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.scale.points import depth_span, fit_to_points, ordered, refine_to_matches
from geodiff_plugin.scale.space import MetricMap, smooth_floor
from geodiff_plugin.scale.volume_search import search_scale


def span_of_points(evidence: Sequence[Evidence]) -> tuple[Tensor, Tensor]:
    """Metres ``(B,)`` of the nearest and of the farthest point of every sample, which all have some."""
    spans = [depth_span(points) for sample in evidence if (points := sample.points) is not None]
    nearest, farthest = zip(*spans, strict=True)
    return torch.stack(nearest), torch.stack(farthest)


def settle_ends(
    x: Tensor,
    owners: Sequence[int],
    evidence: Sequence[Evidence],
    metric: MetricMap,
    config: GuidanceConfig,
    current: tuple[Tensor, Tensor] | None,
    on_edge: Tensor | None,
    known: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Near and far jointly, by lookup, or by a fit to points where there is no right view.

    Args:
        x: ``(B, 1, h, w)`` float32 relative maps.
        owners: the image of every sample; those of an image side by side.
        evidence: of every sample.
        metric: the prior's metric parametrisation.
        config: hyperparameters.
        current: metres ``(B,)`` of both ends in use, which stay unless a better basin shows up.
        on_edge: ``(B,)`` bool of the search before, ``None`` at the first.
        known: ``(B, 1, H, W)`` bool, where the maps say something; ``None`` for everywhere.

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
        where = None if known is None else known[first : first + 1]
        results.append(_ends_of_image(x[members], evidence[first], metric, config, before, edge, where))
    near, far, edges = (torch.cat(parts) for parts in zip(*results, strict=True))
    return near, far, edges


def _ends_of_image(
    x: Tensor,
    evidence: Evidence,
    metric: MetricMap,
    config: GuidanceConfig,
    current: tuple[Tensor, Tensor] | None,
    on_edge: Tensor | None,
    known: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """``settle_ends`` of one image. Points have the last word: they are measured, matches inferred."""
    space, floored = metric.space, smooth_floor(x)
    confident = evidence.sure
    if evidence.volume is None:
        assert evidence.points is not None  # without views there are points
        near_far = fit_to_points(x, evidence.points, metric, current)
        on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
    elif current is not None and confident is not None and on_edge is not None:
        # Later steps start from the first one's ends; confident matches tell whether that basin still holds.
        near_far = current
    else:
        search = search_scale(
            evidence.volume, floored, space, depth_range=config.depth_range, current=current, known=known
        )
        near_far, on_edge = (search.near_m, search.far_m), search.on_edge
    if confident is not None and evidence.matches is not None:
        # A poor prior's true basin is shallow in raw costs; matches tell basins apart at a prior's error.
        near_far = refine_to_matches(floored, evidence.matches, *near_far, space)
        near_far = fit_to_points(x, confident, metric, near_far)
    for target in (evidence.matches, evidence.points):
        if target is not None:
            near_far = refine_to_matches(floored, target, *near_far, space)
    if config.depth_range is not None:
        low, high = config.depth_range
        near_far = ordered(*(v.clamp(low, high) for v in near_far))
    return *near_far, on_edge
