"""Computes photometric error, and confidence: the probability that a depth is within 10 % of ground truth.

It is conditional on a correct calibration.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin._internal.strips import row_strips
from geodiff_plugin.algorithm.constants import MAX_PRIOR_ERROR, MIN_PRIOR_ERROR
from geodiff_plugin.algorithm.match_fitting import log_depth_at, range_around
from geodiff_plugin.algorithm.terms import match_exposure
from geodiff_plugin.cameras import ALL_VALID, Camera, View
from geodiff_plugin.geometry import image_size, plane_rays, warp_right_to_left
from geodiff_plugin.matching import Matches, window_mean
from geodiff_plugin.result.constants import (
    DEPTH_LOG_ODDS,
    DISCONTINUITY_RADIUS,
    FEATURE_RADIUS,
    HALF_SUPPORT,
    MAX_CHANGE,
    MAX_DISCONTINUITY,
    MAX_REMAINING_ERROR,
    MAX_RESIDUAL,
    MIN_CHANGE,
    MIN_DISCONTINUITY,
    MIN_REMAINING_ERROR,
    MIN_RESIDUAL,
    PSEUDO_CONFIDENCE,
)
from geodiff_plugin.result.records import ConfidenceFeatures

#: Relative error within which a depth counts as correct for its confidence.
RIGHT_WITHIN = 0.1
#: ``known_fraction`` of the surrounding matches above which they determine the depth as far as data support
#: states.
MIN_DATA_FRACTION = 0.33


def data_support(known: Tensor, size: tuple[int, int]) -> Tensor:
    """Compute data support ``(1, 1, H, W)`` in [0, 1] from the ``known_fraction`` of the matches."""
    fraction = (known / MIN_DATA_FRACTION).clamp_max(1.0)
    return F.interpolate(fraction, size, mode="bilinear", align_corners=False)


def features_of(denoised_m: Tensor, depth_m: Tensor, target: Matches, support: Tensor) -> ConfidenceFeatures:
    """Compute the confidence features of a depth: data support, match residual, change and discontinuity.

    Data support is the total weight of the matches around a pixel, not their agreement. A depth is often
    wrong where matches scatter around it or where the last fit changed the denoised map. It is also often
    wrong next to a depth discontinuity, whose position is uncertain.

    Args:
        denoised_m: ``(1, 1, H, W)`` metres, the map before its last fit to the matches.
        depth_m: like ``denoised_m``, the result.
        target: matches and points, on any grid.
        support: ``(1, 1, H, W)`` in [0, 1], from ``fit_depth``.
    """
    log_depth, denoised = (log_depth_at(each_m, target.size) for each_m in (depth_m, denoised_m))
    features = _features_on_grid(log_depth, denoised, target)
    found = F.interpolate(features, image_size(support), mode="bilinear")
    return ConfidenceFeatures(support, *found.split(1, 1))


@has_kernel("result.kernels.confidence.features_on_grid")
def _features_on_grid(log_depth: Tensor, denoised: Tensor, target: Matches) -> Tensor:
    """Compute residual, change and discontinuity, ``(1, 3, h, w)``, on the grid of the matches."""
    planes = (target.inverse_depth - torch.exp(-log_depth)) / target.plane_step.view(-1, 1, 1, 1)
    weighted = target.confidence * planes.abs().clamp_max(MAX_RESIDUAL)
    layers = torch.cat([target.confidence, weighted, (log_depth - denoised).abs()], 1)
    weight, weighted, change = window_mean(layers, FEATURE_RADIUS).split(1, 1)
    residual = (weighted + PSEUDO_CONFIDENCE * MAX_RESIDUAL) / (weight + PSEUDO_CONFIDENCE)
    # A map that hardly any match could change does not count as stable.
    known = target.confidence.clamp_max(1.0).mean((2, 3), keepdim=True)
    fraction = known / (known + PSEUDO_CONFIDENCE)
    change = change.clamp(MIN_CHANGE, MAX_CHANGE) ** fraction * MAX_CHANGE ** (1.0 - fraction)
    return torch.cat([residual, change, range_around(log_depth, DISCONTINUITY_RADIUS)], 1)


def depth_evidence(
    features: ConfidenceFeatures, spread: Tensor | None, prior_error: Tensor | None = None
) -> Tensor:
    """Compute the features ``(B, 6, H, W)`` of the logistic model in ``depth_confidence``, same arguments.

        In order, they are:

    - the constant 1;
    - certainty, the log of .05 over the remaining error ``(1 - support) * e``. With less data support, the
      prior error ``e`` of a pixel moves from the measured value towards the error of a useless prior;
    - closeness, the log of 10 planes over the match residual;
    - stability, the log of .2 over the change by the last fit;
    - evenness, the log of .5 over the range of log depth in the neighbourhood;
    - the spread of the ensemble, 0 without one.
    """
    support, residual, change, discontinuity = features
    measured = (
        support.new_tensor(MAX_PRIOR_ERROR)
        if prior_error is None
        else prior_error.clamp(MIN_PRIOR_ERROR, MAX_PRIOR_ERROR)
    )
    fraction = support / (support + HALF_SUPPORT)
    remaining = (1.0 - support) * measured**fraction * MAX_PRIOR_ERROR ** (1.0 - fraction)
    evidence = [
        torch.ones_like(support),
        -(remaining.clamp(MIN_REMAINING_ERROR, MAX_REMAINING_ERROR) / MAX_REMAINING_ERROR).log(),
        -(residual.clamp(MIN_RESIDUAL, MAX_RESIDUAL) / MAX_RESIDUAL).log(),
        -(change.clamp(MIN_CHANGE, MAX_CHANGE) / MAX_CHANGE).log(),
        -(discontinuity.clamp(MIN_DISCONTINUITY, MAX_DISCONTINUITY) / MAX_DISCONTINUITY).log(),
        torch.zeros_like(support) if spread is None else spread,
    ]
    return torch.cat(evidence, dim=1)


def depth_confidence(
    features: ConfidenceFeatures, spread: Tensor | None, prior_error: Tensor | None = None
) -> Tensor:
    """Compute the probability ``(B, 1, H, W)`` that a depth is within 10 % of ground truth.

    Depends on its features, the relative spread of the ensemble members (or ``None``), and the prior's
    ``local_error`` on any grid (``None`` counts as a useless prior).
    """
    if prior_error is not None and image_size(prior_error) != (1, 1):
        prior_error = F.interpolate(prior_error, image_size(features.support), mode="nearest-exact")
    return _confidence(features, spread, prior_error)


@has_kernel("result.kernels.confidence.confidence")
def _confidence(features: ConfidenceFeatures, spread: Tensor | None, prior_error: Tensor | None) -> Tensor:
    """Compute ``depth_confidence``; ``prior_error`` is one number per map or has the size of the maps."""
    support = features.support
    weights = support.new_tensor(DEPTH_LOG_ODDS).view(1, -1, 1, 1)
    confidence = torch.empty_like(support)
    for rows in row_strips(*image_size(support)):  # the features need six times the memory of the result
        part = ConfidenceFeatures(*(x[:, :, rows] for x in features))
        further = (None if x is None else x.expand_as(support)[:, :, rows] for x in (spread, prior_error))
        confidence[:, :, rows] = torch.sigmoid(
            (weights * depth_evidence(part, *further)).sum(1, keepdim=True)
        )
    return confidence


def reprojection(rights: Sequence[View], depth_m: Tensor, left: View) -> tuple[Tensor, Tensor]:
    """Return where any native right view sees the pixel, and the least photometric error of the warped views.

    ``(1, 1, H, W)`` bool and float in [0, 1], in the left image's exposure; the error is 0 where no view sees
    the pixel. ``left`` has the size of the depth. Invalid pixels of either image are not visible.
    """
    best, visible = None, None
    for view in rights:
        view = view.as_fine_as(left.camera)
        warped, seen = _warped(view, depth_m, left.camera)
        seen = _visible_and_valid(seen, view, depth_m, left)
        error = torch.where(seen, _photometric_error(warped, left.image_01[None], seen), torch.inf)
        best = error if best is None else torch.minimum(best, error)
        visible = seen if visible is None else visible | seen
    assert best is not None and visible is not None  # there are views
    return visible, torch.where(visible, best, 0.0)


def _visible_and_valid(seen: Tensor, view: View, depth_m: Tensor, left: View) -> Tensor:
    """Restrict visible pixels ``(1, 1, H, W)`` bool to those that are valid in both images."""
    if left.valid is not None:
        seen = seen & left.valid
    if view.valid is None:
        return seen
    mask = view.valid.to(view.image_01).expand_as(view.image_01).contiguous()
    warped, _ = _warped(view._replace(image_01=mask), depth_m, left.camera)
    return seen & (warped[:, :1] > ALL_VALID)


@has_kernel("result.kernels.reprojection.photometric_error")
def _photometric_error(warped: Tensor, left_01: Tensor, seen: Tensor) -> Tensor:
    """Compute the mean absolute difference ``(1, 1, H, W)`` of a warped image, in the left one's exposure."""
    error = torch.zeros_like(warped[:, :1])
    for layer in range(left_01.shape[1]):  # one by one, to avoid a copy of all three
        channel = slice(layer, layer + 1)
        matched = match_exposure(warped[:, channel], left_01[:, channel], seen)
        error += matched.sub_(left_01[:, channel]).abs_()
    return error.div_(left_01.shape[1])


@has_kernel("result.kernels.reprojection.warped")
def _warped(right: View, depth_m: Tensor, left: Camera) -> tuple[Tensor, Tensor]:
    """Warp the right image to the left grid, in strips to save memory; also returns its visibility."""
    right_01, (height, width) = right.image_01[None], image_size(depth_m)
    warped = right_01.new_empty((1, right_01.shape[1], height, width))
    visible = torch.empty_like(depth_m, dtype=torch.bool)
    for rows in row_strips(height, width):
        strip_m = depth_m[:, :, rows]
        strip = left.cropped((0, rows.start, width, rows.stop))
        part = warp_right_to_left(
            right_01, strip_m, plane_rays(strip_m, [strip], [right.camera], [right.T_right_from_left])
        )
        warped[:, :, rows], visible[:, :, rows] = part.image, part.visible
    return warped, visible
