"""Check whether part of the scene moved between the images, perpendicular to the epipolar lines."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.pose.tracks import MIN_MATCHES, Tracks, blocks, epipolar
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.stages import TracksStage

MOVED = FindingKind(
    "views.moved",
    REASON,
    "Part of the scene moved between the images",
    cause="The images were taken at different times, and an object moved.",
    hint="Capture both images simultaneously, or capture a static scene.",
)

#: Minimum epipolar distance of the matches of a moving object, pixels.
MIN_OFF_PX = 2.0
#: Minimum epipolar distance of the matches of a moving object, as a multiple of the median of all matches.
MIN_TIMES = 4.0
#: Maximum median deviation of the distances within a block, as a fraction of their median.
TOGETHER = 0.25
#: Maximum epipolar distance of a match that is used, pixels.
MAX_OFF_PX = 30.0
#: Minimum number of matches in a block of the left image.
MIN_OF_BLOCK = 5


@dataclass(frozen=True)
class Moved:
    """The moving part of the scene."""

    fraction: float  # fraction of matches in moving blocks of the left image, maximum over the views


class MovingObjects(Check[Moved]):
    """Detects parts of the scene that moved between the exposures.

    The matches of a block have similar epipolar distances, several times the usual distance.
    """

    kinds = (MOVED,)
    #: 66 correct pairs, whose poses may be inaccurate, have up to .10. Pairs with half of the right image
    #: shifted have .32 to .39.
    MAX_FRACTION = 0.15
    #: Limit for few matches, half of ``MAX_FRACTION``.
    MAX_RULED_OUT = 0.075

    @classmethod
    def of_tracks(cls, stage: TracksStage) -> Moved | None:
        fractions = (moved_fraction(stage.tracks.view(v), T) for v, T in enumerate(stage.given))
        known = [fraction for fraction in fractions if not math.isnan(fraction)]
        return Moved(max(known)) if known else None

    @classmethod
    def rules_out(cls, fact: Moved | None) -> bool:
        return fact is not None and fact.fraction <= cls.MAX_RULED_OUT

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact and fact.fraction > cls.MAX_FRACTION:
            yield Finding(
                MOVED,
                f"{100 * fact.fraction:.0f} % of the matches are on objects that moved between the "
                "images, so their depth is wrong. Capture both images simultaneously.",
            )


def moved_fraction(tracks: Tracks, T: np.ndarray) -> float:
    """Return the fraction of one right view's matches in moving blocks, [0, 1]; NaN for too few matches.

    Wrong matches have random epipolar distances. The matches of a moving object have similar distances,
    several times the usual one under the pose ``T (4, 4)``, ``T_right_from_left``.
    """
    off_px = epipolar(tracks, T).off_px
    usual_px = float(np.median(np.abs(off_px))) if len(off_px) else math.nan
    kept = np.abs(off_px) < MAX_OFF_PX
    off_px = off_px[kept]
    block = blocks(tracks.kept(kept))
    count = np.bincount(block)
    median = _medians(off_px, block, count)
    deviation = _medians(np.abs(off_px - median[block]), block, count)
    enough = count >= MIN_OF_BLOCK
    away = np.abs(median) > max(MIN_OFF_PX, MIN_TIMES * usual_px)
    moved = int(count[enough & away & (deviation < TOGETHER * np.abs(median))].sum())
    compared = int(count[enough].sum())
    return moved / compared if compared >= MIN_MATCHES else math.nan


def _medians(values: np.ndarray, block: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the median of the values ``(N,)`` of every block; no block of ``count`` values is empty."""
    in_order = values[np.lexsort((values, block))]
    first = np.cumsum(count) - count
    return (in_order[first + (count - 1) // 2] + in_order[first + count // 2]) / 2.0
