"""Check whether one view is out of focus or motion-blurred and the other is sharp."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geodiff_plugin.findings import REMARK, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.stages import ImagesStage

DEFOCUSED = FindingKind(
    "views.defocused",
    REMARK,
    "One view is much blurrier than the other",
    cause="One camera is out of focus or has a dirty lens, or the camera moved during an exposure.",
    hint="Focus both cameras identically, clean the lenses, or use a shorter exposure.",
)

#: Standard deviations of the Gaussians whose differences define fine and coarse detail, pixels.
FINE_PX, MIDDLE_PX, COARSE_PX = 0.7, 1.4, 4.0
#: Quantile of coarse detail above which pixels are compared.
TEXTURED = 0.8
#: Coarse detail below this many grey levels is noise.
MIN_DETAIL = 1.0
#: Minimum number of compared pixels.
MIN_PIXELS = 500


@dataclass(frozen=True)
class Sharpness:
    """The difference in sharpness between the left image and the right view that differs most from it."""

    view: int  # index of the right view
    log_ratio: float  # log of (left image's fine/coarse detail) / (right view's fine/coarse detail)


class Defocus(Check[Sharpness]):
    """Detects a view that lacks fine detail in textured regions where the other view has it.

    Blur removes fine detail and keeps coarse detail. Two views of one scene contain about the same amount of
    both. A blurred view has fewer and less accurate matches, and its edges are displaced.
    """

    kinds = (DEFOCUSED,)
    #: Rectified pairs have up to .07, and hand-held frames, some with motion blur, up to .38. With the right
    #: image blurred by a standard deviation of 2 px the median of 68 pairs is .53, and with 3 px it is .72.
    MAX_LOG_RATIO = 0.45

    @classmethod
    def of_images(cls, stage: ImagesStage) -> Sharpness | None:
        left, *rights = map(log_detail_ratio, stage.greys, stage.masks)
        differences = {
            view: left - right for view, right in enumerate(rights) if left is not None and right is not None
        }
        if not differences:
            return None
        worst = max(differences, key=lambda view: abs(differences[view]))
        return Sharpness(worst, differences[worst])

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact is None or abs(fact.log_ratio) <= cls.MAX_LOG_RATIO:
            return
        right = "right image" if fact.view == 0 else f"image of right view {fact.view + 1}"
        blurred, sharp = (right, "left image") if fact.log_ratio > 0 else ("left image", right)
        lost = 1.0 - np.exp(-abs(fact.log_ratio))
        yield Finding(
            DEFOCUSED,
            f"The {blurred} has {100 * lost:.0f} % less fine detail than the {sharp}, so depth is less "
            "accurate at edges. Check focus.",
        )


def log_detail_ratio(grey: np.ndarray, valid: np.ndarray | None = None) -> float | None:
    """Return the log ratio of mean fine to mean coarse detail of a grey image ``(H, W)`` uint8.

    Both are absolute differences of Gaussians, at ``valid (H, W)`` bool pixels; ``None`` for all. Returns
    ``None`` if the image has too little texture.
    """
    levels = grey.astype(np.float32)
    fine, middle, coarse = (cv2.GaussianBlur(levels, (0, 0), px) for px in (FINE_PX, MIDDLE_PX, COARSE_PX))
    fine_detail, coarse_detail = np.abs(fine - middle), np.abs(middle - coarse)
    if valid is not None:
        fine_detail, coarse_detail = fine_detail[valid], coarse_detail[valid]
    if coarse_detail.size < MIN_PIXELS:
        return None
    textured = coarse_detail >= max(float(np.quantile(coarse_detail, TEXTURED)), MIN_DETAIL)
    if textured.sum() < MIN_PIXELS:
        return None
    return float(np.log(fine_detail[textured].mean() / coarse_detail[textured].mean()))
