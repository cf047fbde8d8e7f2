"""The check of given poses: what is measured on, when whole images are matched, and what is reported."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from geodiff_plugin.evidence import pose_check as module
from geodiff_plugin.evidence.pose_check import CheckedPoses, check_poses, image_facts, used_as_given
from geodiff_plugin.findings import REASON, Finding
from geodiff_plugin.pose import refine
from geodiff_plugin.pose.fit import PosedGreys, PoseFit, poses_of
from geodiff_plugin.pose.refine import CheckedViews, Displacement
from geodiff_plugin.pose.tracks import GreyImage, median_residuals, merge_tracks
from geodiff_plugin.trust import (
    Epipolar,
    FactSheet,
    ImagesStage,
    PoseErrors,
    PosesStage,
    PoseUncertainty,
    TracksStage,
    judge,
)
from geodiff_plugin.trust.field_of_view import FieldOfView, ViewAngle
from geodiff_plugin.trust.inverse_pose import InversePose, Preference
from geodiff_plugin.trust.letterbox import Letterbox, LetterboxWidth
from geodiff_plugin.trust.pose_errors import FoundErrors, PoseError
from geodiff_plugin.trust.registry import NOT_JUDGED
from geodiff_plugin.trust.tearing import Tear, Tearing
from geodiff_plugin.types import PoseReport, RejectedPose
from tests.unit.pose.posed_scene import K_LEFT, POSES, SIZES, make_scene, moved, pose, posed_fit
from tests.views import grey_of

TS = np.linalg.inv(POSES)
WRONG = np.stack(
    [moved(TS[0], np.radians([0.5, -0.4, 0.3, 0, 0, 0])), moved(TS[1], np.radians([-0.6, 0.3, 0.5, 0, 0, 0]))]
)
RIG = np.linalg.inv(np.stack([pose((0, 0, 0), (0.3, 0, 0)), pose((0, 0, 0), (-0.2, 0, 0))]))
K_RIG = (K_LEFT, np.stack([K_LEFT, K_LEFT]))
#: What a made-up ``measure`` finds at each stage; what two of them find is the later one's.
IMAGES = FactSheet({Letterbox: LetterboxWidth(0.1), FieldOfView: ViewAngle(1.0)})
TRACKS = FactSheet({FieldOfView: ViewAngle(2.0), InversePose: Preference(False), PoseErrors: FoundErrors(())})
IN_USE = FactSheet({InversePose: Preference(True)})


@pytest.fixture
def stages(monkeypatch) -> list:
    """The stages that are measured, in their order."""
    measured = []

    def measure(stage):
        measured.append(stage)
        return {ImagesStage: IMAGES, TracksStage: TRACKS, PosesStage: IN_USE}[type(stage)]

    monkeypatch.setattr(module, "measure", measure)
    monkeypatch.setattr(module, "rules_out_everything", lambda facts: True)
    return measured


def flow_finds(monkeypatch, dense) -> None:
    """Optical flow that finds these tracks."""
    monkeypatch.setattr(refine, "coarse_depth", lambda *_: None)
    monkeypatch.setattr(refine, "dense_tracks", lambda *_: dense)


def greys_of(images) -> list[GreyImage]:
    """Grey images of one camera."""
    return [grey_of(image, K_LEFT) for image in images]


def findings_of(facts: FactSheet) -> list[Finding]:
    """What a verdict on these facts alone reports, but that there is no result to judge."""
    return [finding for finding in judge(facts).findings if finding.code != NOT_JUDGED.code]


def codes_of(found: CheckedPoses) -> list[str]:
    return [finding.code for finding in findings_of(found.facts)]


def test_poses_that_are_not_checked_are_those_given():
    posed, _ = posed_fit(make_scene(50).tracks, TS)
    views, report, facts, warps = used_as_given(posed)
    assert warps == () and views is posed.rights and report.status == "given" and facts == FactSheet()
    np.testing.assert_allclose(report.E, POSES, atol=1e-6)
    np.testing.assert_allclose(report.E_given, POSES, atol=1e-6)


def test_a_check_is_applied_to_another_frame_of_the_rig():
    """Poses, report and facts come from the check; the images come from the frame and are warped alike."""
    posed, _ = posed_fit(make_scene(50).tracks, TS)
    warp = Displacement(np.zeros((10, 2)), posed.rights[0].size, 9.0, 3.0)
    warp.coefficients[0] = (2.0, 0.0)  # two pixels to the right, everywhere
    refined = tuple(view._replace(T_right_from_left=view.T_right_from_left + 0.5) for view in posed.rights)
    warps = (warp, *[None] * (len(refined) - 1))
    checked = CheckedPoses(refined, "report", IMAGES, warps)
    rng = np.random.default_rng(0)
    images = [torch.from_numpy(rng.random((3, *view.size), np.float32)) for view in posed.rights]
    frames = tuple(view._replace(image_01=image) for view, image in zip(posed.rights, images, strict=True))
    views, report, facts, kept = checked.of_frame(frames)
    assert (report, facts, kept) == ("report", IMAGES, warps)
    for view, of_check in zip(views, refined, strict=True):
        np.testing.assert_array_equal(view.T_right_from_left, of_check.T_right_from_left)
    assert all(view.image_01 is image for view, image in zip(views[1:], images[1:], strict=True))
    np.testing.assert_allclose(views[0].image_01[..., 2:], images[0][..., :-2], atol=1e-5)


def test_the_checks_of_images_get_all_views_and_the_heights_of_their_originals(stages):
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (24, 32)).astype(np.uint8) for _ in range(3)]
    assert image_facts(PosedGreys(greys_of(images), RIG, [24, 30, 72])) == IMAGES
    (stage,) = stages
    assert all(one is other for one, other in zip(stage.greys, images, strict=True))
    assert stage.heights == [24, 30, 72]


def test_facts_of_images_are_those_of_all_views_in_pixels_of_the_originals():
    rng = np.random.default_rng(0)
    images = [rng.integers(60, 200, (240, 320)).astype(np.uint8) for _ in range(3)]
    smooth = []
    for _ in range(3):
        details = (cv2.GaussianBlur(rng.normal(0, 60 * size, (240, 320)), (0, 0), size) for size in (2, 6))
        smooth.append(np.clip(128 + sum(details) + rng.normal(0, 1, (240, 320)), 0, 255).astype(np.uint8))
    smooth[2][90:] = np.roll(smooth[2][90:], 12, axis=1)
    facts = image_facts(PosedGreys(greys_of(smooth), RIG, [240, 240, 720]))
    assert facts[Tearing] == Tear(2, 270, 36) and facts[Letterbox] is None
    for image in images:
        image[:24], image[-24:] = 0, 0
    facts = image_facts(PosedGreys(greys_of(images), RIG, [240] * 3))
    assert facts[Letterbox] == LetterboxWidth(0.1) and facts[Tearing] is None


@pytest.mark.parametrize("measured", [False, True])
def test_matches_are_measured_under_the_poses_given_and_those_in_use(stages, measured):
    scene = make_scene(120, noise_px=0.15, unseen=0.3)
    posed, fit = posed_fit(scene.tracks, TS)
    views, report, facts, warps = check_poses(posed, fit, IMAGES, measured)
    assert warps == ()
    sparse, in_use = stages
    assert sparse.tracks is fit.tracks and sparse.given is sparse.nearby is fit.greys.given
    assert tuple(sparse.sizes) == SIZES and sparse.size == posed.size == in_use.size == (25, 32)
    assert views is posed.rights and report.status == "fits" and in_use.report is report
    assert in_use.tracks is None
    np.testing.assert_allclose(in_use.used, TS, atol=1e-6)
    assert report.scale_rel_std == (None if measured else 0.05)
    # Each stage has the last word on what it measures.
    expected = FactSheet(
        {
            Letterbox: LetterboxWidth(0.1),
            FieldOfView: ViewAngle(2.0),
            InversePose: Preference(True),
            PoseErrors: FoundErrors(()),
        }
    )
    assert facts == expected


def test_poses_that_do_not_fit_are_refined_from_those_nearby(stages, monkeypatch):
    posed, fit = posed_fit(make_scene(100, noise_px=0.15).tracks, WRONG)
    asked, rights = (
        [],
        tuple(view._replace(T_right_from_left=view.T_right_from_left + 1) for view in posed.rights),
    )

    def refine_views(*given):
        asked.append(given)
        return CheckedViews(rights, "report", "tracks")

    monkeypatch.setattr(module, "nearby_of", lambda fit: TS)
    monkeypatch.setattr(module, "refine_views", refine_views)
    found = check_poses(posed, fit, IMAGES, measured=True)
    assert asked == [(posed, fit, TS, True, False)]
    sparse, in_use = stages
    assert sparse.nearby is TS and sparse.given is WRONG
    assert found.views is rights and found.report == in_use.report == "report" and in_use.tracks == "tracks"
    np.testing.assert_array_equal(in_use.used, poses_of(rights))


@pytest.mark.parametrize("ruled_out", [True, False])
@pytest.mark.parametrize("is_small", [True, False])
def test_small_images_that_do_not_exclude_every_problem_are_followed_by_whole_ones(
    stages, monkeypatch, is_small, ruled_out
):
    few, many = make_scene(60, noise_px=0.02), make_scene(150, noise_px=0.02)
    posed, fit = posed_fit(few.tracks, TS)
    fit = replace(fit, is_small=is_small, surely=True)
    whole = replace(posed_fit(many.tracks, TS)[1], surely=True)
    asked = []
    monkeypatch.setattr(PoseFit, "at_full_resolution", lambda self: asked.append(self) or whole)
    monkeypatch.setattr(module, "rules_out_everything", lambda facts: facts is not TRACKS or ruled_out)
    repeated = is_small and not ruled_out
    found = check_poses(posed, fit, IMAGES, measured=True)
    assert found.report.matches == ((150.0, 150.0) if repeated else (60.0, 60.0))
    assert asked == ([fit] if repeated else []) and found.report.scale_rel_std is None
    sparse = [stage.tracks for stage in stages if isinstance(stage, TracksStage)]
    assert sparse == ([few.tracks, many.tracks] if repeated else [few.tracks])


def test_a_wrong_pose_is_reported_once_and_left_unchanged():
    scene = make_scene(100, noise_px=0.15)
    posed, fit = posed_fit(scene.tracks, np.linalg.inv(TS))
    found = check_poses(posed, fit, FactSheet())
    assert found.views is posed.rights and found.report.status == "mistaken"
    assert found.report.residual_px == found.report.residual_px_given
    assert found.facts[PoseErrors] == FoundErrors((PoseError("depth.inverted-order"),))
    assert codes_of(found)[0] == "depth.inverted-order"


def test_views_with_few_matches_are_not_checked_for_pose_errors():
    scene = make_scene(100, noise_px=0.15)
    for count, status in ((40, "mistaken"), (39, "refined")):
        right = scene.tracks.seen & (np.arange(100) < [[100], [count]])
        given = np.stack([TS[0], np.linalg.inv(TS[1])])
        posed, fit = posed_fit(replace(scene.tracks, seen=right), given)
        stage = TracksStage(fit.tracks, given, TS, SIZES, posed.size)
        found = PoseErrors.of_tracks(stage).found
        assert found == ((PoseError("depth.inverted-order"),) if status == "mistaken" else ())


@pytest.mark.parametrize("count", [39, 40])
def test_where_few_features_match_flow_is_asked_as_well(stages, monkeypatch, count):
    sparse, dense = make_scene(count, noise_px=0.1), make_scene(100, noise_px=0.1, seed=4)
    flow_finds(monkeypatch, dense.tracks)
    posed, fit = posed_fit(sparse.tracks, TS)
    asked = []
    by_flow = refine.refine_by_flow
    monkeypatch.setattr(module, "refine_by_flow", lambda *given: asked.append(given) or by_flow(*given))
    found = check_poses(posed, fit, IMAGES, measured=True)
    assert found.report.status == "fits"
    if count == 40:
        assert not asked and [type(stage) for stage in stages] == [TracksStage, PosesStage]
        return
    assert asked == [(posed, fit, True)] and found.report.matches == (139.0, 139.0)
    (stage,) = stages
    assert isinstance(stage, PosesStage) and stage.report is found.report
    assert found.facts == IMAGES | IN_USE, "matches of flow are not asked about anything else"
    small = replace(fit, surely=True)  # small images showed that the poses fit
    assert check_poses(posed, small, IMAGES).facts == IMAGES | TRACKS | IN_USE and len(asked) == 1


@pytest.mark.parametrize(
    ("given", "dense_count", "status", "codes"),
    [
        (TS, 100, "fits", []),
        (WRONG, 100, "refined", ["pose.refined", "pose.few-matches"]),
        (WRONG, 10, "not checked", []),
    ],
)
def test_what_is_reported_where_few_features_match(given, dense_count, status, codes, monkeypatch):
    sparse = make_scene(12, noise_px=0.1).tracks
    sparse.seen[1, 5:] = False
    dense = make_scene(dense_count, noise_px=0.1, seed=4).tracks
    flow_finds(monkeypatch, dense)
    posed, fit = posed_fit(sparse, given)
    found = check_poses(posed, fit, FactSheet(), measured=True)
    assert found.report.status == status and codes_of(found) == codes
    if status == "refined":
        before = median_residuals(merge_tracks([sparse, dense]), given)
        message = findings_of(found.facts)[-1]
        assert message.severity is REASON and "Only 12 features match, but 40 are needed" in message
        assert f"median epipolar error of {before.max():.1f} px" in message


def test_a_refined_pose_is_reported_with_the_worst_residual_and_the_one_that_is_left(monkeypatch):
    sparse = make_scene(100, noise_px=0.15, outliers=0.05, unseen=0.2)
    dense = make_scene(150, noise_px=0.15, outliers=0.05, seed=5).tracks
    flow_finds(monkeypatch, dense)
    posed, fit = posed_fit(sparse.tracks, WRONG)
    found = check_poses(posed, fit, FactSheet(), measured=True)
    before = median_residuals(merge_tracks([sparse.tracks, dense]), WRONG)
    worst = int(np.argmax(before))
    (message,) = findings_of(found.facts)
    assert message.code == "pose.refined"
    assert f"right view {worst + 1} has a median epipolar error of {before[worst]:.1f} px" in message
    assert f"refined to {found.report.residual_px[worst]:.1f} px" in message


def test_a_rig_is_not_changed_for_what_flow_alone_shows(monkeypatch):
    scene = make_scene(10, poses=np.linalg.inv(RIG), Ks=K_RIG)
    dense = make_scene(200, noise_px=0.02, poses=np.linalg.inv(RIG), Ks=K_RIG, seed=1).tracks
    for by_px, status in ((0.44, "fits"), (0.46, "not checked")):
        flow_finds(monkeypatch, replace(dense, right_px=dense.right_px + [0.0, by_px]))
        posed, fit = posed_fit(scene.tracks, RIG)
        found = check_poses(posed, fit, FactSheet())
        assert found.report.status == status and found.views is posed.rights and codes_of(found) == []


def reported(report: PoseReport, views: int = 2) -> list[Finding]:
    """The findings on a report, as the check of the epipolar lines and of the uncertainty make them."""
    stage = PosesStage(report, None, np.stack([np.eye(4)] * views), (25, 32))
    facts = FactSheet({check: check.of_poses(stage) for check in (Epipolar, PoseUncertainty)})
    return findings_of(facts)


def report_of(status: str, before, after=(0.21, 0.32), **fields) -> PoseReport:
    used = after if status == "refined" else before
    return PoseReport(status, (), (), residual_px_given=before, residual_px=used, **fields)


@pytest.mark.parametrize(
    ("before", "rig", "said", "drift"),
    [
        ((0.9, 0.4), False, False, None),
        ((1.1, 0.4), False, True, False),
        ((0.44, 0.4), True, False, None),
        ((0.46, 0.4), True, True, True),
        ((1.1, np.nan), True, True, False),
    ],
)
def test_a_misfit_is_reported_above_a_pixel_and_for_a_refined_rig_above_its_limit(before, rig, said, drift):
    messages = reported(report_of("refined", before, rig=rig))
    assert [message.code for message in messages] == (["pose.refined"] if said else [])
    if said:
        assert f"right view 1 has a median epipolar error of {before[0]:.1f} px" in messages[0]
        assert "refined to 0.2 px" in messages[0] and ("drifted since" in messages[0]) is drift
    above = bool(np.nanmax(before) > 1.0)
    kept = reported(report_of("kept", before, rig=rig))
    assert [message.code for message in kept] == (["pose.kept"] if above else [])
    assert all("no nearby pose is clearly better" in message for message in kept)
    rejected = RejectedPose(0, 9.0, 0.2, 0.21)
    far = reported(report_of("kept", before, rig=rig, rejected=rejected))
    assert [message.code for message in far] == (["pose.too-far"] if above else [])


def test_only_one_right_view_is_not_numbered():
    (message,) = reported(report_of("kept", (1.26,)), views=1)
    assert message.startswith("The given pose has a median epipolar error of 1.3 px")
    (message, _) = reported(report_of("kept", (1.26, 3.0)))
    assert message.startswith("The given pose of right view 2 has a median epipolar error of 3.0 px")


@pytest.mark.parametrize("v", [0, 1])
def test_a_pose_that_is_too_far_is_named_with_its_distance_and_residual(v):
    before = (1.5, 1.2) if v == 0 else (1.2, 1.5)
    (message,) = reported(report_of("kept", before, rejected=RejectedPose(v, 9.0 + v, 0.81, 0.12)))
    assert message.code == "pose.too-far"
    assert f"right view {v + 1} has a median epipolar error of 1.5 px" in message
    assert f"(0.1 px) was rejected: it is {9 + v} degrees and 81 % of the baseline away" in message


@pytest.mark.parametrize(("apart", "told_of"), [(0.159, False), (0.161, True), (np.log(1.3), True)])
@pytest.mark.parametrize("status", ["refined", "kept"])
def test_a_pose_is_undetermined_where_another_one_gives_other_depths(apart, told_of, status):
    report = report_of(status, (1.1, 0.4), depth_spread=apart)
    codes = [f"pose.{status}", "pose.unconstrained"] if told_of else [f"pose.{status}"]
    messages = {message.code: message for message in reported(report)}
    assert set(messages) == set(codes)
    if told_of:
        assert f"changes depth by {100 * np.expm1(apart):.0f} %" in messages["pose.unconstrained"]
    far = replace(report, status="kept", rejected=RejectedPose(0, 9.0, 0.2, 0.21))
    assert [message.code for message in reported(far)] == ["pose.too-far"], "it was not used"
