"""Check whether near surfaces occlude far ones, by the position of image edges at occlusions.

If the disparity rises along a row, the left image shows pixels that are occluded in the right image. They
belong to the farther surface, so the image edge is at the end of the gap next to the nearer surface. If the
depth order is inverted, the edge is at the other end. The check does not use the prior.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.matching.gaps import Gaps
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.order_ambiguity import OrderAmbiguity
from geodiff_plugin.trust.prior_correlation import PriorCorrelation
from geodiff_plugin.trust.stages import RowsStage

FAR_OCCLUDES = FindingKind(
    "depth.occlusion",
    REASON,
    "The occlusion order is inverted",
    cause="The views are swapped, or both are mirrored or upside down. This is checked only if the cameras' "
    "principal points differ.",
    hint="Swap the images, or restore their original orientation.",
)

#: Minimum rise of the disparity at an occlusion, pixels. Smaller rises occur on slanted surfaces.
MIN_RISE_PX = 4.0
#: Maximum difference between the width of an occlusion and the rise of the disparity, as a fraction of the
#: rise.
AS_WIDE = 0.35
#: Lower bound of the ``AS_WIDE`` tolerance in pixels, for small rises.
AS_WIDE_PX = 2.0
#: Maximum distance of the image edge from an end of the gap, pixels, because matchers displace edges.
MAX_DISTANCE_PX = 3
#: Minimum difference of the brightness steps at both ends, grey levels. Other occlusions are ignored.
MIN_DIFFERENCE = 4.0
#: Minimum number of occlusions, one per row, required for a conclusion.
MIN_OCCLUSIONS = 60
#: Blur of the image before brightness steps are measured, pixels.
BLUR_PX = 0.8


@dataclass(frozen=True)
class Order:
    """The position of image edges at occlusions."""

    order: float  # [-1, 1], above 0 if near surfaces occlude far ones


class OcclusionOrder(Check[Order]):
    """Detects an inverted depth order from the occlusions of a rectified pair.

    The matches permit an inverted order only if the principal points of the cameras differ
    (``OrderAmbiguity``). A prior that confirms the order of the matches suppresses the finding.
    """

    kinds = (FAR_OCCLUDES,)
    #: Correct pairs whose principal points differ have +.30 to +.87, and with mirrored images -.42 to -.98.
    #: Two in thirty other correct pairs were below -.7.
    MIN_ORDER = 0.35

    @classmethod
    def of_rows(cls, stage: RowsStage) -> Order | None:
        order = occlusion_order(stage.grey, stage.shift, stage.gaps)
        return None if math.isnan(order) else Order(order)

    @classmethod
    def near_occludes_far(cls, facts: FactSheet) -> bool:
        """Whether occlusions confirm the depth order of the matches."""
        fact = facts[cls]
        return fact is not None and fact.order > cls.MIN_ORDER

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact is None or fact.order >= -cls.MIN_ORDER or PriorCorrelation.confirms(facts):
            return
        if OrderAmbiguity.allows_inverted_order(facts):
            yield Finding(
                FAR_OCCLUDES,
                f"The occlusion order is inverted ({fact.order:+.2f}), so depth is wrong. Check for swapped, "
                "mirrored or upside-down images.",
            )


def occlusion_order(grey: np.ndarray, shift: np.ndarray, gaps: Gaps) -> float:
    """Average over occlusions +1 if the image edge is at the nearer end, and -1 if at the farther end.

    Args:
        grey: ``(H, W)`` uint8, the left image of a rectified pair whose right camera is on the right.
        shift: ``(H, W)`` disparity in pixels, larger for nearer surfaces.
        gaps: runs of pixels with unknown disparity; some of them are occlusions.

    Returns:
        A score in [-1, 1], above 0 if near surfaces occlude far ones; NaN for too few occlusions.
    """
    far = gaps.first - 1
    near = gaps.end
    inside = (far >= MAX_DISTANCE_PX) & (near < grey.shape[1] - MAX_DISTANCE_PX - 1)
    row = gaps.row[inside]
    far = far[inside]
    near = near[inside]
    rise = shift[row, near] - shift[row, far]
    as_wide = np.abs(near - far - 1 - rise) < np.maximum(AS_WIDE_PX, AS_WIDE * rise)
    occluded = (rise >= MIN_RISE_PX) & as_wide
    row, far, near = row[occluded, None], far[occluded, None], near[occluded, None]
    blurred = cv2.GaussianBlur(grey, (0, 0), BLUR_PX)
    offsets = np.arange(-MAX_DISTANCE_PX, MAX_DISTANCE_PX + 2)  # one more pixel than steps
    at_far, at_near = (blurred[row, end + offsets].astype(np.float32) for end in (far, near - 1))
    difference = np.abs(np.diff(at_near)).max(1) - np.abs(np.diff(at_far)).max(1)
    clear = np.abs(difference) > MIN_DIFFERENCE
    return float(np.sign(difference[clear]).mean()) if clear.sum() >= MIN_OCCLUSIONS else math.nan
