"""Judges the ``Indicators`` of a run: whether its result can be trusted, and if not, why.

No indicator shows a wrong focal length of a rectified pair, or a wrong baseline of a plausible length.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from geodiff_plugin._camera_checks import LONG_BASELINE_M
from geodiff_plugin._certain import MAX_SCALE_SPREAD
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.refine import MOST_DEPTH_SPREAD
from geodiff_plugin.result.indicators import POINTS_WRONG
from geodiff_plugin.types import Indicators, Verdict

#: A depth that differs from the matches by this in the median of the absolute log is not trusted.
OFF_MATCHES = math.log(1.2)
#: Below this mean confidence a result is not to be trusted. Right pairs, real and rendered, had .69 to .98;
#: with a right view of another scene, a mirrored or a blank one, they had .12 to .36.
LEAST_CONFIDENCE = 0.5
#: The same for the share matched, which was .39 to .96 for right pairs.
LEAST_MATCHED = 0.12
#: The same for the rank correlation of near and far, unless the matches exclude that these are exchanged: it
#: was -.60 to +.97 for right pairs, as a prior may take a picture for another scene.
MOST_EXCHANGED = -0.2
#: A smaller share of matches that fit with near and far exchanged as well excludes that they are. It was up
#: to .16 for right pairs whose pose fits, 1 with pictures exchanged, mirrored or upside down, and .99 for a
#: right pair whose principal points differ by more than the matches are shifted.
EXCHANGEABLE = 0.3
#: At occlusions the picture changes at the nearer end more often than at the farther one, as a difference of
#: shares. It was +.30 to +.87 for right pairs of cameras whose principal points differ, and -.42 to -.98 with
#: their pictures mirrored; of other right pairs two in thirty had less than -.7.
OCCLUSION_SHOWS = 0.35
#: A depth that differs from the matches by less follows them (median of the absolute log).
ON_MATCHES = math.log(1.05)
#: A lower rank correlation is bad unless ``MATCHED_ENOUGH`` is matched: a poor prior may cause it.
LEAST_CORRELATION = 0.2
#: Share matched from which the prior is rather to blame.
MATCHED_ENOUGH = 0.5
#: Below this mean confidence it is a weak indicator; two weak ones together count as a bad one.
WEAK_CONFIDENCE = 0.53
#: Below this share matched it is a weak one.
WEAK_MATCHED = 0.38
#: Below this rank correlation it is a weak one.
WEAK_CORRELATION = 0.45
#: Beyond this distance of matches from their epipolar lines, pixels, it is a weak one.
WEAK_EPIPOLAR_PX = 1.0
#: A low rank correlation is accepted if the matched depths lie within this (log of 95 % over 5 %).
LEAST_SPREAD = 0.15
#: Points and matches that differ by this factor are reported (log); by ``POINTS_WRONG``, the result is not
#: trusted.
POINTS_REPORTED = math.log(1.08)
#: Share of the points that differ by ``POINTS_WRONG``, one by one, above which this is reported. In dense
#: maps some always do: at edges, and where a view is occluded.
MANY_OFF = 0.25
#: The share above which the result is not trusted: most of the points then contradict the views.
MOST_OFF = 0.5
#: Shortest plausible baseline, metres; ``check_baseline`` warns of those above ``LONG_BASELINE_M``.
LEAST_BASELINE_M = 1e-3
#: From this baseline on, metres, the depth of the scene is looked at: it may be in centimetres.
SUSPECT_BASELINE_M = 5.0
#: A scene at least as far under such a baseline, metres in the median, is rather one of metres whose baseline
#: is a hundred or a thousand times too long. Nearer scenes pass: a drone 100 m up has such baselines.
FAR_SCENE_M = 200.0
#: The same for rectified rigs, whose cameras are mounted: one a hundred times as small before a scene of half
#: a metre or more is likelier.
FAR_SCENE_OF_RIG_M = 50.0
#: A scene this many baselines away is a distant landscape, whatever the unit.
MOST_BASELINES_AWAY = 200.0
#: Plausible horizontal fields of view, degrees: 135 mm and 10 mm in 35 mm equivalent.
VIEWS_DEG = (15.0, 120.0)
#: A larger ratio of the result to a metric prior's depth is reported (log).
OWN_METRES = math.log(1.9)
#: A ratio that no metric prior is off by, but units are: inches are by 39, centimetres by 100 (log).
OTHER_UNIT = math.log(20.0)
#: Distance of matches from their epipolar lines, under the best pose near the given one, that is reported;
#: pixels of the grid of the matches.
EPIPOLAR_PX = 2.0
#: The distance that is not trusted, twice the one that is reported.
EPIPOLAR_WRONG = 4.0
#: A larger share of matches behind infinity is not trusted: it was up to .015 for right pairs, and .12 to .88
#: where the principal point or the rotation was off and things were far away.
MOST_BEHIND = 0.05
#: A larger radial coefficient k1 left in both pictures is not trusted: what is certain of it was up to .07
#: for right pairs, and .12 to .46 where a distortion of .25 had not been removed, but for two of few matches.
MOST_DISTORTION = 0.11
#: A larger share of matches in parts that moved is not trusted: it was up to .10 for 66 right pairs,
#: whose poses may be off, and .32 to .39 where half of the right picture had moved and the rest fitted.
MOST_MOVED = 0.15
#: A larger shear of the right picture along its rows, in shares of its width, is not trusted: what is certain
#: of it was 0 for 38 right pairs of parallel cameras, and .0048 to .021 for 9 of 14 with a shear of .023.
MOST_SHEAR = 0.005
#: A refined pose whose scale spreads by more than ``MAX_SCALE_SPREAD`` is not trusted, unless known depths
#: give the scale. Nor is one whose scale and shape are within their limits, but together above this: the root
#: of the sum of the squares of their ratios to these. It was up to 1.10 for 50 pairs of trackers whose poses
#: were refined, and 1.21 where the refinement hid that K was of an image .67 times as large.
MOST_TOGETHER = 1.15
#: Known depths that fix a scale and a shift, and show when one of them is wrong.
LEAST_POINTS = 3
#: Without matches a depth is judged by so many known depths: with 40 points AbsRel was .13 in the mean of six
#: pairs, with 80 it was .10.
ENOUGH_POINTS = 50
#: They also lie in this share of 8x8 parts of the image: points in a corner say nothing about the rest.
LEAST_COVER = 0.25
#: A given range may be too narrow if this share of the matches lies on its first or last plane.
MOST_AT_END = 0.05
#: It is too narrow if this share does, four times as many.
TOO_MANY_AT_END = 0.2

#: Doubts that a stated range of depths removes.
LENGTH_DOUBTS = ("baseline.long",)
#: Factor of the points over the views -> the likely cause.
FACTORS = {
    0.256: "KITTI's PNG, whose unit is 1/256 m, read as millimetres: give the points' scale as 256",
    1000 / 256: "millimetres read as KITTI's 1/256 m: give the points' scale as 1000",
    1000.0: "millimetres taken for metres: divide the points by 1000, or give their scale as 1000",
    0.001: "metres divided by 1000 once too often: give the points' scale as 1",
    256.0: "KITTI's integers taken for metres: divide the points by 256, or give their scale as 256",
    100.0: "centimetres taken for metres: divide the points by 100, or give their scale as 100",
    1 / 0.3048: "feet taken for metres",
    0.3048: "metres taken for feet",
}
NEARLY = math.log(1.04)
STATE_RANGE = "If the scene is as far away as that, give its range in metres (depth_range, --near, --far)."


def points_agreement(found: Indicators) -> float:
    """How well points and views agree, [0.25, 1]: what the confidence is multiplied by."""
    if math.isnan(found.points_ratio):
        return 1.0
    off = abs(math.log(found.points_ratio))
    return min(1.0, max(0.25, 1.0 - 0.75 * (off - POINTS_REPORTED) / (POINTS_WRONG - POINTS_REPORTED)))


@dataclass(frozen=True)
class Rule:
    """A message that indicators may call for."""

    code: str  # of ``geodiff_plugin.messages``
    applies: Callable[[Indicators], bool]
    sentence: Callable[[Indicators], str]


def _log(ratio: float) -> float:
    """Size of the log of a ratio; 0 for NaN or 0."""
    return abs(math.log(ratio)) if ratio > 0 else 0.0


def _by_points_alone(found: Indicators) -> bool:
    """Whether there is no second view that could be matched, or be wrong."""
    return math.isnan(found.matched)


def _depths_vary(found: Indicators) -> bool:
    """Whether the order of near and far means something; an unknown spread counts as a wide one."""
    return math.isnan(found.spread) or found.spread >= LEAST_SPREAD


def _well_matched(found: Indicators) -> bool:
    """Whether so much is matched that a low rank correlation is rather the prior's fault."""
    return found.matched > MATCHED_ENOUGH


def _points_wrong(found: Indicators) -> bool:
    return _log(found.points_ratio) > POINTS_WRONG or found.points_off > MOST_OFF


def _points_differ_by_a_factor(found: Indicators) -> bool:
    return _log(found.points_ratio) >= POINTS_REPORTED


def _points_contradict(found: Indicators) -> bool:
    return not _points_differ_by_a_factor(found) and found.points_off > MANY_OFF


def _order_known(found: Indicators) -> bool:
    """Whether the matches themselves show what is near, so that another order is the prior's mistake."""
    shown = found.exchangeable < EXCHANGEABLE or found.occlusion > OCCLUSION_SHOWS
    fits = found.epipolar_px < WEAK_EPIPOLAR_PX and found.off_matches < ON_MATCHES
    return shown and fits and _well_matched(found)


def _order_contradicts(found: Indicators) -> bool:
    """Whether the prior takes near for far, as the matches have it."""
    return found.rank_correlation < MOST_EXCHANGED and _depths_vary(found) and not _by_points_alone(found)


def _exchanged(found: Indicators) -> bool:
    return _order_contradicts(found) and not _order_known(found)


def _far_hides_near(found: Indicators) -> bool:
    """Whether occlusions show an exchange that the matches allow and the prior does not speak against."""
    shown = found.occlusion < -OCCLUSION_SHOWS and not found.rank_correlation >= WEAK_CORRELATION
    return shown and found.exchangeable >= EXCHANGEABLE


def _prior_exchanged(found: Indicators) -> bool:
    return _order_contradicts(found) and _order_known(found)


def _hardly_ordered(found: Indicators) -> bool:
    low = MOST_EXCHANGED <= found.rank_correlation < LEAST_CORRELATION and not found.inverse_fits
    return low and _depths_vary(found) and not (_by_points_alone(found) or _well_matched(found))


def _weaknesses(found: Indicators) -> tuple[bool, bool, bool]:
    """Whether share matched, confidence and rank correlation are weak."""
    return (
        found.matched < WEAK_MATCHED,
        found.confidence < WEAK_CONFIDENCE,
        found.rank_correlation < WEAK_CORRELATION,
    )


def _views_disagree(found: Indicators) -> bool:
    if _by_points_alone(found):
        return False
    weak = sum(_weaknesses(found)) + (found.epipolar_px > WEAK_EPIPOLAR_PX)
    return found.matched < LEAST_MATCHED or found.confidence < LEAST_CONFIDENCE or weak > 1


def _unit_stated(found: Indicators) -> bool:
    """Whether the user said how far away the scene is, in metres, and the matches lie there."""
    return found.range_given and found.at_end <= TOO_MANY_AT_END


def _unit_doubted(found: Indicators) -> bool:
    """Whether baseline and scene are both a hundred or a thousand times too large."""
    far_m = FAR_SCENE_OF_RIG_M if found.rectified else FAR_SCENE_M
    far = far_m <= found.scene_m <= MOST_BASELINES_AWAY * found.baseline_m
    return far and SUSPECT_BASELINE_M <= found.baseline_m <= LONG_BASELINE_M and not _unit_stated(found)


def _behind_infinity(found: Indicators) -> bool:
    """Whether rays diverge, and no mistake that is named already explains it."""
    named = found.inverse_fits or bool(found.mistakes) or _exchanged(found)
    return found.behind_infinity > MOST_BEHIND and not named


def _other_centre(found: Indicators) -> bool:
    return _behind_infinity(found) and found.centre_assumed


def _scale_uncertain(found: Indicators) -> bool:
    return found.scale_spread > MAX_SCALE_SPREAD and found.points < LEAST_POINTS


def _pose_uncertain(found: Indicators) -> bool:
    """Whether scale and shape are each within their limit, but too doubtful together."""
    if _scale_uncertain(found) or found.depth_spread > MOST_DEPTH_SPREAD or found.points >= LEAST_POINTS:
        return False
    shares = found.scale_spread / MAX_SCALE_SPREAD, found.depth_spread / MOST_DEPTH_SPREAD
    return math.hypot(*shares) > MOST_TOGETHER


def _pose_unproved(found: Indicators) -> bool:
    """Whether too few matches show if the poses are right, and the depth does not show it either.

    It does where most pixels have the same match from both sides, and the result and the prior follow them,
    or where known depths agree with them.
    """
    if not found.pose_unchecked or _by_points_alone(found):
        return False
    followed = found.off_matches < ON_MATCHES and found.rank_correlation >= WEAK_CORRELATION
    agreed = found.points_ratio > 0 and not _points_wrong(found)
    return not (agreed or (_well_matched(found) and followed))


def _why_exchanged(_: Indicators) -> str:
    return (
        "Near and far are exchanged against the prior, or the inverse pose fits better: are left and "
        "right swapped, is the sign of the baseline wrong, is E world-to-camera, or is a prior map of "
        "another space (--space)?"
    )


def _why_unit(found: Indicators) -> str:
    return (
        f"With a baseline of {found.baseline_m:.4g} m the matches lie {found.scene_m:.0f} m away in the "
        "median. If the baseline or the translation is in centimetres, divide it by 100; if it is in "
        f"millimetres, by 1000. {STATE_RANGE}"
    )


def _why_prior(found: Indicators) -> str:
    return (
        f"The depth is {found.prior_ratio:.2g} times the prior's own metres: is the baseline in metres, "
        "and K for an image of this size? Or is the scene of a kind that the prior does not know?"
    )


def _why_other_unit(found: Indicators) -> str:
    return f"{_why_prior(found)} {STATE_RANGE}"


def _why_factor(found: Indicators) -> str:
    ratio = found.points_ratio
    causes = [text for factor, text in FACTORS.items() if abs(math.log(ratio / factor)) < NEARLY]
    cause = causes[0] if causes else "a unit, the baseline or K is wrong, or the points are in another frame"
    return f"The points lie {float(f'{ratio:.3g}'):g} times as far as what both views match: {cause}."


def _why_contradicted(found: Indicators) -> str:
    return (
        f"{100 * found.points_off:.0f} % of the known depths contradict what both views match there, and the "
        "result follows them: give them a confidence (points_confidence, --points-confidence), or leave them "
        "out."
    )


def _why_scale(found: Indicators) -> str:
    misses = f"E misses the matches by {found.given_px:.0f} px: is it of this pair? "
    return (
        f"{misses if found.given_px > EPIPOLAR_WRONG else ''}The scale of the refined pose is uncertain by "
        f"{100 * min(found.scale_spread, 1):.0f} %: the baseline and the depth of the scene under the given "
        "pose disagree. Give the measured distance of the cameras (--baseline, measured_baseline=True), or "
        f"{LEAST_POINTS} known points or more."
    )


def _why_pose(found: Indicators) -> str:
    return (
        f"The refined pose is uncertain: its scale by {100 * found.scale_spread:.0f} %, and another pose "
        f"that fits as well changes depths by {100 * math.expm1(found.depth_spread):.0f} % in the median. "
        "Check K, or give a more exact pose."
    )


def _why_off_lines(found: Indicators) -> str:
    return (
        f"Matches lie {found.epipolar_px:.1f} px off their epipolar lines, and no pose near the given one "
        "brings them closer: are the images rectified, the poses right, and K for these images?"
    )


def _why_behind(found: Indicators) -> str:
    return (
        f"{100 * found.behind_infinity:.0f} % of the matches lie behind infinity, where the rays of the two "
        "cameras diverge. Likely causes: another cx of the right camera than K says (give K_right, or "
        "--cx-right), a wrong rotation in E, a right image that was cropped or stretched, or things that "
        "moved."
    )


def _why_other_centre(found: Indicators) -> str:
    return (
        f"{100 * found.behind_infinity:.0f} % of the matches lie behind infinity, where the rays of the two "
        "cameras diverge: the right camera's cx, which is assumed to be the left one's, seems to differ from "
        f"it by {found.behind_px:.0f} px or more. Give its K or cx (K_right, or --cx-right). If both are "
        "alike, E has a wrong rotation, the right image was cropped or stretched, or things moved."
    )


def _bent(found: Indicators) -> bool:
    """Whether residuals change over the pictures as by a distortion, or by what looks like one."""
    return abs(found.distortion) > MOST_DISTORTION


def _distorted(found: Indicators) -> bool:
    """Whether nothing but a distortion explains them; without the comparison they are called one."""
    return _bent(found) and not abs(found.distortion_alone) <= MOST_DISTORTION


def _why_torn(found: Indicators) -> str:
    view, row, px = found.tear or (0, 0, 0)
    picture = ("left picture", "right picture")[view] if view < 2 else f"picture of right view {view}"
    return (
        f"The {picture} is torn: from row {row} on it is moved by {abs(px)} px to the "
        f"{'right' if px > 0 else 'left'} against the rows above. Depth is wrong in the part that is moved. "
        "Take another frame, or read the camera out again."
    )


def _why_sheared(found: Indicators) -> str:
    return (
        "Upright lines lean in the right picture against the left one: it is sheared along its rows by "
        f"{100 * abs(found.shear):.1f} % of its width from top to bottom, as by a rolling shutter while "
        "something moved. Depth is wrong by as much, and differently in every row: use a global shutter, or "
        "hold everything still."
    )


def _why_bent(found: Indicators) -> str:
    return (
        "The distance of matches from their epipolar lines changes over the pictures. A turn of the right "
        "camera, as by a wrong yaw in E, or a sheared picture, as by a rolling shutter, explains it as well "
        f"as a lens distortion of k1 = {found.distortion:+.2f}: check E, and that the pictures are rectified."
    )


def _why_distorted(found: Indicators) -> str:
    how = "was not removed: rectify the pictures, or give the distortion with the calibration."
    if found.distortion > 0:  # as a telephoto has it, and a wide lens whose distortion was taken out twice
        how = "was not removed, or removed twice: are the pictures rectified already?"
    return (
        "The distance of matches from their epipolar lines grows away from the centre of the pictures, as by "
        f"a lens distortion of k1 = {found.distortion:+.2f} that {how}"
    )


def _why_disagreement(found: Indicators) -> str:
    few, unsure, unordered = _weaknesses(found)
    shares = [f"{100 * found.matched:.0f} % of the left image is matched"] if few else []
    shares += [f"the mean confidence is {found.confidence:.2f}"] if unsure else []
    if unordered and not shares:
        shares = [f"the rank correlation with the prior is {found.rank_correlation:.2f}"]
    return (
        f"The views hardly agree: {' and '.join(shares)}. Likely causes: E along the wrong axis or with a "
        "wrong rotation, images that are not rectified or whose lens is not corrected, K of another size, a "
        "mirrored image, or views of different scenes or moments."
    )


#: Without any other reason: nothing else that is wrong with them matters.
SAME_PICTURE = Message(
    "views.same", "The left and a right view are the same picture, pixel by pixel; two places are needed."
)
#: Reasons in the order in which they are told: those that explain a pose's mistakes, which only describe
#: (``Indicators.mistakes``), come before them, and the others after them.
EXPLAINING = (
    Rule(
        "baseline.short",
        lambda found: 0 < found.baseline_m < LEAST_BASELINE_M,
        lambda found: (
            f"The baseline is {1000 * found.baseline_m:.3g} mm: was it divided by 1000 once too often? "
            "Baselines and poses are in metres."
        ),
    ),
    Rule("pose.unit", _unit_doubted, _why_unit),
    Rule(
        "prior.unit",
        lambda found: _log(found.prior_ratio) > OTHER_UNIT and not _unit_stated(found),
        _why_other_unit,
    ),
    Rule("depth.exchanged", lambda found: found.inverse_fits, _why_exchanged),
)
REASONS = (
    Rule(
        "views.shifted",
        lambda found: found.flat,
        lambda _: (
            "All matches have one depth: the right image looks like a shifted copy of the left one. (Of a "
            "flat wall seen head-on it may be true.)"
        ),
    ),
    Rule(
        "depth.range",
        lambda found: found.at_end > TOO_MANY_AT_END,
        lambda found: (
            f"{100 * found.at_end:.0f} % of the matches lie at an end of the range of depths: the scene "
            "reaches beyond it. Widen depth_range (--near, --far)."
        ),
    ),
    Rule(
        "points.factor",
        lambda found: _points_wrong(found) and _points_differ_by_a_factor(found),
        _why_factor,
    ),
    Rule(
        "points.contradict",
        lambda found: _points_wrong(found) and _points_contradict(found),
        _why_contradicted,
    ),
    Rule(
        "points.too-few",
        lambda found: 0 < found.points < LEAST_POINTS and _by_points_alone(found),
        lambda found: (
            f"Too few known depths to fix scale and shift: {found.points}; give at least {LEAST_POINTS}."
        ),
    ),
    Rule("scale.uncertain", _scale_uncertain, _why_scale),
    Rule("pose.undetermined", _pose_uncertain, _why_pose),
    Rule(
        "depth.off-matches",
        lambda found: found.off_matches > OFF_MATCHES and found.points < LEAST_POINTS,
        lambda found: (
            f"The depth differs by {100 * math.expm1(found.off_matches):.0f} %, in the median, from what "
            "both views match: the scale or the shift was not found."
        ),
    ),
    Rule(
        "depth.order-points",
        lambda found: found.rank_correlation < LEAST_CORRELATION and _by_points_alone(found),
        lambda found: (
            "The prior and the known depths disagree on near and far (rank correlation "
            f"{found.rank_correlation:+.2f}): are they metres along z in the left camera's frame, and is the "
            "space of the prior right?"
        ),
    ),
    Rule(
        "depth.occlusion",
        _far_hides_near,
        lambda _: (
            "At occlusions what is matched as far hides what is near: are left and right swapped, or both "
            "pictures mirrored or upside down?"
        ),
    ),
    Rule("depth.exchanged", lambda found: _exchanged(found) and not found.inverse_fits, _why_exchanged),
    Rule(
        "depth.order",
        _hardly_ordered,
        lambda found: (
            "The prior and the matches hardly agree on near and far (rank correlation "
            f"{found.rank_correlation:+.2f}): is E, K or the order of the images wrong, or is the right "
            "image of something else?"
        ),
    ),
    Rule("camera.other-centre", _other_centre, _why_other_centre),
    Rule(
        "views.behind-infinity",
        lambda found: _behind_infinity(found) and not found.centre_assumed,
        _why_behind,
    ),
    Rule(
        "views.moved",
        lambda found: found.moved > MOST_MOVED,
        lambda found: (
            f"{100 * found.moved:.0f} % of the matches lie off their epipolar lines together, in parts of "
            "the pictures, and the others on them: something moved between the pictures, and its depth is "
            "wrong. Take both at one moment."
        ),
    ),
    Rule("views.torn", lambda found: found.tear is not None, _why_torn),
    Rule("views.sheared", lambda found: abs(found.shear) > MOST_SHEAR, _why_sheared),
    Rule("views.distorted", _distorted, _why_distorted),
    Rule("views.bent", lambda found: _bent(found) and not _distorted(found), _why_bent),
    Rule(
        "pose.unchecked",
        _pose_unproved,
        lambda _: (
            "Nothing shows whether the pose is right: too few features match to check it, and the depth does "
            "not confirm it either. Give views that show more texture or overlap more, or pose='given' for a "
            "pose that is known to be exact."
        ),
    ),
    Rule("pose.off-lines", lambda found: found.epipolar_px > EPIPOLAR_WRONG, _why_off_lines),
    Rule("views.disagree", _views_disagree, _why_disagreement),
)
REMARKS = (
    Rule(
        "camera.field-of-view",
        lambda found: found.view_deg < VIEWS_DEG[0] or found.view_deg > VIEWS_DEG[1],
        lambda found: (
            f"K gives the left image a field of view of {found.view_deg:.0f} degrees: is it for an image of "
            "another size?"
        ),
    ),
    Rule(
        "prior.order",
        _prior_exchanged,
        lambda found: (
            "The prior takes near for far (rank correlation with the matches "
            f"{found.rank_correlation:+.2f}), and the matches show that it is wrong. If you gave a depth "
            "map: is it of this picture, and in the space that --space names? Where nothing is matched the "
            "depth follows the prior."
        ),
    ),
    Rule(
        "prior.metres",
        lambda found: OWN_METRES < _log(found.prior_ratio) <= OTHER_UNIT,
        _why_prior,
    ),
    Rule(
        "points.differ",
        lambda found: not _points_wrong(found) and _points_differ_by_a_factor(found),
        _why_factor,
    ),
    Rule(
        "points.some-contradict",
        lambda found: not _points_wrong(found) and _points_contradict(found),
        _why_contradicted,
    ),
    Rule(
        "points.few",
        lambda found: 0 < found.points < LEAST_POINTS and not _by_points_alone(found),
        lambda found: f"Known depths that lie in the image: {found.points}, too few to rely on.",
    ),
    Rule(
        "views.bars",
        lambda found: found.bars > 0,
        lambda found: (
            f"Bars of one colour lie at opposite sides of the pictures, {100 * found.bars:.0f} % of the side "
            "each: is K for the pictures with these bars, or for what is between them?"
        ),
    ),
    Rule("pose.residual", lambda found: EPIPOLAR_PX < found.epipolar_px <= EPIPOLAR_WRONG, _why_off_lines),
)
#: A remark only where the result is not trusted for other reasons, or matches lie at an end of the range.
ON_EDGE = Message(
    "depth.search-edge",
    "The search for the scale ended on the edge of its range: the depth may lie beyond it. Check the "
    "units of the baseline, or widen depth_range (--near, --far).",
)


def _told(rules: Sequence[Rule], found: Indicators) -> tuple[Message, ...]:
    return tuple(Message(rule.code, rule.sentence(found)) for rule in rules if rule.applies(found))


def _reasons(found: Indicators) -> tuple[Message, ...]:
    if found.same:
        return (SAME_PICTURE,)
    lifted = LENGTH_DOUBTS if _unit_stated(found) else ()
    doubts = [doubt for doubt in found.doubts if doubt.code not in lifted]
    return (*doubts, *_told(EXPLAINING, found), *found.mistakes, *_told(REASONS, found))


def _remarks(found: Indicators, trusted: bool) -> tuple[Message, ...]:
    remarks = _told(REMARKS, found)
    if found.on_edge and (not trusted or found.at_end > MOST_AT_END):
        return (*remarks, ON_EDGE)
    return remarks


def judge(found: Indicators) -> Verdict:
    """The verdict on one image's run: not trusted where any indicator is bad, or two are weak."""
    reasons = _reasons(found)
    enough = found.points >= ENOUGH_POINTS and found.cover >= LEAST_COVER
    judged = enough or not _by_points_alone(found)
    status = "not trusted" if reasons else "trusted" if judged else "not judged"
    return Verdict(status, reasons, _remarks(found, trusted=not reasons), found)
