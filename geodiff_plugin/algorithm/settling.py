"""Find the scale of a relative map (S7.3), in this order (``_ends_of_image``).

1. ``search_scale``: near and far by lookup in the cost volume, at the first step, or at every step if too
   few matches are reliable; without a right view ``fit_to_points`` instead.
2. ``refine_to_matches``, then ``fit_to_points`` on reliable matches: choose among the search's minima.
3. ``refine_to_matches``: fit within that minimum, first to the matches, then to the points.
4. ``ordered``: near stays below far, and both within a given range.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from geodiff_plugin.algorithm.terms import Objective
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.scale.points import depth_span, fit_to_points, ordered, refine_to_matches
from geodiff_plugin.scale.space import AffineState, MetricMap, smooth_floor
from geodiff_plugin.scale.volume_search import search_scale

#: Metres ``(B,)`` of the nearest and of the farthest end of a map.
_Ends = tuple[Tensor, Tensor]


def span_of_points(evidence: Sequence[Evidence]) -> _Ends:
    """The nearest and the farthest point of every sample; all samples have points."""
    spans = [depth_span(points) for sample in evidence if (points := sample.points) is not None]
    nearest, farthest = zip(*spans, strict=True)
    return torch.stack(nearest), torch.stack(farthest)


@torch.no_grad()
def search_one_number(x: Tensor, objective: Objective) -> tuple[AffineState, Tensor]:
    """The g_s of least photometric loss at the paper's s_hat = t_hat = 0, and whether it is on the edge."""
    config, zero = objective.config, x.new_zeros(x.shape[0])
    low, high = config.g_s_range
    candidates = torch.linspace(low, high, config.g_s_candidates, dtype=torch.float32, device=x.device)

    def cost(g_s: Tensor) -> Tensor:
        affine = AffineState(zero, zero, g_s.expand_as(zero))
        loss = objective(x, affine, affine, zero.view(-1, 1), zero.view(-1, 1), None)
        # A scene that no right camera sees costs nothing, and must not win.
        shown = (loss.visible_fraction > 0) & (loss.visible_fraction >= config.min_visible)
        return loss.terms["photometric"].where(shown, torch.inf)

    index = torch.stack([cost(g_s) for g_s in candidates]).argmin(0)  # S7.3, g_s* = argmin L_geo
    return AffineState(zero, zero, candidates[index]), (index == 0) | (index == len(candidates) - 1)


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
    """Metres ``(B,)`` of both ends of maps ``x (B, 1, h, w)``, and whether they are on the edge of the range.

    ``evidence`` has an entry per sample, as has ``owners``, the image of each; samples of one image lie side
    by side. ``current`` ends stay unless a better basin shows up; ``on_edge`` is the previous result or
    ``None``; ``valid`` marks the pixels where the prior gives a depth.
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
    """``settle_ends`` of one image."""
    space, floored, reliable = metric.space, smooth_floor(x), evidence.reliable
    if evidence.volume is None:
        assert evidence.points is not None  # without views there are points
        ends = fit_to_points(x, evidence.points, metric, current)
        on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
    elif current is not None and reliable is not None and on_edge is not None:
        # Later steps start from the first one's ends; reliable matches show if that basin is still best.
        ends = current
    else:
        near, far, on_edge = search_scale(
            evidence.volume, floored, space, depth_range=config.depth_range, current=current, valid=valid
        )
        ends = near, far
    if reliable is not None and evidence.matches is not None:
        # A poor prior's true basin is shallow in raw costs; matches separate basins at that error.
        ends = refine_to_matches(floored, evidence.matches, *ends, space)
        ends = fit_to_points(x, reliable, metric, ends)
    for target in (evidence.matches, evidence.points):
        if target is not None:
            ends = refine_to_matches(floored, target, *ends, space)
    if config.depth_range is not None:
        low, high = config.depth_range
        ends = ordered(*(v.clamp(low, high) for v in ends))
    return *ends, on_edge
