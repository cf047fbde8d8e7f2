"""Metrics of depth, disparity, uncertainty and edges against ground truth, and alignment (paper S5.1).

Maps are ``(H, W)``: ``pred_m`` and ``ground_truth_m`` float, metres; disparity in pixels; ``valid`` bool,
where the ground truth counts. Predictions that are not finite or not positive are holes, which never count.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage

from geodiff_plugin._internal.checks import bad_value, check_choice
from geodiff_plugin.scale.space import SPACES

#: ``(H, W)``, or some of its pixels.
Map = np.ndarray
#: Minimum ground truth that counts and minimum value of a prediction, metres (Marigold's evaluation of
#: KITTI).
FLOOR_M = 1e-5
#: Maximum aligned depth, metres, of predictions that decrease with depth.
MAX_ALIGNED_M = 1000.0
#: Maximum ratio of an inlier in the Robust Multi-View Depth Benchmark.
INLIER = 1.03
#: Metrics of depths ``(p, t)`` in metres, over pixels with both. Deltas are fractions of max(p/t, t/p) below
#: 1.25**k; the RMSE is rooted, logarithms are natural, SILog is 100 times a standard deviation.
DEPTH_METRICS: dict[str, Callable[[Map, Map], np.floating]] = {
    "abs_rel": lambda p, t: np.mean(np.abs(p - t) / t),
    "delta1": lambda p, t: np.mean(np.maximum(p / t, t / p) < 1.25),
    "delta2": lambda p, t: np.mean(np.maximum(p / t, t / p) < 1.25**2),
    "delta3": lambda p, t: np.mean(np.maximum(p / t, t / p) < 1.25**3),
    "inliers": lambda p, t: np.mean(np.maximum(p / t, t / p) < INLIER),
    "rmse": lambda p, t: np.sqrt(np.mean((p - t) ** 2)),
    "log_rmse": lambda p, t: np.sqrt(np.mean((np.log(p) - np.log(t)) ** 2)),
    "silog": lambda p, t: 100.0 * np.std(np.log(p) - np.log(t)),
}
#: Metrics of disparity errors ``e`` and ground truth ``t`` in pixels, with their threshold. Bad-k is a
#: fraction of pixels; D1 is KITTI's: above 3 px and above 5 % of the ground truth.
DISPARITY_METRICS: dict[str, tuple[float, Callable[[Map, Map], np.floating]]] = {
    "epe": (np.inf, lambda e, t: np.mean(e)),
    "bad1": (1, lambda e, t: np.mean(e > 1)),
    "bad2": (2, lambda e, t: np.mean(e > 2)),
    "bad3": (3, lambda e, t: np.mean(e > 3)),
    "d1": (3, lambda e, t: np.mean((e > 3) & (e > 0.05 * np.abs(t)))),
}


def answered(pred_m: Map) -> Map:
    """``(H, W)`` bool: pixels of a metric map that are no holes."""
    return np.isfinite(pred_m) & (pred_m > 0)


def counted(ground_truth_m: Map, valid: Map, cap_m: float | None = None) -> Map:
    """``(H, W)`` bool: pixels with ground truth between ``FLOOR_M`` and the cap; raise if there are none."""
    valid = np.asarray(valid, bool)  # integers would index rows
    kept = (
        valid
        & np.isfinite(ground_truth_m)
        & (ground_truth_m > FLOOR_M)
        & (True if cap_m is None else ground_truth_m < cap_m)
    )
    if not kept.any():
        bad_value(
            "ground truth", "known for at least one pixel", "no valid pixel", "Check the mask and the cap."
        )
    return kept


def evaluate_depth(
    pred_m: Map, ground_truth_m: Map, valid: Map, cap_m: float | None = None
) -> dict[str, float]:
    """Compute metrics of a depth map; drop ground truth from ``cap_m`` on, and clip predictions to it.

    ``DEPTH_METRICS``, NaN if no pixel has ground truth and prediction; ``coverage`` (fraction of ground-truth
    pixels with a prediction); ``pixels``, their number. ``ValueError`` if shapes differ or no pixel has
    ground truth.
    """
    if not pred_m.shape == ground_truth_m.shape == valid.shape:
        bad_value("maps", "of equal shape (H, W)", f"{pred_m.shape}, {ground_truth_m.shape}, {valid.shape}")
    kept = counted(ground_truth_m, valid, cap_m)
    pred, ground_truth = np.asarray(pred_m, np.float64)[kept], np.asarray(ground_truth_m, np.float64)[kept]
    filled = answered(pred)
    scores = {"coverage": float(filled.mean()), "pixels": float(kept.sum())}
    if not filled.any():
        return dict.fromkeys(DEPTH_METRICS, float("nan")) | scores
    pred = np.clip(pred[filled], FLOOR_M, cap_m)
    ground_truth = ground_truth[filled]
    return {name: float(metric(pred, ground_truth)) for name, metric in DEPTH_METRICS.items()} | scores


def bad_fraction(pred_px: Map, ground_truth_px: Map, mask: Map, limit_px: float) -> float | None:
    """Fraction of the pixels in ``mask`` with a disparity error above a limit; a hole is an error.

    ``None`` if the mask is empty. Source: the development kits of KITTI, Middlebury and ETH3D; KITTI's fills
    holes instead.
    """
    error = np.abs(pred_px - ground_truth_px)[mask]
    return float(np.mean(~(error <= limit_px))) if error.size else None


def evaluate_disparity(
    pred_px: Map, ground_truth_px: Map, valid: Map, step_px: float = 0.0
) -> dict[str, float | None]:
    """Compute ``DISPARITY_METRICS`` of a map in pixels; NaN without pixels with ground truth and prediction.

    ``step_px`` is the step between neighbouring values of the ground truth: metrics with a finer threshold
    are ``None``.
    """
    kept = np.asarray(valid, bool)
    error = np.abs(pred_px - ground_truth_px)[kept]
    ground_truth = ground_truth_px[kept]
    filled = np.isfinite(error)
    error, ground_truth = error[filled], ground_truth[filled]
    scores: dict[str, float | None] = {}
    for name, (limit, metric) in DISPARITY_METRICS.items():
        score = float(metric(error, ground_truth)) if error.size else float("nan")
        scores[name] = None if step_px > limit else score
    return scores


def _remaining(error: Map, order: Map, steps: int) -> Map:
    """Mean error without the first ``k / steps`` of the pixels in an order, for every k."""
    cut = (np.arange(steps) * error.size) // steps
    return np.cumsum(error[order][::-1])[::-1][cut] / (error.size - cut)


class RiskCoverage(NamedTuple):
    """Mean relative error of the most certain pixels, by their fraction of all: ``(steps,)`` each."""

    coverage: Map  # from 1 down to 1 / steps
    risk: Map  # in the order of the uncertainty
    oracle: Map  # in the order of the errors themselves


def risk_coverage(
    pred_m: Map, ground_truth_m: Map, valid: Map, uncertainty: Map | None, steps: int = 100
) -> RiskCoverage:
    """Compute the risk-coverage curve: the AbsRel that remains if only the most certain pixels are kept.

    ``uncertainty`` is ``(H, W)``, any unit, larger is less certain; ``None``: the mean over random ones.
    ``ValueError`` if no pixel has ground truth, prediction and uncertainty.
    Source: Geifman and El-Yaniv, "Selective Classification for Deep Neural Networks", S2.
    """
    kept = (
        np.asarray(valid, bool)
        & answered(pred_m)
        & (True if uncertainty is None else np.isfinite(uncertainty))
    )
    if not kept.any():
        bad_value("uncertainty", "finite for at least one pixel with ground truth and prediction", "none")
    ground_truth = np.asarray(ground_truth_m, np.float64)[kept]
    error = np.abs(np.asarray(pred_m, np.float64)[kept] - ground_truth) / ground_truth
    # Stable sorts keep the image's order for equal uncertainty on every machine.
    oracle = _remaining(error, np.argsort(-error, kind="stable"), steps)
    coverage = 1.0 - np.arange(steps) / steps
    if uncertainty is None:
        return RiskCoverage(coverage, np.full(steps, error.mean()), oracle)
    order = np.argsort(-np.asarray(uncertainty, np.float64)[kept], kind="stable")
    return RiskCoverage(coverage, _remaining(error, order, steps), oracle)


def ause(pred_m: Map, ground_truth_m: Map, valid: Map, uncertainty: Map | None, steps: int = 100) -> float:
    """Area under the sparsification error: how badly uncertainty sorts pixels by relative error.

    This is the area between ``risk_coverage`` (same arguments) and its oracle.
    Source: Ilg et al., "Uncertainty Estimates and Multi-Hypotheses Networks for Optical Flow", S5.
    """
    curve = risk_coverage(pred_m, ground_truth_m, valid, uncertainty, steps)
    return float(np.mean(curve.risk - curve.oracle))


def confidence_deciles(
    pred_m: Map, ground_truth_m: Map, valid: Map, confidence: Map, within: float
) -> list[dict[str, float | None]]:
    """Compare the confidence that the relative error is below ``within`` with the observed rate, by decile.

    ``fraction`` of the pixels, mean ``predicted``, ``observed``, ``abs_rel``; ``None`` for an empty decile.
    """
    used = valid & answered(pred_m)
    error = np.abs(pred_m[used] - ground_truth_m[used]) / ground_truth_m[used]
    predicted = confidence[used]
    values = {"predicted": predicted, "observed": error < within, "abs_rel": error}
    decile = np.minimum((predicted * 10).astype(int), 9)
    classes = list[dict[str, float | None]]()
    for inside in (decile == k for k in range(10)):
        means = {name: float(np.mean(v[inside])) if inside.any() else None for name, v in values.items()}
        classes.append({"fraction": float(inside.mean()) if inside.size else 0.0, **means})
    return classes


def to_space(depth_m: Map, space: str) -> Map:
    """Convert depths in metres, > 0, of any shape, to a space in ``SPACES``, float64."""
    return SPACES[space].inverse(torch.from_numpy(np.asarray(depth_m, np.float64))).numpy()


def align(values: Map, ground_truth_m: Map, valid: Map, space: str = "depth") -> Map:
    """Align ``values``, correct up to scale and shift in a space of ``SPACES``, to depth ``(H, W)`` metres.

    The result is at least ``FLOOR_M``, and at most ``MAX_ALIGNED_M`` if values decrease with depth. It is NaN
    where ``values`` is not finite, and everywhere if no pixel has ground truth and prediction. Source:
    Marigold's evaluation, ``least_square`` and ``least_square_disparity``, the latter over positive
    predictions only.
    """
    kind = SPACES[check_choice(space, "space", SPACES)]
    known = valid & np.isfinite(values) & (ground_truth_m > 0)
    if space == "disparity":
        known &= np.nan_to_num(values) > 0
    if not known.any():  # without predictions there are no errors
        return np.full(np.shape(ground_truth_m), np.nan)
    target = to_space(np.asarray(ground_truth_m, np.float64)[known], space)
    values = np.asarray(values, np.float64)
    pairs = np.stack([values[known], np.ones(known.sum())], axis=1)
    scale, shift = np.linalg.lstsq(pairs, target, rcond=None)[0]
    x = torch.from_numpy(values * scale + shift)
    if not kind.grows_with_depth:
        x = x.clamp_min(float(to_space(np.array(MAX_ALIGNED_M), space)))
    depth_m = kind.forward(x, torch.ones((), dtype=torch.float64)).numpy()  # for a global scale of 1
    return np.where(np.isfinite(values), np.maximum(depth_m, FLOOR_M), np.nan)


#: Minimum ground-truth disparity step between neighbours that makes an edge, pixels.
STEP_PX = 3.0
#: Maximum distance of an "edge" pixel from an edge, pixels.
MAX_DISTANCE_PX = 4
#: Depth ratios of neighbours that Depth Pro counts as boundaries; thresholds are weighted by their size.
RATIOS = np.linspace(1.05, 1.25, 10)
#: Standard deviation in pixels of iBims-1's Canny filter on depth scaled to [0, 1].
CANNY_SIGMA = np.sqrt(2.0)
#: Lower threshold of the gradient of that filter.
CANNY_LOW = 0.1
CANNY_HIGH = 0.2
#: iBims-1's maximum distance between two boundaries, pixels.
MAX_PX = 10.0


def near_disparity_steps(disparity_px: Map, valid: Map) -> Map:
    """``(H, W)`` bool: pixels near a step of the ground-truth disparity between known neighbours."""
    step = np.zeros(valid.shape, bool)
    known_px = np.where(valid, disparity_px, np.nan)
    for near, px in ((step, known_px), (step.T, known_px.T)):
        is_step = np.abs(np.diff(px)) > STEP_PX
        near[:, 1:] |= is_step
        near[:, :-1] |= is_step
    return valid & step.any() & (ndimage.distance_transform_edt(~step) <= MAX_DISTANCE_PX)


def occluded_by_ground_truth(disparity_px: Map, valid: Map) -> Map:
    """``(H, W)`` bool: pixels occluded in the right view by ground-truth disparity larger by 1 px."""
    target = np.rint(np.arange(valid.shape[1]) - np.where(valid, disparity_px, 0.0)).astype(int)
    rows, columns = np.nonzero(valid & (target >= 0) & (target < valid.shape[1]))
    shift = disparity_px[rows, columns]
    at = (rows, target[rows, columns])
    nearest = np.full(valid.shape, -np.inf)
    hidden = np.zeros(valid.shape, bool)
    np.maximum.at(nearest, at, shift)
    hidden[rows, columns] = nearest[at] > shift + 1.0
    return hidden


def _front_of(depth_m: Map, known: Map) -> list[tuple[Map, Map]]:
    """Ratios of the right, left, lower and upper neighbour's depth to a pixel's, and where both are known."""
    pairs = []
    for depth, known_there in ((depth_m, known), (depth_m.T, known.T)):
        first = depth[:, :-1]
        second = depth[:, 1:]
        both = known_there[:, :-1] & known_there[:, 1:]
        pairs += [(second / first, both), (first / second, both)]
    return pairs


def boundary_f1(pred_m: Map, ground_truth_m: Map, valid: Map) -> float:
    """F1 of depth boundaries against ground truth, scale-invariant, in [0, 1]; NaN without boundaries.

    Source: Depth Pro, S3.2 and ``SI_boundary_F1``: F1 of foreground relations of neighbours, by four
    directions, averaged over thresholds of their ratio. Deviation: masked, because ground truth has holes.
    """
    known = valid & answered(pred_m)
    pred, ground_truth = (
        _front_of(np.where(known, m, 1.0).astype(np.float64), known) for m in (pred_m, ground_truth_m)
    )
    if not any((both & (ratio > RATIOS[0])).any() for ratio, both in ground_truth):
        return float("nan")
    total = 0.0
    for threshold in RATIOS:
        recall = precision = 0.0
        for (ratio, both), (true_ratio, _) in zip(pred, ground_truth, strict=True):
            drawn, true = both & (ratio > threshold), both & (true_ratio > threshold)
            hits = 0.25 * float((drawn & true).sum())
            recall += hits / max(float(true.sum()), 1.0)
            precision += hits / max(float(drawn.sum()), 1.0)
        if recall + precision > 0:
            total += threshold * 2 * recall * precision / (recall + precision)
    return float(total / RATIOS.sum())


def _canny(depth_m: Map) -> Map:
    """``(H, W)`` bool: thin edges of a map without holes, scaled to [0, 1]."""
    span = max(float(np.ptp(depth_m)), 1e-12)
    smooth = ndimage.gaussian_filter((depth_m - depth_m.min()) / span, CANNY_SIGMA, mode="nearest")
    dy, dx = (ndimage.sobel(smooth, axis) for axis in (0, 1))
    size = np.hypot(dx, dy)
    # The gradient is largest across the edge, between the two neighbours on either side.
    rows, columns = np.indices(size.shape, dtype=np.float64)
    unit = np.maximum(np.maximum(np.abs(dx), np.abs(dy)), 1e-12)
    sides = ((rows + s * dy / unit, columns + s * dx / unit) for s in (-1.0, 1.0))
    neighbours = [ndimage.map_coordinates(size, side, order=1, mode="nearest") for side in sides]
    ridge = (size >= neighbours[0]) & (size > neighbours[1])
    weak, strong = ridge & (size >= CANNY_LOW), ridge & (size >= CANNY_HIGH)
    labels, _ = ndimage.label(weak, np.ones((3, 3)))
    return weak & np.isin(labels, np.unique(labels[strong]))


def boundary_errors(pred_m: Map, ground_truth_m: Map, valid: Map) -> dict[str, float]:
    """Mean distances in pixels between boundaries of a map (holes filled) and of the ground truth.

    ``dbe_acc``: from the map's boundaries to the ground truth's, below 10; ``dbe_comp``: both ways, clipped
    to 10.
    Source: Koch et al. 2018 (iBims-1), S3.2. Deviation: their ground-truth boundaries are annotated by hand.
    """
    known = answered(pred_m)
    true = _canny(filled(ground_truth_m, valid)) & valid
    if not known.any() or not true.any():
        return {"dbe_acc": float("nan"), "dbe_comp": float("nan")}
    drawn = _canny(filled(pred_m, known)) & valid
    to_true = ndimage.distance_transform_edt(~true)
    near = drawn & (to_true < MAX_PX)
    if not near.any():
        return {"dbe_acc": MAX_PX, "dbe_comp": MAX_PX}
    both = np.concatenate([to_true[drawn], ndimage.distance_transform_edt(~drawn)[true]])
    return {"dbe_acc": float(to_true[near].mean()), "dbe_comp": float(np.minimum(both, MAX_PX).mean())}


def filled(depth_m: Map, known: Map) -> Map:
    """Fill holes with the nearest known depth, float64."""
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(depth_m, np.float64)[tuple(nearest)]
