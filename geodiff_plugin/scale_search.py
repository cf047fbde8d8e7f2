"""Find the metres of a relative map by lookup in a plane-sweep volume, and refine them on matches.

Hop: ``CostVolume``, relative map ``x (B, 1, h, w)`` -> depths of ``x = 0`` and ``x = 1``, per sample.
Paper: S7.3 (pre-selection of g_s, "a variant of the traditional Plane Sweep Volume technique").

The paper's one number, x = g_s x_rel, prefers depths at which every pixel leaves the right image;
(near, far) jointly, on pixels that stay in view, does not (docs/paper-map.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.matching import CostVolume, Matches

__all__ = ["ScaleSearch", "argmin_over", "refine_to_matches", "search_scale"]

#: Cost beyond which a pixel counts as an outlier (occluded, mirrored, mistaken by the prior).
COST_CLAMP = 0.35
SAMPLES = 6000
COARSE_SAMPLES = 1500  # enough to tell basins apart; the finer grids look at all of them
COARSE = 48  # 1128 pairs near < far
FINE = 13
#: A current state this close to the best cost found stays: re-anchoring restarts the affine updates.
KEEP_MARGIN = 2e-3
#: Fit to matches: width of the Cauchy weight in planes, how far near and far may move (log factor), what
#: counts as a sure match, how many of them a quantile needs, and which quantile the prior calls 0.
CAUCHY_PLANES, LOG_NEAREST, LOG_FARTHEST, SURE, MIN_SURE, NEAR_QUANTILE = 8.0, 1.4, 0.7, 0.5, 50, 0.02
#: Least share of the pixels that must stay in the right image.
MIN_SEEN_RECTIFIED, MIN_SEEN_POSED = 0.6, 0.25


@dataclass(frozen=True)
class ScaleSearch:
    """Result of a search, ``(B,)`` each.

    Attributes:
        near_m: metres, depth of the nearest end of the relative map.
        far_m: metres, depth of its farthest end.
        cost: mean clamped census cost there, [0, 0.35].
        on_edge: the best pair touches the far end of the range, or the near end of a given range.
        kept: the current state was as good and stays.
    """

    near_m: Tensor
    far_m: Tensor
    cost: Tensor
    on_edge: Tensor
    kept: Tensor


def _sample_positions(height: int, width: int, device: torch.device) -> Tensor:
    """Flat indices of about ``SAMPLES`` pixels on a regular, offset grid: the same ones every time."""
    stride = max(1, round((height * width / SAMPLES) ** 0.5))
    rows = torch.arange(stride // 2, height, stride, device=device)
    columns = torch.arange(stride // 2, width, stride, device=device)
    return (rows[:, None] * width + columns[None]).flatten()


def _depth_at(x: Tensor, near: Tensor, far: Tensor, space: str) -> Tensor:
    """Metres at relative values ``x (..., P)`` for ranges ``(..., 1)``; monotone between near and far."""
    if space == "depth":
        return near + (far - near) * x
    if space == "log":
        return near * (far / near) ** x
    if space == "log1p":
        return torch.expm1(torch.lerp(torch.log1p(near), torch.log1p(far), x))
    power = 1.0 if space == "disparity" else 0.5
    low, high = far**-power, near**-power
    return (low + (high - low) * x) ** (-1.0 / power)


def _lookup(
    volume_cost: Tensor, seen: Tensor, inverse_depth: Tensor, depth_m: Tensor
) -> tuple[Tensor, Tensor]:
    """Mean clamped cost and seen share ``(M,)`` of candidate depths ``(M, P)``, linear between planes."""
    planes = inverse_depth.shape[0]
    step = (inverse_depth[-1] - inverse_depth[0]) / (planes - 1)
    position = (1.0 / depth_m - inverse_depth[0]) / step
    inside = (position >= 0) & (position <= planes - 1)
    position = position.clamp(0, planes - 1)
    below = position.floor().clamp_max(planes - 2).long()
    weight = position - below
    cost = torch.lerp(volume_cost.gather(0, below), volume_cost.gather(0, below + 1), weight).clamp_max(
        COST_CLAMP
    )
    # Beyond the nearest plane nothing is known: as bad as an outlier, and not out of view.
    cost = torch.where(inside, cost, torch.full_like(cost, COST_CLAMP))
    visible = seen.gather(0, below) | ~inside
    count = visible.sum(1)
    return (cost * visible).sum(1) / count.clamp_min(1), count / depth_m.shape[1]


@torch.no_grad()
def search_scale(
    volume: CostVolume,
    x: Tensor,
    space: str,
    *,
    depth_range: tuple[float, float] | None = None,
    current: tuple[Tensor, Tensor] | None = None,
) -> ScaleSearch:
    """Depths of the two ends of a relative map that the two views agree on best.

    Args:
        volume: plane-sweep costs of the image.
        x: ``(B, 1, h, w)`` relative maps of that image, about [0, 1], >= 0.
        space: what ``x`` is affine in, key of ``metric.SPACES``; in disparity spaces ``x = 1`` is near.
        depth_range: ``(near, far)`` metres, bounds of the search; by default from the volume's nearest
            plane to where the shift is 0.3 px.
        current: depths ``(B,)`` of ``x = 0`` and ``x = 1`` in use, to be kept unless a better basin shows up.

    Returns:
        ``ScaleSearch``. 1128 (near, far) pairs, log-spaced, then two finer grids around the best.

    Source: S7.3. Deviation: two numbers instead of one, clamped census cost instead of L_geo.
    """
    low, high = volume.reach_m if depth_range is None else depth_range
    height, width = volume.size
    at = _sample_positions(height, width, x.device)
    cost, seen = volume.cost.flatten(1)[:, at], volume.in_view.flatten(1)[:, at]
    least = MIN_SEEN_RECTIFIED if volume.rectified else MIN_SEEN_POSED
    values = F.interpolate(x.float(), (height, width), mode="bilinear", align_corners=False).flatten(1)[:, at]
    grid = torch.linspace(0, 1, COARSE, device=x.device)
    log_low, log_span = math.log(low), math.log(high / low)
    i, j = torch.triu_indices(COARSE, COARSE, 1, device=x.device)
    offsets = torch.linspace(-1, 1, FINE, device=x.device)
    found = []
    for b in range(x.shape[0]):

        def best_of(
            near: Tensor, far: Tensor, row: Tensor = values[b], every: int = 1
        ) -> tuple[Tensor, Tensor, Tensor]:
            depth = _depth_at(row[None, ::every], near[:, None], far[:, None], space)
            mean, share = _lookup(cost[:, ::every], seen[:, ::every], volume.inverse_depth, depth)
            mean = mean + (share < least) * 1.0  # only if no pair keeps enough in view does one of these win
            k = mean.argmin()
            return near[k], far[k], mean[k]

        def to_m(u: Tensor) -> Tensor:
            return torch.exp(log_low + log_span * u)

        near, far, mean = best_of(to_m(grid[i]), to_m(grid[j]), every=max(1, len(at) // COARSE_SAMPLES))
        reach = log_span / (COARSE - 1)
        for _ in range(2):
            n = near.log() + reach * offsets.repeat_interleave(FINE)
            f = far.log() + reach * offsets.repeat(FINE)
            n, f = n.exp().clamp(low, high), f.exp().clamp(low, high)
            near, far, mean = best_of(torch.minimum(n, f), torch.maximum(n, f))
            reach = reach / (FINE - 1) * 2
        # The volume's own near end lies nearer than anything seen, so only a given one can cut a scene off.
        on_edge = (far >= high * 0.98) | ((near <= low * 1.02) & (depth_range is not None))
        kept = torch.zeros((), dtype=torch.bool, device=x.device)
        if current is not None:
            a, c = (v[b : b + 1] for v in current)
            now = best_of(torch.minimum(a, c), torch.maximum(a, c))
            kept = now[2] <= mean + KEEP_MARGIN
            near, far, mean = (
                torch.where(kept, old, new) for old, new in zip(now, (near, far, mean), strict=True)
            )
        found.append((near, far, mean, on_edge, kept))
    return ScaleSearch(*(torch.stack(column) for column in zip(*found, strict=True)))


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
        return _ordered(fit)
    nearest = -torch.quantile(target[sure], 1.0 - NEAR_QUANTILE).log()
    fit = torch.stack(
        [torch.minimum(fit[:, 0], torch.maximum(nearest, start[:, 0] - LOG_NEAREST)), fit[:, 1]], 1
    )
    for _ in range(iterations):
        fit = _refine_once(fit, start, values, target, weight, matches.plane_step, space, (False, True))
    return _ordered(fit)


def _ordered(fit: Tensor) -> tuple[Tensor, Tensor]:
    near, far = fit.exp().unbind(1)
    return torch.minimum(near, far * 0.98), far


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
        return (1.0 / _depth_at(values, p[:, :1].exp(), p[:, 1:].exp(), space) - target) / plane_step

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


def argmin_over(candidates: Tensor, cost: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """The candidate of least cost per sample, and whether it is the first or the last one.

    Args:
        candidates: ``(M,)``.
        cost: one candidate (0-d) -> ``(B,)``.

    Returns:
        best ``(B,)`` and ``on_edge (B,)`` bool.

    Source: S7.3, ``g_s* = argmin L_geo``.
    """
    with torch.no_grad():
        index = torch.stack([cost(c) for c in candidates]).argmin(0)
    return candidates[index], (index == 0) | (index == len(candidates) - 1)
