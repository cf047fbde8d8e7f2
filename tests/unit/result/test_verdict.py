"""The verdict against its rules written as one table of conditions; the numbers in its sentences."""

import math
import random
from dataclasses import FrozenInstanceError, replace

import pytest

from geodiff_plugin.messages import Message
from geodiff_plugin.result.verdict import REASONS, judge, points_agreement
from geodiff_plugin.types import Indicators, Tear

NAN, LOG = math.nan, math.log
GOOD = Indicators(
    confidence=0.85, matched=0.8, rank_correlation=0.8, spread=0.7, baseline_m=0.12, view_deg=60.0
)
ALONE = Indicators(points=99, cover=0.5, rank_correlation=0.8)
LONG, LENS = Message("baseline.long", "25 m."), Message("camera.stretched", "fx and fy.")
SCALED, AXES = Message("camera.scaled", "K is scaled."), Message("pose.opengl", "OpenGL.")


def around(*thresholds: float, step: float = 1e-6) -> list[float]:
    """Values at, just below and just above each threshold."""
    return [value for t in thresholds for value in (t, t - step, t + step)]


#: Values of every indicator on which a rule depends: at each threshold, on both sides of it, and unknown.
VALUES = {
    "confidence": [NAN, 0.9, 0.1, *around(0.5, 0.53)],
    "matched": [NAN, 0.9, *around(0.12, 0.38, 0.5)],
    "rank_correlation": [NAN, 0.9, -0.9, *around(-0.2, 0.2, 0.45)],
    "spread": [NAN, 0.01, 0.9, *around(0.15)],
    "points_ratio": [NAN, 0.0, 1.0, 3.0, 1 / 3, *around(1.2, 1 / 1.2, 1.08, 1 / 1.08)],
    "points_off": [NAN, 0.0, *around(0.25, 0.5)],
    "centre_assumed": [True, False],
    "points": [0, 1, 2, 3, 4, 49, 50, 51],
    "cover": [0.0, 1.0, *around(0.25)],
    "range_given": [True, False],
    "at_end": [0.0, *around(0.05, 0.2)],
    "baseline_m": [0.0, 0.12, 10.0, *around(1e-3, 5.0, 20.0)],
    "scene_m": [NAN, 1e4, *around(50.0, 200.0, 1000.0, 2000.0, 4000.0)],
    "rectified": [True, False],
    "view_deg": [NAN, *around(15.0, 120.0)],
    "prior_ratio": [NAN, 0.0, 1.0, *around(1.9, 1 / 1.9, 20.0, 1 / 20.0)],
    "epipolar_px": [NAN, 0.1, *around(1.0, 2.0, 4.0)],
    "given_px": [NAN, 9.0],
    "scale_spread": [NAN, 0.0, math.inf, 0.092, *around(0.1)],
    "depth_spread": [NAN, 0.0, 0.15, *around(0.16)],
    "behind_infinity": [NAN, 0.0, *around(0.05)],
    "behind_px": [NAN, 7.0],
    "distortion": [NAN, 0.3, -0.3, *around(0.11, -0.11)],
    "distortion_alone": [NAN, 0.3, -0.3, *around(0.11, -0.11)],
    "tear": [None, None, Tear(1, 40, 6)],
    "exchangeable": [NAN, *around(0.3)],
    "occlusion": [NAN, *around(0.35, -0.35)],
    "moved": [NAN, *around(0.15)],
    "bars": [0.0, 0.02],
    "shear": [NAN, *around(0.005, -0.005)],
    "off_matches": [NAN, *around(LOG(1.05), LOG(1.2))],
    "doubts": [(), (LONG,), (LENS,), (LENS, LONG)],
    "pose_unchecked": [True, False],
    "mistakes": [(), (SCALED,), (SCALED, AXES)],
    "flat": [True, False],
    "same": [False, False, False, True],
    "inverse_fits": [True, False],
    "on_edge": [True, False],
}
#: Indicators that decide together.
GROUPS = [
    "rank_correlation spread matched exchangeable occlusion epipolar_px off_matches inverse_fits",
    "rank_correlation occlusion exchangeable matched",
    "points_ratio points_off points matched",
    "pose_unchecked off_matches rank_correlation matched points_ratio points_off",
    "behind_infinity centre_assumed inverse_fits mistakes",
    "behind_infinity centre_assumed rank_correlation spread exchangeable off_matches epipolar_px matched",
    "baseline_m scene_m rectified range_given at_end",
    "prior_ratio range_given at_end on_edge",
    "scale_spread depth_spread points",
    "confidence matched rank_correlation epipolar_px",
    "doubts range_given at_end mistakes",
    "distortion distortion_alone shear tear moved bars flat",
    "points cover matched",
    "off_matches points given_px scale_spread",
    "on_edge at_end same view_deg",
]


def expected(f: Indicators) -> tuple[str, list[str], list[str]]:
    """Status, reasons and remarks of indicators, as the reference of the messages describes them."""

    def off(ratio: float) -> float:
        return abs(LOG(ratio)) if ratio > 0 else 0.0

    alone = math.isnan(f.matched)
    stated = f.range_given and f.at_end <= 0.2
    wrong = off(f.points_ratio) > LOG(1.2) or f.points_off > 0.5
    by_factor = off(f.points_ratio) >= LOG(1.08)
    contradict = not by_factor and f.points_off > 0.25
    wide = not f.spread < 0.15
    shown = f.exchangeable < 0.3 or f.occlusion > 0.35
    known = shown and f.epipolar_px < 1.0 and f.off_matches < LOG(1.05) and f.matched > 0.5
    against = f.rank_correlation < -0.2 and wide and not alone
    exchanged = against and not known
    least_m = 50.0 if f.rectified else 200.0
    behind = f.behind_infinity > 0.05 and not (f.inverse_fits or f.mistakes or exchanged)
    bent = abs(f.distortion) > 0.11
    alike = bent and abs(f.distortion_alone) <= 0.11
    scale = f.scale_spread > 0.1 and f.points < 3
    together = math.hypot(f.scale_spread / 0.1, f.depth_spread / 0.16)
    weak = [f.matched < 0.38, f.confidence < 0.53, f.rank_correlation < 0.45, f.epipolar_px > 1.0]
    confirmed = f.matched > 0.5 and f.off_matches < LOG(1.05) and f.rank_correlation >= 0.45
    agreed = f.points_ratio > 0 and not wrong
    far = least_m <= f.scene_m <= 200 * f.baseline_m and 5 <= f.baseline_m <= 20
    explaining = {
        "baseline.short": 0 < f.baseline_m < 1e-3,
        "pose.unit": far and not stated,
        "prior.unit": off(f.prior_ratio) > LOG(20) and not stated,
        "depth.exchanged": f.inverse_fits,
    }
    others = {
        "views.shifted": f.flat,
        "depth.range": f.at_end > 0.2,
        "points.factor": wrong and by_factor,
        "points.contradict": wrong and contradict,
        "points.too-few": alone and f.points in (1, 2),
        "scale.uncertain": scale,
        "pose.undetermined": f.points < 3 and not scale and not f.depth_spread > 0.16 and together > 1.15,
        "depth.off-matches": f.off_matches > LOG(1.2) and f.points < 3,
        "depth.order-points": alone and f.rank_correlation < 0.2,
        "depth.occlusion": f.occlusion < -0.35 and not f.rank_correlation >= 0.45 and f.exchangeable >= 0.3,
        "depth.exchanged": exchanged and not f.inverse_fits,
        "depth.order": not alone
        and wide
        and -0.2 <= f.rank_correlation < 0.2
        and not f.matched > 0.5
        and not f.inverse_fits,
        "camera.other-centre": behind and f.centre_assumed,
        "views.behind-infinity": behind and not f.centre_assumed,
        "views.moved": f.moved > 0.15,
        "views.torn": f.tear is not None,
        "views.sheared": abs(f.shear) > 0.005,
        "views.distorted": bent and not alike,
        "views.bent": alike,
        "pose.unchecked": f.pose_unchecked and not alone and not agreed and not confirmed,
        "pose.off-lines": f.epipolar_px > 4,
        "views.disagree": not alone and (f.matched < 0.12 or f.confidence < 0.5 or sum(weak) >= 2),
    }
    doubts = [doubt.code for doubt in f.doubts if not (stated and doubt.code == "baseline.long")]
    reasons = [*doubts, *(code for code, holds in explaining.items() if holds)]
    reasons += [*(mistake.code for mistake in f.mistakes), *(code for code, holds in others.items() if holds)]
    reasons = ["views.same"] if f.same else reasons
    remarks = {
        "camera.field-of-view": f.view_deg < 15 or f.view_deg > 120,
        "prior.order": against and known,
        "prior.metres": LOG(1.9) < off(f.prior_ratio) <= LOG(20),
        "points.differ": not wrong and by_factor,
        "points.some-contradict": not wrong and contradict,
        "points.few": not alone and f.points in (1, 2),
        "views.bars": f.bars > 0,
        "pose.residual": 2 < f.epipolar_px <= 4,
        "depth.search-edge": f.on_edge and (bool(reasons) or f.at_end > 0.05),
    }
    judged = not alone or (f.points >= 50 and f.cover >= 0.25)
    status = "not trusted" if reasons else "trusted" if judged else "not judged"
    return status, reasons, [code for code, holds in remarks.items() if holds]


def drawn(rng: random.Random) -> Indicators:
    """Good indicators, of which a group and perhaps one more have a value that a rule looks for."""
    names = rng.choice(GROUPS).split()
    names = rng.sample(names, rng.randint(1, len(names))) + rng.sample(list(VALUES), rng.randint(0, 1))
    return replace(rng.choice((GOOD, GOOD, ALONE)), **{name: rng.choice(VALUES[name]) for name in names})


def found(indicators: Indicators) -> tuple[str, list[str], list[str]]:
    verdict = judge(indicators)
    assert verdict.indicators is indicators
    return verdict.status, *(
        [message.code for message in each] for each in (verdict.reasons, verdict.remarks)
    )


def test_each_rule_applies_exactly_where_it_is_stated_to():
    rng = random.Random(0)
    for indicators in (drawn(rng) for _ in range(5000)):
        assert found(indicators) == expected(indicators), indicators
    with pytest.raises(FrozenInstanceError):
        REASONS[0].code = "views.same"


@pytest.mark.parametrize("base", [GOOD, ALONE])
def test_every_value_alone(base):
    for name, values in VALUES.items():
        for value in values:
            indicators = replace(base, **{name: value})
            assert found(indicators) == expected(indicators), (name, value)


#: What is wrong, the code of the message, and parts of its sentence with their numbers.
SENTENCES = [
    ({"baseline_m": 0.000345}, "baseline.short", ["The baseline is 0.345 mm"]),
    (
        {"baseline_m": 12.34, "scene_m": 456.7},
        "pose.unit",
        ["With a baseline of 12.34 m the matches lie 457 m away", "depth_range, --near, --far"],
    ),
    ({"prior_ratio": 34.56}, "prior.unit", ["The depth is 35 times the prior's own", "depth_range, --near"]),
    ({"prior_ratio": 3.456}, "prior.metres", ["The depth is 3.5 times the prior's own metres"]),
    ({"at_end": 0.3456}, "depth.range", ["35 % of the matches lie at an end"]),
    (
        {"points_ratio": 3.456, "points": 9},
        "points.factor",
        ["lie 3.46 times as far", "the baseline or K is wrong"],
    ),
    ({"points_ratio": 1.1234, "points": 9}, "points.differ", ["lie 1.12 times as far"]),
    ({"points_ratio": 1234.0, "points": 9}, "points.factor", ["lie 1230 times as far"]),
    ({"points_ratio": 1.0, "points_off": 0.6789}, "points.contradict", ["68 % of the known depths"]),
    ({"points_ratio": 1.0, "points_off": 0.3456}, "points.some-contradict", ["35 % of the known depths"]),
    ({"matched": NAN, "points": 2}, "points.too-few", ["scale and shift: 2; give at least 3"]),
    ({"points": 2}, "points.few", ["that lie in the image: 2, too few"]),
    ({"scale_spread": 0.3456}, "scale.uncertain", ["is uncertain by 35 %", "or 3 known points"]),
    ({"scale_spread": 3.456}, "scale.uncertain", ["is uncertain by 100 %"]),
    (
        {"scale_spread": 0.3456, "given_px": 12.6},
        "scale.uncertain",
        ["E misses the matches by 13 px: is it of this pair? The scale"],
    ),
    (
        {"scale_spread": 0.0956, "depth_spread": LOG(1.1567)},
        "pose.undetermined",
        ["its scale by 10 %", "changes depths by 16 % in the median"],
    ),
    ({"off_matches": LOG(1.4567)}, "depth.off-matches", ["The depth differs by 46 %"]),
    ({"matched": NAN, "rank_correlation": 0.1234}, "depth.order-points", ["(rank correlation +0.12)"]),
    ({"matched": 0.45, "rank_correlation": -0.1234}, "depth.order", ["(rank correlation -0.12)"]),
    ({"behind_infinity": 0.3456}, "views.behind-infinity", ["35 % of the matches lie behind infinity"]),
    (
        {"behind_infinity": 0.3456, "behind_px": 12.6, "centre_assumed": True},
        "camera.other-centre",
        ["35 % of the matches", "to differ from it by 13 px or more"],
    ),
    ({"moved": 0.3456}, "views.moved", ["35 % of the matches lie off"]),
    (
        {"tear": Tear(0, 123, -7)},
        "views.torn",
        ["The left picture is torn: from row 123 on it is moved by 7 px to the left"],
    ),
    (
        {"tear": Tear(1, 45, 6)},
        "views.torn",
        ["The right picture is torn: from row 45", "by 6 px to the right"],
    ),
    ({"tear": Tear(2, 45, 6)}, "views.torn", ["The picture of right view 2 is torn"]),
    ({"shear": -0.03456}, "views.sheared", ["by 3.5 % of its width"]),
    ({"distortion": -0.3456}, "views.distorted", ["k1 = -0.35 that was not removed: rectify"]),
    ({"distortion": 0.3456}, "views.distorted", ["k1 = +0.35 that was not removed, or removed twice"]),
    ({"distortion": 0.3456, "distortion_alone": 0.0}, "views.bent", ["as a lens distortion of k1 = +0.35"]),
    ({"epipolar_px": 5.67}, "pose.off-lines", ["Matches lie 5.7 px off their epipolar lines"]),
    ({"epipolar_px": 3.46}, "pose.residual", ["Matches lie 3.5 px off their epipolar lines"]),
    ({"view_deg": 12.6}, "camera.field-of-view", ["a field of view of 13 degrees"]),
    ({"bars": 0.0678}, "views.bars", ["7 % of the side each"]),
    (
        {"rank_correlation": -0.5678, "exchangeable": 0.1, "epipolar_px": 0.3, "off_matches": 0.01},
        "prior.order",
        ["(rank correlation with the matches -0.57)"],
    ),
    (
        {"matched": 0.0456},
        "views.disagree",
        ["The views hardly agree: 5 % of the left image is matched. Likely"],
    ),
    ({"confidence": 0.4567}, "views.disagree", ["hardly agree: the mean confidence is 0.46. Likely"]),
    (
        {"confidence": 0.4567, "matched": 0.0456, "rank_correlation": 0.3},
        "views.disagree",
        ["5 % of the left image is matched and the mean confidence is 0.46. Likely"],
    ),
    (
        {"rank_correlation": 0.3456, "epipolar_px": 1.5},
        "views.disagree",
        ["hardly agree: the rank correlation with the prior is 0.35. Likely"],
    ),
]


@pytest.mark.parametrize(("signs", "code", "parts"), SENTENCES, ids=[code for _, code, _ in SENTENCES])
def test_a_sentence_has_the_numbers_of_its_own_indicators(signs, code, parts):
    verdict = judge(replace(GOOD, **signs))
    (message,) = [message for message in (*verdict.reasons, *verdict.remarks) if message.code == code]
    assert all(part in message for part in parts), message
    assert ("E misses" in message) == ("given_px" in signs)


@pytest.mark.parametrize(("px", "told"), [(4.0, False), (4.01, True)])
def test_a_pose_of_another_pair_is_suspected_only_beyond_four_pixels(px, told):
    (reason,) = judge(replace(GOOD, scale_spread=0.2, given_px=px)).reasons
    assert ("is it of this pair?" in reason) is told


#: Units that are confused: factor of the points, and what its sentence calls it.
UNITS = {
    0.256: "read as millimetres: give the points' scale as 256",
    3.90625: "give the points' scale as 1000",
    1000.0: "millimetres taken for metres",
    0.001: "divided by 1000 once too often: give the points' scale as 1",
    256.0: "KITTI's integers taken for metres",
    100.0: "centimetres taken for metres",
    3.28084: "feet taken for metres",
    0.3048: "metres taken for feet",
}


@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_is_named_for_factors_within_four_percent_of_it(unit):
    for ratio, named in (
        (unit, True),
        (unit * 1.039, True),
        (unit / 1.039, True),
        (unit * 1.041, False),
        (unit / 1.041, False),
    ):
        (reason,) = judge(replace(GOOD, points=9, points_ratio=ratio)).reasons
        assert (UNITS[unit] in reason) is named
        assert ("a unit, the baseline or K is wrong" in reason) is not named


def test_confidence_falls_with_the_factor_of_the_points_and_is_not_changed_without_one():
    for ratio in (NAN, 1.0, 1.0799, 1 / 1.0799):
        assert points_agreement(Indicators(points_ratio=ratio)) == 1.0
    middle = math.exp((LOG(1.08) + LOG(1.2)) / 2)
    for ratio, left in ((middle, 0.625), (1.2, 0.25), (1.5, 0.25), (100.0, 0.25)):
        for each in (ratio, 1 / ratio):
            assert points_agreement(Indicators(points_ratio=each)) == pytest.approx(left)
