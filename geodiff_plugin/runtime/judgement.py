"""Whether a result can be trusted, and if not, the likeliest cause.

Data flow: ``Signs`` of an image's run -> ``Judgement``: one word and a few sentences.
Paper: none; the paper takes its calibration for granted.

What no sign shows, none of this can tell: a rectified pair with a wrong focal length, or with a baseline that
is wrong by a factor that a rig might have, matches as well as a right one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from geodiff_plugin.runtime.signs import Signs

__all__ = ["EPIPOLAR_PX", "Judgement", "agreement_of_points", "judge"]

#: Below these a run is not to be trusted: mean confidence, share matched; and a rank correlation of near and
#: far that is this far below 0. Right pairs, real and rendered, had .66 to .98, .32 to .96 and +.18 to +.97;
#: where nothing is matched, confidence is about .45.
LEAST_CONFIDENCE, LEAST_MATCHED, MOST_EXCHANGED = 0.5, 0.12, -0.2
#: No agreement on near and far is bad where few matches speak for themselves: a poor prior may be at fault.
LEAST_ORDER, MATCHED_ENOUGH = 0.2, 0.5
#: Two weak signs together weigh as much as one that is bad.
WEAK_CONFIDENCE, WEAK_MATCHED, WEAK_ORDER = 0.6, 0.4, 0.45
#: A rank correlation says nothing of a scene whose matched depths all lie within this (log of 95 % over 5 %).
LEAST_SPREAD = 0.15
#: Points and matches that differ by these factors are said to; and cost trust.
POINTS_SAID, POINTS_WRONG = math.log(1.08), math.log(1.2)
#: A rig's baseline in metres is longer, and a lens's horizontal field of view lies between these, in degrees:
#: that of 135 mm and that of 10 mm in 35 mm equivalent. A long baseline is warned of when it is given.
LEAST_BASELINE_M, VIEWS_DEG = 1e-3, (15.0, 120.0)
#: No lens that keeps lines straight sees as much, degrees.
TOO_WIDE_DEG = 150.0
#: From this factor on it is said that a metric prior's own metres are others.
OWN_METRES = math.log(1.9)
#: Matches that lie further beside their epipolar lines, with the best pose that was found near the given
#: one, are weak, are said, and cost trust; pixels of the grid of the matches.
EPIPOLAR_WEAK, EPIPOLAR_PX, EPIPOLAR_WRONG = 1.0, 2.0, 4.0
#: Known depths that fix a scale and a shift, and tell when one of them is wrong.
LEAST_POINTS = 3
#: Share of the matches on the first or last plane of a range from which it is too narrow.
MOST_AT_END = 0.05

#: Points over views -> what it looks like.
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


@dataclass(frozen=True)
class Judgement:
    """What is to be thought of one image's depth.

    Attributes:
        trusted: whether nothing speaks against it.
        reasons: sentences on what does, the likeliest cause first; empty where it is trusted.
        remarks: sentences on what looks odd but may be so.
        signs: the numbers that this rests on.
    """

    trusted: bool
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]
    signs: Signs

    @property
    def sentence(self) -> str:
        """One line for people; empty where it is trusted."""
        return "" if self.trusted else f"Do not trust this depth: {' '.join(self.reasons)}"


def agreement_of_points(signs: Signs) -> float:
    """How far points and views bear each other out, [0.25, 1]: what the confidence is multiplied by.

    Two that differ by a factor of 1.2 cannot both be within 10 %, and nobody knows which of them is.
    """
    if math.isnan(signs.points_ratio):
        return 1.0
    off = abs(math.log(signs.points_ratio))
    return min(1.0, max(0.25, 1.0 - 0.75 * (off - POINTS_SAID) / (POINTS_WRONG - POINTS_SAID)))


def _of_points(signs: Signs) -> str | None:
    ratio = signs.points_ratio
    if math.isnan(ratio) or abs(math.log(ratio)) < POINTS_SAID:
        return None
    looks = [text for factor, text in FACTORS.items() if abs(math.log(ratio / factor)) < NEARLY]
    cause = looks[0] if looks else "a unit, the baseline or K may be off by that, or the points want a pose"
    return f"The points lie {ratio:.3g} times as far as what both views match: {cause}."


def _of_order(signs: Signs) -> str | None:
    varied = not signs.spread < LEAST_SPREAD
    if signs.inverse_fits or (signs.order < MOST_EXCHANGED and varied):
        return (
            "Near and far are exchanged against the prior, or the inverse pose fits better: are left and "
            "right swapped, is the sign of the baseline wrong, or is E world-to-camera?"
        )
    if signs.order < LEAST_ORDER and varied and not signs.matched > MATCHED_ENOUGH:
        return (
            f"The prior and the matches hardly agree on near and far (rank correlation {signs.order:+.2f}): "
            "is E or K wrong, is the order of the images, or does the right image show something else?"
        )
    return None


def _of_matches(signs: Signs) -> str | None:
    if math.isnan(signs.matched):  # known points alone: nothing that a second view could be wrong about
        return None
    few = signs.matched < LEAST_MATCHED
    weak = [
        signs.matched < WEAK_MATCHED,
        signs.confidence < WEAK_CONFIDENCE,
        signs.order < WEAK_ORDER,
        signs.epipolar_px > EPIPOLAR_WEAK,
    ]
    if not (few or signs.confidence < LEAST_CONFIDENCE or sum(weak) > 1):
        return None
    said = [f"{100 * signs.matched:.0f} % of the left image is matched"]
    said += [] if math.isnan(signs.confidence) else [f"mean confidence is {signs.confidence:.2f}"]
    cause = (
        "Likely causes: E along the wrong axis or with a wrong rotation, images that are not rectified or "
        "whose lens is not corrected, K of another size, a mirrored image, or views of different scenes or "
        "moments."
    )
    return f"Only {' and '.join(said)}. {cause}"


def _of_lines(signs: Signs) -> str | None:
    if not signs.epipolar_px > EPIPOLAR_PX:
        return None
    return (
        f"Matches lie {signs.epipolar_px:.1f} px beside their epipolar lines, and no pose near the given one "
        "brings them closer: are the images rectified or the poses right, and is K for them?"
    )


def _bad(signs: Signs) -> list[str]:
    if signs.same:
        return ["The left and a right view are the same picture, pixel by pixel; two places are needed."]
    found = list(signs.mistakes)
    if signs.flat:
        found.append(
            "All matches have one depth: the right image looks like a shifted copy of the left one. (Of a "
            "flat wall seen head-on it may be true.)"
        )
    if signs.view_deg > TOO_WIDE_DEG:
        found.append(
            f"K gives the left image {signs.view_deg:.0f} degrees of view, which no lens without distortion "
            "has: K must be in pixels of this image, not normalised by its size."
        )
    points = _of_points(signs)
    if points is not None and abs(math.log(signs.points_ratio)) > POINTS_WRONG:
        found.append(points)
    if 0 < signs.points < LEAST_POINTS and math.isnan(signs.matched):
        found.append(
            f"Too few known depths to fix both scale and shift, {signs.points}; give at least {LEAST_POINTS}."
        )
    order = _of_order(signs)
    lines = _of_lines(signs) if signs.epipolar_px > EPIPOLAR_WRONG else None
    matches = _of_matches(signs)
    return found + [sentence for sentence in (order, lines, matches) if sentence is not None]


def _odd(signs: Signs, trusted: bool) -> list[str]:
    found = []
    if 0 < signs.baseline_m < LEAST_BASELINE_M:
        found.append(
            f"The baseline is {1000 * signs.baseline_m:.3g} mm: was it divided by 1000 once too often? "
            "Baselines and poses are in metres."
        )
    if signs.view_deg < VIEWS_DEG[0] or VIEWS_DEG[1] < signs.view_deg <= TOO_WIDE_DEG:
        found.append(
            f"K gives the left image a field of view of {signs.view_deg:.0f} degrees: is it for an image of "
            "another size?"
        )
    if signs.own_ratio > 0 and abs(math.log(signs.own_ratio)) > OWN_METRES:
        found.append(
            f"The depth is {signs.own_ratio:.2g} times the prior's own metres: is the baseline in metres, "
            "and K for an image of this size? Or is the scene of a kind that the prior does not know?"
        )
    points = _of_points(signs)
    if points is not None and abs(math.log(signs.points_ratio)) <= POINTS_WRONG:
        found.append(points)
    if 0 < signs.points < LEAST_POINTS and not math.isnan(signs.matched):
        found.append(f"Known depths that lie in the image: {signs.points}, too few to rely on.")
    lines = _of_lines(signs)
    if lines is not None and not signs.epipolar_px > EPIPOLAR_WRONG:
        found.append(lines)
    if signs.on_edge and (not trusted or signs.at_end > MOST_AT_END):
        found.append(
            "The search for the scale ended on the edge of its range: the depth may lie beyond it. Check the "
            "units of the baseline, or widen depth_range (--near, --far)."
        )
    return found


def judge(signs: Signs) -> Judgement:
    """The one judgement of an image's run.

    Args:
        signs: of it.

    Returns:
        Untrusted where any sign is bad, or two are weak.
    """
    reasons = _bad(signs)
    return Judgement(not reasons, tuple(reasons), tuple(_odd(signs, not reasons)), signs)
