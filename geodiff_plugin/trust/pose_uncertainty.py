"""Check how well the matches constrain the scale and shape of refined poses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from geodiff_plugin._internal.statistics import MAX_SCALE_SPREAD
from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet, MatchError
from geodiff_plugin.trust.epipolar import Epipolar, beyond
from geodiff_plugin.trust.known_points import KnownPoints
from geodiff_plugin.trust.stages import PosesStage

SCALE = FindingKind(
    "scale.uncertain",
    REASON,
    "The scale of the refined pose is uncertain",
    cause="The baseline is not declared as measured, and two estimates of the scale of the refined pose "
    "differ: one from the given baseline, one from the depth of the matches under the given pose.",
    hint="Specify the measured baseline (--baseline, measured_baseline=True), or provide at least three "
    "known points.",
)
UNCONSTRAINED = FindingKind(
    "pose.unconstrained",
    REASON,
    "The matches do not constrain the pose",
    cause="The baseline is too short, or there are too few matches, to separate rotation from translation.",
    hint="Provide a more accurate pose, or use views with a longer baseline.",
)


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of the poses in use."""

    scale_rel_std: float | None  # relative standard deviation of the scale; None if it was measured
    depth_change: float  # median change of log depth under another pose that fits equally well
    refined: bool  # False if the best-fitting pose was rejected as too far from the given one


class PoseUncertainty(Check[Uncertainty]):
    """Detects poses whose scale or shape the matches do not constrain.

    A given pose has the scale uncertainty of a tracker unless its baseline was measured, because the baseline
    length is unobservable from two views.
    """

    kinds = (SCALE, UNCONSTRAINED)
    #: Correct pairs have up to .148. Pairs whose yaw in E is wrong by a degree have .17 to .64.
    MAX_DEPTH_CHANGE = 0.16
    #: Limit on the root sum of squares of both uncertainties, each divided by its own limit. It is 1.10 for
    #: 50 tracker pairs with refined poses, and 1.21 when refinement masked a K for an image .67 times as
    #: large.
    MAX_TOGETHER = 1.15
    #: Weight of the scale's standard deviation in the relative error of all depths. The log loss of 90 pairs
    #: from three trackers is within .002 of its minimum from .75 to .9, and higher by .008 at .65.
    SCALE_WEIGHT = 0.85
    #: Weight of the change of log depth in the relative error of all depths, because the pose in use lies
    #: between the other one and the given one. The log loss of 77 tracker pairs is within .001 of its minimum
    #: from .3 to .5, and correct pairs lose the least confidence at .3.
    CHANGE_WEIGHT = 0.3
    #: Above this change of log depth, which correct pairs do not reach, the whole excess counts.
    USUAL_CHANGE = 0.15

    @classmethod
    def of_poses(cls, stage: PosesStage) -> Uncertainty | None:
        report = stage.report
        return Uncertainty(report.scale_rel_std, report.depth_spread, report.rejected is None)

    @classmethod
    def scale_rel_std(cls, facts: FactSheet) -> float:
        """Return the relative standard deviation of the scale; 0 if it was measured or is unknown."""
        fact = facts[cls]
        return (fact.scale_rel_std or 0.0) if fact and facts.call.has_unit else 0.0

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact is None:
            return
        scale = cls.scale_rel_std(facts)
        fixed = KnownPoints.fix_scale(facts)
        if scale > MAX_SCALE_SPREAD and not fixed:
            yield _scale_uncertain(scale, Epipolar.misses_by_px(facts))
        if fact.depth_change > cls.MAX_DEPTH_CHANGE:
            if fact.refined:
                yield Finding(
                    UNCONSTRAINED,
                    "The matches do not constrain the pose: a different, equally good pose changes depth by "
                    f"{100 * math.expm1(fact.depth_change):.0f} % (median). Provide a more accurate pose.",
                )
        elif scale <= MAX_SCALE_SPREAD and not fixed and cls._together(scale, fact) > cls.MAX_TOGETHER:
            yield Finding(
                UNCONSTRAINED,
                f"The refined pose is uncertain: its scale may be off by {100 * scale:.0f} %, and a "
                f"different, equally good pose changes depth by {100 * math.expm1(fact.depth_change):.0f} % "
                "(median). Check K and E.",
            )

    @classmethod
    def _together(cls, scale: float, fact: Uncertainty) -> float:
        return math.hypot(scale / MAX_SCALE_SPREAD, fact.depth_change / cls.MAX_DEPTH_CHANGE)

    @classmethod
    def match_error(cls, facts: FactSheet) -> MatchError:
        fact = facts[cls]
        if fact is None:
            return MatchError()
        change = max(cls.CHANGE_WEIGHT * fact.depth_change, beyond(fact.depth_change, cls.USUAL_CHANGE))
        return MatchError(relative=math.hypot(cls.SCALE_WEIGHT * cls.scale_rel_std(facts), change))


def _scale_uncertain(scale: float, given_px: float | None) -> Finding:
    misses = "" if given_px is None else f"E has an epipolar error of {given_px:.0f} px; check E. "
    return Finding(
        SCALE,
        f"{misses}The scale of the refined pose is uncertain by {100 * min(scale, 1):.0f} %. Specify the "
        f"measured baseline (--baseline), or provide at least {KnownPoints.MIN_POINTS} known points.",
    )
