"""Check whether any evidence confirms the poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.epipolar import Epipolar
from geodiff_plugin.trust.known_points import KnownPoints
from geodiff_plugin.trust.matched_fraction import MatchedFraction
from geodiff_plugin.trust.prior_correlation import PriorCorrelation
from geodiff_plugin.trust.result_vs_matches import ResultVsMatches

UNCHECKED = FindingKind(
    "pose.unchecked",
    REASON,
    "The pose could not be checked",
    cause="There are too few feature matches to check the pose, and the depth does not confirm it either.",
    hint="Use views with more texture or overlap. If the pose is exact, set pose='given' (--set pose=given).",
)


class UncheckedPose(Check[None]):
    """Detects poses that cannot be checked with the matches and are not confirmed by the depth.

    The depth confirms them if most pixels have a left-right consistent match and the result and the prior
    agree with the matches, or if known points agree with the matches. This check measures no facts itself.
    """

    kinds = (UNCHECKED,)

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[Epipolar]
        if fact is None or fact.status != "not checked" or not MatchedFraction.has_matches(facts):
            return
        followed = ResultVsMatches.follows(facts) and PriorCorrelation.confirms(facts)
        if not (KnownPoints.agree(facts) or (MatchedFraction.well_matched(facts) and followed)):
            yield Finding(
                UNCHECKED,
                "The pose could not be checked: there are too few feature matches. Use views with more "
                "texture or, if the pose is exact, set pose='given' (--set pose=given).",
            )
