"""Flat walls: where the matches of a place know little, slopes of inverse depth are smoothed.

Beyond the paper, whose result is the decoded latent. A blank wall's matches are uncertain, and neighbours on
it err alike, so a fit that follows them makes blotches of a wall. A plane in space is a plane in inverse
depth over the pixels: its slope is the same everywhere, which a smoothness of first order does not know.
Smoothing in two steps, slopes and then values, after Bredies, Kunisch and Pock, Total Generalized Variation,
SIAM J. Imaging Sci. 2010, here with squares, whose minimisers ``solve_field`` finds. The second step is
taken on the grid of the matches and once more on that of the votes, for what is finer than the first grid.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import use_kernel
from geodiff_plugin.algorithm.correction import DEPTH_EDGE, edge_links, log_depth_at
from geodiff_plugin.algorithm.solver import FieldSystem, solve_field
from geodiff_plugin.geometry import constant_like, image_size
from geodiff_plugin.matching import Matches, known_shape
from geodiff_plugin.matching.rows import grid_of_rows

#: How much a slope resists its neighbours' where nothing is known: all slopes count a little, as a wall on
#: which nothing is known has no others.
LEAST_SLOPE_WEIGHT = 0.01
#: Smoothness of the slopes: over about the root of its ratio to their own weight, in pixels, they are alike.
SLOPE_SMOOTHNESS = 300.0
#: Weight of the smoothed slopes against that of the values.
SLOPES = 40.0
#: Weight of a value where nothing is known, for a prior of ``WEAK_PRIOR`` or worse: it holds wide shapes.
LEAST_VALUE_WEIGHT = 0.015
#: The same on the grid of the votes, where only detail of a few pixels is to go.
LEAST_DETAIL_WEIGHT = 0.5
#: Step in log depth across which detail is not smoothed: less than ``DEPTH_EDGE``, so that edges stay sharp.
#: The map of a good prior has the same, as its small steps are no errors.
DETAIL_EDGE = 0.03
#: Step in log depth of the denoised map that is an edge. It is small: the false steps of a fitted map are the
#: borders of patches of wrong matches, which the denoised map does not follow.
DENOISED_EDGE = 0.02
#: Error of a prior from which these weights are the least. They grow as the fourth power of a smaller error,
#: as the stiffness of the fit does: the surfaces of a good prior need no smoothing.
WEAK_PRIOR = 0.1
#: The largest weight of a value that is known: there the depth stays.
MOST_VALUE_WEIGHT = 1e3
#: Conjugate-gradient steps on each grid of the solver's pyramid.
STEPS = 8
#: The inverse depth is never lowered below this share of itself.
LEAST_SHARE = 0.3
#: Least inverse depth of which a change counts as a share, about 1 in the mean: depth is nearly unbounded.
LEAST_INVERSE = 1e-3


class _Known(NamedTuple):
    """What the matches know of a map, ``(1, 1, h, w)`` each, on their grid."""

    inverse: Tensor  # inverse depth, about 1
    shape: Tensor  # ``known_shape``
    held: Tensor  # how firmly values are held by it
    weight: Tensor  # of changes of the inverse depth


class _Surface(NamedTuple):
    """A map on one grid, ``(1, 1, h, w)``."""

    inverse: Tensor  # about 1, so that no weight depends on the unit
    links: tuple[Tensor, Tensor]  # ``edge_links``, across and down


class _Wanted(NamedTuple):
    """What the values of a surface are drawn to, and how firmly they are held, on the grid of the matches."""

    slopes: Tensor  # (2, 1, h, w), smoothed, across and down
    held: Tensor  # (1, 1, h, w), weight of the values by what the matches know


@torch.no_grad()
def flatten(depth_m: Tensor, target: Matches, left_01: Tensor, error: Tensor, denoised_m: Tensor) -> Tensor:
    """Make the slopes of inverse depth alike where the matches know little, and leave the rest as it is.

    With ``q`` the inverse depth, about 1 in the mean, ``k`` the ``known_shape`` of the matches, and ``g``
    links that fall at edges of image and depth, the slopes ``s`` of ``q`` along either axis are smoothed to
    ``t = argmin sum g (k^2 + LEAST_SLOPE_WEIGHT) (t - s)^2 + SLOPE_SMOOTHNESS sum g |grad t|^2``. The result
    is ``q + e`` with ``e = argmin sum w (e / q)^2 + SLOPES sum g |grad (q + e) - t|^2`` and ``w = k^2 / (1 -
    k) + w_0``, where ``w_0`` is ``LEAST_VALUE_WEIGHT`` of a weak prior, and more of a better one. A change
    counts by its share of ``q``, as the error of a prior is one of log depth. Otherwise what lies far behind
    an edge, whose ``q`` is small, would be drawn to what is near.

    A step of ``DEPTH_EDGE`` in log depth is an edge of a weak prior's map, and a smaller one, down to
    ``DETAIL_EDGE``, of a better one's. A step of ``DENOISED_EDGE`` in the denoised map is an edge, however
    weak its prior.

    The map has detail finer than the grid of the matches: upsampling, sharpened edges and votes leave specks
    of a pixel or a few. So the second problem is solved once more, for ``q + e`` in place of ``q``, on the
    grid of the votes. There ``w_0`` is ``LEAST_DETAIL_WEIGHT``, so that only detail changes, and a step of
    ``DETAIL_EDGE`` in log depth is an edge.

    Args:
        depth_m: ``(1, 1, H, W)`` metres, fitted to the matches and voted on by them.
        target: the matches.
        left_01: ``(1, 3, h, w)`` in [0, 1], the left image at any resolution.
        error: ``(1, 1, 1, 1)`` of the prior in log depth.
        denoised_m: as ``depth_m``, the map before it was fitted to the matches for the last time.

    Returns:
        As ``depth_m``.
    """
    log_depth = depth_m.float().log()
    unit, good = log_depth.mean(), (WEAK_PRIOR / error).clamp_min(1.0) ** 4
    on_grid = _on(log_depth, target.size)
    known = _known_of(target, on_grid, unit, good)
    surface = _Surface(known.inverse, _links_of_walls(on_grid, denoised_m, left_01, good))
    wanted = _Wanted(_smoothed(surface, known.shape), known.held)
    change = _towards(wanted.slopes, surface, known.weight)
    lowering = _on(_lowering(surface, change), image_size(depth_m))
    lowering = lowering + _lowering_of_detail(log_depth - lowering, unit, wanted, left_01, good)
    return (depth_m * torch.exp(-lowering)).to(depth_m.dtype)


def _known_of(target: Matches, log_depth: Tensor, unit: Tensor, good: Tensor) -> _Known:
    """What matches know of a map on their grid, about ``unit ()``; ``good`` is as in ``_links_of_walls``."""
    if use_kernel(log_depth) and target.deviation is not None:
        from geodiff_plugin.result import flattening_kernels as kernels

        return _Known(*kernels.known_of(target, target.deviation, log_depth, unit, good))
    inverse, shape = torch.exp(unit - log_depth), known_shape(target, torch.exp(-log_depth))
    held = _held(shape)
    return _Known(inverse, shape, held, _relative(held + LEAST_VALUE_WEIGHT * good, inverse))


def _links_of_walls(
    log_depth: Tensor, denoised_m: Tensor, left_01: Tensor, good: Tensor
) -> tuple[Tensor, Tensor]:
    """Links on the grid of the matches, across and down; ``good`` is by how much more its values weigh."""
    edge = (DEPTH_EDGE / good.sqrt()).clamp_min(DETAIL_EDGE)
    guide = _guide(left_01, image_size(log_depth))
    fitted = _links(log_depth, guide, edge)
    denoised = _links(log_depth_at(denoised_m, image_size(log_depth)), guide, DENOISED_EDGE)
    return torch.minimum(fitted[0], denoised[0]), torch.minimum(fitted[1], denoised[1])


def _lowering_of_detail(
    log_depth: Tensor, unit: Tensor, wanted: _Wanted, left_01: Tensor, good: Tensor
) -> Tensor:
    """By how much the second problem, on the grid of the votes, lowers the log depth ``(1, 1, H, W)``."""
    (height, width), size = image_size(wanted.held), grid_of_rows(image_size(log_depth))
    on_grid = _on(log_depth, size)
    surface = _Surface(torch.exp(unit - on_grid), _links(on_grid, _guide(left_01, size), DETAIL_EDGE))
    # A slope is the change from one pixel to the next, and the pixels of this grid are smaller.
    smaller = constant_like(wanted.slopes, width / size[1], height / size[0]).view(2, 1, 1, 1)
    weight = _relative(_on(wanted.held, size) + LEAST_DETAIL_WEIGHT * good, surface.inverse)
    change = _towards(smaller * _on(wanted.slopes, size), surface, weight, torch.zeros_like(weight))
    return _on(_lowering(surface, change), image_size(log_depth))


def _on(x: Tensor, size: tuple[int, int], *, antialias: bool = False) -> Tensor:
    """A map ``(B, C, h, w)`` on another grid."""
    if image_size(x) == size:
        return x
    return F.interpolate(x, size, mode="bilinear", align_corners=False, antialias=antialias)


def _guide(left_01: Tensor, size: tuple[int, int]) -> Tensor:
    """The left image on a grid."""
    return _on(left_01.float(), size, antialias=True)


def _links(log_depth: Tensor, guide: Tensor, edge: Tensor | float) -> tuple[Tensor, Tensor]:
    """Links on the grid of a map, which fall to a third across a step of ``edge`` in log depth."""
    return edge_links(guide, log_depth * (DEPTH_EDGE / edge))


def _held(known: Tensor) -> Tensor:
    """The weight of values by what is known of them."""
    return (known**2 / (1.0 - known).clamp_min(1e-6)).clamp_max(MOST_VALUE_WEIGHT)


def _relative(weight: Tensor, inverse: Tensor) -> Tensor:
    """The weight of changes of the inverse depth by that of their shares of it."""
    return weight / inverse.clamp_min(LEAST_INVERSE) ** 2


def _lowering(surface: _Surface, change: Tensor) -> Tensor:
    """By how much a change of its inverse depth lowers the log depth of a surface."""
    return (1.0 + change / surface.inverse).clamp_min(LEAST_SHARE).log()


def _smoothed(surface: _Surface, known: Tensor) -> Tensor:
    """Smoothed slopes ``(2, 1, h, w)`` across and down, each at the first of its two pixels."""
    weight, pull = _slopes(surface.inverse, known, surface.links)
    across, down = surface.links
    return solve_field(FieldSystem(weight, pull, SLOPE_SMOOTHNESS * across, SLOPE_SMOOTHNESS * down), STEPS)


def _towards(slopes: Tensor, surface: _Surface, weight: Tensor, start: Tensor | None = None) -> Tensor:
    """The change ``(1, 1, h, w)`` that draws the values of a surface to ``slopes (2, 1, h, w)``.

    ``weight`` resists it. With a ``start`` only what ``STEPS`` steps reach changes.
    """
    pull = _forces(surface.inverse, slopes, surface.links)
    across, down = surface.links
    return solve_field(FieldSystem(weight, pull, SLOPES * across, SLOPES * down), STEPS, start)


def _slopes(inverse: Tensor, known: Tensor, links: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Weight and pull ``(2, 1, h, w)`` of the slopes across and down."""
    if use_kernel(inverse):
        from geodiff_plugin.result import flattening_kernels as kernels

        return kernels.slopes(inverse, known, links)
    own, weights, pulls = known**2 + LEAST_SLOPE_WEIGHT, [], []
    for axis, link in zip((-1, -2), links, strict=True):
        weights.append(_after(link, axis, first=False) * own + 1e-6)
        pulls.append(weights[-1] * _after(inverse.diff(dim=axis), axis, first=False))
    return torch.cat(weights), torch.cat(pulls)


def _forces(inverse: Tensor, slopes: Tensor, links: tuple[Tensor, Tensor]) -> Tensor:
    """The pull ``(1, 1, h, w)`` of values whose slopes are drawn to ``slopes (2, 1, h, w)``."""
    if use_kernel(inverse):
        from geodiff_plugin.result import flattening_kernels as kernels

        return kernels.forces(inverse, slopes, links)
    pull = torch.zeros_like(inverse)
    for axis, link, smoothed in zip((-1, -2), links, slopes, strict=True):
        slope = inverse.diff(dim=axis)
        force = SLOPES * link * (smoothed.narrow(axis, 0, slope.shape[axis]) - slope)
        pull += _after(force, axis, first=True) - _after(force, axis, first=False)
    return pull


def _after(between: Tensor, axis: int, *, first: bool) -> Tensor:
    """Values between neighbours along an axis, padded with one 0 at the first or at the last pixel."""
    ends = (1, 0) if first else (0, 1)
    return F.pad(between, ends if axis == -1 else (0, 0, *ends))
