"""Check for letterbox bars at opposite sides of all images, added by fitting them into another format."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from geodiff_plugin.findings import REMARK, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.stages import ImagesStage

LETTERBOX = FindingKind(
    "views.letterbox",
    REMARK,
    "The images are letterboxed",
    cause="The images were padded to a different aspect ratio.",
    hint="Crop off the black bars and pass K for the cropped images. Ignore this message if K was calibrated "
    "for the padded images.",
)

#: Maximum variation of grey levels within a bar, because compressed black is not exactly uniform.
EVEN = 4
#: Minimum width as a fraction of the side. Narrower bars are edges of a sensor or of a rectified image.
MIN_WIDTH = 0.02
#: Maximum width as a fraction of the side. Wider bars leave no image between them.
MAX_WIDTH = 0.45
#: Maximum difference in width between opposite bars and between images, as a fraction of the side.
MAX_DIFFERENCE = 0.005


@dataclass(frozen=True)
class LetterboxWidth:
    """Letterbox bars of all images."""

    width: float  # width of each bar as a fraction of that side of the image


class Letterbox(Check[LetterboxWidth]):
    """Detects uniform bars of equal width at opposite sides of all images."""

    kinds = (LETTERBOX,)

    @classmethod
    def of_images(cls, stage: ImagesStage) -> LetterboxWidth | None:
        width = letterbox_fraction(stage.in_black) if stage.has_rectangles else 0.0
        return LetterboxWidth(width) if width > 0 else None

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact is not None:
            yield Finding(
                LETTERBOX,
                f"The images are letterboxed: each black bar covers {100 * fact.width:.0f} % of the image. "
                "Check that K was calibrated for the padded images.",
            )


def _bar_fraction(value: int, minima: np.ndarray, maxima: np.ndarray) -> float:
    """Return the fraction of the image that a bar covers: the leading lines whose pixels all equal ``value``.

    ``minima (N,)`` and ``maxima (N,)`` are the extrema of every line.
    """
    uniform = (maxima.astype(np.int16) - value <= EVEN) & (value - minima.astype(np.int16) <= EVEN)
    return float(np.argmin(uniform)) / len(uniform) if not uniform.all() else 1.0


def letterbox_fraction(greys: Sequence[np.ndarray]) -> float:
    """Return the width of the letterbox bars of images ``(H, W)`` as a fraction of the side; 0 for none.

    Bars count only if they have the same width at both sides of all images. The border of a rectified image
    is curved, or wider at one side.
    """
    for horizontal in (False, True):
        widths = [width for grey in greys for width in _bar_widths(grey if horizontal else grey.T)]
        narrowest, widest = min(widths), max(widths)
        if narrowest >= MIN_WIDTH and widest <= min(MAX_WIDTH, narrowest + MAX_DIFFERENCE):
            return widest
    return 0.0


def _bar_widths(lines: np.ndarray) -> tuple[float, float]:
    """Return the width of the bars before and after the content of lines ``(N, M)``, as fractions of N."""
    minima, maxima = lines.min(1), lines.max(1)
    first = _bar_fraction(int(lines[0, 0]), minima, maxima)
    last = _bar_fraction(int(lines[-1, 0]), minima[::-1], maxima[::-1])
    return first, last
