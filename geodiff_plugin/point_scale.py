"""Metres of a relative map from matches and known points: which basin is right, and the fit within it.

Hop: matches or points, relative map ``x (B, 1, h, w)`` -> depths of its nearest and farthest end, per sample.
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
from geodiff_plugin.scale_search import depth_at

__all__ = ["depth_span", "fit_to_points", "ordered", "refine_to_matches", "sure_matches"]

#: (near, far) pairs tried, and how far beyond the points' own range, as a factor.
CANDIDATES, REACH = 48, 4.0
#: Points that tell basins apart; width of the Cauchy cost in units of the points, about a prior's own error.
COARSE_SAMPLES, CAUCHY_UNITS = 1500, 32.0
#: A current state this close to the best cost, as a factor, stays: a new one restarts the affine updates.
KEEP_FACTOR = 1.05
#: What counts as a sure match, and how many of them make a basin or a quantile.
SURE, MIN_SURE = 0.5, 50
#: The fit: points that are looked at, width of its Cauchy weight in planes, how far near and far may move
#: (log factor), and which quantile the prior calls 0.
SAMPLES, CAUCHY_PLANES, LOG_NEAREST, LOG_FARTHEST, NEAR_QUANTILE = 6000, 8.0, 1.4, 0.7, 0.02


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
        so that some points may be wrong. Coarse: ``refine_to_matches`` does the rest.
    """
    at = (points.confidence.flatten() > 0).nonzero()[:, 0]
    at = at[:: max(1, -(-len(at) // COARSE_SAMPLES))]
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


@torch.no_grad()
def refine_to_matches(
    x: Tensor, matches: Matches, near_m: Tensor, far_m: Tensor, space: str, *, iterations: int = 8
) -> tuple[Tensor, Tensor]:
    """Robust fit of the two ends of a relative map to matches, started from the search's result.

    Args:
        x: ``(B, 1, h, w)`` relative maps of one image.
        matches: of that image; or known points.
        near_m: ``(B,)`` metres, start.
        far_m: ``(B,)`` metres, start.
        space: as in ``search_scale``.
        iterations: of reweighted Gauss-Newton on (log near, log far).

    Returns:
        ``near_m, far_m``, far within a factor of 2 of the start: matches alone have outliers, so they
        refine what the lookup found and never replace it. Residuals are in planes, with Cauchy weights.
        Near is at most the 2 % quantile of the matched depths (priors are trained on that normalisation): no
        value of the map can be nearer than its own zero, so a zero that lies too far away would hold the
        nearest surfaces back for good.
    """
    height, width = matches.size
    at = (matches.confidence.flatten() > 0).nonzero()[:, 0]  # known points are few: not one may be missed
    at = at[:: max(1, len(at) // SAMPLES)]
    target = matches.inverse_depth.flatten()[at]
    # A match at infinity constrains nothing, and a wrong one would push far without end.
    weight = matches.confidence.flatten()[at] * (target > matches.plane_step)
    values = F.interpolate(x.float(), (height, width), mode="bilinear", align_corners=False).flatten(1)[:, at]
    start = torch.stack([near_m, far_m], 1).log()
    fit = start
    for _ in range(iterations):
        fit = _refine_once(fit, start, values, target, weight, matches.plane_step, space, (True, True))
    sure = weight > SURE
    if int(sure.sum()) < MIN_SURE:
        return ordered(*fit.exp().unbind(1))
    nearest = -torch.quantile(target[sure], 1.0 - NEAR_QUANTILE).log()
    fit = torch.stack(
        [torch.minimum(fit[:, 0], torch.maximum(nearest, start[:, 0] - LOG_NEAREST)), fit[:, 1]], 1
    )
    for _ in range(iterations):
        fit = _refine_once(fit, start, values, target, weight, matches.plane_step, space, (False, True))
    return ordered(*fit.exp().unbind(1))


def ordered(near_m: Tensor, far_m: Tensor) -> tuple[Tensor, Tensor]:
    """Both ends, near at most 0.98 of far: a range of nothing has no scale."""
    return torch.minimum(near_m, far_m * 0.98), far_m


def _refine_once(
    fit: Tensor,
    start: Tensor,
    values: Tensor,
    target: Tensor,
    weight: Tensor,
    plane_step: Tensor,
    space: str,
    free: tuple[bool, bool],
) -> Tensor:
    """One reweighted Gauss-Newton step on ``fit (B, 2)``, log metres; what is not ``free`` stays."""

    def residual(p: Tensor) -> Tensor:
        return (1.0 / depth_at(values, p[:, :1].exp(), p[:, 1:].exp(), space) - target) / plane_step

    e, h = residual(fit), 1e-3
    mask = fit.new_tensor(free)
    J = torch.stack([(residual(fit + h * d) - e) / h for d in torch.eye(2, device=fit.device)], -1) * mask
    w = weight / (1.0 + (e / CAUCHY_PLANES) ** 2)
    normal = torch.einsum("bpi,bp,bpj->bij", J, w, J)
    damping = 1e-3 * normal.diagonal(dim1=1, dim2=2).sum(1) + 1e-6
    normal = normal + damping[:, None, None] * torch.eye(2, device=fit.device)
    gradient = torch.einsum("bpi,bp,bp->bi", J, w, e)
    step = torch.linalg.solve(normal, gradient).clamp(-0.3, 0.3) * mask
    limit = fit.new_tensor([LOG_NEAREST, LOG_FARTHEST])
    return torch.maximum(torch.minimum(fit - step, start + limit), start - limit)
