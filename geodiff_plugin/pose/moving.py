"""A part of the pictures that moved between them across the epipolar lines, while the rest fits."""

from __future__ import annotations

import math

import numpy as np

from geodiff_plugin.pose.tracks import FEWEST, Tracks, blocks, epipolar

#: Matches of a part that moved lie off their epipolar lines by this at least, pixels.
LEAST_OFF_PX = 2.0
#: And by so many times the median distance of all.
LEAST_TIMES = 4.0
#: They lie off them together: their median deviation from their median is below this share of it.
TOGETHER = 0.25
#: Matches further off are wrong ones, pixels.
MOST_OFF_PX = 30.0
#: Fewest matches of a block of the left image that say so.
FEWEST_OF_BLOCK = 5


def moved_share(tracks: Tracks, T: np.ndarray) -> float:
    """Share of the matches of one right view that lie in blocks that moved, [0, 1]; NaN for too few.

    Matches that are wrong lie off their lines each by its own distance, those of a thing that moved by about
    one, and by several times what is usual under the pose ``T (4, 4)``, ``T_right_from_left``.
    """
    off_px = epipolar(tracks, T).off_px
    usual_px = float(np.median(np.abs(off_px))) if len(off_px) else math.nan
    kept = np.abs(off_px) < MOST_OFF_PX
    off_px, block = off_px[kept], blocks(tracks.kept(kept))
    count = np.bincount(block)
    middle = _medians(off_px, block, count)
    apart = _medians(np.abs(off_px - middle[block]), block, count)
    enough = count >= FEWEST_OF_BLOCK
    away = np.abs(middle) > max(LEAST_OFF_PX, LEAST_TIMES * usual_px)
    moved = int(count[enough & away & (apart < TOGETHER * np.abs(middle))].sum())
    compared = int(count[enough].sum())
    return moved / compared if compared >= FEWEST else math.nan


def _medians(values: np.ndarray, block: np.ndarray, count: np.ndarray) -> np.ndarray:
    """The median of the values ``(N,)`` of every block, which ``count`` of them lie in, none of it empty."""
    in_order = values[np.lexsort((values, block))]
    first = np.cumsum(count) - count
    return (in_order[first + (count - 1) // 2] + in_order[first + count // 2]) / 2.0
