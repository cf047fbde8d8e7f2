"""Fills holes in a match map from the background.

Data flow: shift or inverse depth with holes -> without.
Paper: none; as KITTI's development kit does it for sparse results.
"""

from __future__ import annotations

import numpy as np

__all__ = ["fill_background"]


def fill_background(shift: np.ndarray) -> np.ndarray:
    """Fill holes with the farther of the two neighbours in the row, as KITTI's development kit does.

    Args:
        shift: ``(H, W)`` float, smaller is farther (pixels or 1/m), NaN in holes.

    Returns:
        ``(H, W)`` without holes: within a row the smaller of the nearest known values to either side, the
        only one at the row's ends; an empty row copies the nearest filled one above, else below. All NaN
        where nothing is known.
    """
    known = np.isfinite(shift)
    columns = np.arange(shift.shape[1])[None]
    from_left = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
    from_right = np.minimum.accumulate(np.where(known, columns, shift.shape[1])[:, ::-1], axis=1)[:, ::-1]
    rows = np.arange(shift.shape[0])[:, None]
    padded = np.pad(np.where(known, shift, np.inf), ((0, 0), (1, 1)), constant_values=np.inf)
    filled = np.minimum(padded[rows, from_left + 1], padded[rows, from_right + 1])
    full_rows = np.flatnonzero(known.any(axis=1))
    if full_rows.size == 0:
        return np.full_like(shift, np.nan)
    above = np.searchsorted(full_rows, rows[:, 0], side="right") - 1
    return filled[full_rows[np.maximum(above, 0)]].astype(shift.dtype)
