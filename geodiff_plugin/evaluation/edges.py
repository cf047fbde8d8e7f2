"""Metrics of depth edges and of the surfaces between them.

Maps are ``(H, W)`` as in ``metrics``: depth in metres, disparity in pixels, ``valid`` bool.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

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
    step = np.zeros(valid.shape, bool)
    for axis in (0, 1):
        apart = np.abs(np.diff(np.where(valid, disparity_px, np.nan), axis=axis)) > STEP_PX
        pad = [(0, 0), (0, 0)]
        pad[axis] = (0, 1)
        step |= np.pad(apart, pad) | np.pad(apart, [p[::-1] for p in pad])
    return valid & step.any() & (ndimage.distance_transform_edt(~step) <= REACH_PX)


def hidden_by_truth(disparity_px: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """``(H, W)`` bool: pixels of dense truth hidden in the right view of a rectified pair.

    Another pixel of the row, nearer by more than 1 px of disparity, falls onto the same column of the right
    image; pixels that fall beside the image are none.
    """
    height, width = valid.shape
    rows, columns = np.nonzero(valid)
    shift = disparity_px[valid]
    target = np.rint(columns - shift).astype(int)
    inside = (target >= 0) & (target < width)
    nearest = np.full((height, width), -np.inf)
    np.maximum.at(nearest, (rows[inside], target[inside]), shift[inside])
    hidden = np.zeros(valid.shape, bool)
    behind = nearest[rows[inside], target[inside]] > shift[inside] + 1.0
    hidden[rows[inside], columns[inside]] = behind
    return hidden


def _front_of(depth_m: np.ndarray, known: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Depth of the neighbour right, left, below, above over that of a pixel, and where both are known."""
    pairs = []
    for axis in (1, 0):
        near, far = (np.take(depth_m, range(i, depth_m.shape[axis] - 1 + i), axis) for i in (0, 1))
        both = np.take(known, range(1, known.shape[axis]), axis)
        both = both & np.take(known, range(known.shape[axis] - 1), axis)
        pairs += [(far / near, both), (near / far, both)]
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
    beside = [
        ndimage.map_coordinates(
            size, (rows + s * dy / unit, columns + s * dx / unit), order=1, mode="nearest"
        )
        for s in (-1.0, 1.0)
    ]
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
    to_drawn = ndimage.distance_transform_edt(~drawn)
    both = np.concatenate([to_true[drawn], to_drawn[true]])
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
