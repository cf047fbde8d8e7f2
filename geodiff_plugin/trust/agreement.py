"""Check whether the two views are consistent."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.epipolar import Epipolar
from geodiff_plugin.trust.matched_fraction import MatchedFraction
from geodiff_plugin.trust.prior_correlation import PriorCorrelation

INCONSISTENT = FindingKind(
    "views.inconsistent",
    REASON,
    "The views are inconsistent",
    cause="E uses the wrong axis convention or has a wrong rotation, the images are unrectified or "
    "distorted, K is for a different image size, one image is mirrored, or the images show different scenes "
    "or times.",
    hint="Check these causes in the order listed; overview.png shows where the views disagree.",
)


class _Numbers(NamedTuple):
    """Indicators of agreement. Unknown ones have the value of perfect agreement."""

    matched: float
    confidence: float
    rank_correlation: float


class Agreement(Check[None]):
    """Detects views that do not show the same scene under these cameras, whatever the cause.

    There are four weak indicators: a low matched fraction, a low mean confidence, large epipolar errors and a
    prior with another depth order, unless the prior is weak. Two of them together are a reason. A very low
    matched fraction or confidence is a reason on its own. This check measures no facts of its own.
    """

    kinds = (INCONSISTENT,)
    #: Correct pairs, real and rendered, have a matched fraction of .39 to .96.
    MIN_MATCHED = 0.12
    WEAK_MATCHED = 0.38
    #: Correct pairs, real and rendered, have a mean confidence of .69 to .98. Pairs whose right view shows
    #: another scene, is mirrored or is blank have .12 to .36.
    MIN_CONFIDENCE = 0.5
    WEAK_CONFIDENCE = 0.53
    WEAK_CORRELATION = 0.45

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        if not MatchedFraction.has_matches(facts):
            return
        fact = _numbers(facts)
        few, unsure = fact.matched < cls.WEAK_MATCHED, fact.confidence < cls.WEAK_CONFIDENCE
        unordered = PriorCorrelation.is_low(facts, cls.WEAK_CORRELATION)
        weak = few + unsure + unordered + Epipolar.is_weak(facts)
        if not (fact.matched < cls.MIN_MATCHED or fact.confidence < cls.MIN_CONFIDENCE or weak > 1):
            return
        numbers = [f"{100 * fact.matched:.0f} % of the left image is matched"] if few else []
        numbers += [f"mean confidence is {fact.confidence:.2f}"] if unsure else []
        if unordered and not numbers:
            numbers = [f"rank correlation with the prior is {fact.rank_correlation:.2f}"]
        yield Finding(
            INCONSISTENT,
            f"The views are inconsistent ({', '.join(numbers)}). Check E, K, rectification, and for mirrored "
            "or wrong images.",
        )


def _numbers(facts: FactSheet) -> _Numbers:
    overlap, order = facts[MatchedFraction], facts[PriorCorrelation]
    matched = 1.0 if overlap is None or overlap.matched is None else overlap.matched
    confidence = 1.0 if overlap is None or overlap.confidence is None else overlap.confidence
    return _Numbers(matched, confidence, 1.0 if order is None else order.rank_correlation)
