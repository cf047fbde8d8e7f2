"""Errors at the edges of dense ground truth, and of the surfaces between them."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from geodiff_plugin.evaluation.metrics import Map

#: Step of log depth between neighbours that makes an edge of dense ground truth.
LOG_STEP = 0.08
#: How near an edge counts as at it, pixels.
NEAR_EDGE = 3
#: How far from an edge surfaces begin, pixels.
OFF_EDGE = 5


def depth_edges(depth_m: Map, valid: Map) -> Map:
    """``(H, W)`` bool: pixels whose 3x3 neighbourhood is known and has a step of depth in it."""
    log = np.log(np.where(valid, depth_m, 1.0))
    high = ndimage.maximum_filter(np.where(valid, log, np.inf), 3)
    low = ndimage.minimum_filter(np.where(valid, log, -np.inf), 3)
    return np.isfinite(high) & np.isfinite(low) & (high - low > LOG_STEP)


def edge_error(pred_m: Map, ground_truth_m: Map, valid: Map) -> float:
    """Mean relative error within ``NEAR_EDGE`` of the edges of dense ground truth; NaN without an edge."""
    near = ndimage.binary_dilation(depth_edges(ground_truth_m, valid), iterations=NEAR_EDGE) & valid
    return (
        float((np.abs(pred_m - ground_truth_m)[near] / ground_truth_m[near]).mean())
        if near.any()
        else float("nan")
    )


def surface_error(pred_m: Map, ground_truth_m: Map, valid: Map) -> float:
    """Mean absolute error of the slope of log depth, per mille a pixel, more than 5 px from any edge."""
    off = valid & ~ndimage.binary_dilation(depth_edges(ground_truth_m, valid), iterations=OFF_EDGE)
    difference = np.log(np.maximum(pred_m, 1e-6)) - np.log(np.where(valid, ground_truth_m, 1.0))
    whole = off[1:, 1:] & off[:-1, 1:] & off[1:, :-1]
    if not whole.any():
        return float("nan")
    slopes = [np.abs(np.diff(difference, axis=axis)) for axis in (0, 1)]
    return float(500.0 * (slopes[0][:, 1:] + slopes[1][1:])[whole].mean())
