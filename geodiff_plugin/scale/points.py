"""Scale from matches and points: choose a minimum of the search, fit within it, check the depth order.

Marigold-DC starts from the range of the points (Viola et al. 2024, Eq. 2).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._certain import SD_PER_MAD
from geodiff_plugin._kernels import use_kernel
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.matches import UNIT, read_above
from geodiff_plugin.scale.space import KERNEL_FORMS, SPACES, SQUARE, MetricMap, Space

#: Matches above this confidence are reliable: more likely right than wrong.
RELIABLE = 0.5
#: Fewer reliable matches than this are not used: they may all lie on one wrong surface.
FEWEST_RELIABLE = 50
#: Candidates of near, and of far, in the search by points or reliable matches: 1128 pairs.
BASIN_CANDIDATES = 48
#: Upper bound on the points of that search, which bounds its time.
BASIN_SAMPLES = 1500
#: Factor by which the candidates reach beyond the range of the points.
BASIN_REACH = 4.0
#: Width of the Cauchy cost in units of the points, about the error of a prior.
BASIN_CAUCHY = 32.0
#: The current state stays if its cost is within this factor of the best: a new one restarts scale and shift.
BASIN_KEEP = 1.05
#: Reweighted Gauss-Newton steps on near and far: a fixed number, so that no GPU is waited for.
FIT_ITERATIONS = 12
#: Upper bound on the matches of the fit, which bounds its time.
FIT_SAMPLES = 8000
#: Upper bound on the values that are sorted for a quantile.
MOST_SORTED = 20_000
#: Standard deviation of a match of confidence .96, planes.
FIT_NOISE = 0.5
#: Least standard deviation of the map's residuals, log depth.
FIT_FLOOR = 4e-3
#: Width of the Cauchy weight, in standard deviations of match and map together.
FIT_CAUCHY = 2.0
#: Bound of the change of near in the fit, as a log factor: the fit must stay in its basin.
NEAR_REACH = 1.4
#: The same of far.
FAR_REACH = 0.7
#: Upper bound on the reliable matches whose depth order is compared with the prior's.
ORDER_SAMPLES = 4000
#: Lower bound on them: the rank correlation of fewer is chance.
ORDER_FEWEST = 40
#: The variance of a match is proportional to its doubt, ``1 - confidence``: so it was on pairs with truth.
#: ``FIT_NOISE`` holds at this doubt.
REFERENCE_DOUBT = 0.04
#: Lower doubts count as this share of it at least.
LEAST_DOUBT = 0.16
#: Near is at most this share of far: an empty range has no scale.
FULLEST = 0.98


class FitTarget(NamedTuple):
    """What relative maps of one image are fitted to: ``P`` matches of it."""

    inverse_depth: Tensor  # (P,) 1/m, >= 0
    confidence: Tensor  # (P,) above 0
    deviation: Tensor  # (P,) standard deviation, in units of ``noise``
    noise: Tensor  # () 1/m, that of a match of the reference confidence


def depth_span(points: Matches) -> tuple[Tensor, Tensor]:
    """Metres, ``()`` each, of the nearest and the farthest point."""
    inverse_depth = points.inverse_depth.flatten()[points.above(0.0)]
    return inverse_depth.amax().reciprocal(), inverse_depth.amin().reciprocal()


def reliable_matches(matches: Matches) -> Matches | None:
    """Matches that are more likely right than wrong, in the form of points; ``None`` for too few."""
    likely = (matches.confidence > RELIABLE) & (matches.inverse_depth > matches.plane_step)
    unit = UNIT * torch.where(likely, matches.inverse_depth, torch.nan).nanmedian()
    reliable = replace(matches, confidence=likely.float(), plane_step=unit)
    read_above((reliable, 0.0), (matches, 0.0), (matches, RELIABLE))  # these two are needed later
    return reliable if len(reliable.above(0.0)) >= FEWEST_RELIABLE else None


@torch.no_grad()
def fit_to_points(
    x: Tensor, points: Matches, metric: MetricMap, current: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Metres ``(B,)`` of both ends of one image's relative maps ``x (B, 1, h, w)`` that explain points best.

    The best of 1128 log-spaced pairs in mean Cauchy cost of inverse depth, so that some points may be wrong;
    ``current`` ends stay unless a better basin shows up. Coarse: ``refine_to_matches`` does the rest.
    """
    if use_kernel(x) and metric.space in KERNEL_FORMS:
        from geodiff_plugin.scale import search_kernels

        return search_kernels.basin(x, points, metric.space, metric.positive == SQUARE, current)
    at = points.above(0.0)
    at = at[:: basin_stride(at)]
    target = points.inverse_depth.flatten()[at]
    values = _values_at(x, points.size, at)
    nearest, farthest = depth_span(points)
    low, high = (nearest / BASIN_REACH).log(), (farthest * BASIN_REACH).log()
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
    """Metres ``(B,)`` of both ends of one image's relative maps ``x (B, 1, h, w)``: a robust fit to matches.

    Matches have outliers, so they refine ``near_m`` and ``far_m``, the search's result, and never replace it.
    A residual is the log ratio of inverse depths, to each of which the noise of a match is added: a relative
    error where matches are exact, and symmetric near infinity, where a plain logarithm favours matches that
    err towards the camera. It is weighted by the variances of its match and of the map, whose residuals are
    measured at every iteration: an exact map follows its most exact matches, an inexact one all of them.
    """
    at = matches.above(0.0)  # all of them: known points are few
    if not len(at):
        return near_m, far_m
    if use_kernel(x) and space in KERNEL_FORMS:
        from geodiff_plugin.scale import kernels

        return kernels.refined_range(x, matches, near_m, far_m, space)
    at = at[:: sampling_stride(at)]
    inverse = matches.inverse_depth.flatten()[at].clamp_min(0.0)
    confidence = matches.confidence.flatten()[at]
    doubt = ((1.0 - confidence) / REFERENCE_DOUBT).clamp_min(LEAST_DOUBT)
    target = FitTarget(inverse, confidence, doubt.sqrt(), FIT_NOISE * matches.plane_step)
    values = _values_at(x, matches.size, at)
    form = SPACES[space]
    ends = _ends(form, near_m, far_m)
    lower = _ends(form, near_m / math.exp(NEAR_REACH), far_m / math.exp(FAR_REACH))
    upper = _ends(form, near_m * math.exp(NEAR_REACH), far_m * math.exp(FAR_REACH))
    bounds = torch.minimum(lower, upper), torch.maximum(lower, upper)
    for _ in range(FIT_ITERATIONS):
        ends = _refine_once(form, ends, values, target, bounds)
    at_zero, at_one = (form.forward(end, torch.ones_like(end)) for end in ends.unbind(1))
    return ordered(*form.ends(at_zero, at_one))


def basin_stride(at: Tensor) -> int:
    """Every so many of the points ``at (P,)`` take part in the search for a basin."""
    return max(1, -(-len(at) // BASIN_SAMPLES))


def sampling_stride(at: Tensor) -> int:
    """Every so many of the matches ``at (P,)`` are fitted to."""
    return max(1, len(at) // FIT_SAMPLES)


def _ends(form: Space, near_m: Tensor, far_m: Tensor) -> Tensor:
    """``(B, 2)``: what the space is affine in, at ``x = 0`` and at ``x = 1``."""
    return torch.stack([form.inverse(end) for end in form.ends(near_m, far_m)], 1)


def ordered(near_m: Tensor, far_m: Tensor) -> tuple[Tensor, Tensor]:
    """Both ends, near at most ``FULLEST`` of far."""
    return torch.minimum(near_m, far_m * FULLEST), far_m


def _refine_once(
    form: Space, ends: Tensor, values: Tensor, target: FitTarget, bounds: tuple[Tensor, Tensor]
) -> Tensor:
    """One reweighted Gauss-Newton step on ``ends (B, 2)``, kept within ``bounds``.

    With ``q_i`` the inverse depth of a match, ``n`` its noise, ``m_i(e)`` that of the map at the ends ``e``,
    and ``r_i(e) = log((q_i + n) / (m_i(e) + n))``, the steps minimise ``sum_i c_i C^2 log(1 + r_i^2 / (C^2
    v_i))``, ``C = FIT_CAUCHY``, by ``e -= (J' W J)^-1 J' W r`` with ``W = diag(c_i / (v_i (1 + r_i^2 / (C^2
    v_i))))``. The variance ``v_i`` is that of the match at the map's depth plus that of the map, the weighted
    median of ``|r|``; both are measured anew in every step.
    """
    inverse, confidence, deviation, noise = target

    def log_depth(v: Tensor) -> Tensor:
        return form.forward(v, torch.ones_like(v)).clamp_min(1e-9).log()

    shares = torch.stack([1.0 - values, values], -1)  # (B, P, 2)
    v, gap = (shares @ ends[:, :, None])[..., 0], (ends[:, 1:] - ends[:, :1]).abs()
    h = 1e-3 * torch.maximum(gap, 1e-2 * ends.abs().amax(1, keepdim=True))
    # The relative noise is taken at the map's depth. At the match's depth, of two far matches with opposite
    # errors the nearer one would count for more.
    mapped = (-log_depth(v)).exp()
    above = mapped + noise
    residual = ((inverse + noise) / above).log().clamp(-1.0, 1.0)
    slope = mapped / above * (log_depth(v + h) - log_depth(v - h)) / (2.0 * h)
    left_over = SD_PER_MAD * weighted_quantile(residual.abs(), confidence.expand_as(residual), 0.5)
    floor = left_over.clamp_min(FIT_FLOOR)[:, None]
    variance = (deviation * noise / above) ** 2 + floor**2
    weight = confidence / (variance * (1.0 + residual**2 / (FIT_CAUCHY**2 * variance)))
    J = slope[..., None] * shares
    normal = torch.einsum("bpi,bp,bpj->bij", J, weight, J)
    gradient = torch.einsum("bpi,bp,bp->bi", J, weight, residual)
    diagonal = normal.diagonal(dim1=1, dim2=2)
    # One point leaves a direction undetermined; with less damping rounding errors would choose along it.
    damped = normal + torch.diag_embed(1e-4 * diagonal + 1e-12 * diagonal.sum(1, keepdim=True) + 1e-20)
    free = ends - torch.linalg.solve_ex(damped, gradient).result  # unchecked: a check waits for the device
    bound = torch.minimum(torch.maximum(free, bounds[0]), bounds[1])
    # If one end is at its bound, the other end is solved for that.
    moved = bound - ends
    alone = ends - (gradient + normal.flip(2).diagonal(dim1=1, dim2=2) * moved.flip(1)) / (diagonal + 1e-20)
    solved = torch.where((bound != free).flip(1), alone, bound)
    return torch.minimum(torch.maximum(solved, bounds[0]), bounds[1])


def _ranks(values: Tensor) -> Tensor:
    """Ranks along the last axis, about 0 and of length 1; equal values are ranked as they come."""
    ranks = values.argsort(-1).argsort(-1).float()
    ranks = ranks - ranks.mean(-1, keepdim=True)
    return ranks / ranks.norm(dim=-1, keepdim=True).clamp_min(1e-12)


@torch.no_grad()
def order_agreement(x: Tensor, matches: Matches, space: str) -> Tensor:
    """Spearman's rank correlation ``(B,)`` of nearness in relative maps with that in matches of one image.

    ``x (B, 1, h, w)`` is of the prior alone. NaN if fewer than 40 matches are reliable.

    Convention:
        Cameras in the wrong order turn near into far: -1 where +1 is right.
    """
    at = matches.above(RELIABLE)
    if len(at) < ORDER_FEWEST:
        return x.new_full((x.shape[0],), torch.nan)
    at = at[:: max(1, len(at) // ORDER_SAMPLES)]
    values = _values_at(x, matches.size, at)
    nearness = -values if SPACES[space].grows_with_depth else values
    ranks = _ranks(torch.cat([nearness, matches.inverse_depth.flatten()[at][None]]))
    return (ranks[:-1] * ranks[-1]).sum(-1)


def _values_at(x: Tensor, size: tuple[int, int], at: Tensor) -> Tensor:
    """``(B, P)`` values of maps ``(B, 1, h, w)`` at flat indices of a grid of another size."""
    return F.interpolate(x.float(), size, mode="bilinear", align_corners=False).flatten(1)[:, at]


def weighted_quantile(values: Tensor, weight: Tensor, share: float | Tensor) -> Tensor:
    """``(B,)`` of rows ``(B, P)``, long ones sampled, with weights >= 0; ``share`` may be ``(B, 1)``."""
    every = max(1, values.shape[1] // MOST_SORTED)
    values, order = values[:, ::every].sort(dim=1)
    below = weight[:, ::every].gather(1, order).cumsum(1)
    at = torch.searchsorted(below, share * below[:, -1:]).clamp_max(values.shape[1] - 1)
    return values.gather(1, at)[:, 0]
