"""Check whether part of one view is blank and the other view is not: a thumb or a cap at the lens."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.stages import ImagesStage

BLOCKED = FindingKind(
    "views.blocked",
    REASON,
    "Part of one view is blank",
    cause="A finger, a lens cap or dirt on the lens covers part of one camera's image.",
    hint="Clean or uncover the lens, or mask the blocked region in both views (--mask, --right-mask).",
)

#: Images are downscaled by this factor.
STEP = 2
#: Standard deviations of the Gaussians whose difference is detail, in these pixels. Noise is finer.
FINE_PX, COARSE_PX = 1.0, 3.0
#: Standard deviation of the window over which detail is averaged, as a fraction of the longer side.
WINDOW_FRACTION = 0.015
#: Detail below this many grey levels is blank.
MIN_DETAIL = 0.6
#: Minimum area of a blank region as a fraction of the image.
MIN_REGION = 0.02


@dataclass(frozen=True)
class BlankRegions:
    """Fractions of the images that are blank or masked, in regions at the border."""

    left: float
    right: float  # of the right view that differs most from the left one
    view: int  # index of that right view


class BlockedView(Check[BlankRegions]):
    """Detects blank or masked regions at the border of one view that are much larger than in the other view.

    Walls and skies are blank in both views. Where only one view is blank, depth is not measured, and matches
    at the edge of the region may be wrong.
    """

    kinds = (BLOCKED,)
    #: 106 real pairs, rectified or hand-held, have up to .14. With half of one lens covered, by black, noise
    #: or a blurred finger, 27 of them have at least .27.
    MAX_DIFFERENCE = 0.2

    @classmethod
    def of_images(cls, stage: ImagesStage) -> BlankRegions | None:
        masks = stage.valid or [None] * len(stage.greys)
        left, *rights = (blank_fraction(*view) for view in zip(stage.greys, masks, strict=True))
        if not rights:
            return None
        view = max(range(len(rights)), key=lambda v: abs(rights[v] - left))
        return BlankRegions(left, rights[view], view)

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact is None or abs(fact.right - fact.left) <= cls.MAX_DIFFERENCE:
            return
        right = "right image" if fact.view == 0 else f"image of right view {fact.view + 1}"
        blank, other = (right, "left image") if fact.right > fact.left else ("left image", right)
        low, high = sorted((fact.left, fact.right))
        yield Finding(
            BLOCKED,
            f"{100 * high:.0f} % of the {blank} is blank or masked at its border, but only "
            f"{100 * low:.0f} % of the {other}. Depth is not measured there. Uncover the lens, or mask that "
            "region in both images.",
        )


def blank_fraction(grey: np.ndarray, valid: np.ndarray | None = None) -> float:
    """Return the fraction of an image ``(H, W)`` uint8 that is blank or not ``valid``, at its border."""
    levels = cv2.resize(grey, None, fx=1 / STEP, fy=1 / STEP, interpolation=cv2.INTER_AREA).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(levels, (0, 0), px) for px in (FINE_PX, COARSE_PX))
    detail = cv2.GaussianBlur(np.abs(fine - coarse), (0, 0), WINDOW_FRACTION * max(levels.shape))
    blank = detail < MIN_DETAIL
    if valid is not None:
        blank |= cv2.resize(valid.astype(np.uint8), blank.shape[::-1], interpolation=cv2.INTER_NEAREST) == 0
    _, labels, areas, _ = cv2.connectedComponentsWithStats(blank.astype(np.uint8), connectivity=4)
    at_border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    sizes = [int(areas[n, cv2.CC_STAT_AREA]) for n in at_border if n]
    return sum(size for size in sizes if size >= MIN_REGION * blank.size) / blank.size
