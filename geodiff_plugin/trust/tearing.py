"""Check for frame tearing: all rows below some row are shifted horizontally.

A horizontal shift of part of an image keeps matches on their epipolar lines but changes their depths.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.stages import ImagesStage

TEARING = FindingKind(
    "views.tearing",
    REASON,
    "An image shows frame tearing",
    cause="A frame was read while the next one was overwriting it, or image rows were lost.",
    hint="Capture a new frame; synchronise readout and exposure.",
)

#: Maximum shift as a fraction of the width.
MAX_SHIFT = 0.08
#: Minimum shift in pixels. Smaller shifts occur at slanted lines.
MIN_SHIFT_PX = 3
#: Minimum ratio between the difference of two adjacent rows and the differences of nearby rows. No row of
#: both images of 73 correct pairs, also flipped, transposed, halved and blurred, had 1.12 for this and for
#: ``GAIN``. Of images with a shifted third, 25 of 25 had a row with 1.4 to 24.
STEEP = 1.3
#: Difference between rows, in grey levels, below which nearby rows count as this different.
MIN_DIFFERENCE = 0.5
#: Minimum factor by which the shift reduces the difference between the rows.
GAIN = 1.3
#: Number of segments of a row that are compared separately.
PARTS = 8
#: Minimum difference of the rows in a textured segment, grey levels.
TEXTURED = 1.5
#: Minimum number of textured segments.
MIN_TEXTURED = 6
#: Minimum fraction of the textured segments that the shift must improve.
AGREEING = 0.85
#: The shift improves a segment if it reduces the difference to less than this fraction.
MORE_ALIKE = 0.9
#: Maximum number of candidate rows.
MAX_ROWS = 12
#: Maximum number of tears. An image with more shows a pattern such as bricks.
MAX_TEARS = 4
#: Number of ignored rows at the upper and lower edge, where undistorted images end.
EDGE = 4


@dataclass(frozen=True)
class Tear:
    """The rows of the left (``view`` 0) or a right image from ``row`` on are shifted ``px`` to the right."""

    view: int
    row: int
    px: int


class Tearing(Check[Tear]):
    """Detects a frame that was read out while the next one replaced it, or that lost lines.

    A tear is a row that differs from the row above much more than nearby rows do, and much less after one of
    the two is shifted.
    """

    kinds = (TEARING,)

    @classmethod
    def of_images(cls, stage: ImagesStage) -> Tear | None:
        return find_tear_row(stage.greys, stage.heights)

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact is None:
            return
        image = (
            ("left image", "right image")[fact.view] if fact.view < 2 else f"image of right view {fact.view}"
        )
        yield Finding(
            TEARING,
            f"The {image} is torn: all rows from {fact.row} on are shifted {abs(fact.px)} px to the "
            f"{'right' if fact.px > 0 else 'left'}, so depth is wrong there. Capture a new frame.",
        )


class _TornRow(NamedTuple):
    """A row from which on an image is shifted. Tears are sorted by their fields in this order."""

    gain: float  # factor by which the shift reduces the difference between the rows
    row: int
    shift: int  # pixels to the right


def _tears(grey: np.ndarray) -> list[_TornRow]:
    """Find the tears of a grey image ``(H, W)`` uint8, the clearest first."""
    if len(grey) < 2 * EDGE + 2:
        return []
    difference = _sums(cv2.absdiff(grey[1:], grey[:-1])) / np.float32(grey.shape[1])  # (H - 1,), row to row
    padded = np.pad(difference, 3, mode="edge")
    rows_away = [padded[3 + k : 3 + k + len(difference)] for k in (-3, -2, 2, 3)]
    steep = difference / np.maximum(np.max(rows_away, axis=0), MIN_DIFFERENCE)
    steep[:EDGE], steep[-EDGE:] = 0, 0
    found = []
    for row in np.argsort(-steep)[:MAX_ROWS]:
        if steep[row] < STEEP:
            break
        gain, shift = _shift(grey[row], grey[row + 1])
        if gain > GAIN and abs(shift) >= MIN_SHIFT_PX:
            found.append(_TornRow(min(gain, float(steep[row])), int(row) + 1, shift))
    return sorted(found, reverse=True)


def _sums(rows: np.ndarray) -> np.ndarray:
    """Sum every row ``(N, W)`` uint8 as float32 ``(N,)``, which is exact for up to 65,793 columns."""
    return cv2.reduce(rows, 1, cv2.REDUCE_SUM, dtype=cv2.CV_32F)[:, 0]


def _shift(above: np.ndarray, below: np.ndarray) -> tuple[float, int]:
    """Return the gain and the shift in pixels of a row ``(W,)`` relative to the row above it.

    Both rows are uint8. The gain is 0 if segments of the row disagree, or if the best shift is the largest
    one.
    """
    width = len(above)
    limit = int(MAX_SHIFT * width)
    part = np.arange(width) * PARTS // width
    # Row k of ``shifted`` is ``above`` shifted by k - limit pixels; ``known`` marks pixels inside the image.
    shifted, known = (sliding_window_view(np.pad(row, limit), width) for row in (above, np.ones_like(above)))
    shifted = np.ascontiguousarray(shifted[::-1])
    known = known[::-1]
    off = known * cv2.absdiff(np.tile(below, (len(shifted), 1)), shifted)  # one row per shift
    totals = _sums(off) / known.sum(1)
    unshifted = np.bincount(part, off[limit], PARTS) / np.bincount(part, minlength=PARTS)
    best = int(np.argmin(totals))
    count = np.maximum(np.bincount(part, known[best], PARTS), 1.0)
    of_parts = np.bincount(part, off[best], PARTS) / count
    textured = unshifted > TEXTURED
    improved = (of_parts < MORE_ALIKE * unshifted) & textured
    agree = textured.sum() >= MIN_TEXTURED and improved.sum() >= AGREEING * textured.sum()
    is_clear = agree and 0 < best < 2 * limit
    return float(totals[limit] / max(totals[best], 0.5)) if is_clear else 0.0, best - limit


def find_tear_row(greys: Sequence[np.ndarray], heights: Sequence[int]) -> Tear | None:
    """Find the clearest tear in grey images ``(H, W)`` uint8, the left image first; ``None`` for no tear.

    The row and the shift are in pixels of the original images, whose ``heights`` are given. A pattern of the
    scene that other images also show is not a tear.
    """
    found = [_tears(grey) for grey in greys]
    torn = [view for view, tear_rows in enumerate(found) if 0 < len(tear_rows) <= MAX_TEARS]
    if len(torn) != 1 or any(len(tear_rows) > MAX_TEARS for tear_rows in found):
        return None
    view = torn[0]
    clearest = found[view][0]
    factor = heights[view] / len(greys[view])
    return Tear(view, round(clearest.row * factor), round(clearest.shift * factor))
