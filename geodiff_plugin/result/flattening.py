"""Flat walls: where the matches of a place know little, slopes of inverse depth are smoothed.

Beyond the paper, whose result is the decoded latent. A blank wall's matches are uncertain, and neighbours on
it err alike, so a fit that follows them makes blotches of a wall. A plane in space is a plane in inverse
depth over the pixels: its slope is the same everywhere, which a smoothness of first order does not know.
Smoothing in two steps, slopes and then values, after Bredies, Kunisch and Pock, Total Generalized Variation,
SIAM J. Imaging Sci. 2010, here with squares, whose minimisers ``solve_field`` finds.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import use_kernel
from geodiff_plugin.algorithm.correction import edge_links, log_depth_at
from geodiff_plugin.algorithm.solver import FieldSystem, solve_field
from geodiff_plugin.geometry import image_size
from geodiff_plugin.matching import Matches, known_shape

#: How much a slope resists its neighbours' where nothing is known: all slopes count a little, as a wall on
#: which nothing is known has no others.
LEAST_SLOPE_WEIGHT = 0.01
#: Smoothness of the slopes: over about the root of its ratio to their own weight, in pixels, they are alike.
SLOPE_SMOOTHNESS = 300.0
#: Weight of the smoothed slopes against that of the values.
SLOPES = 40.0
#: Weight of a value where nothing is known, for a prior of ``WEAK_PRIOR`` or worse: it holds wide shapes.
LEAST_VALUE_WEIGHT = 0.02
#: Error of a prior from which that weight is the least. It grows as the fourth power of a smaller error, as
#: the stiffness of the fit does: the surfaces of a good prior need no smoothing.
WEAK_PRIOR = 0.1
#: The largest weight of a value: there the depth stays.
MOST_VALUE_WEIGHT = 1e3
#: Conjugate-gradient steps on each grid of the solver's pyramid.
STEPS = 8
#: The inverse depth is never lowered below this share of itself.
LEAST_SHARE = 0.3


@torch.no_grad()
def flatten(depth_m: Tensor, target: Matches, left_01: Tensor, error: Tensor) -> Tensor:
    """Make the slopes of inverse depth alike where the matches know little, and leave the rest as it is.

    With ``q`` the inverse depth, ``k`` the ``known_shape`` of the matches, and ``g`` links that fall at edges
    of image and depth, the slopes ``s`` of ``q`` along either axis are smoothed to ``t = argmin sum g (k^2 +
    LEAST_SLOPE_WEIGHT) (t - s)^2 + SLOPE_SMOOTHNESS sum g |grad t|^2``. The result is ``q + e`` with ``e =
    argmin sum w e^2 + SLOPES sum g |grad (q + e) - t|^2`` and ``w = k^2 / (1 - k) + w_0``, where ``w_0`` is
    ``LEAST_VALUE_WEIGHT`` of a weak prior, and more of a better one.

    Args:
        depth_m: ``(1, 1, H, W)`` metres, fitted to the matches and voted on by them.
        target: the matches.
        left_01: ``(1, 3, h, w)`` in [0, 1], the left image at any resolution.
        error: ``(1, 1, 1, 1)`` of the prior in log depth.

    Returns:
        As ``depth_m``.
    """
    log_depth = log_depth_at(depth_m, target.size)
    known = known_shape(target, torch.exp(-log_depth))
    guide = F.interpolate(left_01.float(), target.size, mode="bilinear", antialias=True)
    inverse = torch.exp(log_depth.mean() - log_depth)  # about 1, so that no weight depends on the unit
    links = edge_links(guide, log_depth)
    least = LEAST_VALUE_WEIGHT * (WEAK_PRIOR / error).clamp_min(1.0) ** 4
    weight = (known**2 / (1.0 - known).clamp_min(1e-6) + least).clamp_max(MOST_VALUE_WEIGHT)
    pull = _towards_smoothed(inverse, known, links)
    change = solve_field(FieldSystem(weight, pull, SLOPES * links[0], SLOPES * links[1]), STEPS)
    factor = (1.0 + change / inverse).clamp_min(LEAST_SHARE).log()
    factor = F.interpolate(factor, image_size(depth_m), mode="bilinear", align_corners=False)
    return (depth_m * torch.exp(-factor)).to(depth_m.dtype)


def _towards_smoothed(inverse: Tensor, known: Tensor, links: tuple[Tensor, Tensor]) -> Tensor:
    """The pull ``(1, 1, h, w)`` of values whose slopes are drawn to the smoothed ones."""
    if use_kernel(inverse):
        from geodiff_plugin.result import flattening_kernels as kernels

        weight, pull = kernels.slopes(inverse, known, links)  # of both axes, as a batch
        system = FieldSystem(weight, pull, SLOPE_SMOOTHNESS * links[0], SLOPE_SMOOTHNESS * links[1])
        return kernels.forces(inverse, solve_field(system, STEPS), links)
    pull = torch.zeros_like(inverse)
    for axis, link in zip((-1, -2), links, strict=True):
        slope = inverse.diff(dim=axis)
        force = SLOPES * link * (_smoothed(slope, axis, known, links) - slope)
        pull += _after(force, axis, first=True) - _after(force, axis, first=False)
    return pull


def _after(between: Tensor, axis: int, *, first: bool) -> Tensor:
    """Values between neighbours along an axis, padded with one 0 at the first or at the last pixel."""
    ends = (1, 0) if first else (0, 1)
    return F.pad(between, ends if axis == -1 else (0, 0, *ends))


def _smoothed(slope: Tensor, axis: int, known: Tensor, links: tuple[Tensor, ...]) -> Tensor:
    """Slopes between neighbours along an axis, smoothed along both: each at the first of its two pixels."""
    link = links[0] if axis == -1 else links[1]
    weight = _after(link, axis, first=False) * (known**2 + LEAST_SLOPE_WEIGHT) + 1e-6
    pull = weight * _after(slope, axis, first=False)
    system = FieldSystem(weight, pull, SLOPE_SMOOTHNESS * links[0], SLOPE_SMOOTHNESS * links[1])
    return solve_field(system, STEPS).narrow(axis, 0, slope.shape[axis])
