"""Gaps of a map: runs of unknown pixels in its rows, which of them are hidden, and what goes on in them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: The least step of shift that hides a strip of the farther surface, pixels: below it, matches differ by
#: chance.
LEAST_STEP_PX = 2.0
#: How much wider than its step of shift a hidden strip may seem, pixels: matches end before an edge.
SLACK_PX = 2.0


class Gaps(NamedTuple):
    """Runs of unknown pixels in the rows of a map, in the order of the pixels."""

    unknown: np.ndarray  # (H, W) bool
    row: np.ndarray  # (N,), of each gap
    first: np.ndarray  # (N,), column of its first pixel
    end: np.ndarray  # (N,), column after its last pixel

    @property
    def width(self) -> np.ndarray:
        """``(N,)`` pixels of each gap."""
        return self.end - self.first

    @property
    def inner(self) -> np.ndarray:
        """``(N,)`` bool: gaps between two known pixels of their row."""
        return (self.first > 0) & (self.end < self.unknown.shape[1])

    def ends(self, values: np.ndarray, outside: float) -> tuple[np.ndarray, np.ndarray]:
        """Of ``values (H, W)`` those left and right of each gap; ``outside`` where its row ends."""
        width, flat = self.unknown.shape[1], values.ravel()
        of_row = self.row * width
        left = flat[of_row + np.maximum(self.first - 1, 0)]
        right = flat[of_row + np.minimum(self.end, width - 1)]
        return np.where(self.first > 0, left, outside), np.where(self.end < width, right, outside)

    def put(self, into: np.ndarray, of_gap: np.ndarray) -> np.ndarray:
        """``into (H, W)``, whose unknown pixels have got the value ``(N,)`` of their gap."""
        into[self.unknown] = np.repeat(of_gap, self.width)
        return into


def find_gaps(known: np.ndarray) -> Gaps:
    """The gaps of a map that is ``known (H, W)`` bool elsewhere."""
    height, width = known.shape
    unknown = ~known
    fenced = np.zeros((height, width + 2), bool)  # so that each gap begins and ends in its row
    fenced[:, 1:-1] = unknown
    change = np.flatnonzero(fenced[:, 1:] != fenced[:, :-1])
    row = change[::2] // (width + 1)
    first, end = (side - row * (width + 1) for side in (change[::2], change[1::2]))
    return Gaps(unknown, row, first, end)


def hidden_gaps(shift: np.ndarray, gaps: Gaps, infinity_px: float) -> np.ndarray:
    """``(N,)`` bool: gaps between matches that a view to the right cannot see.

    A surface hides a strip of what is behind its left edge, and the strip is as wide as the shift of the near
    surface exceeds that of the far one. A wider gap, or one without such a step, has another reason. So
    may a gap have near the left border: where the right view would not see the near surface either, this may
    go on unmatched, and what is matched beyond the gap is often chance.

    Args:
        shift: ``(H, W)`` pixels; it falls with depth.
        gaps: where it is not matched.
        infinity_px: disparity of a point at infinity, from which shifts are counted.
    """
    left, right = gaps.ends(shift, np.nan)
    step, in_view = right - left, gaps.first >= right + infinity_px
    return in_view & (step > LEAST_STEP_PX) & (gaps.width <= step + SLACK_PX)


def fill_background(shift: np.ndarray, gaps: Gaps | None = None) -> np.ndarray:
    """Fill gaps with the farther of the two neighbours in the row, as KITTI's development kit does.

    At a row's ends the only neighbour counts; an empty row copies the nearest filled one above, else below.

    Args:
        shift: ``(H, W)`` pixels or 1/m; it falls with depth.
        gaps: where it is not known; by default, where it is not finite.

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
