"""Check the matched fraction of the left image, its mean confidence and its overlap with the right views."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin.findings import WARNING, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.stages import ResultStage

OVERLAP = FindingKind(
    "views.overlap",
    WARNING,
    "The views have little overlap",
    cause="Only a small fraction of the left image is visible in a right view.",
    hint="Choose views that overlap by at least half of the image.",
)


@dataclass(frozen=True)
class Matched:
    """Fractions of the left image."""

    matched: float | None = None  # fraction with a left-right consistent match, [0, 1]; None without matches
    confidence: float | None = None  # mean confidence over all pixels, [0, 1]
    visible: float | None = None  # fraction visible to a right view at the estimated depth, [0, 1]


class MatchedFraction(Check[Matched]):
    """Detects views with little overlap, and measures fractions that other checks use."""

    kinds = (OVERLAP,)
    #: Above this matched fraction, a prior with another depth order is more likely wrong than the matches.
    WELL_MATCHED = 0.5
    #: Below this visible fraction few pixels constrain the scale.
    MIN_VISIBLE = 0.3

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        numbers = {"matched": stage.matched["matched"] / stage.valid_fraction} if stage.matched else {}
        if stage.confidence is not None:
            numbers["confidence"] = stage.mean(stage.confidence)
        if stage.visible is not None:
            numbers["visible"] = stage.mean(stage.visible)
        return numbers

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> Matched | None:
        return Matched(**numbers) if numbers else None

    @classmethod
    def has_matches(cls, facts: FactSheet) -> bool:
        """Whether a second view was matched. Otherwise only known points can test the depth."""
        fact = facts[cls]
        return fact is not None and fact.matched is not None

    @classmethod
    def well_matched(cls, facts: FactSheet) -> bool:
        """Whether so much is matched that the matches are more reliable than the prior."""
        fact = facts[cls]
        return fact is not None and fact.matched is not None and fact.matched > cls.WELL_MATCHED

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact and fact.visible is not None and fact.visible < cls.MIN_VISIBLE:
            yield Finding(
                OVERLAP,
                f"Only {fact.visible:.0%} of the left image is visible in a right view, so the scale is "
                "poorly constrained. Increase the overlap.",
            )
