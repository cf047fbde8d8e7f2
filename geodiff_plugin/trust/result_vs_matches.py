"""Check whether the result agrees with the matches."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.constants import MIN_MATCHES
from geodiff_plugin.trust.known_points import KnownPoints
from geodiff_plugin.trust.stages import ResultStage

OFF = FindingKind(
    "depth.off-matches",
    REASON,
    "The depth differs from the matched depths",
    cause="No scale and shift could be found that align the prior with the matches.",
    hint="Enable match fitting (fit_matches) if it is disabled; otherwise use a different prior, or provide "
    "known points.",
)


@dataclass(frozen=True)
class Deviation:
    """Deviation of the result from the matches."""

    log_deviation: float  # median absolute log ratio of the depth to the matched depth


class ResultVsMatches(Check[Deviation]):
    """Detects a result whose scale or shift was not found."""

    kinds = (OFF,)
    #: A larger deviation is a reason (log).
    MAX_DEVIATION = math.log(1.2)
    #: A result with a smaller deviation follows the matches (log).
    FOLLOWS = math.log(1.05)

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        found = stage.matched
        return {name: found[name] for name in ("log_deviation", "compared")} if found else {}

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> Deviation | None:
        return Deviation(numbers["log_deviation"]) if numbers.get("compared", 0) >= MIN_MATCHES else None

    @classmethod
    def follows(cls, facts: FactSheet) -> bool:
        """Whether the result is known to follow the matches."""
        fact = facts[cls]
        return fact is not None and fact.log_deviation < cls.FOLLOWS

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact and fact.log_deviation > cls.MAX_DEVIATION and not KnownPoints.fix_scale(facts):
            yield Finding(
                OFF,
                f"The depth differs by {100 * math.expm1(fact.log_deviation):.0f} % (median) from the "
                "matched depths. Use a different prior, or provide known points.",
            )
