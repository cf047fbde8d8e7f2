"""Alignment of relative depth to the truth by least squares in scale and shift.

Data flow: prediction in its own space + truth -> depth in metres.
Paper: S5.1 ("aligned"); least squares as Marigold's evaluation does it.
"""

from __future__ import annotations

import numpy as np
import torch

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.evaluation.metrics import FLOOR_M
from geodiff_plugin.scale.space import SPACES

__all__ = ["MIN_DISPARITY", "align", "least_squares", "to_space"]

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
    values = torch.from_numpy(np.asarray(values, np.float64))
    if not kind.grows_with_depth:
        values = values.clamp_min(float(kind.inverse(metre / MIN_DISPARITY)))
    return kind.forward(values, metre).numpy()


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
