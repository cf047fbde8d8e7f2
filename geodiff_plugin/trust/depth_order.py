"""Check whether the depth order is inverted relative to the prior."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from geodiff_plugin.findings import REASON, REMARK, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.epipolar import Epipolar
from geodiff_plugin.trust.matched_fraction import MatchedFraction
from geodiff_plugin.trust.occlusion_order import OcclusionOrder
from geodiff_plugin.trust.order_ambiguity import OrderAmbiguity
from geodiff_plugin.trust.pose_errors import ORDER_INVERTED, inverted_order
from geodiff_plugin.trust.prior_correlation import PriorCorrelation
from geodiff_plugin.trust.result_vs_matches import ResultVsMatches
from geodiff_plugin.trust.shifted_copy import ShiftedCopy

ORDER = FindingKind(
    "depth.order",
    REASON,
    "Prior and matches disagree on the depth order",
    cause="E, K or the order of the images is wrong, or the right image shows a different scene.",
    hint="Check these causes in the order listed.",
)
PRIOR_ORDER = FindingKind(
    "prior.order",
    REMARK,
    "According to the matches, the prior inverts near and far",
    cause="The prior was not trained on scenes like this, or the supplied prior map is rotated, is for a "
    "different image, or is in a different prediction space.",
    hint="Check the map and its prediction space (--space). Matched regions are unaffected; elsewhere, the "
    "depth follows the prior and has low confidence.",
)


class DepthOrder(Check[None]):
    """Detects matches whose depth order the prior contradicts: swapped images, a wrong sign or axis of E.

    Epipolar geometry and occlusions may confirm the matches nevertheless. Then only the prior is wrong. This
    check measures no facts of its own.
    """

    kinds = (ORDER_INVERTED, ORDER, PRIOR_ORDER)
    #: Correct pairs have -.60 to +.97, and are below this only if the matches exclude an inverted order.
    MAX_INVERTED_CORRELATION = -0.2
    #: A lower rank correlation is a reason unless much is matched, because a poor prior may cause it.
    MIN_CORRELATION = 0.2
    #: Minimum log ratio of the 95 % to the 5 % quantile of matched depths for a meaningful depth order.
    MIN_LOG_RATIO = 0.15

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact, depths = facts[PriorCorrelation], facts[ShiftedCopy]
        one_depth = depths is not None and depths.log_ratio < cls.MIN_LOG_RATIO
        if fact is None or one_depth or not MatchedFraction.has_matches(facts):
            return
        correlation = f"(rank correlation {fact.rank_correlation:+.2f})"
        if fact.rank_correlation < cls.MAX_INVERTED_CORRELATION:
            yield _prior_is_wrong(fact.rank_correlation) if _order_known(facts) else inverted_order()
        elif PriorCorrelation.is_low(facts, cls.MIN_CORRELATION) and not MatchedFraction.well_matched(facts):
            yield Finding(
                ORDER,
                f"Prior and matches disagree on the depth order {correlation}. Check E, K, and the order of "
                "the images.",
            )


def _order_known(facts: FactSheet) -> bool:
    """Whether the matches constrain the depth order, so that the prior must be wrong."""
    constrained = OrderAmbiguity.excludes_inverted_order(facts) or OcclusionOrder.near_occludes_far(facts)
    return (
        constrained
        and Epipolar.is_good(facts)
        and ResultVsMatches.follows(facts)
        and MatchedFraction.well_matched(facts)
    )


def _prior_is_wrong(rank_correlation: float) -> Finding:
    return Finding(
        PRIOR_ORDER,
        f"The prior inverts near and far (rank correlation {rank_correlation:+.2f}), so unmatched regions "
        "are unreliable. Check the prior map and --space.",
    )
