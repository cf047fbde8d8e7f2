"""Computes sigma, the standard deviation of a depth, from confidence, geometry and pose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import erf, ndtri

from geodiff_plugin._internal.statistics import SD_PER_MAD
from geodiff_plugin._internal.strips import row_strips
from geodiff_plugin.result.confidence import RIGHT_WITHIN
from geodiff_plugin.result.expected_error import expected_error
from geodiff_plugin.trust import FactSheet, PoseUncertainty, match_error

#: Lower bound of the confidence when it is converted to a standard deviation.
MIN_CONFIDENCE = 0.05
#: Upper bound of the confidence when it is converted to a standard deviation.
MAX_CONFIDENCE = 0.999
#: Standard deviation of an inlier, as a multiple of the standard error of its match. Errors of neighbouring
#: matches are correlated, so it exceeds 1. This and the next two constants are near the maximum likelihood of
#: the errors of the 13 real and 8 plain rendered pairs in docs/appendix/results-trust.md; the log likelihood
#: per pixel changes by less than .03 from 1 to 2, from .002 to .01, and from .15 to .3.
INLIER_FACTOR = 1.5
#: Minimum standard deviation of an inlier, relative to its depth.
MIN_INLIER = 0.005
#: Standard deviation of an outlier, relative to its depth. It is larger if the confidence is too low for
#: such an error.
OUTLIER = 0.2


def relative_sigma(confidence: np.ndarray, geometric: np.ndarray | None = None) -> np.ndarray:
    """Compute the standard deviation of a depth relative to the depth, in the shape of the arguments.

    The error is a mixture of two zero-mean normal distributions: of inliers, whose standard deviation
    ``s_in`` follows from the standard error of the match, and of outliers with a wide ``s_out``. The fraction
    ``w`` of inliers is the one with which an error is below ``RIGHT_WITHIN`` with the probability
    ``confidence``. Sigma is ``w s_in + (1 - w) s_out``: the normal distribution with this standard deviation
    has the same mean absolute error as the mixture.

    Args:
        confidence: in [0, 1].
        geometric: standard error of the match and the pose, relative to the depth. Without it, all errors
            are inliers with the standard deviation that the confidence implies.
    """
    bounded = np.clip(confidence, MIN_CONFIDENCE, MAX_CONFIDENCE)
    alone = RIGHT_WITHIN / ndtri((1.0 + bounded) / 2.0)
    if geometric is None:
        return alone
    # An inlier is as precise as its confidence implies, but no more precise than its match.
    inlier, least = (np.hypot(factor * geometric, MIN_INLIER) for factor in (INLIER_FACTOR, 1.0))
    inlier = np.minimum(inlier, np.maximum(alone, least))
    outlier = np.maximum(np.maximum(OUTLIER, alone), inlier)
    within, without = (erf(RIGHT_WITHIN / (np.sqrt(2.0) * each)) for each in (inlier, outlier))
    fraction = np.clip((bounded - without) / np.maximum(within - without, 1e-9), 0.0, 1.0)
    return fraction * inlier + (1.0 - fraction) * outlier


def geometric_sigma(
    depth_m: np.ndarray, K_left: np.ndarray, poses: Sequence[np.ndarray], facts: FactSheet
) -> np.ndarray:
    """Compute the standard error of a matched depth ``(H, W)``, metres, including the errors of the facts.

    ``poses (4, 4)`` are the poses in use; ``expected_error`` has the equations.
    """
    return expected_error(depth_m, K_left, poses, PoseUncertainty.scale_rel_std(facts), match_error(facts))


def depth_sigma(
    depth_m: np.ndarray,
    confidence: np.ndarray,
    geometric_m: np.ndarray | None = None,
    deviation_m: np.ndarray | None = None,
    scale_rel_std: float | None = None,
) -> np.ndarray:
    """Compute the standard deviation of a depth map, ``(H, W)`` float32 metres; NaN where there is no depth.

    It is conditional on a correct calibration, as the confidence is. A depth with confidence 0 counts as
    none.

    Args:
        depth_m: ``(H, W)`` metres.
        confidence: ``(H, W)`` in [0, 1].
        geometric_m: ``geometric_sigma``; ``None`` if no second view was matched.
        deviation_m: ``(H, W)`` metres, median absolute deviation of the ensemble members, a lower bound.
        scale_rel_std: relative standard deviation of the scale of estimated poses.
    """
    sigma_m = np.empty(depth_m.shape, np.float32)
    for rows in row_strips(*depth_m.shape):
        known = np.isfinite(depth_m[rows]) & (depth_m[rows] > 0) & (confidence[rows] > 0)
        z_m = np.where(known, depth_m[rows], 1.0).astype(np.float64)
        geometric = None if geometric_m is None else geometric_m[rows] / z_m
        relative = relative_sigma(confidence[rows].astype(np.float64), geometric)
        if deviation_m is not None:
            relative = np.maximum(relative, SD_PER_MAD * deviation_m[rows] / z_m)
        if scale_rel_std is not None:
            relative = np.hypot(relative, scale_rel_std)
        sigma_m[rows] = np.where(known, relative * z_m, np.nan)
    return sigma_m
