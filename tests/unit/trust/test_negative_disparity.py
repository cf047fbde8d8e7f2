"""Matches beyond the point at infinity: how many, how far, and what that does to a verdict and to errors."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import MatchError
from geodiff_plugin.trust.inverse_pose import Preference
from geodiff_plugin.trust.negative_disparity import Negative, NegativeDisparity, negative_disparities
from geodiff_plugin.trust.pose_errors import FoundErrors, PoseError
from geodiff_plugin.trust.prior_correlation import Correlation
from geodiff_plugin.types import PoseReport
from tests.scenes import render_pair
from tests.tiny import checked_views
from tests.unit.pose.posed_scene import K_RIGHTS, Scene, make_scene, moved, pose, projected
from tests.unit.trust.made_stages import poses_stage, tracks_stage
from tests.unit.trust.sheets import codes, good, judged, sheet
from tests.unit.trust.walls import K as K_WALLS
from tests.unit.trust.walls import guided, pair_of_shifts
from tests.views import view_of

PARALLEL = pose((0, 0, 0), (0.3, 0, 0))[None]


def behind_scene(px_behind: np.ndarray, px_off: np.ndarray) -> Scene:
    """Per view 100 matches; the first are so many pixels beyond infinity, and so many off their line."""
    scene = make_scene(100)
    for v, (K, T) in enumerate(zip(K_RIGHTS, scene.Ts, strict=True)):
        infinity, further = (projected(scene.tracks.rays * z, K, T) for z in (1e12, 1e4))
        along = further - infinity
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        count = len(px_behind)
        scene.tracks.right_px[v, :count] = infinity[:count] - px_behind[:, None] * along[:count]
        scene.tracks.right_px[v, :count] += px_off[:, None] * across[:count]
    return scene


def test_matches_beyond_infinity_are_counted_over_all_views_if_they_are_on_their_lines():
    px_behind = np.r_[np.full(6, 0.95), np.linspace(1.05, 9.0, 12), 50.0]
    px_off = np.r_[np.zeros(18), 2.05]  # the last one is a wrong match
    px_off[3:9] = 1.95
    scene = behind_scene(px_behind, px_off)
    found = negative_disparities(scene.tracks, scene.Ts)
    beyond = np.r_[np.where(px_behind > 1.0, px_behind, 0.0)[:18], np.zeros(81)]
    assert found.fraction == pytest.approx(12 / 99)
    assert found.px == pytest.approx(np.quantile(np.r_[beyond, beyond], 0.97), abs=1e-4)
    few = replace(scene.tracks, seen=scene.tracks.seen & (np.arange(100) >= 80))
    assert negative_disparities(few, scene.Ts) == Negative(0.0, 0.0)
    few.seen[1, -1] = False
    assert negative_disparities(replace(few), scene.Ts) is None


@pytest.mark.parametrize("off_px", [-30.0, -17.0, 0.0, 30.0])
def test_a_principal_point_that_is_off_to_one_side_alone_puts_matches_behind_infinity(off_px):
    """Depths are uniform in 2 to 8 m; a cx too small by d takes d from every disparity."""
    scene = make_scene(600, noise_px=0.15, poses=PARALLEL)
    disparity_px = K_RIGHTS[0][0, 0] * 0.3 * scene.inverse_depth
    K = K_RIGHTS[:1].copy()
    K[0, 0, 2] += off_px
    found = negative_disparities(replace(scene.tracks, K_rights=K), scene.Ts)
    assert found.fraction == pytest.approx((disparity_px < -off_px - 1.0).mean(), abs=0.01)
    assert found.px == pytest.approx(max(0.0, -off_px - disparity_px.min()), abs=0.8)
    assert found.fraction == 0.0 or off_px == -30.0


def test_matches_off_their_lines_do_not_count():
    scene = make_scene(600, poses=PARALLEL)
    off_lines = replace(scene.tracks, right_px=scene.tracks.right_px + [0.0, 3.0])
    assert negative_disparities(off_lines, scene.Ts) is None
    assert negative_disparities(scene.tracks.kept(slice(40)), scene.Ts) == Negative(0.0, 0.0)
    assert negative_disparities(scene.tracks.kept(slice(39)), scene.Ts) is None


@pytest.mark.parametrize(("count", "px"), [(8, 0.0), (20, 5.0)])
def test_single_matches_do_not_show_how_far_it_goes(count, px):
    """Of 600 matches 8 are 1.3 %, as of correct pairs; 20 are 3.3 %."""
    scene = make_scene(600, poses=PARALLEL)
    right_px = scene.tracks.right_px.copy()
    right_px[0, :count, 0] += K_RIGHTS[0][0, 0] * 0.3 * scene.inverse_depth[:count] + 5.0
    found = negative_disparities(replace(scene.tracks, right_px=right_px), scene.Ts)
    assert found.fraction == pytest.approx(count / 600) and found.px == pytest.approx(px, abs=1e-6)


def off_centre() -> Scene:
    """A parallel pair whose cx of the right camera is off by 30 px."""
    scene = make_scene(600, poses=PARALLEL)
    K = K_RIGHTS[:1].copy()
    K[0, 0, 2] -= 30.0
    scene.tracks = replace(scene.tracks, K_rights=K)
    return scene


def test_distances_are_in_pixels_of_the_left_image_under_the_poses_as_given():
    scene = off_centre()
    alone = negative_disparities(scene.tracks, scene.Ts)
    elsewhere = np.stack([moved(scene.Ts[0], np.full(6, 0.1))])
    found = NegativeDisparity.of_tracks(tracks_stage(scene.tracks, scene.Ts, elsewhere, size=(300, 1664)))
    assert (
        found.fraction == alone.fraction > 0.05 and found.px == pytest.approx(2 * alone.px) and found.px > 5
    )


def test_refined_poses_are_measured_again_and_others_keep_what_was_measured():
    scene, given = off_centre(), np.eye(4)[None]
    refined, kept = (PoseReport(status, (), ()) for status in ("refined", "kept"))
    found = NegativeDisparity.of_poses(poses_stage(refined, scene.tracks, scene.Ts, (300, 1664)))
    assert found == NegativeDisparity.of_tracks(tracks_stage(scene.tracks, scene.Ts, size=(300, 1664)))
    assert NegativeDisparity.of_poses(poses_stage(kept, scene.tracks, given)) is None
    assert NegativeDisparity.of_poses(poses_stage(kept, None, scene.Ts)) is None


def test_an_unknown_fraction_is_not_ruled_out():
    assert NegativeDisparity.rules_out(Negative(0.02, 9.0)) and not NegativeDisparity.rules_out(None)


ASSUMED = (Finding("camera.assumed-cx", "cx is assumed."),)


@pytest.mark.parametrize(
    ("fraction", "findings", "expected"),
    [
        (0.049, (), []),
        (0.051, (), ["depth.negative-disparity"]),
        (0.049, ASSUMED, []),
        (0.051, ASSUMED, ["camera.cx-mismatch"]),
    ],
)
def test_an_assumed_centre_is_the_likeliest_cause(fraction, findings, expected):
    assert codes(good(Negative(fraction, 3.0), findings=findings)) == expected


@pytest.mark.parametrize(
    ("fact", "code"),
    [
        (Preference(True), "depth.inverted-order"),
        (FoundErrors((PoseError("depth.inverted-order"),)), "depth.inverted-order"),
        (FoundErrors((PoseError("pose.opengl"),)), "pose.opengl"),
        (FoundErrors((PoseError("camera.scaled", 2.0),)), "camera.scaled"),
        (Correlation(-0.5), "depth.inverted-order"),
    ],
)
@pytest.mark.parametrize("findings", [(), ASSUMED], ids=["own centre", "assumed centre"])
def test_a_reported_error_explains_negative_disparities(fact, code, findings):
    assert codes(good(Negative(0.9, 3.0), fact, findings=findings)) == [code]


def test_the_finding_states_how_many_and_how_far():
    own, assumed = good(Negative(0.3456, 12.6)), good(Negative(0.3456, 12.6), findings=ASSUMED)
    assert "35 % of the matches have negative disparity" in judged(own, "depth.negative-disparity")
    finding = judged(assumed, "camera.cx-mismatch")
    assert "35 % of the matches" in finding and "the right cx is off by at least 13 px" in finding
    assert "possibly more" in finding and "check one known distance" in finding


@pytest.mark.parametrize(("fraction", "px"), [(0.04, 0.0), (0.0401, 2.5)])
def test_more_of_them_than_correct_pairs_have_are_an_error_of_matches(fraction, px):
    assert NegativeDisparity.match_error(sheet(Negative(fraction, 2.5))) == MatchError(px=px)


@pytest.mark.end_to_end
def test_a_principal_point_that_is_off_is_found_in_images_of_distant_objects():
    rig = render_pair(0, size=(240, 320), posed=False)
    left_01, K_left = rig.left.image_01.float(), rig.K_left.float()
    T = torch.linalg.inv(rig.E).float()
    disparity_px = float(K_left[0, 0] * rig.E[0, 3] / rig.left.depth_m.median())
    fractions = []
    for off_px in (0.0, disparity_px):  # what is further than the median is then beyond infinity
        K_right = rig.K_right.float().clone()
        K_right[0, 2] -= off_px
        view = view_of(rig.right.image_01.float(), K_right, T)
        facts = checked_views(PosedViews(view_of(left_01, K_left), (view,))).facts
        fractions.append(facts[NegativeDisparity].fraction)
    assert fractions[0] < 0.02 and fractions[1] > 0.2


@pytest.mark.end_to_end
def test_a_centre_that_is_not_as_assumed_is_reported_in_pixels_and_lowers_confidence():
    """The right cx is larger by 6 px: of the shifts -3, 5 and 11 px the first are beyond infinity."""
    left, right, shifts = pair_of_shifts(-3, 5, 11)
    K_right = K_WALLS.copy()
    K_right[0, 2] += 6
    own = guided(left, right, shifts, (K_WALLS, K_right))
    assert own.verdicts[0].trusted and own.verdicts[0].facts[NegativeDisparity].px == 0
    for cameras, code in ((K_WALLS, "camera.cx-mismatch"), ((K_WALLS, K_WALLS), "depth.negative-disparity")):
        out = guided(left, right, shifts, cameras)
        (verdict,) = out.verdicts
        (reason,) = [each for each in verdict.reasons if each.code in (code, "depth.negative-disparity")]
        assert reason.code == code
        assert verdict.facts[NegativeDisparity].px == pytest.approx(3, abs=0.5)
        of_centre = "by at least 3 px, possibly more" in reason
        assert of_centre is (cameras is K_WALLS)
        assert out.confidence[0, 68:].mean() < 0.4 < 0.8 < own.confidence[0, 68:].mean()
