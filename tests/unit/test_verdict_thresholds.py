"""Every threshold of the verdict, with a value on either side of it, written out again."""

import math
from dataclasses import replace

import pytest

from geodiff_plugin.result.verdict import judge, points_agreement
from geodiff_plugin.types import Indicators

GOOD = Indicators(
    confidence=0.85, matched=0.8, rank_correlation=0.8, spread=0.7, baseline_m=0.12, view_deg=60.0
)
#: Without a second view: known depths alone.
ALONE = Indicators(points=99, cover=0.5, rank_correlation=0.8)
#: What excludes that near and far are exchanged, under a prior that says so.
ORDERED = {"rank_correlation": -0.5, "exchangeable": 0.1, "epipolar_px": 0.3, "off_matches": 0.01}
#: What shows that they are.
HIDDEN = {"rank_correlation": 0.3, "exchangeable": 0.9, "occlusion": -0.9}
#: A pose that nobody could check, of a depth that confirms it.
UNCHECKED = {"pose_unchecked": True, "off_matches": 0.01}
#: Codes of reasons and remarks, what is given beside, the indicator, and values without and with the message.
TABLE = (
    ("depth.off-matches", {}, "off_matches", math.log(1.19), math.log(1.21)),
    ("depth.off-matches", {"off_matches": 0.5}, "points", 3, 2),
    ("views.disagree", {}, "confidence", 0.51, 0.49),
    ("views.disagree", {}, "matched", 0.13, 0.11),
    ("views.disagree", {"confidence": 0.52}, "matched", 0.39, 0.37),
    ("views.disagree", {"matched": 0.37}, "confidence", 0.54, 0.52),
    ("views.disagree", {"confidence": 0.52}, "rank_correlation", 0.46, 0.44),
    ("views.disagree", {"confidence": 0.52}, "epipolar_px", 0.95, 1.05),
    ("depth.exchanged", {}, "rank_correlation", -0.19, -0.21),
    ("depth.exchanged", {"rank_correlation": -0.5}, "spread", 0.149, 0.151),
    ("depth.exchanged", ORDERED, "exchangeable", 0.29, 0.31),
    ("depth.exchanged", ORDERED, "epipolar_px", 0.95, 1.05),
    ("depth.exchanged", ORDERED, "matched", 0.51, 0.49),
    ("depth.exchanged", ORDERED, "off_matches", math.log(1.04), math.log(1.06)),
    ("depth.exchanged", ORDERED | {"exchangeable": 0.9}, "occlusion", 0.36, 0.34),
    ("depth.occlusion", HIDDEN, "occlusion", -0.34, -0.36),
    ("depth.occlusion", HIDDEN, "exchangeable", 0.29, 0.31),
    ("depth.occlusion", HIDDEN, "rank_correlation", 0.46, 0.44),
    ("views.moved", {}, "moved", 0.14, 0.16),
    ("views.bars", {}, "bars", 0.0, 0.03),
    ("prior.order", ORDERED, "rank_correlation", -0.19, -0.21),
    ("prior.order", ORDERED, "exchangeable", 0.31, 0.29),
    ("prior.order", ORDERED, "spread", 0.149, 0.151),
    ("depth.order", {"matched": 0.45}, "rank_correlation", 0.21, 0.19),
    ("depth.order", {"rank_correlation": 0.1}, "matched", 0.51, 0.49),
    ("depth.order", {"rank_correlation": 0.1, "matched": 0.45}, "spread", 0.149, 0.151),
    ("points.factor", {"points": 99}, "points_ratio", 1.19, 1.21),
    ("points.factor", {"points": 99}, "points_ratio", 1 / 1.19, 1 / 1.21),
    ("points.differ", {"points": 99}, "points_ratio", 1.07, 1.09),
    ("points.some-contradict", {"points": 99, "points_ratio": 1.0}, "points_off", 0.24, 0.26),
    ("points.contradict", {"points": 99, "points_ratio": 1.0}, "points_off", 0.49, 0.51),
    ("points.few", {}, "points", 3, 2),
    ("baseline.short", {}, "baseline_m", 1.1e-3, 0.9e-3),
    ("pose.residual", {}, "epipolar_px", 1.9, 2.1),
    ("pose.residual", {}, "epipolar_px", 4.1, 3.9),
    ("pose.off-lines", {}, "epipolar_px", 3.9, 4.1),
    ("scale.uncertain", {}, "scale_spread", 0.095, 0.105),
    ("scale.uncertain", {"scale_spread": 0.2}, "points", 3, 2),
    # .069^2 / .1^2 + .1472^2 / .16^2 is 1.15^2.
    ("pose.undetermined", {"scale_spread": 0.069}, "depth_spread", 0.146, 0.148),
    ("pose.undetermined", {"depth_spread": 0.1472}, "scale_spread", 0.068, 0.070),
    ("pose.undetermined", {"depth_spread": 0.15}, "scale_spread", 0.11, 0.09),  # then it is the scale
    ("pose.undetermined", {"scale_spread": 0.09, "depth_spread": 0.15}, "points", 3, 2),
    ("pose.unchecked", {"off_matches": 0.5}, "pose_unchecked", False, True),
    ("pose.unchecked", UNCHECKED, "matched", 0.51, 0.49),
    ("pose.unchecked", UNCHECKED, "rank_correlation", 0.46, 0.44),
    ("pose.unchecked", UNCHECKED, "off_matches", math.log(1.04), math.log(1.06)),
    ("pose.unchecked", UNCHECKED | {"matched": 0.4, "points": 99}, "points_ratio", 1.19, 1.21),
    ("pose.unchecked", UNCHECKED | {"matched": 0.4, "points": 99}, "points_ratio", 1.0, math.nan),
    ("prior.metres", {}, "prior_ratio", 1.85, 1.95),
    ("prior.metres", {}, "prior_ratio", 1 / 1.85, 1 / 1.95),
    ("prior.metres", {}, "prior_ratio", 20.5, 19.5),
    ("camera.field-of-view", {}, "view_deg", 15.5, 14.5),
    ("camera.field-of-view", {}, "view_deg", 119.0, 121.0),
    ("depth.range", {}, "at_end", 0.19, 0.21),
    ("depth.search-edge", {"on_edge": True}, "at_end", 0.04, 0.06),
)


@pytest.mark.parametrize(("code", "beside", "name", "without", "with_it"), TABLE)
def test_a_message_is_given_on_one_side_of_its_threshold(code, beside, name, without, with_it):
    for value, told in ((without, False), (with_it, True)):
        verdict = judge(replace(GOOD, **beside | {name: value}))
        codes = [message.code for message in (*verdict.reasons, *verdict.remarks)]
        assert (code in codes) is told, (value, codes)
        assert verdict.trusted is not any(message.forbids_trust for message in verdict.reasons)


@pytest.mark.parametrize(
    ("signs", "status"),
    [
        ({"points": 50, "cover": 0.25}, "trusted"),
        ({"points": 49, "cover": 0.25}, "not judged"),
        ({"points": 50, "cover": 0.24}, "not judged"),
        ({"rank_correlation": 0.21}, "trusted"),
        ({"rank_correlation": 0.19}, "not trusted"),
        ({"points": 2}, "not trusted"),
        ({"points": 3}, "not judged"),
    ],
)
def test_known_depths_alone_are_judged_from_fifty_on_in_a_quarter_of_the_image(signs, status):
    assert judge(replace(ALONE, **signs)).status == status


@pytest.mark.parametrize("ratio", [1.0, 1.08, 1.1, 1.15, 1.2, 2.0])
def test_confidence_falls_from_where_points_differ_to_where_they_are_wrong(ratio):
    """In a straight line over the log of the ratio, from 1 at 1.08 to a quarter at 1.2."""
    share = (math.log(ratio) - math.log(1.08)) / (math.log(1.2) - math.log(1.08))
    expected = min(1.0, max(0.25, 1.0 - 0.75 * share))
    for each in (ratio, 1.0 / ratio):
        assert points_agreement(replace(GOOD, points_ratio=each)) == pytest.approx(expected)
    assert points_agreement(GOOD) == 1.0


@pytest.mark.parametrize(
    ("ratio", "words"),
    [
        (0.256, "give the points' scale as 256"),
        (3.90625, "give the points' scale as 1000"),
        (1000.0, "divide the points by 1000"),
        (0.001, "divided by 1000 once too often"),
        (256.0, "divide the points by 256"),
        (100.0, "divide the points by 100,"),
        (3.2808, "feet taken for metres"),
        (0.3048, "metres taken for feet"),
        (1.039 * 100.0, "divide the points by 100,"),
        (1.041 * 100.0, "the baseline or K is wrong"),
    ],
)
def test_the_factor_of_the_points_names_their_unit(ratio, words):
    (reason,) = judge(replace(GOOD, points=99, points_ratio=ratio)).reasons
    assert reason.code == "points.factor" and words in reason
