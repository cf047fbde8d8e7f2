"""Fit a metric map to its matches and points by edge-aware least squares, stiffer for a better prior."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import launch_bound, use_kernel
from geodiff_plugin.algorithm.solver import RobustField, RobustSystem, solve_robust
from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.geometry import image_size, to_device_of
from geodiff_plugin.matching import Matches, with_points
from geodiff_plugin.scale.points import weighted_quantile

#: Longer side in pixels of the grid for which ``smoothness``, ``IMAGE_EDGE`` and ``DEPTH_EDGE`` hold; on
#: other grids they are scaled, so that a correction reaches the same share of the image.
REFERENCE_SIDE = 512.0
#: Error of the prior at which ``smoothness`` and ``INERTIA`` hold.
REFERENCE_ERROR = 0.05
#: Both fall with this power of the error: a weak prior's map hardly resists its matches.
STIFFNESS_POWER = 4.0
#: Lower bound of the smoothness: the map of a useless prior still carries a match to its neighbours.
LOOSEST = 0.03
#: Upper bound of the smoothness: the map of an exact prior still gives way over wide regions.
STIFFEST = 100.0
#: Weight of the squared correction, so that pixels far from every match keep their depth.
INERTIA = 0.015
#: Lower bound of the inertia in the last pass: without any the correction far from matches is undetermined.
LEAST_INERTIA = 5e-4
#: Upper bound of the inertia: more would hold back the correction at the matches themselves.
MOST_INERTIA = 0.03
#: Passes of a fit; the smoothness falls geometrically from a broad one to that of the prior's error.
PASSES = 3
#: Least smoothness of the first pass: it corrects whole regions.
BROAD_SMOOTHNESS = 50.0
#: Least inertia of the first pass: low, so that it corrects even far from any match.
BROAD_INERTIA = 1e-4
#: Smoothness of the fit that measures the prior and finds outliers: it bends the map over wide regions only.
STIFF_SMOOTHNESS = 400.0
#: Inertia of that fit, as a share of its smoothness.
STIFF_INERTIA = 1.3e-3
#: Robustly reweighted solves of a pass: a fixed number, so that no GPU is waited for.
REWEIGHTINGS = 2
#: Conjugate-gradient steps of a solve on every level of its pyramid, which truncate it: see ``fit_depth``.
SOLVER_STEPS = 6
#: Residual, in standard deviations of a match, from which it counts for less.
RESIDUAL_CAUCHY = 2.5
#: Side of the blocks of matches left out to measure the prior, in image sides.
BLOCK = 0.08
#: Least error that is assumed of a prior, in log depth: matches cannot measure a smaller one.
LEAST_ERROR = 0.01
#: The largest error: that of a useless prior.
MOST_ERROR = 0.5
#: Of fewer points the measured error is partly chance: the fewer, the nearer to the largest it is taken.
FEW_POINTS = 100
#: Step in brightness across which a correction does not spread.
IMAGE_EDGE = 0.1
#: Step in log depth across which it does not.
DEPTH_EDGE = 0.1
#: Share of the smoothness that remains across any edge.
LEAST_LINK = 1e-3
#: Reach of a match over an edge, as a share of the longer side.
EDGE_REACH = 0.006
#: Step in log depth that is an edge.
EDGE_STEP = 0.3
#: Above this error of the prior, ``EDGE_STEP`` grows with its third power: its edges are in wrong places.
EDGE_ERROR = 0.11
#: The prior's error is measured at this quantile of the correct matches' residuals: the median would miss
#: that a fifth of the scene is on a wrong surface.
SHARE = 0.8
#: The same quantile of the size of a normal variable, by which it is divided.
NORMAL_QUANTILE = 1.2816


class _Residuals(NamedTuple):
    """Matches against a map on their grid, ``(B, 1, h, w)`` each."""

    residual: Tensor  # log of a match's inverse depth over the map's
    noise: Tensor  # its standard deviation
    weight: Tensor  # confidence over relative variance


class _Observations(NamedTuple):
    """``_Residuals`` with what else a fit needs of its grid."""

    residual: Tensor
    noise: Tensor
    weight: Tensor
    confidence: Tensor  # (B, 1, h, w) of the matches
    links: tuple[Tensor, Tensor]  # ``edge_links``, across and down, at a smoothness of 1


def _observations(depth_m: Tensor, target: Matches, left_01: Tensor, config: GuidanceConfig) -> _Observations:
    guide = F.interpolate(left_01.float(), target.size, mode="bilinear", antialias=True)
    log_depth = log_depth_at(depth_m, target.size)
    residuals = _residuals(log_depth, target, config.match_noise)
    return _Observations(*residuals, target.confidence, edge_links(guide, log_depth))


def _residuals(log_depth: Tensor, target: Matches, match_noise: float) -> _Residuals:
    """Matches against the log of a map on their grid."""
    if use_kernel(log_depth):
        from geodiff_plugin.algorithm import correction_kernels as kernels

        return _Residuals(*kernels.residuals(log_depth, target, match_noise))
    matched, step = target.inverse_depth.clamp_min(1e-9), target.plane_step.view(-1, 1, 1, 1)
    noise = ((step / matched) ** 2 + match_noise**2).sqrt()
    weight = target.confidence * (match_noise / noise) ** 2
    residual = torch.where(weight > 0, matched.log() + log_depth, torch.zeros_like(matched))
    return _Residuals(residual, noise, weight)


def log_depth_at(depth_m: Tensor, size: tuple[int, int]) -> Tensor:
    """The log of a map ``(B, 1, H, W)`` on another grid."""
    return F.interpolate(depth_m.float().log(), size, mode="bilinear", align_corners=False)


def edge_links(guide: Tensor, log_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Strength with which neighbours across and down share a correction, one per pair of them.

    ``guide (B, 3, h, w)`` and ``log_depth (B, 1, h, w)`` lie on one grid; it falls at the edges of both.
    """
    if use_kernel(guide):
        from geodiff_plugin.algorithm import correction_kernels as kernels

        return kernels.edge_links(guide, log_depth)
    return _links_along(-1, guide, log_depth), _links_along(-2, guide, log_depth)


def _links_along(axis: int, guide: Tensor, log_depth: Tensor) -> Tensor:
    scale = max(guide.shape[-2:]) / REFERENCE_SIDE
    step = guide.diff(dim=axis).abs().mean(1, keepdim=True) / IMAGE_EDGE
    jump = log_depth.diff(dim=axis).abs() / DEPTH_EDGE
    return scale**2 * torch.exp(-scale * (step + jump)).clamp_min(LEAST_LINK)


def local_error(error: Tensor | None, valid: Tensor | None) -> Tensor | None:
    """A prior's ``error (B, 1, 1, 1)`` where it gives a depth, ``MOST_ERROR`` elsewhere, ``(B, 1, H, W)``.

    ``valid (B, 1, H, W)`` is above 0 where the prior gives a depth; ``None`` returns ``error`` itself.
    """
    if error is None or valid is None:
        return error
    return torch.where(valid > 0, error, torch.full_like(error, MOST_ERROR))


def _on_grid(error: Tensor, size: tuple[int, int]) -> Tensor:
    """A ``local_error`` on another grid; one number per sample is returned unchanged."""
    if image_size(error) in ((1, 1), size):
        return error
    return F.interpolate(error, size, mode="nearest-exact")


def correction_target(
    matches: Matches | None,
    points: Matches | None,
    kept: Tensor | None,
    error: Tensor | None,
    depth_m: Tensor,
) -> Matches | None:
    """What an estimate is fitted to: points, and matches that are no reflections and not beside its edges.

    ``matches`` and ``points`` are on one grid; ``kept`` is the factor on each match's confidence that removes
    reflections (``None``: no match is used yet), ``error`` that of the prior, ``None`` until it is measured.
    """
    if matches is None or kept is None:
        return None if points is None else with_points(None, points)
    if image_size(kept) != matches.size:
        kept = F.interpolate(kept, matches.size, mode="bilinear", align_corners=False)
    matches = replace(matches, confidence=kept * matches.confidence)
    if error is not None:
        matches = off_edges(matches, depth_m, error)
    return matches if points is None else with_points(matches, points)


@torch.no_grad()
def off_edges(target: Matches, depth_m: Tensor, error: Tensor) -> Matches:
    """Matches with less confidence near the depth edges of a map.

    A matching window across an edge gives both sides the depth of the nearer surface. Known points have no
    window and do not belong here. Above ``EDGE_ERROR`` a prior errs in its edges: matches lose less.
    """
    size = target.size
    log_depth = log_depth_at(depth_m, size)
    reach = max(1, round(EDGE_REACH * max(size)))
    error = _on_grid(error, size)
    if use_kernel(log_depth):
        from geodiff_plugin.algorithm import correction_kernels as kernels

        return replace(target, confidence=kernels.off_edges(target.confidence, log_depth, error, reach))
    span = range_around(log_depth, reach)
    width = EDGE_STEP * (error / EDGE_ERROR).clamp_min(1.0) ** 3
    return replace(target, confidence=target.confidence / (1.0 + (span / width) ** 2))


def range_around(values: Tensor, reach: int) -> Tensor:
    """The largest less the least value of a square window, of a map ``(B, 1, H, W)``."""
    return highest(torch.cat([values, -values], 1), reach).sum(1, keepdim=True)


def highest(values: Tensor, reach: int) -> Tensor:
    """The largest value of a square window, rows and columns one after the other, by windows that double."""
    side = 2 * reach + 1
    if launch_bound(values):
        across = F.max_pool2d(values, (1, side), 1, (0, reach))
        return F.max_pool2d(across, (side, 1), 1, (reach, 0))
    values = F.pad(values, (reach,) * 4, mode="replicate")
    for axis in (-1, -2):
        covered = 1
        while covered < side:
            step, last = min(covered, side - covered), values.shape[axis]
            shifted = (values.narrow(axis, first, last - step) for first in (0, step))
            values = torch.maximum(*shifted)
            covered += step
    return values


def _stiff(observed: _Observations, trusted: Tensor, error: Tensor, config: GuidanceConfig) -> RobustField:
    """The correction that follows matches over wide regions only, and their weights at what it leaves.

    ``trusted`` may be several sets of weights, as for ``solve_robust``. A residual counts half at
    ``outlier_width`` standard deviations of match and prior together.
    """
    stiff = error.new_full((1, len(error), 1, 1, 1), STIFF_SMOOTHNESS)
    inertia = error.new_full((1, len(error), 1, 1, 1), STIFF_INERTIA * STIFF_SMOOTHNESS)
    of_data = observed.residual, trusted, observed.noise
    system = RobustSystem(*of_data, error, config.outlier_width, observed.links, stiff, inertia)
    return solve_robust(system, REWEIGHTINGS + 1, SOLVER_STEPS)


def _spread(residual: Tensor, observed: _Observations) -> Tensor:
    """``(B, 1, 1, 1)`` robust standard deviation of residuals, less their matches' noise, within bounds.

    The largest residuals are left out, as many as matches are expected to be wrong by their confidence. No
    match: ``MOST_ERROR``.
    """
    if use_kernel(residual):
        from geodiff_plugin.algorithm import correction_kernels as kernels

        return kernels.spread(residual, observed.noise, observed.weight, observed.confidence)
    weight = observed.weight.flatten(1)
    right = (observed.weight * observed.confidence.clamp_max(1.0)).flatten(1).sum(1, keepdim=True)
    correct_share = right / weight.sum(1, keepdim=True).clamp_min(1e-9)
    largest = weighted_quantile(residual.abs().flatten(1), weight, SHARE * correct_share)
    noise = weighted_quantile(observed.noise.flatten(1), weight, 0.5)
    beyond = ((largest / NORMAL_QUANTILE) ** 2 - noise**2 / 4.0).clamp_min(0.0).sqrt()
    beyond = torch.where(weight.sum(1) > 0, beyond, MOST_ERROR)
    return beyond.view(-1, 1, 1, 1).clamp(LEAST_ERROR, MOST_ERROR)


@torch.no_grad()
def prior_error(
    depth_m: Tensor, target: Matches, left_01: Tensor, config: GuidanceConfig = DEFAULT
) -> Tensor:
    """Error of a prior in log depth, ``(B, 1, 1, 1)`` within ``LEAST_ERROR`` and ``MOST_ERROR``.

    Cross-validation: matches are left out in blocks and predicted from the other blocks by the prior's map
    under a stiff correction. This measures the map between matches, not how well it can be bent to them.
    Arguments as ``fit_depth``, for a map that matches have moved in scale and shift only.
    """
    observed = _observations(depth_m, target, left_01, config)
    height, width = observed.residual.shape[-2:]
    side = max(1, round(BLOCK * max(height, width)))
    is_odd = np.concatenate([np.arange(n) // side % 2 for n in (height, width)]) > 0
    odd_row, odd_column = to_device_of(depth_m, is_odd).split([height, width])
    black = odd_row[:, None] != odd_column
    weight_of_black = observed.weight * black
    first = _spread(observed.residual, observed)
    trusted = torch.cat([weight_of_black, observed.weight - weight_of_black])
    of_black, of_white = _stiff(observed, trusted, first, config).field.chunk(2)
    error = _spread(torch.where(black, of_white, of_black) - observed.residual, observed)
    count = (observed.weight > 0).sum((1, 2, 3), keepdim=True, dtype=torch.float32)
    share = (count / FEW_POINTS).clamp_max(1.0)
    return error**share * MOST_ERROR ** (1.0 - share)


class DepthFit(NamedTuple):
    """A map that was fitted to matches and points, and how."""

    depth_m: Tensor  # (B, 1, H, W) metres
    support: Tensor  # (B, 1, H, W) in [0, 1], how far the matches determine it
    correction: Tensor  # (B, 1, h, w) on the grid of the matches, by which the log of depth was lowered


@torch.no_grad()
def fit_depth(
    depth_m: Tensor, target: Matches, left_01: Tensor, error: Tensor, config: GuidanceConfig = DEFAULT
) -> DepthFit:
    """Least-squares correction of log depth that follows matches and stops at edges.

    With ``u`` the correction and ``r`` the residual of each match after earlier passes, a pass goes towards
    the minimiser of ``sum w (u - r)^2 + a sum g |grad u|^2 + b sum u^2``: ``w`` is the confidence over the
    match's relative variance, robustly reweighted, and ``g`` falls at edges of the image and of the given
    depth. Passes go from a broad ``a`` to that of the prior's error: a pixel far from matches keeps the
    correction that the broad passes gave its region. Every solve is truncated after ``SOLVER_STEPS``
    conjugate-gradient steps on each grid of a pyramid, a fixed number, so that no GPU is waited for.
    ``tests/unit/test_solver.py`` bounds how far that leaves the depth from the exact minimisers.

    Args:
        depth_m: ``(B, 1, H, W)`` metres, at any resolution.
        target: matches or known points of the same images, on any grid.
        left_01: ``(B, 3, h, w)`` in [0, 1], the left images at any resolution.
        error: ``prior_error`` or ``local_error``; matches that contradict a good prior count for less.
        config: the fit's numbers.
    """
    observed = _observations(depth_m, target, left_01, config)
    error = _on_grid(error, target.size)
    trusted = _stiff(observed, observed.weight, error, config).weights
    of_data, levels = (observed.residual, trusted, observed.noise), _levels(error, config)
    system = RobustSystem(*of_data, None, RESIDUAL_CAUCHY, observed.links, *levels)
    total, _, decided = solve_robust(system, REWEIGHTINGS, SOLVER_STEPS, with_support=True)
    assert decided is not None  # it was asked for
    size = image_size(depth_m)
    change, support = (
        F.interpolate(field, size, mode="bilinear", align_corners=False, antialias=size < target.size)
        for field in (total, decided)
    )
    refined_m = depth_m.float() * torch.exp(-change)
    return DepthFit(refined_m.to(depth_m.dtype), support.clamp(0.0, 1.0), total)


def _levels(error: Tensor, config: GuidanceConfig) -> tuple[Tensor, Tensor]:
    """Smoothness and inertia ``(P, *error.shape)`` of all passes, from broad to that of the prior's error."""
    if use_kernel(error):
        from geodiff_plugin.algorithm import correction_kernels as kernels

        return kernels.levels(error, config)
    ratio = REFERENCE_ERROR / error
    last = (config.smoothness * ratio**STIFFNESS_POWER).clamp(LOOSEST, STIFFEST)
    broad = last.clamp_min(BROAD_SMOOTHNESS)
    inertia = (INERTIA * ratio**STIFFNESS_POWER).clamp_max(MOST_INERTIA)
    shares = [k / (PASSES - 1) for k in range(PASSES)]
    least = [BROAD_INERTIA ** (1.0 - share) * LEAST_INERTIA**share for share in shares]
    return (
        torch.stack([broad ** (1.0 - share) * last**share for share in shares]),
        torch.stack([inertia.clamp_min(floor) for floor in least]),
    )
