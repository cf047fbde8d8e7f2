"""Confidence: the probability that a pixel's depth is within 10 % of the truth; photometric error."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import launch_bound, use_kernel
from geodiff_plugin._strips import STRIP_PIXELS, row_strips
from geodiff_plugin.algorithm.terms import match_exposure
from geodiff_plugin.geometry import as_fine_as, image_size, warp_right_to_left
from geodiff_plugin.types import CameraView

#: Confidence is the probability of a relative error below this.
RIGHT_WITHIN = 0.1
#: Log-odds, by logistic regression on pairs with truth, every pair weighing the same
#: (``python -m tests.benchmarks.confidence`` refits them): constant, certainty, strength of the prior,
#: photometric agreement, and relative spread of the ensemble (by hand: 10 % quarter the odds).
BY_EVIDENCE = (-0.228, 0.788, 2.42, 0.0864, -15.0)
#: Below this photometric error images agree as well as their noise lets them.
LEAST_DIFFERENCE = 0.01
#: Above this photometric error they do not agree at all.
MOST_DIFFERENCE = 0.1
#: A smaller error of the prior, in log depth, makes no difference.
STRONG = 0.03
#: Nor does a larger one.
WEAK = 0.15
#: A smaller error that is left in a depth makes no difference.
LEAST_LEFT = 0.0005
#: Nor does a larger one.
MOST_LEFT = 0.05
#: The least error of a prior, in log depth, that matches can measure.
BEST = 0.01
#: The error of a useless prior.
USELESS = 0.5
#: Known share of the matches around a pixel from which on they determine what their support says.
DETERMINED_FROM = 0.33
#: Support at which the prior's error is half known: it is measured where there are matches, and a prior that
#: is right on the street may be wrong on the trees above it.
HALF_KNOWN = 0.1


def determined(known: Tensor, size: tuple[int, int]) -> Tensor:
    """How far matches determine a depth, ``(1, 1, H, W)`` in [0, 1], by their ``known_share``."""
    share = (known / DETERMINED_FROM).clamp_max(1.0)
    return F.interpolate(share, size, mode="bilinear", align_corners=False)


def depth_evidence(
    support: Tensor, error: Tensor, visible: Tensor, spread: Tensor | None, prior_error: Tensor | None = None
) -> Tensor:
    """Features ``(B, 5, H, W)`` of the logistic model in ``depth_confidence``, whose arguments these are.

    They are 1, certainty, strength, agreement and spread. With less support, a pixel's prior error e moves
    from the measured one towards a useless prior's. Certainty is the log of .05 over the remaining error,
    ``(1 - support) * e``; strength is the log of .15 over e, because wrong matches lose their weight with a
    good prior, while a poor one follows them. Agreement is the log of .1 over the photometric ``error``.
    """
    agreement = -(error.clamp(LEAST_DIFFERENCE, MOST_DIFFERENCE) / MOST_DIFFERENCE).log()
    measured = support.new_tensor(USELESS) if prior_error is None else prior_error.clamp(BEST, USELESS)
    share = support / (support + HALF_KNOWN)
    left_to_prior = measured**share * USELESS ** (1.0 - share)
    left = (1.0 - support) * left_to_prior
    evidence = [
        torch.ones_like(support),
        -(left.clamp(LEAST_LEFT, MOST_LEFT) / MOST_LEFT).log(),
        -(left_to_prior.clamp(STRONG, WEAK) / WEAK).log(),
        torch.where(visible, agreement, torch.zeros_like(agreement)),
        torch.zeros_like(support) if spread is None else spread,
    ]
    return torch.cat(evidence, dim=1)


def depth_confidence(
    support: Tensor, error: Tensor, visible: Tensor, spread: Tensor | None, prior_error: Tensor | None = None
) -> Tensor:
    """Probability ``(B, 1, H, W)`` that a depth is within 10 % of the truth.

    From the support of ``fit_depth``, the photometric error, the relative spread of an ensemble's members
    (or ``None``), and the prior's ``local_error`` on any grid (``None`` counts as a useless prior).
    """
    size = image_size(support)
    if prior_error is not None and image_size(prior_error) != (1, 1):
        prior_error = F.interpolate(prior_error, size, mode="nearest-exact")
    if use_kernel(support):
        from geodiff_plugin.result import kernels

        return kernels.confidence_of(support, error, visible, spread, prior_error)
    weights = support.new_tensor(BY_EVIDENCE).view(1, -1, 1, 1)
    confidence = torch.empty_like(support)
    for rows in row_strips(*size):  # the features take five times as much memory as the result
        shown = [x[:, :, rows] for x in (support, error, visible)]
        further = (None if x is None else x.expand_as(support)[:, :, rows] for x in (spread, prior_error))
        evidence = depth_evidence(*shown, *further)
        confidence[:, :, rows] = torch.sigmoid((weights * evidence).sum(1, keepdim=True))
    return confidence


def reprojection(
    views: Sequence[CameraView], depth_m: Tensor, left_01: Tensor, K_left: Tensor
) -> tuple[Tensor, Tensor]:
    """Where any native right view sees the pixel, and the least photometric error of the re-rendered image.

    ``(1, 1, H, W)`` bool and float in [0, 1], in the left image's exposure, 0 where no view sees the pixel.
    """
    best, visible = torch.full_like(depth_m, torch.inf), torch.zeros_like(depth_m, dtype=torch.bool)
    for image, K_right, T in views:
        image, K_right = as_fine_as(image, K_right, K_left[0])
        warped, seen = _warped(image[None], depth_m, K_left, K_right[None], T[None])
        error = torch.zeros_like(depth_m)
        # One by one where a copy of all three counts.
        at_once = left_01.shape[1] if launch_bound(depth_m) and depth_m.numel() <= STRIP_PIXELS else 1
        for layer in range(0, left_01.shape[1], at_once):
            channels = slice(layer, layer + at_once)
            matched = match_exposure(warped[:, channels], left_01[:, channels], seen)
            error += matched.sub_(left_01[:, channels]).abs_().sum(1, keepdim=True)
        error /= left_01.shape[1]
        best = torch.where(seen, torch.minimum(best, error), best)
        visible |= seen
    return visible, best.where(visible, torch.zeros_like(best))


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
