"""Errors of depth, disparity, uncertainty and edges against the truth, and alignment with it (paper S5.1).

Maps are ``(H, W)``: ``pred_m`` and ``truth_m`` float, metres; disparity in pixels; ``valid`` bool, where the
truth counts. A prediction is not finite, or not positive, where a method leaves a hole; holes count nowhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy import ndimage

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.scale.space import SPACES

#: ``(H, W)``, or of some of its pixels.
Map = np.ndarray
#: Nearest truth that counts and nearest value of a prediction, metres (Marigold's evaluation of KITTI).
FLOOR_M = 1e-5
#: Aligned disparity, 1/m, is clipped here before it is inverted: nothing is farther than a kilometre.
MIN_DISPARITY = 1e-3
#: Metric of depths ``(p, t)``, metres, of the pixels with both. The deltas are the shares of max(p/t, t/p)
#: below 1.25**k; the RMSE is rooted, the logarithms are natural, SILog is 100 times a standard deviation.
DEPTH_METRICS: dict[str, Callable[[Map, Map], np.floating]] = {
    "abs_rel": lambda p, t: np.mean(np.abs(p - t) / t),
    "delta1": lambda p, t: np.mean(np.maximum(p / t, t / p) < 1.25),
    "delta2": lambda p, t: np.mean(np.maximum(p / t, t / p) < 1.25**2),
    "delta3": lambda p, t: np.mean(np.maximum(p / t, t / p) < 1.25**3),
    "rmse": lambda p, t: np.sqrt(np.mean((p - t) ** 2)),
    "log_rmse": lambda p, t: np.sqrt(np.mean((np.log(p) - np.log(t)) ** 2)),
    "silog": lambda p, t: 100.0 * np.std(np.log(p) - np.log(t)),
}
#: Metric of disparity errors ``e`` and truths ``t``, pixels, and the threshold that it has. Bad-k is a share
#: of pixels; D1 is KITTI's: above 3 px and above 5 % of the truth.
DISPARITY_METRICS: dict[str, tuple[float, Callable[[Map, Map], np.floating]]] = {
    "epe": (np.inf, lambda e, t: np.mean(e)),
    "bad1": (1, lambda e, t: np.mean(e > 1)),
    "bad2": (2, lambda e, t: np.mean(e > 2)),
    "bad3": (3, lambda e, t: np.mean(e > 3)),
    "d1": (3, lambda e, t: np.mean((e > 3) & (e > 0.05 * np.abs(t)))),
}


def answered(pred_m: Map) -> Map:
    """``(H, W)`` bool: where a map in metres has no hole."""
    return np.isfinite(pred_m) & (pred_m > 0)


def counted(truth_m: Map, valid: Map, cap_m: float | None = None) -> Map:
    """``(H, W)`` bool: pixels whose truth is known and between ``FLOOR_M`` and any cap; at least one."""
    valid = np.asarray(valid, bool)  # integers would choose rows
    kept = valid & np.isfinite(truth_m) & (truth_m > FLOOR_M) & (True if cap_m is None else truth_m < cap_m)
    if not kept.any():
        bad_value("truth", "known for at least one pixel", "no valid pixel", "Check the mask and the cap.")
    return kept


def evaluate_depth(pred_m: Map, truth_m: Map, valid: Map, cap_m: float | None = None) -> dict[str, float]:
    """Errors of one depth map; truth from ``cap_m`` on is dropped, and predictions are clipped to it.

    ``DEPTH_METRICS``, NaN where no pixel has truth and prediction; ``coverage`` (share of the truth's pixels
    with a prediction); ``pixels``, their number. ``ValueError`` where shapes differ or no pixel has truth.
    """
    if not pred_m.shape == truth_m.shape == valid.shape:
        bad_value("maps", "of one shape (H, W)", f"{pred_m.shape}, {truth_m.shape}, {valid.shape}")
    kept = counted(truth_m, valid, cap_m)
    pred, truth = np.asarray(pred_m, np.float64)[kept], np.asarray(truth_m, np.float64)[kept]
    filled = answered(pred)
    scores = {"coverage": float(filled.mean()), "pixels": float(kept.sum())}
    if not filled.any():
        return dict.fromkeys(DEPTH_METRICS, float("nan")) | scores
    pred, truth = np.clip(pred[filled], FLOOR_M, cap_m), truth[filled]
    return {name: float(metric(pred, truth)) for name, metric in DEPTH_METRICS.items()} | scores


def evaluate_disparity(
    pred_px: Map, truth_px: Map, valid: Map, step_px: float = 0.0
) -> dict[str, float | None]:
    """``DISPARITY_METRICS`` of a disparity map, pixels; NaN without a pixel with truth and prediction.

    ``step_px`` lies between neighbouring values of the truth: a metric with a finer threshold is ``None``.
    """
    kept = np.asarray(valid, bool)
    error, truth = np.abs(pred_px - truth_px)[kept], truth_px[kept]
    filled = np.isfinite(error)
    error, truth = error[filled], truth[filled]
    scores: dict[str, float | None] = {}
    for name, (limit, metric) in DISPARITY_METRICS.items():
        score = float(metric(error, truth)) if error.size else float("nan")
        scores[name] = None if step_px > limit else score
    return scores


def _remaining(error: Map, order: Map, steps: int) -> Map:
    """Mean error without the first ``k / steps`` of the pixels of an order, for every k."""
    cut = (np.arange(steps) * error.size) // steps
    return np.cumsum(error[order][::-1])[::-1][cut] / (error.size - cut)


def ause(pred_m: Map, truth_m: Map, valid: Map, uncertainty: Map | None, steps: int = 100) -> float:
    """Area under the sparsification error: how badly the uncertainty sorts pixels by their relative error.

    ``uncertainty`` is ``(H, W)``, any unit, larger is less certain; ``None``: the mean over random ones.
    ``ValueError`` where no pixel has truth, prediction and uncertainty.
    Source: Ilg et al., "Uncertainty Estimates and Multi-Hypotheses Networks for Optical Flow", S5.
    """
    kept = (
        np.asarray(valid, bool)
        & answered(pred_m)
        & (True if uncertainty is None else np.isfinite(uncertainty))
    )
    if not kept.any():
        bad_value("uncertainty", "finite for at least one pixel with truth and prediction", "none")
    truth = np.asarray(truth_m, np.float64)[kept]
    error = np.abs(np.asarray(pred_m, np.float64)[kept] - truth) / truth
    # Stable sorts: pixels of equal uncertainty keep the image's order on every machine.
    best = _remaining(error, np.argsort(-error, kind="stable"), steps)
    if uncertainty is None:
        return float(error.mean() - best.mean())
    order = np.argsort(-np.asarray(uncertainty, np.float64)[kept], kind="stable")
    return float(np.mean(_remaining(error, order, steps) - best))


def confidence_deciles(
    pred_m: Map, truth_m: Map, valid: Map, confidence: Map, within: float
) -> list[dict[str, float | None]]:
    """What a confidence that the relative error is below ``within`` promises, and what it keeps, by decile.

    ``share`` of the pixels, mean ``promised``, ``kept``, ``abs_rel``; ``None`` for an empty class.
    """
    used = valid & answered(pred_m)
    error, promised = np.abs(pred_m[used] - truth_m[used]) / truth_m[used], confidence[used]
    values = {"promised": promised, "kept": error < within, "abs_rel": error}
    decile, classes = np.minimum((promised * 10).astype(int), 9), list[dict[str, float | None]]()
    for inside in (decile == k for k in range(10)):
        means = {name: float(np.mean(v[inside])) if inside.any() else None for name, v in values.items()}
        classes.append({"share": float(inside.mean()) if inside.size else 0.0, **means})
    return classes


def to_space(depth_m: Map, space: str) -> Map:
    """Depths in metres, > 0, of any shape, in a key of ``SPACES``, float64: linear in a right prior."""
    return SPACES[space].inverse(torch.from_numpy(np.asarray(depth_m, np.float64))).numpy()


def align(values: Map, truth_m: Map, valid: Map, space: str = "depth") -> Map:
    """Depth ``(H, W)`` in metres of ``values`` that are right up to scale and shift in a key of ``SPACES``.

    At least ``FLOOR_M``, at most a kilometre where values fall with depth; not finite where ``values`` is
    not, nor anywhere if no pixel has truth and prediction. Source: Marigold's evaluation, ``least_square``
    and ``least_square_disparity``, the latter over positive predictions only.
    """
    kind, metre = SPACES[check_choice(space, "space", SPACES)], torch.ones((), dtype=torch.float64)
    known = valid & np.isfinite(values) & (truth_m > 0)
    if space == "disparity":
        known &= np.nan_to_num(values) > 0
    if not known.any():  # a method without an answer has no errors, as without alignment
        return np.full(np.shape(truth_m), np.nan)
    target = to_space(np.asarray(truth_m, np.float64)[known], space)
    values = np.asarray(values, np.float64)
    pairs = np.stack([values[known], np.ones(known.sum())], axis=1)
    scale, shift = np.linalg.lstsq(pairs, target, rcond=None)[0]
    x = torch.from_numpy(values * scale + shift)
    if not kind.grows_with_depth:
        x = x.clamp_min(float(kind.inverse(metre / MIN_DISPARITY)))
    return np.maximum(kind.forward(x, metre).numpy(), FLOOR_M)


#: A step of the true disparity between neighbours that makes an edge, pixels.
STEP_PX = 3.0
#: How near an edge a pixel counts as "edge", pixels.
REACH_PX = 4
#: Ratios of neighbouring depths that Depth Pro counts as boundaries; a threshold weighs as much as its size.
RATIOS = np.linspace(1.05, 1.25, 10)
#: iBims-1's Canny filter of depth scaled to [0, 1]: standard deviation of its blur, pixels,
CANNY_SIGMA = np.sqrt(2.0)
#: and its two thresholds of the gradient.
CANNY_LOW = 0.1
CANNY_HIGH = 0.2
#: iBims-1's longest distance between two boundaries, pixels.
FARTHEST_PX = 10.0


def near_disparity_steps(disparity_px: Map, valid: Map) -> Map:
    """``(H, W)`` bool: pixels near a step of the true disparity between known neighbours."""
    step, known_px = np.zeros(valid.shape, bool), np.where(valid, disparity_px, np.nan)
    for near, px in ((step, known_px), (step.T, known_px.T)):
        apart = np.abs(np.diff(px)) > STEP_PX
        near[:, 1:] |= apart
        near[:, :-1] |= apart
    return valid & step.any() & (ndimage.distance_transform_edt(~step) <= REACH_PX)


def hidden_by_truth(disparity_px: Map, valid: Map) -> Map:
    """``(H, W)`` bool: pixels of dense truth onto whose place in the right image one nearer by 1 px falls."""
    target = np.rint(np.arange(valid.shape[1]) - np.where(valid, disparity_px, 0.0)).astype(int)
    rows, columns = np.nonzero(valid & (target >= 0) & (target < valid.shape[1]))
    shift, at = disparity_px[rows, columns], (rows, target[rows, columns])
    nearest, hidden = np.full(valid.shape, -np.inf), np.zeros(valid.shape, bool)
    np.maximum.at(nearest, at, shift)
    hidden[rows, columns] = nearest[at] > shift + 1.0
    return hidden


def _front_of(depth_m: Map, known: Map) -> list[tuple[Map, Map]]:
    """Depth of the neighbour right, left, below, above over that of a pixel, and where both are known."""
    pairs = []
    for depth, there in ((depth_m, known), (depth_m.T, known.T)):
        first, second, both = depth[:, :-1], depth[:, 1:], there[:, :-1] & there[:, 1:]
        pairs += [(second / first, both), (first / second, both)]
    return pairs


def boundary_f1(pred_m: Map, truth_m: Map, valid: Map) -> float:
    """How well the boundaries of a map of any scale lie where the truth's lie, in [0, 1]; NaN for none.

    Source: Depth Pro, S3.2 and ``SI_boundary_F1``: F1 of foreground relations of neighbours, by four
    directions, averaged over thresholds of their ratio. Deviation: masked, since our truth has holes.
    """
    known = valid & answered(pred_m)
    pred, truth = (_front_of(np.where(known, m, 1.0).astype(np.float64), known) for m in (pred_m, truth_m))
    if not any((both & (ratio > RATIOS[0])).any() for ratio, both in truth):
        return float("nan")
    total = 0.0
    for threshold in RATIOS:
        recall = precision = 0.0
        for (ratio, both), (true_ratio, _) in zip(pred, truth, strict=True):
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
    # Across the edge, between the two neighbours on either side, the gradient is the largest.
    rows, columns = np.indices(size.shape, dtype=np.float64)
    unit = np.maximum(np.maximum(np.abs(dx), np.abs(dy)), 1e-12)
    sides = ((rows + s * dy / unit, columns + s * dx / unit) for s in (-1.0, 1.0))
    beside = [ndimage.map_coordinates(size, side, order=1, mode="nearest") for side in sides]
    ridge = (size >= beside[0]) & (size > beside[1])
    weak, strong = ridge & (size >= CANNY_LOW), ridge & (size >= CANNY_HIGH)
    labels, _ = ndimage.label(weak, np.ones((3, 3)))
    return weak & np.isin(labels, np.unique(labels[strong]))


def boundary_errors(pred_m: Map, truth_m: Map, valid: Map) -> dict[str, float]:
    """Mean distances, pixels, between the boundaries of a map, its holes filled, and those of the truth.

    ``dbe_acc``: of the map's from the truth's, of those nearer than 10; ``dbe_comp``: both ways, at most 10
    each. Source: Koch et al. 2018 (iBims-1), S3.2. Deviation: their true boundaries are drawn by hand.
    """
    known = answered(pred_m)
    true = _canny(filled(truth_m, valid)) & valid
    if not known.any() or not true.any():
        return {"dbe_acc": float("nan"), "dbe_comp": float("nan")}
    drawn = _canny(filled(pred_m, known)) & valid
    to_true = ndimage.distance_transform_edt(~true)
    near = drawn & (to_true < FARTHEST_PX)
    if not near.any():
        return {"dbe_acc": FARTHEST_PX, "dbe_comp": FARTHEST_PX}
    both = np.concatenate([to_true[drawn], ndimage.distance_transform_edt(~drawn)[true]])
    return {"dbe_acc": float(to_true[near].mean()), "dbe_comp": float(np.minimum(both, FARTHEST_PX).mean())}


def filled(depth_m: Map, known: Map) -> Map:
    """The map with the nearest known depth in its holes, float64."""
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(depth_m, np.float64)[tuple(nearest)]
