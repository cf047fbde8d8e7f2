"""Fits a metric map to matches and points by edge-aware least squares, stiffer for a better prior."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel, launch_bound
from geodiff_plugin.algorithm.constants import (
    BROAD_SMOOTHNESS,
    BROAD_TIKHONOV,
    DEPTH_EDGE,
    EDGE_ERROR,
    EDGE_STEP,
    IMAGE_EDGE,
    MATCHED_FRACTION,
    MAX_PRIOR_ERROR,
    MAX_SMOOTHNESS,
    MAX_TIKHONOV,
    MIN_AFFINITY,
    MIN_PRIOR_ERROR,
    MIN_SMOOTHNESS,
    MIN_TIKHONOV,
    NORMAL_QUANTILE,
    OWN_DEPTH_WEIGHT,
    PASSES,
    REFERENCE_ERROR,
    REFERENCE_SIDE,
    STIFFNESS_POWER,
    TIKHONOV,
)
from geodiff_plugin.algorithm.solver import solve_robust
from geodiff_plugin.algorithm.systems import RobustField, RobustSystem
from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.geometry import image_size, to_device_of
from geodiff_plugin.matching import Matches, with_points
from geodiff_plugin.scale.points import weighted_quantile

#: Smoothness of the fit that measures the prior and finds outliers; it changes the map over wide regions
#: only.
STIFF_SMOOTHNESS = 400.0
#: Tikhonov weight of that fit, as a fraction of its smoothness.
STIFF_TIKHONOV = 1.3e-3
#: Number of robustly reweighted solves per pass, fixed so that the GPU never has to synchronize.
REWEIGHTINGS = 2
#: Conjugate-gradient steps per pyramid level; they truncate the solve, see ``fit_depth``.
SOLVER_STEPS = 6
#: Residual, in standard deviations of a match, at which it has half the weight.
RESIDUAL_CAUCHY = 2.5
#: Side of the blocks of matches held out to measure the prior, as a fraction of the longer image side.
BLOCK = 0.08
#: Number of points below which the measured error is partly chance, so that it is moved towards the maximum.
FEW_POINTS = 100
#: Distance that a match spreads across an edge, as a fraction of the longer side.
EDGE_RADIUS = 0.006


class _Observations(NamedTuple):
    """Matches compared with a map on their grid, ``(B, 1, h, w)`` each, and the fit's affinities."""

    residual: Tensor  # log of a match's inverse depth over the map's
    noise: Tensor  # standard deviation of the residual
    weight: Tensor  # confidence over relative variance
    confidence: Tensor  # of the matches
    affinities: tuple[Tensor, Tensor]  # ``edge_affinities``, horizontal and vertical, at smoothness 1


def _observations(depth_m: Tensor, target: Matches, left_01: Tensor, config: GuidanceConfig) -> _Observations:
    guide = F.interpolate(left_01.float(), target.size, mode="bilinear", antialias=True)
    log_depth = log_depth_at(depth_m, target.size)
    residuals = _residuals(log_depth, target, config.match_sigma)
    return _Observations(*residuals, target.confidence, edge_affinities(guide, log_depth))


@has_kernel("algorithm.kernels.match_fitting.residuals")
def _residuals(log_depth: Tensor, target: Matches, match_sigma: float) -> tuple[Tensor, Tensor, Tensor]:
    """Compute residual, noise and weight of ``_Observations`` from log depth on the grid of the matches."""
    matched = target.inverse_depth.clamp_min(1e-9)
    step = target.plane_step.view(-1, 1, 1, 1)
    noise = ((step / matched) ** 2 + match_sigma**2).sqrt()
    weight = target.confidence * (match_sigma / noise) ** 2
    residual = torch.where(weight > 0, matched.log() + log_depth, torch.zeros_like(matched))
    return residual, noise, weight


def log_depth_at(depth_m: Tensor, size: tuple[int, int]) -> Tensor:
    """Resample the log of a map ``(B, 1, H, W)`` to another grid."""
    return F.interpolate(depth_m.float().log(), size, mode="bilinear", align_corners=False)


@has_kernel("algorithm.kernels.match_fitting.edge_affinities")
def edge_affinities(guide: Tensor, log_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the affinities of horizontal and vertical neighbours, one per pair of pixels.

    ``guide (B, 3, h, w)`` and ``log_depth (B, 1, h, w)`` are on one grid. Affinities fall at the edges of
    both.
    """
    return _affinities_along(-1, guide, log_depth), _affinities_along(-2, guide, log_depth)


def _affinities_along(axis: int, guide: Tensor, log_depth: Tensor) -> Tensor:
    scale = max(guide.shape[-2:]) / REFERENCE_SIDE
    step = guide.diff(dim=axis).abs().mean(1, keepdim=True) / IMAGE_EDGE
    jump = log_depth.diff(dim=axis).abs() / DEPTH_EDGE
    return scale**2 * torch.exp(-scale * (step + jump)).clamp_min(MIN_AFFINITY)


def local_error(error: Tensor | None, valid: Tensor | None) -> Tensor | None:
    """Return ``(B, 1, H, W)``: a prior's ``error`` where it gives a depth, else the maximum.

    ``error`` is ``(B, 1, 1, 1)``, or ``(B, 1, h, w)`` on any grid.
    ``valid (B, 1, H, W)`` is above 0 where the prior gives a depth; ``None`` returns ``error`` itself.
    """
    if error is None or valid is None:
        return error
    error = _on_grid(error, image_size(valid))
    return torch.where(valid > 0, error, torch.full_like(error, MAX_PRIOR_ERROR))


def _on_grid(error: Tensor, size: tuple[int, int]) -> Tensor:
    """Resample a ``local_error`` to another grid; one number per sample is returned unchanged."""
    if image_size(error) in ((1, 1), size):
        return error
    return F.interpolate(error, size, mode="nearest-exact")


def fit_target(
    matches: Matches | None,
    points: Matches | None,
    kept: Tensor | None,
    error: Tensor | None,
    depth_m: Tensor,
) -> Matches | None:
    """Select the matches and points that an estimate is fitted to, without reflections and edge pixels.

    ``matches`` and ``points`` are on one grid. ``kept`` is the factor on each match's confidence that removes
    reflections; with ``None`` no match is used yet. ``error`` is the prior's, ``None`` until it is measured.
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
    """Reduce the confidence of matches near the depth edges of a map.

    A matching window across an edge gives both sides the depth of the nearer surface. Known points have no
    window and are not affected. Above ``EDGE_ERROR`` the prior's own edges are misplaced, so matches lose
    less confidence.
    """
    size = target.size
    log_depth = log_depth_at(depth_m, size)
    radius = max(1, round(EDGE_RADIUS * max(size)))
    confidence = _off_edges(target.confidence, log_depth, _on_grid(error, size), radius)
    return replace(target, confidence=confidence)


@has_kernel("algorithm.kernels.match_fitting.off_edges")
def _off_edges(confidence: Tensor, log_depth: Tensor, error: Tensor, radius: int) -> Tensor:
    """Compute the confidence of ``off_edges``; ``error`` is on the same grid or has one value per sample."""
    span = range_around(log_depth, radius)
    width = EDGE_STEP * (error / EDGE_ERROR).clamp_min(1.0) ** 3
    return confidence / (1.0 + (span / width) ** 2)


def range_around(values: Tensor, radius: int) -> Tensor:
    """Compute the maximum minus the minimum in a square window, for a map ``(B, 1, H, W)``."""
    return highest(torch.cat([values, -values], 1), radius).sum(1, keepdim=True)


def highest(values: Tensor, radius: int) -> Tensor:
    """Compute the maximum in a square window, separably by rows and columns, with doubling window sizes."""
    side = 2 * radius + 1
    if launch_bound(values):
        across = F.max_pool2d(values, (1, side), 1, (0, radius))
        return F.max_pool2d(across, (side, 1), 1, (radius, 0))
    values = F.pad(values, (radius,) * 4, mode="replicate")
    for axis in (-1, -2):
        covered = 1
        while covered < side:
            step = min(covered, side - covered)
            last = values.shape[axis]
            shifted = (values.narrow(axis, first, last - step) for first in (0, step))
            values = torch.maximum(*shifted)
            covered += step
    return values


def _stiff(observed: _Observations, trusted: Tensor, error: Tensor, config: GuidanceConfig) -> RobustField:
    """Fit the map to matches over wide regions only, and return the matches' weights at the new residuals.

    ``trusted`` may hold several sets of weights, as in ``solve_robust``. A match has half its weight at a
    residual of ``outlier_sigma`` combined standard deviations of match and prior.
    """
    stiff = error.new_full((1, len(error), 1, 1, 1), STIFF_SMOOTHNESS)
    tikhonov = error.new_full((1, len(error), 1, 1, 1), STIFF_TIKHONOV * STIFF_SMOOTHNESS)
    system = RobustSystem(
        data=observed.residual,
        trusted=trusted,
        noise=observed.noise,
        error=error,
        radius=config.outlier_sigma,
        affinities=observed.affinities,
        smoothness=stiff,
        tikhonov=tikhonov,
    )
    return solve_robust(system, REWEIGHTINGS + 1, SOLVER_STEPS)


@has_kernel("algorithm.kernels.match_fitting.spread")
def _spread(residual: Tensor, noise: Tensor, weight: Tensor, confidence: Tensor) -> Tensor:
    """Estimate the robust standard deviation ``(B, 1, 1, 1)`` of residuals without the matches' noise.

    The largest residuals are excluded, as many as matches are expected to be wrong by their confidence.
    Without matches the result is ``MAX_PRIOR_ERROR``.
    """
    expected_correct = (weight * confidence.clamp_max(1.0)).flatten(1).sum(1, keepdim=True)
    weight = weight.flatten(1)
    correct_fraction = expected_correct / weight.sum(1, keepdim=True).clamp_min(1e-9)
    largest = weighted_quantile(residual.abs().flatten(1), weight, MATCHED_FRACTION * correct_fraction)
    noise = weighted_quantile(noise.flatten(1), weight, 0.5)
    excess = ((largest / NORMAL_QUANTILE) ** 2 - noise**2 / 4.0).clamp_min(0.0).sqrt()
    excess = torch.where(weight.sum(1) > 0, excess, MAX_PRIOR_ERROR)
    return excess.view(-1, 1, 1, 1).clamp(MIN_PRIOR_ERROR, MAX_PRIOR_ERROR)


class MeasuredError(NamedTuple):
    """A prior's error, and the held-out matches' deviations that it was measured from."""

    error: Tensor  # (B, 1, 1, 1) log depth, in [``MIN_PRIOR_ERROR``, ``MAX_PRIOR_ERROR``]
    deviation: Tensor  # (B, 1, h, w), log inverse depth predicted from the other blocks minus the match's


def prior_error(
    depth_m: Tensor, target: Matches, left_01: Tensor, config: GuidanceConfig = DEFAULT
) -> Tensor:
    """Return the error ``(B, 1, 1, 1)`` of ``measure_error``."""
    return measure_error(depth_m, target, left_01, config).error


@torch.no_grad()
def measure_error(
    depth_m: Tensor, target: Matches, left_01: Tensor, config: GuidanceConfig = DEFAULT
) -> MeasuredError:
    """Measure a prior's error from matches.

    Cross-validation: matches are held out in blocks and predicted from the other blocks by the prior's map
    under a stiff fit. This measures the map between matches, not how well it can be bent to them. Arguments
    as in ``fit_depth``; scale and shift of the map are already fitted.
    """
    observed = _observations(depth_m, target, left_01, config)
    height, width = observed.residual.shape[-2:]
    side = max(1, round(BLOCK * max(height, width)))
    is_odd = np.concatenate([np.arange(n) // side % 2 for n in (height, width)]) > 0
    odd_row, odd_column = to_device_of(depth_m, is_odd).split([height, width])
    black = odd_row[:, None] != odd_column
    weight_of_black = observed.weight * black
    first = _spread(*observed[:4])
    trusted = torch.cat([weight_of_black, observed.weight - weight_of_black])
    of_black, of_white = _stiff(observed, trusted, first, config).field.chunk(2)
    deviation = torch.where(black, of_white, of_black) - observed.residual
    error = _spread(deviation, *observed[1:4])
    count = (observed.weight > 0).sum((1, 2, 3), keepdim=True, dtype=torch.float32)
    fraction = (count / FEW_POINTS).clamp_max(1.0)
    return MeasuredError(error**fraction * MAX_PRIOR_ERROR ** (1.0 - fraction), deviation)


class DepthFit(NamedTuple):
    """A map fitted to matches and points, with the details of the fit."""

    depth_m: Tensor  # (B, 1, H, W) metres
    support: Tensor  # (B, 1, H, W) in [0, 1], how far the matches determine it
    log_change: Tensor  # (B, 1, h, w) decrease of log depth, on the grid of the matches


@torch.no_grad()
def fit_depth(
    depth_m: Tensor,
    target: Matches,
    left_01: Tensor,
    error: Tensor,
    config: GuidanceConfig = DEFAULT,
    own_scale: Tensor | None = None,
) -> DepthFit:
    """Fit log depth to matches by least squares, smooth except at edges.

    With ``u`` the decrease of log depth and ``r`` the residual of each match after earlier passes, a pass
    approaches the minimizer of ``sum w (u - r)^2 + a sum g |grad u|^2 + b sum u^2``. ``w`` is the confidence
    divided by the match's relative variance, robustly reweighted, and ``g`` falls at edges of the image and
    of the given depth. Passes go from a broad ``a`` to the one for the prior's error, so a pixel far from
    matches keeps the change that the broad passes gave its region.

    Every solve is truncated after ``SOLVER_STEPS`` conjugate-gradient steps on each grid of a pyramid, a
    fixed number, so that the GPU never has to synchronize. ``tests/unit/algorithm/test_solver.py`` bounds the
    resulting distance from the exact minimizers.

    Args:
        depth_m: ``(B, 1, H, W)`` metres, at any resolution.
        target: matches or known points of the same images, on any grid.
        left_01: ``(B, 3, h, w)`` in [0, 1], the left images at any resolution.
        error: ``prior_error`` or ``local_error``; matches that contradict a good prior have a lower weight.
        config: parameters of the fit.
        own_scale: ``(B, 1, 1, 1)``, 1 for a map that keeps its own scale, else 0; ``None`` for 0. Such a map
            has this error in its depth, and not only in its depth relative to the depth around it.
    """
    observed = _observations(depth_m, target, left_01, config)
    error = _on_grid(error, target.size)
    trusted = _stiff(observed, observed.weight, error, config).weights
    smoothness, tikhonov = _levels(error, config)
    if own_scale is not None:
        tikhonov = tikhonov.maximum(own_scale * OWN_DEPTH_WEIGHT * (config.match_sigma / error) ** 2)
    system = RobustSystem(
        data=observed.residual,
        trusted=trusted,
        noise=observed.noise,
        error=None,
        radius=RESIDUAL_CAUCHY,
        affinities=observed.affinities,
        smoothness=smoothness,
        tikhonov=tikhonov,
    )
    total, _, determined = solve_robust(system, REWEIGHTINGS, SOLVER_STEPS, with_support=True)
    assert determined is not None  # with_support=True
    size = image_size(depth_m)
    is_smaller = size[0] < target.size[0] or size[1] < target.size[1]
    change, support = (
        F.interpolate(field, size, mode="bilinear", align_corners=False, antialias=is_smaller)
        for field in (total, determined)
    )
    refined_m = depth_m.float() * torch.exp(-change)
    return DepthFit(refined_m.to(depth_m.dtype), support.clamp(0.0, 1.0), total)


@has_kernel("algorithm.kernels.match_fitting.levels")
def _levels(error: Tensor, config: GuidanceConfig) -> tuple[Tensor, Tensor]:
    """Compute smoothness and Tikhonov weight ``(P, *error.shape)`` of all passes, from broad to final."""
    ratio = REFERENCE_ERROR / error
    last = (config.smoothness * ratio**STIFFNESS_POWER).clamp(MIN_SMOOTHNESS, MAX_SMOOTHNESS)
    broad = last.clamp_min(BROAD_SMOOTHNESS)
    tikhonov = (TIKHONOV * ratio**STIFFNESS_POWER).clamp_max(MAX_TIKHONOV)
    fractions = [k / (PASSES - 1) for k in range(PASSES)]
    least = [BROAD_TIKHONOV ** (1.0 - fraction) * MIN_TIKHONOV**fraction for fraction in fractions]
    return (
        torch.stack([broad ** (1.0 - fraction) * last**fraction for fraction in fractions]),
        torch.stack([tikhonov.clamp_min(floor) for floor in least]),
    )
