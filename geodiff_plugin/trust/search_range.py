"""Check whether the scene extends beyond the given depth range."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.matching.matches import RELIABLE
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.constants import MIN_MATCHES
from geodiff_plugin.trust.stages import ResultStage

RANGE = FindingKind(
    "depth.range",
    REASON,
    "The scene extends beyond the specified depth range",
    cause="depth_range (--near, --far) is too narrow.",
    hint="Widen or omit it.",
)


@dataclass(frozen=True)
class Ends:
    """Matches at the ends of a given depth range."""

    fraction: float  # fraction of the confident matches on the first or last plane


class SearchRange(Check[Ends]):
    """Detects a given depth range that is too narrow."""

    kinds = (RANGE,)
    #: Above this fraction the range may be too narrow.
    MANY = 0.05
    #: Above this fraction the range is too narrow.
    MAX_FRACTION = 0.2

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        matches, planes = stage.matches, stage.planes
        if matches is None or planes is None or not stage.call.range_given:
            return {}
        in_front = (matches.confidence > RELIABLE) & (matches.inverse_depth > 0)
        off = ((matches.inverse_depth - planes[end]).abs() for end in (0, -1))
        first, last = (in_front & (each < 0.75 * matches.plane_step) for each in off)
        at_ends = (first | last).sum() / in_front.sum().clamp_min(1)
        return {"at_ends": at_ends, "in_front": stage.matched["in_front"]}

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> Ends | None:
        return Ends(numbers["at_ends"]) if numbers.get("in_front", 0) >= MIN_MATCHES else None

    @classmethod
    def confirms_unit(cls, facts: FactSheet) -> bool:
        """Whether the user gave a depth range in metres that contains the matches."""
        fact = facts[cls]
        return facts.call.range_given and (fact is None or fact.fraction <= cls.MAX_FRACTION)

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact and fact.fraction > cls.MAX_FRACTION:
            yield Finding(
                RANGE,
                f"{100 * fact.fraction:.0f} % of the matches are at an end of the depth range, so depth is "
                "clipped. Widen depth_range (--near, --far).",
            )
