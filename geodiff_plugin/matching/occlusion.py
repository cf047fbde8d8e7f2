"""Whether what is matched as near hides what is matched as far, by where pictures change at occlusions.

Where the shift rises along a row, the left picture shows pixels that are hidden from the right camera. They
are part of the farther surface, so the picture changes at their end beside the nearer one. Of pictures whose
near and far are exchanged it changes at the other end. No prior is asked.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from geodiff_plugin.matching.gaps import Gaps

#: Smaller rises are those of slanted surfaces, pixels.
LEAST_RISE_PX = 4.0
#: An occlusion is as wide as the shift rises, up to this share of the rise.
AS_WIDE = 0.35
#: The same in pixels, for small rises.
AS_WIDE_PX = 2.0
#: Pixels to either side of an end in which the picture changes: matchers move edges by that much.
REACH_PX = 3
#: Ends whose steps of brightness differ by less say nothing, grey levels.
LEAST_DIFFERENCE = 4.0
#: Fewest occlusions, one a row, that say something together.
FEWEST = 60
#: Blur of the picture before its steps are measured, pixels.
BLUR_PX = 0.8


def occlusion_order(grey: np.ndarray, shift: np.ndarray, gaps: Gaps) -> float:
    """Mean over occlusions of +1 where the picture changes at the nearer end, and -1 at the farther one.

    Args:
        grey: ``(H, W)`` uint8, the left picture of a rectified pair; the right camera stands to the right.
        shift: ``(H, W)`` pixels, larger where it is nearer.
        gaps: where the shift is not known; some of them are occlusions.

    Returns:
        In [-1, 1], above 0 where near hides far; NaN for too few occlusions.
    """
    far, near = gaps.first - 1, gaps.end
    inside = (far >= REACH_PX) & (near < grey.shape[1] - REACH_PX - 1)
    row, far, near = gaps.row[inside], far[inside], near[inside]
    rise = shift[row, near] - shift[row, far]
    as_wide = np.abs(near - far - 1 - rise) < np.maximum(AS_WIDE_PX, AS_WIDE * rise)
    occluded = (rise >= LEAST_RISE_PX) & as_wide
    row, far, near = row[occluded, None], far[occluded, None], near[occluded, None]
    blurred = cv2.GaussianBlur(grey, (0, 0), BLUR_PX)
    beside = np.arange(-REACH_PX, REACH_PX + 2)  # steps from each of these pixels to the next
    at_far, at_near = (blurred[row, end + beside].astype(np.float32) for end in (far, near - 1))
    difference = np.abs(np.diff(at_near)).max(1) - np.abs(np.diff(at_far)).max(1)
    clear = np.abs(difference) > LEAST_DIFFERENCE
    return float(np.sign(difference[clear]).mean()) if clear.sum() >= FEWEST else math.nan
