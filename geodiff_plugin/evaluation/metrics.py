"""Errors of depth, disparity and uncertainty against the truth, and alignment with it (paper S5.1)."""

from __future__ import annotations

import numpy as np
import torch

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.evaluation.options import CROPS
from geodiff_plugin.scale.space import SPACES

__all__ = [
    "FLOOR_M",
    "MIN_DISPARITY",
    "align",
    "ause",
    "ause_of_random",
    "confidence_deciles",
    "counted",
    "crop_mask",
    "evaluate_depth",
    "evaluate_disparity",
    "least_squares",
    "to_space",
]

FLOOR_M = 1e-5
"""Nearest truth that counts and nearest value of a prediction, metres (Marigold's evaluation of KITTI)."""


def _check_maps(**maps: np.ndarray) -> None:
    shapes = {name: np.shape(values) for name, values in maps.items()}
    if len(set(shapes.values())) != 1:
        bad_value(
            "maps", "of one shape (H, W)", ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        )


def counted(truth_m: np.ndarray, valid: np.ndarray, cap_m: float | None = None) -> np.ndarray:
    """Pixels whose truth counts: known and strictly between ``FLOOR_M`` and the cap.

    Args:
        truth_m: ``(H, W)`` float, metres.
        valid: ``(H, W)`` bool, where the truth is known.
        cap_m: farthest truth that counts, metres; ``None`` for no limit.

    Returns:
        ``(H, W)`` bool.

    Raises:
        ValueError: shapes differ, or no pixel is left.
    """
    _check_maps(truth_m=truth_m, valid=valid)
    with_truth = valid & np.isfinite(truth_m) & (truth_m > FLOOR_M)
    kept = with_truth if cap_m is None else with_truth & (truth_m < cap_m)
    if not kept.any():
        bad_value("truth", "known for at least one pixel", "no valid pixel", "Check the mask and the cap.")
    return kept


def evaluate_depth(
    pred_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray, cap_m: float | None = None
) -> dict[str, float]:
    """Errors of one depth map.

    Args:
        pred_m: ``(H, W)`` float, metres; NaN, infinite or not positive where a method leaves a hole.
        truth_m: ``(H, W)`` float, metres.
        valid: ``(H, W)`` bool, where the truth is known.
        cap_m: truth from here on is dropped and predictions are clipped to it, metres; ``None`` for no limit.

    Returns:
        ``abs_rel`` (mean of |p - t| / t), ``delta1`` .. ``delta3`` (share with max(p/t, t/p) < 1.25**k),
        ``rmse`` (metres, rooted), ``log_rmse`` (natural logarithm), ``silog`` (100 times the standard
        deviation of log p - log t), all over the pixels with both truth and prediction, NaN where there is
        none; ``coverage`` (share of the truth's pixels with a prediction) and ``pixels`` (their number).

    Raises:
        ValueError: shapes differ, or no pixel has truth.

    Source: S5.1; Marigold's evaluation code for clipping and SILog.
    """
    _check_maps(pred_m=pred_m, truth_m=truth_m, valid=valid)
    kept = counted(truth_m, valid, cap_m)
    pred, truth = np.asarray(pred_m, np.float64)[kept], np.asarray(truth_m, np.float64)[kept]
    filled = np.isfinite(pred) & (pred > 0)
    scores = {"coverage": float(filled.mean()), "pixels": float(kept.sum())}
    pred, truth = np.clip(pred[filled], FLOOR_M, cap_m), truth[filled]
    if not filled.any():
        names = ("abs_rel", "delta1", "delta2", "delta3", "rmse", "log_rmse", "silog")
        return dict.fromkeys(names, float("nan")) | scores
    ratio = np.maximum(pred / truth, truth / pred)
    log_error = np.log(pred) - np.log(truth)
    return {
        "abs_rel": float(np.mean(np.abs(pred - truth) / truth)),
        "delta1": float(np.mean(ratio < 1.25)),
        "delta2": float(np.mean(ratio < 1.25**2)),
        "delta3": float(np.mean(ratio < 1.25**3)),
        "rmse": float(np.sqrt(np.mean((pred - truth) ** 2))),
        "log_rmse": float(np.sqrt(np.mean(log_error**2))),
        "silog": float(100.0 * np.std(log_error)),
    } | scores


def evaluate_disparity(
    pred_px: np.ndarray, truth_px: np.ndarray, valid: np.ndarray, step_px: float = 0.0
) -> dict[str, float | None]:
    """Errors of one disparity map.

    Args:
        pred_px: ``(H, W)`` float, pixels; not finite where a method leaves a hole.
        truth_px: ``(H, W)`` float, pixels.
        valid: ``(H, W)`` bool, where the truth counts.
        step_px: distance between two neighbouring values that the truth can take, pixels.

    Returns:
        ``epe`` (mean of |p - t|), ``bad1`` .. ``bad3`` (share with an error above 1, 2, 3 px; ``None`` where
        the truth's step is coarser than the threshold), ``d1`` (KITTI: error above 3 px and above 5 % of
        the truth), over the pixels with both truth and prediction; NaN where there is none.

    Raises:
        ValueError: shapes differ, or no pixel has truth.

    Source: KITTI 2015 development kit (D1), Middlebury (bad-k).
    """
    _check_maps(pred_px=pred_px, truth_px=truth_px, valid=valid)
    if not valid.any():
        bad_value("truth", "known for at least one pixel", "no valid pixel")
    pred, truth = np.asarray(pred_px, np.float64)[valid], np.asarray(truth_px, np.float64)[valid]
    filled = np.isfinite(pred)
    error, truth = np.abs(pred[filled] - truth[filled]), truth[filled]

    def share(wrong: np.ndarray) -> float:
        return float(wrong.mean()) if wrong.size else float("nan")

    scores: dict[str, float | None] = {"epe": share(error)}
    for k in (1, 2, 3):
        scores[f"bad{k}"] = share(error > k) if step_px <= k else None
    scores["d1"] = share((error > 3) & (error > 0.05 * np.abs(truth))) if step_px <= 3 else None
    return scores


def ause(
    pred_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray, uncertainty: np.ndarray, steps: int = 100
) -> float:
    """Area under the sparsification error: how badly the uncertainty sorts pixels by their error.

    The share ``k / steps`` of the least certain pixels is left out, the mean relative error of the rest is
    compared with the same where the worst pixels are left out, and the difference is averaged over k.

    Args:
        pred_m: ``(H, W)`` float, metres.
        truth_m: ``(H, W)`` float, metres.
        valid: ``(H, W)`` bool, where the truth counts.
        uncertainty: ``(H, W)`` float, any unit; larger is less certain.
        steps: number of points on the curve, at least 1.

    Returns:
        In AbsRel's unit, at least 0; 0 where the order of the pixels is the order of their errors.

    Raises:
        ValueError: shapes differ, or no pixel has truth, prediction and uncertainty.

    Source: Ilg et al., "Uncertainty Estimates and Multi-Hypotheses Networks for Optical Flow", S5; on AbsRel
    here.
    """
    _check_maps(pred_m=pred_m, truth_m=truth_m, valid=valid, uncertainty=uncertainty)
    kept = valid & np.isfinite(pred_m) & (pred_m > 0) & np.isfinite(uncertainty)
    if not kept.any():
        bad_value("uncertainty", "finite for at least one pixel with truth", "none")
    error = _relative_errors(pred_m, truth_m, kept)
    # Stable sorts: pixels of equal uncertainty keep the image's order on every machine.
    by_uncertainty = np.argsort(-np.asarray(uncertainty, np.float64)[kept], kind="stable")
    by_error = np.argsort(-error, kind="stable")
    return float(np.mean(_remaining(error, by_uncertainty, steps) - _remaining(error, by_error, steps)))


def ause_of_random(pred_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray, steps: int = 100) -> float:
    """What ``ause`` is in the mean over random uncertainties; arguments and errors as there."""
    _check_maps(pred_m=pred_m, truth_m=truth_m, valid=valid)
    kept = valid & np.isfinite(pred_m) & (pred_m > 0)
    if not kept.any():
        bad_value("pred_m", "known for at least one pixel with truth", "none")
    error = _relative_errors(pred_m, truth_m, kept)
    return float(error.mean() - _remaining(error, np.argsort(-error, kind="stable"), steps).mean())


def _relative_errors(pred_m: np.ndarray, truth_m: np.ndarray, kept: np.ndarray) -> np.ndarray:
    truth = np.asarray(truth_m, np.float64)[kept]
    return np.abs(np.asarray(pred_m, np.float64)[kept] - truth) / truth


def _remaining(error: np.ndarray, order: np.ndarray, steps: int) -> np.ndarray:
    """Mean error without the first ``k / steps`` of the pixels of an order, for every k."""
    cut = (np.arange(steps) * error.size) // steps
    return np.cumsum(error[order][::-1])[::-1][cut] / (error.size - cut)


def confidence_deciles(
    pred_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray, confidence: np.ndarray, within: float
) -> list[dict[str, float | None]]:
    """What a confidence promises and what it keeps, in ten classes of equal width.

    Args:
        pred_m: ``(H, W)`` metres.
        truth_m: ``(H, W)`` metres.
        valid: ``(H, W)`` bool, where the truth counts.
        confidence: ``(H, W)`` in [0, 1], a probability that the relative error is below ``within``.
        within: relative error, > 0.

    Returns:
        Ten entries, from [0, 0.1) to [0.9, 1]: ``share`` of the pixels, mean ``promised``, ``kept`` (share of
        pixels within), ``abs_rel``; the last three ``None`` for an empty class.

    Raises:
        ValueError: shapes differ.
    """
    _check_maps(pred_m=pred_m, truth_m=truth_m, valid=valid, confidence=confidence)
    used = valid & np.isfinite(pred_m) & (pred_m > 0)
    error = np.abs(pred_m[used] - truth_m[used]) / truth_m[used]
    promised = confidence[used]
    decile = np.minimum((promised * 10).astype(int), 9)
    found: list[dict[str, float | None]] = []
    for k in range(10):
        own = decile == k
        values = {"promised": promised, "kept": error < within, "abs_rel": error}
        means = {name: float(np.mean(v[own])) if own.any() else None for name, v in values.items()}
        found.append({"share": float(own.mean()) if own.size else 0.0, **means})
    return found


MIN_DISPARITY = 1e-3
"""Aligned disparity, 1/m, is clipped here before it is inverted: nothing is farther than a kilometre."""


def to_space(depth_m: np.ndarray, space: str) -> np.ndarray:
    """What depths in metres are in a space, in float64: linear there in a prior that is right.

    Args:
        depth_m: any shape, metres, > 0.
        space: key of ``SPACES``.
    """
    return SPACES[space].inverse(torch.from_numpy(np.asarray(depth_m, np.float64))).numpy()


def _from_space(values: np.ndarray, space: str) -> np.ndarray:
    """Metres of values in a space; where values fall with depth, none is less than that of a kilometre."""
    kind, metre = SPACES[space], torch.ones((), dtype=torch.float64)
    x = torch.from_numpy(np.asarray(values, np.float64))
    if not kind.grows_with_depth:
        x = x.clamp_min(float(kind.inverse(metre / MIN_DISPARITY)))
    return kind.forward(x, metre).numpy()


def least_squares(values: np.ndarray, target: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    """Scale and shift that bring ``values`` closest to ``target`` over the mask, in the sum of squares.

    Args:
        values: ``(H, W)`` float.
        target: ``(H, W)`` float.
        mask: ``(H, W)`` bool.

    Returns:
        ``(scale, shift)``; the scale is negative where the two run against each other, as the sum of squares
        says.

    Raises:
        ValueError: the mask is empty: map and truth have no pixel in common.

    Source: Marigold, ``align_depth_least_square`` (without its optional downscaling), in float64.
    """
    if not mask.any():
        bad_value("the map to align", "known for at least one pixel with truth", "known for none")
    x, y = np.asarray(values, np.float64)[mask], np.asarray(target, np.float64)[mask]
    system = np.stack([x, np.ones_like(x)], axis=1)
    scale, shift = np.linalg.lstsq(system, y, rcond=None)[0]
    return float(scale), float(shift)


def align(values: np.ndarray, truth_m: np.ndarray, valid: np.ndarray, space: str = "depth") -> np.ndarray:
    """Depth in metres of a prediction that is right up to scale and shift in its space.

    Args:
        values: ``(H, W)`` float, affine in what ``space`` says; not finite where a method leaves a hole.
        truth_m: ``(H, W)`` float, metres.
        valid: ``(H, W)`` bool, where the truth counts.
        space: key of ``SPACES``.

    Returns:
        ``(H, W)`` float64, metres, at least ``FLOOR_M``, where Marigold's evaluation clips what least
        squares sends behind the camera; not finite where ``values`` is not, and nowhere finite where no pixel
        has both truth and prediction.

    Raises:
        ValueError: an unknown space.

    Source: Marigold's evaluation: ``least_square`` and ``least_square_disparity``, the latter over positive
        predictions only and clipped at 1e-3; the other spaces are the same idea.
    """
    check_choice(space, "space", SPACES)
    known = valid & np.isfinite(values) & (truth_m > 0)
    if space == "disparity":
        known &= np.nan_to_num(values) > 0
    if not known.any():  # a method that finds nothing has no errors, as without alignment
        return np.full(np.shape(truth_m), np.nan)
    target = np.zeros(np.shape(truth_m))
    target[known] = to_space(np.asarray(truth_m, np.float64)[known], space)
    scale, shift = least_squares(values, target, known)
    return np.maximum(_from_space(np.asarray(values, np.float64) * scale + shift, space), FLOOR_M)


#: Shares of the image: first and last row, first and last column.
_SHARES = {
    "garg": (0.40810811, 0.99189189, 0.03594771, 0.96405229),
    "eigen": (0.3324324, 0.91351351, 0.0359477, 0.96405229),
}
#: Rows and columns that every image of KITTI's depth benchmark has.
_BENCHMARK = (352, 1216)


def crop_mask(name: str, size: tuple[int, int]) -> np.ndarray:
    """Pixels inside of a crop; methods still see whole images.

    Args:
        name: one of ``CROPS``.
        size: ``(H, W)`` of the image.

    Returns:
        ``(H, W)`` bool. Of 375 x 1242 pixels, Garg's crop keeps rows 153 to 370 and columns 44 to 1196,
        Eigen's rows 124 to 341 and the same columns, the benchmark's rows 23 to 374 and columns 13 to 1228
        (at the bottom, in the middle).

    Raises:
        ValueError: an unknown name, or an image smaller than the benchmark's.

    Source: Marigold's evaluation of KITTI, which follows BTS and monodepth. Deviation: Marigold's tables take
        Eigen's crop of an image that was cut to the benchmark's before; here each stands alone.
    """
    check_choice(name, "crop", CROPS)
    height, width = size
    if name == "none":
        return np.ones(size, bool)
    if name == "benchmark":
        rows, columns = _BENCHMARK
        if height < rows or width < columns:
            cure = "It is for KITTI; leave --crop out."
            bad_value(
                "crop", f"'benchmark' for images of at least {columns} x {rows}", f"{width} x {height}", cure
            )
        top, left = height - rows, (width - columns) // 2
        bottom, right = top + rows, left + columns
    else:
        top, bottom, left, right = (
            int(share * side)
            for share, side in zip(_SHARES[name], (height, height, width, width), strict=True)
        )
    mask = np.zeros(size, bool)
    mask[top:bottom, left:right] = True
    return mask
