"""How well matches determine the scale and the shape of poses, and how much less certain depths are by it."""

import math
from dataclasses import replace

import pytest

from geodiff_plugin.trust import MatchError, PoseUncertainty
from geodiff_plugin.trust.epipolar import Residuals
from geodiff_plugin.trust.known_points import Points
from geodiff_plugin.trust.pose_uncertainty import Uncertainty
from geodiff_plugin.types import PoseReport, RejectedPose
from tests.unit.trust.made_stages import poses_stage
from tests.unit.trust.sheets import codes, good, judged, sheet

LOG = math.log


def test_it_is_that_of_the_report():
    report = PoseReport("refined", (), (), scale_rel_std=0.023, depth_spread=0.034)
    assert PoseUncertainty.of_poses(poses_stage(report)) == Uncertainty(0.023, 0.034, True)
    rejected = replace(report, scale_rel_std=None, rejected=RejectedPose(0, 9.0, 0.4, 0.2))
    assert PoseUncertainty.of_poses(poses_stage(rejected)) == Uncertainty(None, 0.034, False)


def test_a_scale_that_was_measured_or_has_no_unit_is_certain():
    uncertain = Uncertainty(0.2, 0.0, True)
    assert PoseUncertainty.scale_rel_std(sheet(uncertain)) == 0.2
    assert PoseUncertainty.scale_rel_std(sheet(uncertain, has_unit=False)) == 0.0
    assert PoseUncertainty.scale_rel_std(sheet(Uncertainty(None, 0.0, True))) == 0.0
    assert PoseUncertainty.scale_rel_std(sheet()) == 0.0
    assert codes(good(uncertain)) == ["scale.uncertain"] and codes(good(uncertain, has_unit=False)) == []


@pytest.mark.parametrize("count", [0, 2, 3, 99])
@pytest.mark.parametrize("scale", [0.099, 0.101, math.inf])
def test_an_uncertain_scale_is_a_reason_unless_points_fix_it(count, scale):
    facts = good(Uncertainty(scale, 0.0, True), Points(count, 0, 0.5, None, None))
    assert ("scale.uncertain" in codes(facts)) is (scale > 0.1 and count < 3)


@pytest.mark.parametrize(
    ("scale", "change", "count", "expected"),
    [
        (0.0, 0.159, 0, []),
        (None, 0.161, 0, ["pose.unconstrained"]),
        (0.08, 0.14, 0, ["pose.unconstrained"]),  # both within their limits, but not together
        (0.08, 0.14, 3, []),
        (0.08, 0.12, 0, []),
        (0.2, 0.14, 0, ["scale.uncertain"]),  # named already
        (0.2, 0.161, 0, ["scale.uncertain", "pose.unconstrained"]),
        (None, 0.159, 0, []),
    ],
)
def test_poses_that_matches_do_not_determine_are_a_reason(scale, change, count, expected):
    facts = good(Uncertainty(scale, change, True), Points(count, 0, 0.5, None, None))
    assert [code for code in codes(facts) if not code.startswith("points")] == expected


def test_a_pose_that_was_not_used_is_not_called_undetermined():
    assert codes(good(Uncertainty(0.05, 0.3, False))) == []


@pytest.mark.parametrize(("given_px", "suspected"), [(None, False), (4.0, False), (4.01, True), (12.6, True)])
def test_a_pose_of_another_pair_is_suspected_only_beyond_four_pixels(given_px, suspected):
    residuals = Residuals("refined", (given_px,), (0.3,), 0.0, 1.0, False, None, None)
    finding = judged(good(Uncertainty(0.3456, 0.0, True), residuals), "scale.uncertain")
    assert ("px; check E. The scale" in finding) is suspected
    assert (f"E has an epipolar error of {given_px or 0:.0f} px" in finding) is suspected


@pytest.mark.parametrize(
    ("uncertainty", "words"),
    [
        (Uncertainty(0.3456, 0.0, True), ["is uncertain by 35 %", "at least 3 known points"]),
        (Uncertainty(3.456, 0.0, True), ["is uncertain by 100 %"]),
        (Uncertainty(math.inf, 0.0, True), ["is uncertain by 100 %"]),
        (
            Uncertainty(0.0956, LOG(1.1567), True),
            ["its scale may be off by 10 %", "changes depth by 16 % (median)"],
        ),
        (Uncertainty(None, LOG(1.2345), True), ["changes depth by 23 % (median)"]),
    ],
)
def test_findings_state_the_uncertainty(uncertainty, words):
    code = "scale.uncertain" if (uncertainty.scale_rel_std or 0) > 0.1 else "pose.unconstrained"
    finding = judged(good(uncertainty), code)
    assert all(each in finding for each in words)


@pytest.mark.parametrize(
    ("scale", "change", "relative"),
    [
        (None, 0.0, 0.0),
        # .85 of the deviation of a scale count.
        (0.04, 0.0, 0.034),
        (0.2, 0.0, 0.17),
        (math.inf, 0.0, math.inf),  # no point is in front of the cameras
        # Three tenths of the change by another pose count, or what is beyond .15 if that is more.
        (None, 0.1, 0.03),
        (None, 0.15, 0.045),
        (None, 0.155, 0.0465),
        (None, 0.25, 0.2),
        (0.1, 0.2, math.hypot(0.085, math.sqrt(0.0175))),
        (0.2, 0.1, math.hypot(0.17, 0.03)),
    ],
)
def test_all_depths_share_the_error_of_inexact_poses(scale, change, relative):
    error = PoseUncertainty.match_error(sheet(Uncertainty(scale, change, True)))
    assert error == pytest.approx(MatchError(relative=relative), abs=1e-9)
