"""Planar regularization: smooths slopes of inverse depth where matches have little data support.

Beyond the paper, whose result is the decoded latent. Matches on a textureless wall are uncertain, and
neighbouring ones have similar errors, so a fit to them makes blotches. A plane in space is a plane in inverse
depth over the pixels: its slope is constant, which first-order smoothness does not model. Slopes and then
values are smoothed after Bredies, Kunisch and Pock, Total Generalized Variation, SIAM J. Imaging Sci. 2010,
here with squares, which ``solve_field`` minimizes. The second step runs on the grid of the matches and again
on the filter's grid, for detail finer than the first grid.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin.algorithm.constants import DEPTH_EDGE
from geodiff_plugin.algorithm.match_fitting import edge_affinities, log_depth_at
from geodiff_plugin.algorithm.solver import solve_field
from geodiff_plugin.algorithm.systems import FieldSystem
from geodiff_plugin.geometry import constant_like, image_size
from geodiff_plugin.matching import Matches, known_shape
from geodiff_plugin.matching.rows import grid_of_rows
from geodiff_plugin.result.constants import (
    MAX_VALUE_WEIGHT,
    MIN_INVERSE,
    MIN_SLOPE_WEIGHT,
    MIN_VALUE_WEIGHT,
    SLOPES,
)
from geodiff_plugin.result.records import KnownMaps

#: Smoothness of the slopes: they are similar over about the square root of its ratio to their own weight,
#: pixels.
SLOPE_SMOOTHNESS = 300.0
#: Weight of a value without data support on the filter's grid, where only detail of few pixels should change.
MIN_DETAIL_WEIGHT = 0.5
#: Log-depth step across which detail is not smoothed: less than ``DEPTH_EDGE``, so that edges stay sharp. A
#: good prior's map uses the same value, since its small steps are real.
DETAIL_EDGE = 0.03
#: Log-depth step of the denoised map that is an edge. It is small, since false steps of a fitted map border
#: patches of wrong matches, which the denoised map does not follow.
DENOISED_EDGE = 0.02
#: Prior error above which these weights are minimal. They grow with the inverse fourth power of a smaller
#: error, like the stiffness of the fit: the surfaces of a good prior need no smoothing.
WEAK_PRIOR = 0.1
#: Conjugate-gradient steps per grid of the solver's pyramid.
STEPS = 8
#: Minimum ratio of changed to original inverse depth.
MIN_RATIO = 0.3


class _Surface(NamedTuple):
    """A map on one grid, ``(1, 1, h, w)``."""

    inverse: Tensor  # about 1, so that no weight depends on the unit
    affinities: tuple[Tensor, Tensor]  # ``edge_affinities``, horizontal and vertical


class _Targets(NamedTuple):
    """Targets of the regularization on the grid of the matches."""

    slopes: Tensor  # (2, 1, h, w), smoothed slopes, horizontal and vertical
    data_weight: Tensor  # (1, 1, h, w), weight of the values by data support


@torch.no_grad()
def flatten(depth_m: Tensor, target: Matches, left_01: Tensor, error: Tensor, denoised_m: Tensor) -> Tensor:
    """Regularize the slopes of inverse depth where matches have little data support; keep the rest unchanged.

    With ``q`` the inverse depth, about 1 on average, ``k`` the ``known_shape`` of the matches, and ``g``
    affinities that fall at edges of image and depth, the slopes ``s`` of ``q`` along either axis are smoothed
    to ``t = argmin sum g (k^2 + MIN_SLOPE_WEIGHT) (t - s)^2 + SLOPE_SMOOTHNESS sum g |grad t|^2``. The result
    is ``q + e`` with ``e = argmin sum w (e / q)^2 + SLOPES sum g |grad (q + e) - t|^2`` and ``w = k^2 / (1 -
    k) + w_0``, where ``w_0`` is ``MIN_VALUE_WEIGHT`` for a weak prior and larger for a better one. A change
    is weighted relative to ``q``, since the error of a prior is one of log depth. Otherwise the distant
    background of an edge, with small ``q``, would be drawn to the foreground.

    A step of ``DEPTH_EDGE`` in log depth is an edge of a weak prior's map, and a smaller one, down to
    ``DETAIL_EDGE``, of a better one's. A step of ``DENOISED_EDGE`` in the denoised map is an edge for any
    prior.

    The map has detail finer than the grid of the matches: upsampling, edge sharpening and filtering leave
    specks of a few pixels. The second problem is therefore solved again, for ``q + e`` in place of ``q``, on
    the filter's grid. There ``w_0`` is ``MIN_DETAIL_WEIGHT``, so that only detail changes, and a step of
    ``DETAIL_EDGE`` in log depth is an edge.

    Args:
        depth_m: ``(1, 1, H, W)`` metres, fitted to the matches and filtered.
        target: the matches.
        left_01: ``(1, 3, h, w)`` in [0, 1], the left image at any resolution.
        error: ``(1, 1, 1, 1)`` prior error in log depth.
        denoised_m: like ``depth_m``, the map before its last fit to the matches.

    Returns:
        Map like ``depth_m``.
    """
    log_depth = depth_m.float().log()
    mean_log_depth = log_depth.mean()
    prior_weight = (WEAK_PRIOR / error).clamp_min(1.0) ** 4
    on_grid = _on(log_depth, target.size)
    known = _known_maps(target, on_grid, mean_log_depth, prior_weight)
    surface = _Surface(known.inverse, _affinities_of_walls(on_grid, denoised_m, left_01, prior_weight))
    targets = _Targets(_smoothed(surface, known.shape), known.data_weight)
    change = _fit_slopes(targets.slopes, surface, known.weight)
    log_decrease = _on(_log_decrease(surface, change), image_size(depth_m))
    log_decrease = log_decrease + _log_decrease_of_detail(
        log_depth - log_decrease, mean_log_depth, targets, left_01, prior_weight
    )
    return (depth_m * torch.exp(-log_decrease)).to(depth_m.dtype)


@has_kernel(
    "result.kernels.planar.known_maps",
    when=lambda target, log_depth, mean_log_depth, prior_weight: target.deviation is not None,
)
def _known_maps(
    target: Matches, log_depth: Tensor, mean_log_depth: Tensor, prior_weight: Tensor
) -> KnownMaps:
    """Compute the data support of a map by matches, with ``log_depth`` on their grid.

    Inverse depths are relative to the one at ``mean_log_depth ()``; ``prior_weight`` is as in
    ``_affinities_of_walls``.
    """
    inverse = torch.exp(mean_log_depth - log_depth)
    shape = known_shape(target, torch.exp(-log_depth))
    data_weight = _data_weight(shape)
    weight = _relative(data_weight + MIN_VALUE_WEIGHT * prior_weight, inverse)
    return KnownMaps(inverse, shape, data_weight, weight)


def _affinities_of_walls(
    log_depth: Tensor, denoised_m: Tensor, left_01: Tensor, prior_weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute affinities on the grid of the matches.

    ``prior_weight`` is the factor on the weight of the prior's values.
    """
    edge = (DEPTH_EDGE / prior_weight.sqrt()).clamp_min(DETAIL_EDGE)
    guide = _guide(left_01, image_size(log_depth))
    fitted = _affinities(log_depth, guide, edge)
    denoised = _affinities(log_depth_at(denoised_m, image_size(log_depth)), guide, DENOISED_EDGE)
    return torch.minimum(fitted[0], denoised[0]), torch.minimum(fitted[1], denoised[1])


def _log_decrease_of_detail(
    log_depth: Tensor, mean_log_depth: Tensor, targets: _Targets, left_01: Tensor, prior_weight: Tensor
) -> Tensor:
    """Solve the second problem on the filter's grid and return the decrease of log depth ``(1, 1, H, W)``."""
    (height, width), size = image_size(targets.data_weight), grid_of_rows(image_size(log_depth))
    on_grid = _on(log_depth, size)
    affinities = _affinities(on_grid, _guide(left_01, size), DETAIL_EDGE)
    surface = _Surface(torch.exp(mean_log_depth - on_grid), affinities)
    # A slope is the change between neighbouring pixels, and the pixels of this grid are smaller.
    smaller = constant_like(targets.slopes, width / size[1], height / size[0]).view(2, 1, 1, 1)
    weight = _relative(_on(targets.data_weight, size) + MIN_DETAIL_WEIGHT * prior_weight, surface.inverse)
    change = _fit_slopes(smaller * _on(targets.slopes, size), surface, weight, torch.zeros_like(weight))
    return _on(_log_decrease(surface, change), image_size(log_depth))


def _on(x: Tensor, size: tuple[int, int], *, antialias: bool = False) -> Tensor:
    """Resample a map ``(B, C, h, w)`` to another grid."""
    if image_size(x) == size:
        return x
    return F.interpolate(x, size, mode="bilinear", align_corners=False, antialias=antialias)


def _guide(left_01: Tensor, size: tuple[int, int]) -> Tensor:
    """Resample the left image to a grid."""
    return _on(left_01.float(), size, antialias=True)


def _affinities(log_depth: Tensor, guide: Tensor, edge: Tensor | float) -> tuple[Tensor, Tensor]:
    """Compute affinities on the grid of a map, which fall to 1/e across a step of ``edge`` in log depth."""
    return edge_affinities(guide, log_depth * (DEPTH_EDGE / edge))


def _data_weight(known: Tensor) -> Tensor:
    """Compute the weight of values from their data support."""
    return (known**2 / (1.0 - known).clamp_min(1e-6)).clamp_max(MAX_VALUE_WEIGHT)


def _relative(weight: Tensor, inverse: Tensor) -> Tensor:
    """Convert the weight of relative changes of inverse depth to the weight of absolute changes."""
    return weight / inverse.clamp_min(MIN_INVERSE) ** 2


def _log_decrease(surface: _Surface, change: Tensor) -> Tensor:
    """Return the decrease of log depth for a change of a surface's inverse depth."""
    return (1.0 + change / surface.inverse).clamp_min(MIN_RATIO).log()


def _smoothed(surface: _Surface, known: Tensor) -> Tensor:
    """Smooth the slopes ``(2, 1, h, w)``, horizontal and vertical, each stored at its first pixel."""
    weight, rhs = _slopes(surface.inverse, known, surface.affinities)
    across, down = surface.affinities
    return solve_field(FieldSystem(weight, rhs, SLOPE_SMOOTHNESS * across, SLOPE_SMOOTHNESS * down), STEPS)


def _fit_slopes(slopes: Tensor, surface: _Surface, weight: Tensor, start: Tensor | None = None) -> Tensor:
    """Compute the change ``(1, 1, h, w)`` that fits the values of a surface to ``slopes (2, 1, h, w)``.

    ``weight`` penalizes it. With a ``start`` only detail within the range of ``STEPS`` steps changes.
    """
    rhs = _values_rhs(surface.inverse, slopes, surface.affinities)
    across, down = surface.affinities
    return solve_field(FieldSystem(weight, rhs, SLOPES * across, SLOPES * down), STEPS, start)


@has_kernel("result.kernels.planar.slopes")
def _slopes(inverse: Tensor, known: Tensor, affinities: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Compute weight and right-hand side ``(2, 1, h, w)`` for the horizontal and vertical slopes."""
    own = known**2 + MIN_SLOPE_WEIGHT
    weights = []
    right_sides = []
    for axis, link in zip((-1, -2), affinities, strict=True):
        weights.append(_after(link, axis, first=False) * own + 1e-6)
        right_sides.append(weights[-1] * _after(inverse.diff(dim=axis), axis, first=False))
    return torch.cat(weights), torch.cat(right_sides)


@has_kernel("result.kernels.planar.values_rhs")
def _values_rhs(inverse: Tensor, smoothed: Tensor, affinities: tuple[Tensor, Tensor]) -> Tensor:
    """Compute the right-hand side ``(1, 1, h, w)`` of the equations that fit values to smoothed slopes.

    ``smoothed`` has shape ``(2, 1, h, w)``, horizontal slopes first.
    """
    rhs = torch.zeros_like(inverse)
    for axis, link, targets in zip((-1, -2), affinities, smoothed, strict=True):
        slope = inverse.diff(dim=axis)
        force = SLOPES * link * (targets.narrow(axis, 0, slope.shape[axis]) - slope)
        rhs += _after(force, axis, first=True) - _after(force, axis, first=False)
    return rhs


def _after(between: Tensor, axis: int, *, first: bool) -> Tensor:
    """Pad values between neighbours along an axis with one 0 at the first or last pixel."""
    ends = (1, 0) if first else (0, 1)
    return F.pad(between, ends if axis == -1 else (0, 0, *ends))
