"""Finds gaps of a map (runs of unknown pixels in its rows) and half-occlusions among them, and fills them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Minimum shift discontinuity that occludes a strip of the farther surface, pixels; smaller differences
#: between matches are chance.
MIN_STEP_PX = 2.0
#: Maximum excess of a half-occlusion's width over its shift discontinuity, pixels: matches end before an
#: edge.
SLACK_PX = 2.0


class Gaps(NamedTuple):
    """Runs of unknown pixels in the rows of a map, in the order of the pixels."""

    unknown: np.ndarray  # (H, W) bool
    row: np.ndarray  # (N,), row of each gap
    first: np.ndarray  # (N,), column of its first pixel
    end: np.ndarray  # (N,), column after its last pixel

    @property
    def width(self) -> np.ndarray:
        """Width of each gap, ``(N,)`` pixels."""
        return self.end - self.first

    @property
    def inner(self) -> np.ndarray:
        """Gaps between two known pixels of their row, ``(N,)`` bool."""
        return (self.first > 0) & (self.end < self.unknown.shape[1])

    def ends(self, values: np.ndarray, outside: float) -> tuple[np.ndarray, np.ndarray]:
        """Return ``values (H, W)`` left and right of each gap; ``outside`` beyond the ends of its row."""
        width = self.unknown.shape[1]
        flat = values.ravel()
        of_row = self.row * width
        left = flat[of_row + np.maximum(self.first - 1, 0)]
        right = flat[of_row + np.minimum(self.end, width - 1)]
        return np.where(self.first > 0, left, outside), np.where(self.end < width, right, outside)

    def all_of(self, values: np.ndarray) -> np.ndarray:
        """``(N,)`` bool: gaps in which ``values (H, W)`` bool is true everywhere."""
        if not len(self.row):
            return np.zeros(0, bool)
        first = np.cumsum(self.width) - self.width
        return np.asarray(np.logical_and.reduceat(values[self.unknown], first))

    def put(self, into: np.ndarray, of_gap: np.ndarray) -> np.ndarray:
        """Set the unknown pixels of ``into (H, W)`` to the value ``(N,)`` of their gap."""
        into[self.unknown] = np.repeat(of_gap, self.width)
        return into


def find_gaps(known: np.ndarray) -> Gaps:
    """Find the gaps of a map whose other pixels are ``known (H, W)`` bool."""
    height, width = known.shape
    unknown = ~known
    fenced = np.zeros((height, width + 2), bool)  # makes each gap begin and end within its row
    fenced[:, 1:-1] = unknown
    change = np.flatnonzero(fenced[:, 1:] != fenced[:, :-1])
    row = change[::2] // (width + 1)
    first, end = (side - row * (width + 1) for side in (change[::2], change[1::2]))
    return Gaps(unknown, row, first, end)


def occluded_gaps(shift: np.ndarray, gaps: Gaps, infinity_px: float) -> np.ndarray:
    """Return the gaps between matches that are half-occlusions in a view to the right, ``(N,)`` bool.

    A surface occludes a strip of the background at its left edge. The strip's width is the difference of the
    shifts of both surfaces. A wider gap, or one without such a discontinuity, has another cause. So may a gap
    near the left border: if the right view does not see the near surface either, that surface may continue
    unmatched, and matches beyond the gap are often chance.

    Args:
        shift: ``(H, W)`` pixels; falls with depth.
        gaps: the unmatched gaps.
        infinity_px: disparity of a point at infinity, from which shifts are counted.
    """
    left, right = gaps.ends(shift, np.nan)
    step = right - left
    in_view = gaps.first >= right + infinity_px
    return in_view & (step > MIN_STEP_PX) & (gaps.width <= step + SLACK_PX)


def fill_background(shift: np.ndarray, gaps: Gaps | None = None) -> np.ndarray:
    """Fill gaps with the farther of the two neighbours in the row, as in KITTI's development kit.

    At the ends of a row the only neighbour is used. An empty row copies the nearest filled one above, else
    below.

    Args:
        shift: ``(H, W)`` pixels or 1/m; falls with depth.
        gaps: the gaps to fill; by default, the non-finite pixels.

    Returns:
        The filled map; NaN everywhere if nothing is known.
    """
    gaps = find_gaps(np.isfinite(shift)) if gaps is None else gaps
    filled = gaps.put(shift.copy(), np.minimum(*gaps.ends(shift, np.inf)))
    empty = gaps.row[gaps.width == shift.shape[1]]
    if empty.size == len(shift):
        return np.full_like(shift, np.nan)
    if empty.size:
        full = np.setdiff1d(np.arange(len(shift)), empty)
        filled[empty] = filled[full[np.maximum(np.searchsorted(full, empty) - 1, 0)]]
    return filled
