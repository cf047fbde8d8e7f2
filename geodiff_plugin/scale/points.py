"""Finds the scale from matches and points: chooses a minimum, fits within it, and checks depth order.

Marigold-DC starts from the range of the points (Viola et al. 2024, Eq. 2).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin._internal.statistics import SD_PER_MAD
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.matches import RELIABLE, UNIT, read_above
from geodiff_plugin.scale.constants import (
    BASIN_CANDIDATES,
    BASIN_CAUCHY,
    BASIN_KEEP,
    BASIN_RADIUS,
    FAR_FACTOR,
    FIT_CAUCHY,
    FIT_FLOOR,
    FIT_ITERATIONS,
    FIT_NOISE,
    FULLEST,
    KERNEL_FORMS,
    MAX_SORTED,
    MIN_DOUBT,
    NEAR_FACTOR,
    REFERENCE_DOUBT,
)
from geodiff_plugin.scale.sampling import basin_stride, sampling_stride
from geodiff_plugin.scale.space import SPACES, MetricMap, Space

#: Minimum number of reliable matches; fewer may all be on one wrong surface.
MIN_RELIABLE = 50
#: Maximum number of reliable matches whose depth order is compared with the prior's.
ORDER_SAMPLES = 4000
#: Minimum number of reliable matches for that; the rank correlation of fewer is chance.
MIN_ORDER_POINTS = 40


class FitTarget(NamedTuple):
    """The ``P`` matches that relative maps of one image are fitted to."""

    inverse_depth: Tensor  # (P,) 1/m, >= 0
    confidence: Tensor  # (P,) above 0
    deviation: Tensor  # (P,) standard deviation, in units of ``noise``
    noise: Tensor  # () 1/m, noise of a match of the reference confidence


def depth_span(points: Matches) -> tuple[Tensor, Tensor]:
    """Return the depths of the nearest and farthest point, metres, ``()`` each."""
    inverse_depth = points.inverse_depth.flatten()[points.above(0.0)]
    return inverse_depth.amax().reciprocal(), inverse_depth.amin().reciprocal()


def reliable_matches(matches: Matches) -> Matches | None:
    """Return matches that are more likely right than wrong, as points; ``None`` for too few."""
    likely = (matches.confidence > RELIABLE) & (matches.inverse_depth > matches.plane_step)
    unit = UNIT * torch.where(likely, matches.inverse_depth, torch.nan).nanmedian()
    reliable = replace(matches, confidence=likely.float(), plane_step=unit)
    read_above((reliable, 0.0), (matches, 0.0), (matches, RELIABLE))  # the last two are needed later
    return reliable if len(reliable.above(0.0)) >= MIN_RELIABLE else None


@torch.no_grad()
@has_kernel(
    "scale.kernels.search.fit_to_points",
    when=lambda x, points, metric, current=None: metric.space in KERNEL_FORMS,
)
def fit_to_points(
    x: Tensor, points: Matches, metric: MetricMap, current: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Fit both ends of one image's relative maps ``x (B, 1, h, w)`` to points, metres ``(B,)``.

    Takes the best of 1128 log-spaced pairs by mean Cauchy cost of inverse depth, so that some points may be
    wrong. The ``current`` ends are kept unless a better basin is found. The result is coarse and is improved
    by ``refine_to_matches``.
    """
    at = points.above(0.0)
    at = at[:: basin_stride(at)]
    target = points.inverse_depth.flatten()[at]
    values = _values_at(x, points.size, at)
    nearest, farthest = depth_span(points)
    low, high = (nearest / BASIN_RADIUS).log(), (farthest * BASIN_RADIUS).log()
    steps = torch.linspace(0, 1, BASIN_CANDIDATES, dtype=low.dtype, device=x.device)
    grid = torch.exp(low + (high - low) * steps)
    i, j = torch.triu_indices(len(grid), len(grid), 1, device=x.device)
    best_ends = []
    for b, row in enumerate(values):
        near, far = grid[i], grid[j]
        if current is not None:
            near, far = torch.cat([current[0][b : b + 1], near]), torch.cat([current[1][b : b + 1], far])
        depth_m = metric(row.expand(len(near), 1, 1, -1), metric.from_range(near, far))[:, 0, 0]
        e = (depth_m.reciprocal() - target) / (BASIN_CAUCHY * points.plane_step)
        cost = torch.log1p(e * e).mean(1)
        best = cost.argmin(keepdim=True)  # a 0-d index would be read back from the device
        if current is not None:
            best = torch.where(cost[:1] <= BASIN_KEEP * cost[best], torch.zeros_like(best), best)
        best_ends.append(torch.cat([near[best], far[best]]))
    nearest, farthest = torch.stack(best_ends).unbind(1)
    return nearest, farthest


@torch.no_grad()
def refine_to_matches(
    x: Tensor, matches: Matches, near_m: Tensor, far_m: Tensor, space: str
) -> tuple[Tensor, Tensor]:
    """Refine both ends of one image's relative maps ``x (B, 1, h, w)`` by a robust fit to matches, ``(B,)``.

    Matches have outliers, so they only refine ``near_m`` and ``far_m`` from the search and never replace
    them. A residual is the log ratio of inverse depths, each increased by the noise of a match. This is the
    relative error for accurate matches and symmetric near infinity, where a plain logarithm favours matches
    that err towards the camera. Residuals are weighted by the variances of match and map; the map's is
    measured in every iteration. An exact map thus follows its most accurate matches, an inexact one all of
    them.
    """
    if not len(matches.above(0.0)):  # counts all matches, as known points are few
        return near_m, far_m
    return _refined_ends(x, matches, near_m, far_m, space)


@has_kernel(
    "scale.kernels.points.refined_ends",
    when=lambda x, matches, near_m, far_m, space: space in KERNEL_FORMS,
)
def _refined_ends(
    x: Tensor, matches: Matches, near_m: Tensor, far_m: Tensor, space: str
) -> tuple[Tensor, Tensor]:
    """Compute ``refine_to_matches`` for at least one match."""
    at = matches.above(0.0)
    at = at[:: sampling_stride(at)]
    inverse = matches.inverse_depth.flatten()[at].clamp_min(0.0)
    confidence = matches.confidence.flatten()[at]
    doubt = ((1.0 - confidence) / REFERENCE_DOUBT).clamp_min(MIN_DOUBT)
    target = FitTarget(inverse, confidence, doubt.sqrt(), FIT_NOISE * matches.plane_step)
    values = _values_at(x, matches.size, at)
    form = SPACES[space]
    ends = _ends(form, near_m, far_m)
    lower = _ends(form, near_m / math.exp(NEAR_FACTOR), far_m / math.exp(FAR_FACTOR))
    upper = _ends(form, near_m * math.exp(NEAR_FACTOR), far_m * math.exp(FAR_FACTOR))
    bounds = torch.minimum(lower, upper), torch.maximum(lower, upper)
    for _ in range(FIT_ITERATIONS):
        ends = _refine_once(form, ends, values, target, bounds)
    at_zero, at_one = (form.forward(end, torch.ones_like(end)) for end in ends.unbind(1))
    return ordered(*form.ends(at_zero, at_one))


def _ends(form: Space, near_m: Tensor, far_m: Tensor) -> Tensor:
    """Return the affine values of the space at ``x = 0`` and ``x = 1``, ``(B, 2)``."""
    return torch.stack([form.inverse(end) for end in form.ends(near_m, far_m)], 1)


def ordered(near_m: Tensor, far_m: Tensor) -> tuple[Tensor, Tensor]:
    """Return both ends with near limited to ``FULLEST`` times far."""
    return torch.minimum(near_m, far_m * FULLEST), far_m


def _refine_once(
    form: Space, ends: Tensor, values: Tensor, target: FitTarget, bounds: tuple[Tensor, Tensor]
) -> Tensor:
    """Take one reweighted Gauss-Newton step on ``ends (B, 2)``, clamped to ``bounds``.

    With ``q_i`` the inverse depth of a match, ``n`` its noise, ``m_i(e)`` the map's inverse depth for the
    ends ``e``, and ``r_i(e) = log((q_i + n) / (m_i(e) + n))``, the steps minimize ``sum_i c_i C^2 log(1 +
    r_i^2 / (C^2 v_i))``, ``C = FIT_CAUCHY``, by ``e -= (J' W J)^-1 J' W r`` with ``W = diag(c_i / (v_i (1 +
    r_i^2 / (C^2 v_i))))``. The variance ``v_i`` is the match's at the map's depth plus the map's, from the
    weighted median of ``|r|``. Both are measured again in every step.
    """
    inverse, confidence, deviation, noise = target

    def log_depth(v: Tensor) -> Tensor:
        return form.forward(v, torch.ones_like(v)).clamp_min(1e-9).log()

    fractions = torch.stack([1.0 - values, values], -1)  # (B, P, 2)
    v = (fractions @ ends[:, :, None])[..., 0]
    span = (ends[:, 1:] - ends[:, :1]).abs()
    h = 1e-3 * torch.maximum(span, 1e-2 * ends.abs().amax(1, keepdim=True))
    # The relative noise is evaluated at the map's depth. At the match's depth, the nearer of two far matches
    # with opposite errors would weigh more.
    mapped = (-log_depth(v)).exp()
    above = mapped + noise
    residual = ((inverse + noise) / above).log().clamp(-1.0, 1.0)
    slope = mapped / above * (log_depth(v + h) - log_depth(v - h)) / (2.0 * h)
    map_deviation = SD_PER_MAD * weighted_quantile(residual.abs(), confidence.expand_as(residual), 0.5)
    floor = map_deviation.clamp_min(FIT_FLOOR)[:, None]
    variance = (deviation * noise / above) ** 2 + floor**2
    weight = confidence / (variance * (1.0 + residual**2 / (FIT_CAUCHY**2 * variance)))
    J = slope[..., None] * fractions
    normal = torch.einsum("bpi,bp,bpj->bij", J, weight, J)
    gradient = torch.einsum("bpi,bp,bp->bi", J, weight, residual)
    diagonal = normal.diagonal(dim1=1, dim2=2)
    # A single point does not constrain one direction; without enough damping rounding errors would choose it.
    damped = normal + torch.diag_embed(1e-4 * diagonal + 1e-12 * diagonal.sum(1, keepdim=True) + 1e-20)
    free = ends - torch.linalg.solve_ex(damped, gradient).result  # unchecked: a check would synchronize
    bound = torch.minimum(torch.maximum(free, bounds[0]), bounds[1])
    # If one end is at its bound, solve for the other end given that bound.
    change = bound - ends
    given_other = ends - (gradient + normal.flip(2).diagonal(dim1=1, dim2=2) * change.flip(1)) / (
        diagonal + 1e-20
    )
    solved = torch.where((bound != free).flip(1), given_other, bound)
    return torch.minimum(torch.maximum(solved, bounds[0]), bounds[1])


def _ranks(values: Tensor) -> Tensor:
    """Rank values along the last axis, centred and with unit norm; ties are ranked in their order."""
    ranks = values.argsort(-1).argsort(-1).float()
    ranks = ranks - ranks.mean(-1, keepdim=True)
    return ranks / ranks.norm(dim=-1, keepdim=True).clamp_min(1e-12)


@torch.no_grad()
def order_agreement(x: Tensor, matches: Matches, space: str) -> Tensor:
    """Compute Spearman's rank correlation ``(B,)`` between relative maps and one image's matches in nearness.

    ``x (B, 1, h, w)`` is the prior's map before guidance. NaN if fewer than 40 matches are reliable.

    Convention:
        Swapped cameras invert the depth order: -1 instead of +1.
    """
    at = matches.above(RELIABLE)
    if len(at) < MIN_ORDER_POINTS:
        return x.new_full((x.shape[0],), torch.nan)
    at = at[:: max(1, len(at) // ORDER_SAMPLES)]
    values = _values_at(x, matches.size, at)
    nearness = -values if SPACES[space].grows_with_depth else values
    ranks = _ranks(torch.cat([nearness, matches.inverse_depth.flatten()[at][None]]))
    return (ranks[:-1] * ranks[-1]).sum(-1)


def _values_at(x: Tensor, size: tuple[int, int], at: Tensor) -> Tensor:
    """Sample maps ``(B, 1, h, w)`` at flat indices of a grid of another size, ``(B, P)``."""
    return F.interpolate(x.float(), size, mode="bilinear", align_corners=False).flatten(1)[:, at]


def weighted_quantile(values: Tensor, weight: Tensor, fraction: float | Tensor) -> Tensor:
    """Compute quantiles ``(B,)`` of rows ``(B, P)``, subsampled if long; ``fraction`` may be ``(B, 1)``."""
    every = max(1, values.shape[1] // MAX_SORTED)
    values, order = values[:, ::every].sort(dim=1)
    below = weight[:, ::every].gather(1, order).cumsum(1)
    at = torch.searchsorted(below, fraction * below[:, -1:]).clamp_max(values.shape[1] - 1)
    return values.gather(1, at)[:, 0]
