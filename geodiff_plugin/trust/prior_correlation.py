"""Check whether the prior and the evidence have the same depth order."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.matched_fraction import MatchedFraction
from geodiff_plugin.trust.stages import ResultStage

ORDER_OF_POINTS = FindingKind(
    "depth.order-points",
    REASON,
    "Prior and known depths disagree on the depth order",
    cause="The points are not depths in metres in the left camera's frame, or the prediction space of the "
    "prior is wrong.",
    hint="Check the frame and the unit of the points, and the prediction space of the prior (--space).",
)


@dataclass(frozen=True)
class Correlation:
    """The agreement of prior and evidence on the depth order."""

    rank_correlation: float  # rank correlation of the prior's first map with matches or points, [-1, 1]
    prior_error: float | None = None  # standard deviation of the prior's map from the matches, log depth


class PriorCorrelation(Check[Correlation]):
    """Detects known points whose depth order contradicts the prior, if there is no second view.

    ``DepthOrder`` compares the prior with matches.
    """

    kinds = (ORDER_OF_POINTS,)
    #: Correct pairs have -.60 to +.97, because a prior may misinterpret a scene.
    MIN_CORRELATION = 0.2
    #: Minimum correlation at which the prior confirms the depth order.
    CONFIRMS = 0.45
    #: Errors of the prior, log depth, between which a low correlation is not evidence: the prior is weak. In
    #: 14 correct frames of 216x324, the bundled prior has .17 to .32 where the correlation is below .45, and
    #: mostly .07 to .12 elsewhere. At the maximum, .5, the matches contradict each other, as in wrong pairs.
    WEAK_ERROR = 0.15
    MAX_WEAK_ERROR = 0.45

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        numbers = {"rank_correlation": stage.rank_correlation, "prior_error": stage.prior_error}
        return {name: number for name, number in numbers.items() if number is not None}

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> Correlation | None:
        correlation = numbers.get("rank_correlation", math.nan)
        return None if math.isnan(correlation) else Correlation(correlation, numbers.get("prior_error"))

    @classmethod
    def is_low(cls, facts: FactSheet, correlation: float) -> bool:
        """Whether the correlation is below a value, unless the prior is too weak for this to be evidence."""
        fact = facts[cls]
        if fact is None or fact.rank_correlation >= correlation:
            return False
        error = fact.prior_error
        return error is None or not cls.WEAK_ERROR < error < cls.MAX_WEAK_ERROR

    @classmethod
    def confirms(cls, facts: FactSheet) -> bool:
        """Whether the prior confirms the depth order of the matches."""
        fact = facts[cls]
        return fact is not None and fact.rank_correlation >= cls.CONFIRMS

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact and fact.rank_correlation < cls.MIN_CORRELATION and not MatchedFraction.has_matches(facts):
            yield Finding(
                ORDER_OF_POINTS,
                "Prior and known depths disagree on the depth order (rank correlation "
                f"{fact.rank_correlation:+.2f}). Check the points' frame and unit.",
            )
