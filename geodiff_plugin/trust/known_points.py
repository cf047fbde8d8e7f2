"""Check whether known points agree with the matches of the views and are numerous enough."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.findings import REASON, REMARK, WARNING, Finding, FindingKind
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.matches import RELIABLE
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.match_statistics import where_known
from geodiff_plugin.trust.matched_fraction import MatchedFraction
from geodiff_plugin.trust.stages import ResultStage

OUTSIDE = FindingKind(
    "points.outside",
    WARNING,
    "Points outside the left image are ignored",
    cause="The points cover a larger scene, or are in a different camera's frame.",
    hint="Provide points in the left camera's frame, in metres.",
)
FACTOR = FindingKind(
    "points.factor",
    REASON,
    "Known and matched depths differ by more than 20 %",
    cause="A unit, the baseline or K is wrong, or the points are in the wrong frame.",
    hint="Check the unit of the points, the baseline and K.",
)
CONTRADICT = FindingKind(
    "points.contradict",
    REASON,
    "More than half of the known depths contradict the matches",
    cause="The points are noisy, or from a different scene or time.",
    hint="Specify their confidence (points_confidence, --points-confidence), or remove them.",
)
TOO_FEW = FindingKind(
    "points.too-few",
    REASON,
    "There are too few known depths to determine scale and shift",
    cause="Fewer than three points are in the image, and there is no matched second view.",
    hint="Provide at least three points to determine scale and shift, and at least 50, spread over the "
    "image, for a verdict.",
)
DIFFER = FindingKind(
    "points.differ",
    REMARK,
    "Known and matched depths differ by 8 to 20 %",
    cause="The baseline or K is inaccurate, or the points are in the wrong unit or frame.",
    hint="Check the unit of the points, the baseline and K.",
)
SOME_CONTRADICT = FindingKind(
    "points.some-contradict",
    REMARK,
    "More than a quarter of the known depths contradict the matches",
    cause="The points are noisy, at edges, or on surfaces that only the depth sensor sees.",
    hint="Specify their confidence (points_confidence, --points-confidence), or remove them.",
)
FEW = FindingKind(
    "points.few",
    REMARK,
    "There are too few known depths",
    cause="Fewer than three points are in the image, but there is a matched second view.",
    hint="Provide at least three points.",
)

#: Radius in pixels within which a point is compared with matches, because a point is rarely on a matched
#: pixel.
RADIUS_PX = 3
#: Ratio of known to matched depths -> likely cause and remedy.
CAUSES = {
    0.256: "KITTI depth (1/256 m) was read as millimetres; set the points' scale to 256",
    1000 / 256: "millimetres were read as KITTI depth (1/256 m); set the points' scale to 1000",
    1000.0: "the points are in millimetres; divide them by 1000, or set their scale to 1000",
    0.001: "metres were divided by 1000; set the points' scale to 1",
    256.0: "the points are KITTI integers; divide them by 256, or set their scale to 256",
    100.0: "the points are in centimetres; divide them by 100, or set their scale to 100",
    1 / 0.3048: "the points are in feet",
    0.3048: "metres were read as feet",
}
#: Maximum difference between a measured ratio and the ratio of a cause (log).
NEARLY = math.log(1.04)


@dataclass(frozen=True)
class Points:
    """The known points of one image."""

    count: int  # number of points in the image
    outside: int  # number of given points outside the image
    cover: float  # fraction of the cells of an 8x8 grid over the image that contain a point
    ratio: float | None  # median ratio of known to matched depths
    fraction_off: float | None  # fraction that differs from the matches by more than ``MAX_LOG_RATIO``


class KnownPoints(Check[Points]):
    """Detects known points in another unit, frame or scene, and too few known points."""

    kinds = (OUTSIDE, FACTOR, CONTRADICT, TOO_FEW, DIFFER, SOME_CONTRADICT, FEW)
    #: Minimum number of points that determine scale and shift, and reveal a wrong point.
    MIN_POINTS = 3
    #: Minimum number of points that test a depth without matches. The mean AbsRel of six pairs was .13 with
    #: 40 points and .10 with 80.
    MIN_JUDGED = 50
    #: Minimum fraction of the image that the points cover, because points in a corner do not test the rest.
    MIN_COVER = 0.25
    #: Minimum number of points that are compared with matches, because the median of fewer is not reliable.
    MIN_COMPARED = 12
    #: A larger median ratio is a remark (log).
    REMARKED_LOG_RATIO = math.log(1.08)
    #: A larger median ratio is a reason (log). A single point that differs by more contradicts the matches.
    MAX_LOG_RATIO = math.log(1.2)
    #: A larger fraction of contradicting points is a remark. In dense maps some points always contradict the
    #: matches, at edges and in occluded regions.
    REMARKED_OFF = 0.25
    #: A larger fraction of contradicting points is a reason.
    MAX_OFF = 0.5

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        if stage.points is None:
            return {}
        known = (stage.points.confidence > 0).float()
        numbers = {"count": known.sum(), "cover": F.adaptive_max_pool2d(known, 8).mean()}
        return numbers if stage.matches is None else numbers | _compared(stage.matches, stage.points)

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> Points | None:
        if not numbers and not stage.points_outside:
            return None
        enough = numbers.get("compared", 0) >= cls.MIN_COMPARED
        ratio, off = (numbers[name] if enough else None for name in ("ratio", "off"))
        count, cover = (numbers.get(name, 0.0) for name in ("count", "cover"))
        return Points(round(count), stage.points_outside, cover, ratio, off)

    @classmethod
    def fix_scale(cls, facts: FactSheet) -> bool:
        """Whether there are enough points to determine the scale."""
        fact = facts[cls]
        return fact is not None and fact.count >= cls.MIN_POINTS

    @classmethod
    def agree(cls, facts: FactSheet) -> bool:
        """Whether the points are known to agree with the matches."""
        fact = facts[cls]
        return fact is not None and fact.ratio is not None and fact.ratio > 0 and not _are_wrong(fact)

    @classmethod
    def test_the_depth(cls, facts: FactSheet) -> bool:
        """Whether the points alone suffice to test a depth."""
        fact = facts[cls]
        return fact is not None and fact.count >= cls.MIN_JUDGED and fact.cover >= cls.MIN_COVER

    @classmethod
    def confidence_factor(cls, facts: FactSheet) -> float:
        fact = facts[cls]
        if fact is None or fact.ratio is None:
            return 1.0
        beyond = abs(math.log(fact.ratio)) - cls.REMARKED_LOG_RATIO
        return min(1.0, max(0.25, 1.0 - 0.75 * beyond / (cls.MAX_LOG_RATIO - cls.REMARKED_LOG_RATIO)))

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact is None:
            return
        log_ratio, off = log_size(fact.ratio), fact.fraction_off or 0.0
        if log_ratio > cls.MAX_LOG_RATIO:
            yield _factor(FACTOR, fact)
        elif off > cls.MAX_OFF:
            yield _contradict(CONTRADICT, fact)
        elif log_ratio >= cls.REMARKED_LOG_RATIO:
            yield _factor(DIFFER, fact)
        elif off > cls.REMARKED_OFF:
            yield _contradict(SOME_CONTRADICT, fact)
        if 0 < fact.count < cls.MIN_POINTS:
            yield _few(fact.count, alone=not MatchedFraction.has_matches(facts))
        if fact.outside:
            yield Finding(
                OUTSIDE,
                f"{fact.outside} points outside the left image are ignored. Check that they are in the left "
                "camera's frame.",
            )


def log_size(ratio: float | None) -> float:
    """Return the magnitude of the log of a ratio; 0 if the ratio is unknown or 0."""
    return abs(math.log(ratio)) if ratio is not None and ratio > 0 else 0.0


def _are_wrong(fact: Points) -> bool:
    off = (fact.fraction_off or 0.0) > KnownPoints.MAX_OFF
    return off or log_size(fact.ratio) > KnownPoints.MAX_LOG_RATIO


def _factor(kind: FindingKind, fact: Points) -> Finding:
    ratio = fact.ratio or 1.0
    causes = [text for factor, text in CAUSES.items() if abs(math.log(ratio / factor)) < NEARLY]
    cause = causes[0] if causes else "check their unit and frame, the baseline and K"
    number = float(f"{ratio:.3g}")
    return Finding(kind, f"Known depths are {number:g} times the matched depths: {cause}.")


def _contradict(kind: FindingKind, fact: Points) -> Finding:
    return Finding(
        kind,
        f"{100 * (fact.fraction_off or 0.0):.0f} % of the known depths contradict the matches, and the "
        "result follows the known depths. Pass --points-confidence (points_confidence), or remove wrong "
        "points.",
    )


def _few(count: int, alone: bool) -> Finding:
    message = (
        f"image has only {count} known depth{'s' * (count > 1)}; provide at least {KnownPoints.MIN_POINTS}."
    )
    if alone:
        return Finding(TOO_FEW, f"Scale and shift are undetermined: the {message}")
    return Finding(FEW, f"The {message}")


def _compared(matches: Matches, points: Matches) -> dict[str, Tensor]:
    """Compute the median ratio of known to matched depths, the deviating fraction, and the count."""
    confident = (matches.confidence > RELIABLE).float()
    window = (2 * RADIUS_PX + 1, 1, RADIUS_PX)
    near = F.avg_pool2d(confident[None], *window)[0]
    mean = F.avg_pool2d((confident * matches.inverse_depth)[None], *window)[0] / near.clamp_min(1e-6)
    at = (points.confidence > 0) & (near > 0) & (mean > matches.plane_step)
    ratio = where_known(mean / points.inverse_depth, at)
    off = (ratio.log().abs() > KnownPoints.MAX_LOG_RATIO) & at
    compared = at.sum()
    return {
        "ratio": ratio.flatten().nanmedian(),
        "off": off.sum() / compared.clamp_min(1),
        "compared": compared,
    }
