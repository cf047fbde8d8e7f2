"""The verdict against its rules written as one table of conditions, and on whole calls."""

import copy
import math
import pickle
import random
from dataclasses import FrozenInstanceError, dataclass, replace
from typing import Any

import numpy as np
import pytest

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.findings import Finding, Severity
from geodiff_plugin.trust import KINDS, UNTESTED, FactSheet, Verdict, judge
from geodiff_plugin.trust.distortion import ResidualDistortion
from geodiff_plugin.trust.epipolar import Residuals
from geodiff_plugin.trust.field_of_view import ViewAngle
from geodiff_plugin.trust.identical_views import Difference
from geodiff_plugin.trust.inverse_pose import Preference
from geodiff_plugin.trust.known_points import Points
from geodiff_plugin.trust.length_units import Lengths, LengthUnits
from geodiff_plugin.trust.letterbox import LetterboxWidth
from geodiff_plugin.trust.matched_fraction import Matched
from geodiff_plugin.trust.moving_objects import Moved
from geodiff_plugin.trust.negative_disparity import Negative
from geodiff_plugin.trust.occlusion_order import Order
from geodiff_plugin.trust.order_ambiguity import Ambiguity
from geodiff_plugin.trust.pose_errors import FoundErrors, PoseError
from geodiff_plugin.trust.pose_uncertainty import Uncertainty
from geodiff_plugin.trust.prior_correlation import Correlation
from geodiff_plugin.trust.prior_scale import Ratio
from geodiff_plugin.trust.result_vs_matches import Deviation
from geodiff_plugin.trust.rolling_shutter import Shear
from geodiff_plugin.trust.search_edge import Edge
from geodiff_plugin.trust.search_range import Ends
from geodiff_plugin.trust.shifted_copy import DepthRange
from geodiff_plugin.trust.summary import summarise
from geodiff_plugin.trust.tearing import Tear
from tests.scenes import render_pair
from tests.unit.trust.sheets import good, sheet

NAN, LOG = math.nan, math.log
LONG, LENS = Finding("baseline.long", "25 m."), Finding("camera.principal-point", "cx is far off.")
ALPHA, CENTRE = Finding("image.alpha", "Dropped."), Finding("camera.assumed-cx", "cx is assumed.")
SCALED, AXES = PoseError("camera.scaled", 2.0), PoseError("pose.opengl")


@dataclass(frozen=True)
class Numbers:
    """Facts of one image in one row; NaN where unknown."""

    confidence: float = NAN
    matched: float = NAN
    visible: float = NAN
    rank_correlation: float = NAN
    spread: float = NAN
    planes: float = 30.0
    points_ratio: float = NAN
    points_off: float = NAN
    centre_assumed: bool = False
    points: int = 0
    cover: float = 0.0
    range_given: bool = False
    at_end: float = 0.0
    baseline_m: float = NAN
    scene_m: float = NAN
    rectified: bool = False
    view_deg: float = 60.0
    prior_ratio: float = NAN
    epipolar_px: float = NAN
    given_px: float = NAN
    scale_rel_std: float = NAN
    depth_spread: float = 0.0
    negative_disparity_fraction: float = NAN
    negative_px: float = 7.0
    distortion: float = NAN
    distortion_alone: float = 0.0
    tear: Tear | None = None
    ambiguity: float = NAN
    occlusion: float = NAN
    moved: float = NAN
    letterbox: float = NAN
    shear: float = NAN
    off_matches: float = NAN
    doubts: tuple[Finding, ...] = ()
    pose_unchecked: bool = False
    errors: tuple[PoseError, ...] = ()
    same: bool = False
    inverse_fits: bool = False
    on_edge: bool = False


GOOD = Numbers(confidence=0.85, matched=0.8, rank_correlation=0.8, spread=0.7, baseline_m=0.12)
ALONE = Numbers(points=99, cover=0.5, rank_correlation=0.8)


def known(number: float) -> float | None:
    return None if math.isnan(number) else number


def facts_of(f: Numbers) -> FactSheet:
    """The facts of every check; a record whose first number is unknown is left out."""
    records: list[tuple[float, Any]] = [
        (f.rank_correlation, Correlation(f.rank_correlation)),
        (f.spread, DepthRange(f.spread, f.planes)),
        (f.prior_ratio, Ratio(f.prior_ratio)),
        (f.negative_disparity_fraction, Negative(f.negative_disparity_fraction, f.negative_px)),
        (f.distortion, ResidualDistortion(f.distortion, f.distortion_alone, 0.4)),
        (f.ambiguity, Ambiguity(f.ambiguity)),
        (f.occlusion, Order(f.occlusion)),
        (f.moved, Moved(f.moved)),
        (f.letterbox, LetterboxWidth(f.letterbox)),
        (f.shear, Shear(f.shear, 640)),
        (f.off_matches, Deviation(f.off_matches)),
    ]
    status = "not checked" if f.pose_unchecked else "fits"
    return sheet(
        *(record for number, record in records if not math.isnan(number)),
        *([] if f.tear is None else [f.tear]),
        Matched(known(f.matched), known(f.confidence), known(f.visible)),
        Points(f.points, 0, f.cover, known(f.points_ratio), known(f.points_off)),
        Lengths(f.rectified, known(f.baseline_m), known(f.scene_m)),
        Residuals(status, (known(f.given_px),), (known(f.epipolar_px),), 0.0, 1.0, False, None, None),
        Uncertainty(known(f.scale_rel_std), f.depth_spread, True),
        Ends(f.at_end),
        ViewAngle(f.view_deg),
        FoundErrors(f.errors),
        Difference(0.0 if f.same else 0.5, 0.9),
        Preference(f.inverse_fits),
        Edge(f.on_edge),
        range_given=f.range_given,
        findings=(ALPHA, *f.doubts, *((CENTRE,) if f.centre_assumed else ())),
    )


def around(*thresholds: float, step: float = 1e-6) -> list[float]:
    """Values at, just below and just above each threshold."""
    return [value for t in thresholds for value in (t, t - step, t + step)]


#: Values of every number on which a check depends: at each threshold, on both sides of it, and unknown.
VALUES = {
    "confidence": [NAN, 0.9, 0.1, *around(0.5, 0.53)],
    "matched": [NAN, 0.9, *around(0.12, 0.38, 0.5)],
    "rank_correlation": [NAN, 0.9, -0.9, *around(-0.2, 0.2, 0.45)],
    "visible": [NAN, 0.9, *around(0.3)],
    "spread": [NAN, 0.01, 0.9, *around(0.15, 0.2)],
    "planes": [*around(2.0)],
    "points_ratio": [NAN, 0.0, 1.0, 3.0, 1 / 3, *around(1.2, 1 / 1.2, 1.08, 1 / 1.08)],
    "points_off": [NAN, 0.0, *around(0.25, 0.5)],
    "centre_assumed": [True, False],
    "points": [0, 1, 2, 3, 4, 49, 50, 51],
    "cover": [0.0, 1.0, *around(0.25)],
    "range_given": [True, False],
    "at_end": [0.0, *around(0.05, 0.2)],
    "baseline_m": [NAN, 0.0, 0.12, 10.0, *around(1e-3, 5.0, 20.0)],
    "scene_m": [NAN, 1e4, *around(50.0, 200.0, 1000.0, 2000.0, 4000.0)],
    "rectified": [True, False],
    "view_deg": around(15.0, 120.0),
    "prior_ratio": [NAN, 0.0, 1.0, *around(1.9, 1 / 1.9, 20.0, 1 / 20.0)],
    "epipolar_px": [NAN, 0.1, *around(1.0, 2.0, 4.0)],
    "given_px": [NAN, 9.0],
    "scale_rel_std": [NAN, 0.0, math.inf, 0.092, *around(0.1)],
    "depth_spread": [0.0, 0.15, *around(0.16)],
    "negative_disparity_fraction": [NAN, 0.0, *around(0.05)],
    "distortion": [NAN, 0.3, -0.3, *around(0.11, -0.11)],
    "distortion_alone": [0.3, -0.3, *around(0.11, -0.11)],
    "tear": [None, None, Tear(1, 40, 6)],
    "ambiguity": [NAN, *around(0.3)],
    "occlusion": [NAN, *around(0.35, -0.35)],
    "moved": [NAN, *around(0.15)],
    "letterbox": [NAN, 0.02],
    "shear": [NAN, *around(0.005, -0.005)],
    "off_matches": [NAN, *around(LOG(1.05), LOG(1.2))],
    "doubts": [(), (LONG,), (LENS,), (LENS, LONG)],
    "pose_unchecked": [True, False],
    "errors": [(), (SCALED,), (SCALED, AXES)],
    "same": [False, False, False, True],
    "inverse_fits": [True, False],
    "on_edge": [True, False],
}
#: Numbers that decide together.
GROUPS = [
    "rank_correlation spread matched ambiguity occlusion epipolar_px off_matches inverse_fits",
    "rank_correlation occlusion ambiguity matched",
    "points_ratio points_off points matched",
    "pose_unchecked off_matches rank_correlation matched points_ratio points_off",
    "negative_disparity_fraction centre_assumed inverse_fits errors",
    "negative_disparity_fraction centre_assumed rank_correlation spread ambiguity off_matches epipolar_px "
    "matched",
    "baseline_m scene_m rectified range_given at_end",
    "prior_ratio range_given at_end on_edge",
    "scale_rel_std depth_spread points",
    "confidence matched rank_correlation epipolar_px",
    "doubts range_given at_end errors",
    "distortion distortion_alone shear tear moved letterbox",
    "points cover matched",
    "spread planes rank_correlation",
    "visible matched confidence",
    "off_matches points given_px scale_rel_std",
    "on_edge at_end same view_deg range_given",
]


def expected(f: Numbers) -> tuple[str, list[str], list[str]]:
    """Status, reasons and remarks of numbers, as the reference of the messages describes them."""

    def off(ratio: float) -> float:
        return abs(LOG(ratio)) if ratio > 0 else 0.0

    alone = math.isnan(f.matched)
    stated = f.range_given and f.at_end <= 0.2
    unusual = f.view_deg < 15 or f.view_deg > 120
    large_factor, mostly_off = off(f.points_ratio) > LOG(1.2), f.points_off > 0.5
    wrong = large_factor or mostly_off
    by_factor = off(f.points_ratio) >= LOG(1.08) and (large_factor or not mostly_off)
    contradict = not by_factor and f.points_off > 0.25
    wide = not f.spread < 0.15
    shown = f.ambiguity < 0.3 or f.occlusion > 0.35
    order_known = shown and f.epipolar_px < 1.0 and f.off_matches < LOG(1.05) and f.matched > 0.5
    against = f.rank_correlation < -0.2 and wide and not alone
    inverted_order = against and not order_known
    least_m = 50.0 if f.rectified else 200.0
    negative = f.negative_disparity_fraction > 0.05 and not (f.inverse_fits or f.errors or inverted_order)
    bent = abs(f.distortion) > 0.11
    alike = bent and abs(f.distortion_alone) <= 0.11
    scale = f.scale_rel_std > 0.1 and f.points < 3
    together = math.hypot(f.scale_rel_std / 0.1, f.depth_spread / 0.16)
    undetermined = f.points < 3 and not scale and together > 1.15
    weak = [f.matched < 0.38, f.confidence < 0.53, f.rank_correlation < 0.45, f.epipolar_px > 1.0]
    confirmed = f.matched > 0.5 and f.off_matches < LOG(1.05) and f.rank_correlation >= 0.45
    agreed = f.points_ratio > 0 and not wrong
    far = least_m <= f.scene_m <= 200 * f.baseline_m and 5 <= f.baseline_m <= 20
    hardly = -0.2 <= f.rank_correlation < 0.2 and wide and not (alone or f.matched > 0.5)
    explaining = {
        "camera.principal-point": LENS in f.doubts,
        "baseline.long": LONG in f.doubts and not stated,
        "baseline.short": 0 < f.baseline_m < 1e-3 and not stated,
        "pose.unit": far and not stated,
        "prior.unit": off(f.prior_ratio) > LOG(20) and not stated,
        "depth.inverted-order": f.inverse_fits,
    }
    others = {
        "views.shifted": f.spread < 0.2 and f.planes < 2.0,
        "depth.range": f.at_end > 0.2,
        "points.factor": wrong and by_factor,
        "points.contradict": wrong and contradict,
        "points.too-few": alone and f.points in (1, 2),
        "scale.uncertain": scale,
        "pose.unconstrained": f.depth_spread > 0.16 or undetermined,
        "depth.off-matches": f.off_matches > LOG(1.2) and f.points < 3,
        "depth.order-points": alone and f.rank_correlation < 0.2,
        "depth.occlusion": f.occlusion < -0.35 and not f.rank_correlation >= 0.45 and f.ambiguity >= 0.3,
        "depth.inverted-order": inverted_order and not f.inverse_fits,
        "depth.order": hardly and not f.inverse_fits,
        "camera.cx-mismatch": negative and f.centre_assumed,
        "depth.negative-disparity": negative and not f.centre_assumed,
        "views.moved": f.moved > 0.15,
        "views.tearing": f.tear is not None,
        "views.rolling-shutter": abs(f.shear) > 0.005,
        "views.distorted": bent and not alike,
        "views.residual-trend": alike,
        "pose.unchecked": f.pose_unchecked and not alone and not agreed and not confirmed,
        "pose.epipolar-error": f.epipolar_px > 4,
        "views.inconsistent": not alone and (f.matched < 0.12 or f.confidence < 0.5 or sum(weak) >= 2),
        "camera.unconfirmed-field-of-view": unusual and not stated,
    }
    reasons = [code for code, holds in explaining.items() if holds]
    reasons += [*(error.code for error in f.errors), *(code for code, holds in others.items() if holds)]
    reasons = ["views.identical"] if f.same else reasons
    remarks = {
        "prior.metres": LOG(1.9) < off(f.prior_ratio) <= LOG(20),
        "points.differ": not wrong and by_factor,
        "points.some-contradict": not wrong and contradict,
        "points.few": not alone and f.points in (1, 2),
        "prior.order": against and order_known,
        "pose.residual": 2 < f.epipolar_px <= 4,
        "camera.field-of-view": unusual and stated,
        "views.letterbox": f.letterbox > 0,
        "depth.search-edge": f.on_edge and (bool(reasons) or f.at_end > 0.05),
    }
    judged = not alone or (f.points >= 50 and f.cover >= 0.25)
    status = "not trusted" if reasons else "trusted" if judged else "not judged"
    return status, reasons, [code for code, holds in remarks.items() if holds]


def drawn(rng: random.Random) -> Numbers:
    """Good numbers, of which a group and perhaps one more have a value that a check looks for."""
    names = rng.choice(GROUPS).split()
    names = rng.sample(names, rng.randint(1, len(names))) + rng.sample(list(VALUES), rng.randint(0, 1))
    return replace(rng.choice((GOOD, GOOD, ALONE)), **{name: rng.choice(VALUES[name]) for name in names})


def found(numbers: Numbers) -> tuple[str, list[str], list[str]]:
    facts = facts_of(numbers)
    verdict = judge(facts)
    assert verdict.facts is facts and verdict.trusted is (verdict.status == "trusted")
    overlap = [finding.code for finding in verdict.findings if finding.severity is Severity.WARNING]
    assert ("views.overlap" in overlap) is (numbers.visible < 0.3)
    assert ("verdict.not-judged" in overlap) is (verdict.status == "not judged")
    return verdict.status, *(
        [finding.code for finding in each] for each in (verdict.reasons, verdict.remarks)
    )


def test_each_rule_applies_exactly_where_it_is_stated_to():
    rng = random.Random(0)
    for numbers in (drawn(rng) for _ in range(5000)):
        assert found(numbers) == expected(numbers), numbers


@pytest.mark.parametrize("base", [GOOD, ALONE])
def test_every_value_alone(base):
    for name, values in VALUES.items():
        for value in values:
            numbers = replace(base, **{name: value})
            assert found(numbers) == expected(numbers), (name, value)


def test_a_good_run_is_trusted_in_silence():
    verdict = judge(good())
    assert verdict.trusted and verdict.findings == () and verdict.summary is None
    for records in (
        [Ratio(1.4), ViewAngle(21.0)],
        [Residuals("fits", (1.5,), (1.5,), 0.0, 1.0, False, None, None), Uncertainty(0.09, 0.0, True)],
        [Uncertainty(0.2, 0.0, True), Points(99, 0, 0.5, None, None)],  # known points give the scale
        [Edge(True)],
        [Correlation(0.0), DepthRange(0.1, 30.0), Matched(0.95, 0.85)],  # a scene that is nearly flat
        [Correlation(0.1), Matched(0.95, 0.85)],  # a poor prior under good matches
    ):
        verdict = judge(good(*records))
        assert verdict.trusted and verdict.findings == (), records


def test_the_summary_states_every_reason_or_that_nothing_tests_the_depth():
    bad = judge(good(Moved(0.3), Tear(0, 9, 9), ViewAngle(12.0), calibrated=True))
    assert bad.status == "not trusted" and not bad.trusted
    assert bad.summary == f"Do not trust this depth: {' '.join(bad.reasons)}" and len(bad.reasons) == 2
    assert bad.summary.code == "verdict.not-trusted"
    (remark,) = bad.remarks
    assert remark.code == "camera.field-of-view"
    unknown = judge(FactSheet())
    assert unknown.status == "not judged" and not unknown.trusted and UNTESTED in unknown.summary
    assert unknown.findings == (unknown.summary,) and unknown.summary.code == "verdict.not-judged"
    with pytest.raises(FrozenInstanceError):
        unknown.status = "trusted"


def test_reasons_and_remarks_are_the_findings_of_their_severity():
    findings = [Finding(kind, f"{code}.") for code, kind in KINDS.items()]
    verdict = Verdict("not trusted", tuple(findings), FactSheet())
    for found_here, severity in ((verdict.reasons, Severity.REASON), (verdict.remarks, Severity.REMARK)):
        assert found_here == tuple(each for each in findings if KINDS[each.code].severity is severity)
        assert found_here


@pytest.mark.parametrize("copied", [lambda verdict: pickle.loads(pickle.dumps(verdict)), copy.deepcopy])
def test_a_verdict_from_another_process_is_summed_up_as_well(copied):
    wrong = Verdict("not trusted", (Finding(KINDS["views.identical"], "The same image."),), FactSheet())
    for verdict in (judge(FactSheet()), wrong):
        found = copied(verdict)
        assert found == verdict and found.reasons == verdict.reasons
        assert found.summary == verdict.summary and found.summary.code == verdict.summary.code
        assert summarise(found, ()) == summarise(verdict, ())


def test_reasons_about_the_input_come_first_and_nothing_else_of_it_is_repeated():
    (reason, *others) = judge(good(Moved(0.3), findings=(ALPHA, LENS, CENTRE, LENS))).findings
    assert reason is LENS and [finding.code for finding in others] == ["views.moved"]


@pytest.fixture(scope="module")
def scene():
    """A rendered, rectified pair, and its inverse relative depth, as an oracle prior has it."""
    pair = render_pair(0, size=(96, 128), posed=False)
    left, right = (
        np.rint(v.image_01.permute(1, 2, 0).numpy() * 255).astype(np.uint8) for v in (pair.left, pair.right)
    )
    return left, right, pair.K_left.numpy(), pair.E.numpy(), pair.left.depth_m[0].numpy()


@pytest.fixture
def run(scene, make_oracle):
    """One guided call by a prior that knows near from far; what is changed is wrong."""
    left, right, K, E, depth = scene
    inverse = 1.0 / depth
    relative = (inverse - inverse.min()) / (inverse.max() - inverse.min())
    pipe = enable_geometry_guidance(make_oracle(relative, "disparity"))

    def call(left=left, right=right, K=K, E=E, strict=False, **options):
        return pipe(left, guidance=GeometryGuidance(right, K, E, guidance_steps=0, **options), strict=strict)

    return call


@pytest.mark.end_to_end
def test_a_rendered_pair_correct_and_wrong(run, scene):
    left, right, K, E, _ = scene
    good_run = run(strict=True)
    (assumption,) = good_run.findings
    assert good_run.verdicts[0].trusted and "cx is assumed" in assumption and run(K=(K, K)).findings == []
    assert "trusted" in repr(good_run) and len(repr(good_run).splitlines()) < 8
    for wrong, words in (
        ({"left": right, "right": left}, "swapped"),
        ({"E": np.linalg.inv(E)}, "swapped"),
        ({"right": left.copy()}, "right view are identical"),
        ({"right": np.roll(left, -6, axis=1)}, "shifted copy"),
    ):
        out = run(**wrong)
        assert not out.verdicts[0].trusted and words in " ".join(out.findings)
    black = np.zeros_like(left)
    same = [finding.code for finding in run(left=black, right=black).findings]
    assert "views.identical" not in same
    with pytest.warns(UserWarning, match="Do not trust this depth"):
        run(right=left.copy())
    with pytest.raises(InputError, match="Do not trust this depth"):
        run(right=np.ascontiguousarray(right[:, ::-1]), strict=True)


@pytest.mark.end_to_end
def test_depth_is_at_most_what_the_cameras_can_measure(run, scene):
    _, _, K, E, depth = scene
    out = run()
    reach_m = K[0, 0] * E[0, 3] / 0.3
    assert out.prediction.max() <= reach_m * 1.01
    # Far things under a tenth of the baseline: the sky of this scene.
    shorter = np.ones((4, 4))
    shorter[:3, 3] = 0.1
    assert run(E=E * shorter).prediction.max() <= 0.1 * reach_m * 1.01


@pytest.mark.end_to_end
def test_centimetres_for_metres_are_never_trusted(run, scene):
    _, _, _, E, depth = scene
    longer = np.ones((4, 4))
    longer[:3, 3] = 100.0
    wrong = run(E=E * longer)
    (reason,) = wrong.verdicts[0].reasons
    assert reason.code == "pose.unit" and "a baseline in centimetres by 100" in reason
    lengths = wrong.verdicts[0].facts[LengthUnits]
    assert lengths.rectified and lengths.scene_m == pytest.approx(100 * np.median(depth), rel=0.1)
    with pytest.raises(InputError, match="in centimetres"):
        run(E=E * longer, strict=True)
    assert run(E=E * longer, unit=None).verdicts[0].trusted, "lengths without a unit are not doubted"
    stated = (50 * depth.min(), 200 * depth.max())
    assert run(E=E * longer, depth_range=stated).verdicts[0].trusted
    assert not run(E=E * longer, depth_range=(depth.min(), depth.max())).verdicts[0].trusted


@pytest.mark.end_to_end
@pytest.mark.filterwarnings("ignore:points has depths")
@pytest.mark.parametrize(("factor", "words"), [(0.256, "1/256"), (1000.0, "millimetres")])
def test_points_that_contradict_the_views(run, scene, factor, words):
    known = np.zeros_like(scene[4])
    known[4::9, 4::9] = scene[4][4::9, 4::9]
    right = run(points=known)
    assert right.verdicts[0].trusted
    wrong = run(points=factor * known)
    assert not wrong.verdicts[0].trusted and words in " ".join(wrong.findings)
    assert wrong.confidence.mean() < 0.45 * right.confidence.mean()
