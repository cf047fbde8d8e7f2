"""Torn pictures: from some row on moved along the rows, as where a frame was read out while it was replaced.

A part of a picture that is moved along the rows leaves matches on their epipolar lines, under other depths.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from geodiff_plugin.types import Tear

#: Rows may be moved by this share of the width at most.
MOST_SHIFT = 0.08
#: Smaller shifts are those of slanted lines, pixels.
LEAST_SHIFT_PX = 3
#: A row differs from the one above by this factor more than rows near it do. Both pictures of 73 right pairs,
#: also flipped, transposed, halved and blurred, had no row with 1.12 for this and for ``GAIN``; of pictures a
#: third of which was moved, 25 of 25 had one with 1.4 to 24.
STEEP = 1.3
#: The shift makes it this many times as alike.
GAIN = 1.3
#: Parts of a row, each of which is asked.
PARTS = 8
#: A part can say something if rows differ by this in it, grey levels.
TEXTURED = 1.5
#: So many of the parts must be able to.
FEWEST_TEXTURED = 6
#: So many of these must be more alike with the shift, as a share.
AGREEING = 0.85
#: A part is more alike if its difference falls below this share.
MORE_ALIKE = 0.9
#: Rows that are looked at closely.
MOST_ROWS = 12
#: A picture with more rows like that shows a pattern, as of bricks.
MOST_TEARS = 4
#: Rows at the upper and the lower edge that are not looked at: undistorted pictures end there.
EDGE = 4


class _TornRow(NamedTuple):
    """A row from which on a picture is moved; tears are sorted by their fields in this order."""

    gain: float  # how many times as alike the rows are with the shift
    row: int
    shift: int  # pixels to the right


def _tears(grey: np.ndarray) -> list[_TornRow]:
    """Every tear of a grey image ``(H, W)`` uint8, the clearest first."""
    if len(grey) < 2 * EDGE + 2:
        return []
    rows = _sums(cv2.absdiff(grey[1:], grey[:-1])) / np.float32(grey.shape[1])  # (H - 1,) from row to row
    near = np.pad(rows, 3, mode="edge")
    near = np.stack([near[k : k + len(rows)] for k in (0, 1, 5, 6)]).max(0)  # two and three rows away
    steep = rows / np.maximum(near, 0.5)
    steep[:EDGE], steep[-EDGE:] = 0, 0
    found = []
    for row in np.argsort(-steep)[:MOST_ROWS]:
        if steep[row] < STEEP:
            break
        gain, shift = _shift(grey[row], grey[row + 1])
        if gain > GAIN and abs(shift) >= LEAST_SHIFT_PX:
            found.append(_TornRow(min(gain, float(steep[row])), int(row) + 1, shift))
    return sorted(found, reverse=True)


def _sums(rows: np.ndarray) -> np.ndarray:
    """The sum ``(N,)`` of every row ``(N, W)`` uint8, float32, which is exact for up to 65,793 columns."""
    return cv2.reduce(rows, 1, cv2.REDUCE_SUM, dtype=cv2.CV_32F)[:, 0]


def _shift(above: np.ndarray, below: np.ndarray) -> tuple[float, int]:
    """By how many pixels a row ``(W,)`` has moved against that above it, and how many times as alike it is.

    Both are uint8. The gain is 0 where parts of the row do not agree, or the largest shift is the best one.
    """
    width = len(above)
    most = int(MOST_SHIFT * width)
    part = np.arange(width) * PARTS // width
    # Row k: what lies ``most - k`` pixels to the right of every pixel above, and 1 where the picture has it.
    beside, known = (sliding_window_view(np.pad(row, most), width) for row in (above, np.ones_like(above)))
    beside, known = np.ascontiguousarray(beside[::-1]), known[::-1]
    off = known * cv2.absdiff(np.tile(below, (len(beside), 1)), beside)  # of every shift from -most to most
    totals = _sums(off) / known.sum(1)
    unmoved = np.bincount(part, off[most], PARTS) / np.bincount(part, minlength=PARTS)
    best = int(np.argmin(totals))
    count = np.maximum(np.bincount(part, known[best], PARTS), 1.0)
    of_parts = np.bincount(part, off[best], PARTS) / count
    textured = unmoved > TEXTURED
    alike = (of_parts < MORE_ALIKE * unmoved) & textured
    agree = textured.sum() >= FEWEST_TEXTURED and alike.sum() >= AGREEING * textured.sum()
    is_clear = agree and 0 < best < 2 * most
    return float(totals[most] / max(totals[best], 0.5)) if is_clear else 0.0, best - most


def find_tear(greys: Sequence[np.ndarray], heights: Sequence[int]) -> Tear | None:
    """The clearest tear of grey images ``(H, W)`` uint8, the left one first; ``None`` where none is torn.

    The row and the shift are in pixels of the pictures that they were made from, whose ``heights`` are given.
    A pattern of the scene, which other pictures show as well, is no tear.
    """
    found = [_tears(grey) for grey in greys]
    torn = [view for view, tears in enumerate(found) if 0 < len(tears) <= MOST_TEARS]
    if len(torn) != 1 or any(len(tears) > MOST_TEARS for tears in found):
        return None
    view = torn[0]
    clearest, factor = found[view][0], heights[view] / len(greys[view])
    return Tear(view, round(clearest.row * factor), round(clearest.shift * factor))
