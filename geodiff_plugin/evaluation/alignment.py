"""Scale and shift from the truth: what relative depth is worth once an oracle has aligned it.

Hop: prediction in its own space + truth -> depth in metres.
Paper: S5.1 ("aligned"); least squares as Marigold's evaluation does it.
"""

from __future__ import annotations

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.metrics import FLOOR_M

__all__ = ["MIN_DISPARITY", "align", "least_squares"]

MIN_DISPARITY = 1e-3
"""Aligned disparity, 1/m, is clipped here before it is inverted: nothing is farther than a kilometre."""

_TO_SPACE = {
    "depth": lambda z: z,
    "disparity": lambda z: 1.0 / z,
    "log": np.log,
    "log1p": np.log1p,
    "sqrt_disparity": lambda z: 1.0 / np.sqrt(z),
}
_FROM_SPACE = {
    "depth": lambda x: x,
    "disparity": lambda x: 1.0 / np.maximum(x, MIN_DISPARITY),
    "log": np.exp,
    "log1p": np.expm1,
    "sqrt_disparity": lambda x: 1.0 / np.maximum(x, MIN_DISPARITY**0.5) ** 2,
}


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
        ValueError: the mask is empty.

    Source: Marigold, ``align_depth_least_square`` (without its optional downscaling), in float64.
    """
    if not mask.any():
        bad_value("mask", "true for at least one pixel", "none")
    x, y = np.asarray(values, np.float64)[mask], np.asarray(target, np.float64)[mask]
    system = np.stack([x, np.ones_like(x)], axis=1)
    scale, shift = np.linalg.lstsq(system, y, rcond=None)[0]
    return float(scale), float(shift)


def align(values: np.ndarray, truth_m: np.ndarray, valid: np.ndarray, space: str = "depth") -> np.ndarray:
    """Depth in metres of a prediction that is right up to scale and shift in its space.

    Args:
        values: ``(H, W)`` float; affine in depth, inverse depth, log depth, log(depth + 1 m) or the root of
            inverse depth, as ``space`` says; not finite where a method leaves a hole.
        truth_m: ``(H, W)`` float, metres.
        valid: ``(H, W)`` bool, where the truth counts.
        space: ``"depth"``, ``"disparity"``, ``"log"``, ``"log1p"`` or ``"sqrt_disparity"``.

    Returns:
        ``(H, W)`` float64, metres, at least ``FLOOR_M``, where Marigold's evaluation clips what least
        squares sends behind the camera; not finite where ``values`` is not.

    Raises:
        ValueError: an unknown space, or no pixel has both truth and prediction.

    Source: Marigold's evaluation: ``least_square`` and ``least_square_disparity``, the latter over positive
        predictions only and clipped at 1e-3; the other spaces are the same idea.
    """
    if space not in _TO_SPACE:
        bad_value("space", f"one of {', '.join(_TO_SPACE)}", repr(space))
    known = valid & np.isfinite(values) & (truth_m > 0)
    if space == "disparity":
        known &= np.nan_to_num(values) > 0
    target = np.zeros(np.shape(truth_m))
    target[known] = _TO_SPACE[space](np.asarray(truth_m, np.float64)[known])
    scale, shift = least_squares(values, target, known)
    return np.maximum(_FROM_SPACE[space](np.asarray(values, np.float64) * scale + shift), FLOOR_M)
