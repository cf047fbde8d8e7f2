"""Metres of a relative map from known points alone, where there is no right view to search with.

Hop: points, relative map ``x (B, 1, h, w)`` -> depths of its nearest and farthest end, per sample.
Paper: none; the range of the points is where Marigold-DC starts (Viola et al. 2024, Eq. 2).
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.known_points import UNIT
from geodiff_plugin.metric import GROWS_WITH_DEPTH, MetricMap
from geodiff_plugin.scale_search import MIN_SURE, SURE

__all__ = ["depth_span", "fit_to_points", "sure_matches"]

#: (near, far) pairs tried, and how far beyond the points' own range, as a factor.
CANDIDATES, REACH = 48, 4.0
#: Points that are looked at; width of the Cauchy cost in units of the points, about a prior's own error.
SAMPLES, CAUCHY_UNITS = 1500, 32.0
#: A current state this close to the best cost, as a factor, stays: a new one restarts the affine updates.
KEEP_FACTOR = 1.05


def depth_span(points: Matches) -> tuple[Tensor, Tensor]:
    """Metres, ``()`` each, of the nearest and the farthest known point."""
    known = points.inverse_depth[points.confidence > 0]
    return 1.0 / known.amax(), 1.0 / known.amin()


def sure_matches(matches: Matches) -> Matches | None:
    """The matches that are more likely right than wrong, as if they were points; ``None`` for too few."""
    believed = (matches.confidence > SURE) & (matches.inverse_depth > matches.plane_step)
    if int(believed.sum()) < MIN_SURE:
        return None
    unit = UNIT * matches.inverse_depth[believed].median()
    return replace(matches, confidence=believed.float(), plane_step=unit)


@torch.no_grad()
def fit_to_points(
    x: Tensor, points: Matches, metric: MetricMap, current: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Depths of the two ends of a relative map that explain the points best.

    Args:
        x: ``(B, 1, h, w)`` relative maps of one image.
        points: of that image.
        metric: the prior's metric parametrisation.
        current: ``(near_m, far_m)``, ``(B,)`` each, in use; they stay unless a better basin shows up.

    Returns:
        ``near_m, far_m``, ``(B,)``: the best of 1128 log-spaced pairs in mean Cauchy cost of inverse depth,
        so that some points may be wrong. Coarse: ``scale_search.refine_to_matches`` does the rest.
    """
    at = (points.confidence.flatten() > 0).nonzero()[:, 0]
    at = at[:: max(1, -(-len(at) // SAMPLES))]
    target = points.inverse_depth.flatten()[at]
    values = F.interpolate(x.float(), points.size, mode="bilinear", align_corners=False).flatten(1)[:, at]
    nearest, farthest = depth_span(points)
    low, high = (nearest / REACH).log(), (farthest * REACH).log()
    grid = torch.exp(low + (high - low) * torch.linspace(0, 1, CANDIDATES, device=x.device))
    i, j = torch.triu_indices(CANDIDATES, CANDIDATES, 1, device=x.device)
    found = []
    for b, row in enumerate(values):
        near, far = grid[i], grid[j]
        if current is not None:
            near, far = torch.cat([current[0][b : b + 1], near]), torch.cat([current[1][b : b + 1], far])
        ends = (near, far) if metric.space in GROWS_WITH_DEPTH else (far, near)
        depth_m = metric(row.expand(len(near), 1, 1, -1), metric.from_range(*ends))[:, 0, 0]
        e = (1.0 / depth_m - target) / (CAUCHY_UNITS * points.plane_step)
        cost = torch.log1p(e * e).mean(1)
        best = cost.argmin()
        if current is not None:
            best = torch.where(cost[0] <= KEEP_FACTOR * cost[best], torch.zeros_like(best), best)
        found.append(torch.stack([near[best], far[best]]))
    return torch.stack(found).unbind(1)
