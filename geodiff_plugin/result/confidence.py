"""Confidence: the probability that a pixel's depth is within 10 % of the truth; photometric error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import use_kernel
from geodiff_plugin._strips import row_strips
from geodiff_plugin.algorithm.correction import log_depth_at, range_around
from geodiff_plugin.algorithm.terms import match_exposure
from geodiff_plugin.geometry import as_fine_as, image_size, warp_right_to_left
from geodiff_plugin.matching import Matches, window_mean
from geodiff_plugin.types import CameraView

#: Confidence is the probability of a relative error below this.
RIGHT_WITHIN = 0.1
#: Log-odds, by logistic regression on pairs with truth, every pair weighing the same
#: (``python -m tests.benchmarks.confidence`` refits them): constant, certainty, closeness of the matches,
#: steadiness, evenness, and relative spread of the ensemble (by hand: 10 % quarter the odds).
BY_EVIDENCE = (-2.95, 0.36, 1.04, 0.94, 0.36, -15.0)
#: A smaller error that is left in a depth makes no difference.
LEAST_LEFT = 0.0005
#: Nor does a larger one.
MOST_LEFT = 0.05
#: The least error of a prior, in log depth, that matches can measure.
BEST = 0.01
#: The error of a useless prior.
USELESS = 0.5
#: Half width in px of the window, on the grid of the matches, over which both of the following are means.
GROUNDS_REACH = 15
#: Matches that are closer to a depth, in planes, make no difference.
CLOSE = 0.5
#: Nor do those that are farther from it.
FAR = 10.0
#: Mean confidence of a window that matches as far as that are given beside the found ones: a few may be close
#: by chance, and where there are none, none is close.
FEW = 0.02
#: A smaller change of log depth makes no difference.
STEADY = 0.005
#: Nor does a larger one.
MOVED = 0.2
#: Half width in px of the window, on the grid of the matches, in which a depth is compared with others: what
#: is wrong at an edge of depth, and in the strip that it hides, is wrong within some pixels of it.
EVEN_REACH = 4
#: A smaller range of log depth in it makes no difference: surfaces slope.
EVEN = 0.01
#: Nor does a larger one.
STEPPED = 0.5
#: Known share of the matches around a pixel from which on they determine what their support says.
DETERMINED_FROM = 0.33
#: Support at which the prior's error is half known: it is measured where there are matches, and a prior that
#: is right on the street may be wrong on the trees above it.
HALF_KNOWN = 0.1


def determined(known: Tensor, size: tuple[int, int]) -> Tensor:
    """How far matches determine a depth, ``(1, 1, H, W)`` in [0, 1], by their ``known_share``."""
    share = (known / DETERMINED_FROM).clamp_max(1.0)
    return F.interpolate(share, size, mode="bilinear", align_corners=False)


class Grounds(NamedTuple):
    """What the depth of an image rests on, ``(1, 1, H, W)`` each."""

    support: Tensor  # of ``fit_depth``, [0, 1]
    apart: Tensor  # mean distance of the matches around a pixel from its depth, in planes
    moved: Tensor  # mean change of log depth around it since the denoising; the fewer matches, the larger
    stepped: Tensor  # range of log depth around it


def grounds_of(denoised_m: Tensor, depth_m: Tensor, target: Matches, support: Tensor) -> Grounds:
    """What a depth rests on: its support, how near the matches are to it, what corrected it, how even it is.

    Support says how much the matches of a place weigh, not whether they agree. Where they scatter around the
    depth, or the last fit had to change the denoised map, the depth is often wrong; and so it is beside a
    step from one surface to another, whose place is uncertain.

    Args:
        denoised_m: ``(1, 1, H, W)`` metres, the map before it was fitted to the matches for the last time.
        depth_m: as ``denoised_m``, the result.
        target: the matches and points, on any grid.
        support: ``(1, 1, H, W)`` in [0, 1], of ``fit_depth``.
    """
    log_depth, denoised = (log_depth_at(each_m, target.size) for each_m in (depth_m, denoised_m))
    grounds = _grounds_on_grid(log_depth, denoised, target)
    found = F.interpolate(grounds, image_size(support), mode="bilinear")
    return Grounds(support, *found.split(1, 1))


def _grounds_on_grid(log_depth: Tensor, denoised: Tensor, target: Matches) -> Tensor:
    """``apart``, ``moved`` and ``stepped`` of ``Grounds``, ``(1, 3, h, w)``, on the grid of the matches."""
    if use_kernel(log_depth):
        from geodiff_plugin.result import grounds_kernels as kernels

        return kernels.grounds_on_grid(log_depth, denoised, target)
    planes = (target.inverse_depth - torch.exp(-log_depth)) / target.plane_step.view(-1, 1, 1, 1)
    weighted = target.confidence * planes.abs().clamp_max(FAR)
    layers = torch.cat([target.confidence, weighted, (log_depth - denoised).abs()], 1)
    weight, weighted, moved = window_mean(layers, GROUNDS_REACH).split(1, 1)
    apart = (weighted + FEW * FAR) / (weight + FEW)
    # A map that hardly any match could correct is not steady.
    known = target.confidence.clamp_max(1.0).mean((2, 3), keepdim=True)
    share = known / (known + FEW)
    moved = moved.clamp(STEADY, MOVED) ** share * MOVED ** (1.0 - share)
    return torch.cat([apart, moved, range_around(log_depth, EVEN_REACH)], 1)


def depth_evidence(grounds: Grounds, spread: Tensor | None, prior_error: Tensor | None = None) -> Tensor:
    """Features ``(B, 6, H, W)`` of the logistic model in ``depth_confidence``, whose arguments these are.

    They are 1, certainty, closeness, steadiness, evenness and spread. With less support, a pixel's prior
    error e moves from the measured one towards a useless prior's. Certainty is the log of .05 over the
    remaining error, ``(1 - support) * e``, closeness that of 10 planes over the distance of the matches,
    steadiness that of .2 over the correction, and evenness that of .5 over the range of log depth around.
    """
    support, apart, moved, stepped = grounds
    measured = support.new_tensor(USELESS) if prior_error is None else prior_error.clamp(BEST, USELESS)
    share = support / (support + HALF_KNOWN)
    left = (1.0 - support) * measured**share * USELESS ** (1.0 - share)
    evidence = [
        torch.ones_like(support),
        -(left.clamp(LEAST_LEFT, MOST_LEFT) / MOST_LEFT).log(),
        -(apart.clamp(CLOSE, FAR) / FAR).log(),
        -(moved.clamp(STEADY, MOVED) / MOVED).log(),
        -(stepped.clamp(EVEN, STEPPED) / STEPPED).log(),
        torch.zeros_like(support) if spread is None else spread,
    ]
    return torch.cat(evidence, dim=1)


def depth_confidence(grounds: Grounds, spread: Tensor | None, prior_error: Tensor | None = None) -> Tensor:
    """Probability ``(B, 1, H, W)`` that a depth is within 10 % of the truth.

    From what it rests on, the relative spread of an ensemble's members (or ``None``), and the prior's
    ``local_error`` on any grid (``None`` counts as a useless prior).
    """
    support = grounds.support
    size = image_size(support)
    if prior_error is not None and image_size(prior_error) != (1, 1):
        prior_error = F.interpolate(prior_error, size, mode="nearest-exact")
    if use_kernel(support):
        from geodiff_plugin.result import kernels

        return kernels.confidence_of(grounds, spread, prior_error)
    weights = support.new_tensor(BY_EVIDENCE).view(1, -1, 1, 1)
    confidence = torch.empty_like(support)
    for rows in row_strips(*size):  # the features take six times as much memory as the result
        part = Grounds(*(x[:, :, rows] for x in grounds))
        further = (None if x is None else x.expand_as(support)[:, :, rows] for x in (spread, prior_error))
        confidence[:, :, rows] = torch.sigmoid(
            (weights * depth_evidence(part, *further)).sum(1, keepdim=True)
        )
    return confidence


def reprojection(
    views: Sequence[CameraView], depth_m: Tensor, left_01: Tensor, K_left: Tensor
) -> tuple[Tensor, Tensor]:
    """Where any native right view sees the pixel, and the least photometric error of the re-rendered image.

    ``(1, 1, H, W)`` bool and float in [0, 1], in the left image's exposure, 0 where no view sees the pixel.
    """
    best, visible = None, None
    for image, K_right, T in views:
        image, K_right = as_fine_as(image, K_right, K_left[0])
        warped, seen = _warped(image[None], depth_m, K_left, K_right[None], T[None])
        error = torch.where(seen, _photometric_error(warped, left_01, seen), torch.inf)
        best = error if best is None else torch.minimum(best, error)
        visible = seen if visible is None else visible | seen
    assert best is not None and visible is not None  # there are views
    return visible, torch.where(visible, best, 0.0)


def _photometric_error(warped: Tensor, left_01: Tensor, seen: Tensor) -> Tensor:
    """Mean absolute difference ``(1, 1, H, W)`` of a warped image, in the left one's exposure."""
    if use_kernel(seen):
        from geodiff_plugin.result import exposure_kernels

        return exposure_kernels.photometric_error(warped, left_01, seen)
    error = torch.zeros_like(warped[:, :1])
    for layer in range(left_01.shape[1]):  # one by one: a copy of all three counts
        channel = slice(layer, layer + 1)
        matched = match_exposure(warped[:, channel], left_01[:, channel], seen)
        error += matched.sub_(left_01[:, channel]).abs_()
    return error.div_(left_01.shape[1])


def _warped(
    right_01: Tensor, depth_m: Tensor, K_left: Tensor, K_right: Tensor, T_right_from_left: Tensor
) -> tuple[Tensor, Tensor]:
    """The right image on the left grid and where it is visible, in strips of rows to spare memory."""
    if use_kernel(depth_m):
        from geodiff_plugin.result import kernels

        return kernels.warped(right_01, depth_m, K_left, K_right, T_right_from_left)
    warped = right_01.new_empty((1, right_01.shape[1], *image_size(depth_m)))
    visible = torch.empty_like(depth_m, dtype=torch.bool)
    for rows in row_strips(*image_size(depth_m)):
        K_strip = K_left.clone()
        K_strip[:, 1, 2] -= rows.start
        part = warp_right_to_left(right_01, depth_m[:, :, rows], K_strip, K_right, T_right_from_left)
        warped[:, :, rows], visible[:, :, rows] = part.image, part.visible
    return warped, visible
