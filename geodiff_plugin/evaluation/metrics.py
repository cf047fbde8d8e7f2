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
from geodiff_plugin.evaluation.options import CROPS
from geodiff_plugin.scale.space import SPACES

FLOOR_M = 1e-5
"""Nearest truth that counts and nearest value of a prediction, metres (Marigold's evaluation of KITTI)."""
MIN_DISPARITY = 1e-3
"""Aligned disparity, 1/m, is clipped here before it is inverted: nothing is farther than a kilometre."""

#: Metric of depths ``(p, t)``, metres, of the pixels with both. The deltas are the shares of max(p/t, t/p)
#: below 1.25**k; the RMSE is rooted, the logarithms are natural, SILog is 100 times a standard deviation.
DEPTH_METRICS: dict[str, Callable[[np.ndarray, np.ndarray], np.floating]] = {
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
DISPARITY_METRICS: dict[str, tuple[float, Callable[[np.ndarray, np.ndarray], np.floating]]] = {
    "epe": (np.inf, lambda e, t: np.mean(e)),
    "bad1": (1, lambda e, t: np.mean(e > 1)),
    "bad2": (2, lambda e, t: np.mean(e > 2)),
    "bad3": (3, lambda e, t: np.mean(e > 3)),
    "d1": (3, lambda e, t: np.mean((e > 3) & (e > 0.05 * np.abs(t)))),
}


def _check_maps(**maps: np.ndarray) -> None:
    if len({np.shape(values) for values in maps.values()}) != 1:
        shapes = ", ".join(f"{name} {np.shape(values)}" for name, values in maps.items())
        bad_value("maps", "of one shape (H, W)", shapes)


def counted(truth_m: np.ndarray, valid: np.ndarray, cap_m: float | None = None) -> np.ndarray:
    """``(H, W)`` bool: pixels whose truth is known and between ``FLOOR_M`` and any cap; at least one."""
    _check_maps(truth_m=truth_m, valid=valid)
    kept = valid & np.isfinite(truth_m) & (truth_m > FLOOR_M) & (True if cap_m is None else truth_m < cap_m)
    if not kept.any():
        bad_value("truth", "known for at least one pixel", "no valid pixel", "Check the mask and the cap.")
    return kept


def evaluate_depth(
    pred_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray, cap_m: float | None = None
) -> dict[str, float]:
    """Errors of one depth map; truth from ``cap_m`` on is dropped, and predictions are clipped to it.

    ``DEPTH_METRICS`` over the pixels with both truth and prediction, NaN where there is none; ``coverage``
    (share of the truth's pixels with a prediction) and ``pixels`` (their number). ``ValueError`` where shapes
    differ or no pixel has truth. Source: S5.1; Marigold's evaluation code for clipping and SILog.
    """
    _check_maps(pred_m=pred_m, truth_m=truth_m)
    kept = counted(truth_m, valid, cap_m)
    pred, truth = np.asarray(pred_m, np.float64)[kept], np.asarray(truth_m, np.float64)[kept]
    filled = np.isfinite(pred) & (pred > 0)
    scores = {"coverage": float(filled.mean()), "pixels": float(kept.sum())}
    if not filled.any():
        return dict.fromkeys(DEPTH_METRICS, float("nan")) | scores
    pred, truth = np.clip(pred[filled], FLOOR_M, cap_m), truth[filled]
    return {name: float(metric(pred, truth)) for name, metric in DEPTH_METRICS.items()} | scores


def evaluate_disparity(
    pred_px: np.ndarray, truth_px: np.ndarray, valid: np.ndarray, step_px: float = 0.0
) -> dict[str, float | None]:
    """``DISPARITY_METRICS`` of a disparity map, pixels; NaN without a pixel with truth and prediction.

    ``step_px`` is the distance between two neighbouring values that the truth can take: a metric whose
    threshold is finer is ``None``. Source: KITTI 2015 development kit (D1), Middlebury (bad-k).
    """
    _check_maps(pred_px=pred_px, truth_px=truth_px, valid=valid)
    if not valid.any():
        bad_value("truth", "known for at least one pixel", "no valid pixel")
    pred, truth = np.asarray(pred_px, np.float64)[valid], np.asarray(truth_px, np.float64)[valid]
    filled = np.isfinite(pred)
    error, truth = np.abs(pred[filled] - truth[filled]), truth[filled]
    return {
        name: None if step_px > limit else float(metric(error, truth)) if error.size else float("nan")
        for name, (limit, metric) in DISPARITY_METRICS.items()
    }


def _remaining(error: np.ndarray, order: np.ndarray, steps: int) -> np.ndarray:
    """Mean error without the first ``k / steps`` of the pixels of an order, for every k."""
    cut = (np.arange(steps) * error.size) // steps
    return np.cumsum(error[order][::-1])[::-1][cut] / (error.size - cut)


def ause(
    pred_m: np.ndarray,
    truth_m: np.ndarray,
    valid: np.ndarray,
    uncertainty: np.ndarray | None,
    steps: int = 100,
) -> float:
    """Area under the sparsification error: how badly the uncertainty sorts pixels by their error.

    The mean relative error without the share ``k / steps`` of the least certain pixels is compared with that
    without the worst ones, and the difference is averaged over k. ``uncertainty`` is ``(H, W)``, any unit,
    larger is less certain; ``None``: the mean over random ones.

    ``ValueError`` where no pixel has truth, prediction and uncertainty.
    Source: Ilg et al., "Uncertainty Estimates and Multi-Hypotheses Networks for Optical Flow", S5.
    """
    known = truth_m if uncertainty is None else uncertainty
    _check_maps(pred_m=pred_m, truth_m=truth_m, valid=valid, uncertainty=known)
    kept = valid & np.isfinite(pred_m) & (pred_m > 0) & np.isfinite(known)
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
    pred_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray, confidence: np.ndarray, within: float
) -> list[dict[str, float | None]]:
    """What a confidence in [0, 1], that the relative error is below ``within``, promises and what it keeps.

    Ten entries, from [0, 0.1) to [0.9, 1]: ``share`` of the pixels, mean ``promised``, ``kept`` (share of
    pixels within), ``abs_rel``; the last three ``None`` for an empty class.
    """
    _check_maps(pred_m=pred_m, truth_m=truth_m, valid=valid, confidence=confidence)
    used = valid & np.isfinite(pred_m) & (pred_m > 0)
    error, promised = np.abs(pred_m[used] - truth_m[used]) / truth_m[used], confidence[used]
    values = {"promised": promised, "kept": error < within, "abs_rel": error}
    decile, classes = np.minimum((promised * 10).astype(int), 9), list[dict[str, float | None]]()
    for k in range(10):
        inside = decile == k
        means = {name: float(np.mean(v[inside])) if inside.any() else None for name, v in values.items()}
        classes.append({"share": float(inside.mean()) if inside.size else 0.0, **means})
    return classes


def to_space(depth_m: np.ndarray, space: str) -> np.ndarray:
    """Depths in metres, > 0, of any shape, in a key of ``SPACES``, float64: linear in a right prior."""
    return SPACES[space].inverse(torch.from_numpy(np.asarray(depth_m, np.float64))).numpy()


def align(values: np.ndarray, truth_m: np.ndarray, valid: np.ndarray, space: str = "depth") -> np.ndarray:
    """Depth in metres of ``values`` that are right up to scale and shift in a key of ``SPACES``.

    Returns:
        ``(H, W)`` float64, metres, at least ``FLOOR_M``, and at most a kilometre where values fall with
        depth; not finite where ``values`` is not, nor anywhere if no pixel has both truth and prediction.

    Source: Marigold's evaluation: ``least_square`` and ``least_square_disparity``, the latter over positive
        predictions only and clipped at 1e-3; the other spaces likewise.
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


#: Shares of the image: first and last row, first and last column.
_SHARES = {"none": (0, 1, 0, 1), "garg": (0.40810811, 0.99189189, 0.03594771, 0.96405229)}
_SHARES["eigen"] = (0.3324324, 0.91351351, 0.0359477, 0.96405229)
#: Rows and columns that every image of KITTI's depth benchmark has.
_BENCHMARK = (352, 1216)


def crop_mask(name: str, size: tuple[int, int]) -> np.ndarray:
    """``(H, W)`` bool: pixels of an image inside of a crop, one of ``CROPS``; methods still see whole images.

    Of 375 x 1242 pixels, Garg's crop keeps rows 153 to 370 and columns 44 to 1196, Eigen's rows 124 to 341
    and the same columns, the benchmark's rows 23 to 374 and columns 13 to 1228 (bottom, middle).

    Source: Marigold's evaluation of KITTI, which follows BTS and monodepth. Deviation: Marigold's tables take
        Eigen's crop of an image that was cut to the benchmark's before; here each stands alone.
    """
    check_choice(name, "crop", CROPS)
    (height, width), (rows, columns), mask = size, _BENCHMARK, np.zeros(size, bool)
    if name != "benchmark":
        sides = zip(_SHARES[name], (height, height, width, width), strict=True)
        top, bottom, left, right = (int(share * side) for share, side in sides)
    elif height < rows or width < columns:
        expected = f"'benchmark' for images of at least {columns} x {rows}"
        bad_value("crop", expected, f"{width} x {height}", "It is for KITTI; leave --crop out.")
    else:
        top, bottom, left = height - rows, height, (width - columns) // 2
        right = left + columns
    mask[top:bottom, left:right] = True
    return mask


#: A step of the true disparity between neighbours that makes an edge, and how near it "edge" reaches, pixels.
STEP_PX, REACH_PX = 3.0, 4
#: Ratios of neighbouring depths that Depth Pro counts as boundaries; a threshold weighs as much as its size.
RATIOS = np.linspace(1.05, 1.25, 10)
#: iBims-1's Canny filter of depth scaled to [0, 1], and its longest distance between two boundaries, pixels.
CANNY_SIGMA, CANNY_LOW, CANNY_HIGH, FARTHEST_PX = np.sqrt(2.0), 0.1, 0.2, 10.0
#: Step of log depth between neighbours that makes an edge of dense truth; how near it counts, and how far off
#: a surface begins, pixels.
LOG_STEP, NEAR_EDGE, OFF_EDGE = 0.08, 3, 5


def near_disparity_steps(disparity_px: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """``(H, W)`` bool: pixels within ``REACH_PX`` of a step of the true disparity of more than ``STEP_PX``.

    A step lies between two known neighbours of a row or a column.
    """
    step, known_px = np.zeros(valid.shape, bool), np.where(valid, disparity_px, np.nan)
    for near, px in ((step, known_px), (step.T, known_px.T)):
        apart = np.abs(np.diff(px)) > STEP_PX
        near[:, 1:] |= apart
        near[:, :-1] |= apart
    return valid & step.any() & (ndimage.distance_transform_edt(~step) <= REACH_PX)


def hidden_by_truth(disparity_px: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """``(H, W)`` bool: pixels of dense truth onto whose place in the right image a nearer one falls.

    Nearer is by more than 1 px of disparity; pixels that fall beside the image are none.
    """
    target = np.rint(np.arange(valid.shape[1]) - np.where(valid, disparity_px, 0.0)).astype(int)
    rows, columns = np.nonzero(valid & (target >= 0) & (target < valid.shape[1]))
    shift, at = disparity_px[rows, columns], (rows, target[rows, columns])
    nearest, hidden = np.full(valid.shape, -np.inf), np.zeros(valid.shape, bool)
    np.maximum.at(nearest, at, shift)
    hidden[rows, columns] = nearest[at] > shift + 1.0
    return hidden


def _front_of(depth_m: np.ndarray, known: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Depth of the neighbour right, left, below, above over that of a pixel, and where both are known."""
    pairs = []
    for depth, there in ((depth_m, known), (depth_m.T, known.T)):
        first, second, both = depth[:, :-1], depth[:, 1:], there[:, :-1] & there[:, 1:]
        pairs += [(second / first, both), (first / second, both)]
    return pairs


def boundary_f1(pred_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray) -> float:
    """How well the boundaries of a map, of any scale, lie where those of the truth lie.

    Returns:
        In [0, 1], 1 for truth with boundaries of all four directions itself; NaN where it has none.

    Source: Depth Pro, S3.2 and ``SI_boundary_F1``: F1 of foreground relations of neighbours, by four
        directions, averaged over thresholds of their ratio. Deviation: masked, since our truth has holes.
    """
    known = valid & np.isfinite(pred_m) & (pred_m > 0)
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


def _canny(depth_m: np.ndarray) -> np.ndarray:
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


def boundary_errors(pred_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray) -> dict[str, float]:
    """Distances between the boundaries of a map, whose holes take the nearest depth, and those of the truth.

    Returns:
        ``dbe_acc``: mean distance, pixels, of the map's boundaries from the truth's, of those nearer than 10;
        ``dbe_comp``: mean of the distances both ways, at most 10 each. NaN where the truth has no boundary,
        10 where the map has none.

    Source: Koch et al., "Evaluation of CNN-based Single-Image Depth Estimation Methods" (iBims-1), S3.2.
        Deviation: their true boundaries are drawn by hand, ours are found by the same filter.
    """
    known = np.isfinite(pred_m) & (pred_m > 0)
    true = _canny(_filled(truth_m, valid)) & valid
    if not known.any() or not true.any():
        return {"dbe_acc": float("nan"), "dbe_comp": float("nan")}
    drawn = _canny(_filled(pred_m, known)) & valid
    to_true = ndimage.distance_transform_edt(~true)
    near = drawn & (to_true < FARTHEST_PX)
    if not near.any():
        return {"dbe_acc": FARTHEST_PX, "dbe_comp": FARTHEST_PX}
    both = np.concatenate([to_true[drawn], ndimage.distance_transform_edt(~drawn)[true]])
    return {"dbe_acc": float(to_true[near].mean()), "dbe_comp": float(np.minimum(both, FARTHEST_PX).mean())}


def _filled(depth_m: np.ndarray, known: np.ndarray) -> np.ndarray:
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(depth_m, np.float64)[tuple(nearest)]


def depth_edges(depth_m: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """``(H, W)`` bool: pixels whose 3x3 neighbourhood is known and has a step of depth in it."""
    log = np.log(np.where(valid, depth_m, 1.0))
    high = ndimage.maximum_filter(np.where(valid, log, np.inf), 3)
    low = ndimage.minimum_filter(np.where(valid, log, -np.inf), 3)
    return np.isfinite(high) & np.isfinite(low) & (high - low > LOG_STEP)


def edge_error(pred_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray) -> float:
    """Mean relative error within 3 px of the edges of dense truth; NaN without an edge."""
    near = ndimage.binary_dilation(depth_edges(truth_m, valid), iterations=NEAR_EDGE) & valid
    return float((np.abs(pred_m - truth_m)[near] / truth_m[near]).mean()) if near.any() else float("nan")


def surface_error(pred_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray) -> float:
    """Mean absolute error of the slope of log depth, per mille a pixel, more than 5 px from any edge."""
    off = valid & ~ndimage.binary_dilation(depth_edges(truth_m, valid), iterations=OFF_EDGE)
    difference = np.log(np.maximum(pred_m, 1e-6)) - np.log(np.where(valid, truth_m, 1.0))
    whole = off[1:, 1:] & off[:-1, 1:] & off[1:, :-1]
    if not whole.any():
        return float("nan")
    slopes = [np.abs(np.diff(difference, axis=axis)) for axis in (0, 1)]
    return float(500.0 * (slopes[0][:, 1:] + slopes[1][1:])[whole].mean())
