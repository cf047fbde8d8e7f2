"""What is wrong is named, what is right is left in peace; confidence pixel by pixel."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin._checks import InputError
from geodiff_plugin.matching import Matches
from geodiff_plugin.messages import Message
from geodiff_plugin.result.confidence import Grounds, depth_confidence, grounds_of
from geodiff_plugin.result.verdict import judge
from geodiff_plugin.types import Indicators, Tear
from tests.scenes import render_pair

GOOD = Indicators(
    confidence=0.85, matched=0.8, rank_correlation=0.8, spread=0.7, baseline_m=0.12, view_deg=60.0
)
ROW = {"points": 448, "cover": 0.125}
ONE_POINT = {"points": 1, "matched": math.nan, "confidence": math.nan}


def test_a_good_run_is_trusted_in_silence():
    verdict = judge(GOOD)
    assert verdict.trusted and not verdict.reasons and not verdict.remarks and verdict.sentence == ""
    nothing = judge(Indicators())
    assert nothing.status == "not judged" and not nothing.trusted and "not judged" in nothing.sentence
    for signs in (
        {"prior_ratio": 1.4, "view_deg": 21.0},
        {"epipolar_px": 1.5, "scale_spread": 0.09},
        {"scale_spread": 0.2, "points": 99},  # known depths give the scale
        {"on_edge": True},  # a street's sky
        {"confidence": 0.52},  # one weak indicator alone
        {"matched": 0.35},
        {"rank_correlation": 0.0, "spread": 0.1},  # a scene that is nearly flat
        {"rank_correlation": 0.1, "matched": 0.95},  # a poor prior under good matches
    ):
        assert judge(replace(GOOD, **signs)).trusted and not judge(replace(GOOD, **signs)).remarks
    assert judge(Indicators(points=99, cover=0.5)).trusted
    assert all(judge(Indicators(**few)).status == "not judged" for few in ({"points": 49, "cover": 1}, ROW))


@pytest.mark.parametrize(
    ("signs", "words"),
    [
        ({"same": True, "matched": 1.0, "confidence": 1.0}, "same picture"),
        ({"flat": True, "spread": 0.01, "rank_correlation": 0.05}, "shifted copy"),
        (
            {
                "inverse_fits": True,
                "mistakes": (Message("camera.scaled", "K may be for an image 2 times as large."),),
            },
            "swapped.*2 times",
        ),
        ({"rank_correlation": -0.57}, "swapped"),
        ({"rank_correlation": -0.57, "spread": math.nan}, "swapped"),  # it may be wide
        ({"rank_correlation": 0.05, "spread": math.nan, "matched": 0.45}, "hardly agree"),
        ({"rank_correlation": 0.05, "matched": 0.45}, "hardly agree"),
        ({"confidence": 0.25}, "Likely causes"),
        ({"matched": 0.05}, "5 % of the left image is matched"),
        ({"confidence": 0.4, "matched": 0.25}, "Likely causes"),
        ({"confidence": 0.52, "matched": 0.35}, "35 % of the left image is matched and the mean confidence"),
        ({"confidence": 0.52, "epipolar_px": 1.5}, "the mean confidence is 0.52"),
        ({"points_ratio": 0.256, "points": 99}, "read as millimetres: give the points' scale as 256"),
        ({"points_ratio": 1000.0, "points": 99}, "millimetres taken for metres"),
        ({"points_ratio": 3.0, "points": 99}, "3 times as far"),
        ({"epipolar_px": 9.5}, "9.5 px off"),
        ({"epipolar_px": 1.5, "confidence": 0.45}, "Likely causes"),
        (ONE_POINT, "Too few known depths to fix scale and shift: 1;"),
        (
            {"points": 99, "cover": 1.0, "matched": math.nan, "rank_correlation": 0.1},
            "known depths disagree",
        ),
        ({"at_end": 0.26}, "26 % of the matches lie at an end"),
        ({"baseline_m": 0.00012}, "0.12 mm"),
        (
            {
                "rank_correlation": -0.9,
                "doubts": (Message("camera.principal-point", "K is for another image."),),
            },
            "depth: K is for another image",
        ),
        ({"off_matches": 0.4}, "differs by 49 %"),
        ({"scale_spread": 0.16}, "uncertain by 16 %"),
        ({"scale_spread": 0.16, "points": 2, "given_px": 15.2}, "depth: E misses the matches by 15 px"),
        ({"scale_spread": 0.08, "depth_spread": 0.14}, "by 8 %, and another pose .* by 15 %"),
        ({"pose_unchecked": True, "matched": 0.4}, "Nothing shows whether the pose is right"),
    ],
)
def test_reasons(signs, words):
    verdict = judge(replace(GOOD, **signs))
    assert not verdict.trusted
    assert verdict.sentence.startswith("Do not trust this depth: ")
    assert re.search(words, verdict.sentence)


@pytest.mark.parametrize(
    ("signs", "words"),
    [
        ({"view_deg": 12.0}, "12 degrees"),
        ({"prior_ratio": 2.1}, "2.1 times the prior's own metres"),
        ({"points_ratio": 1.15, "points": 99}, "1.15 times as far"),
        ({"points": 1}, "Known depths that lie in the image: 1"),
        ({"epipolar_px": 2.4}, "2.4 px off"),
        ({"on_edge": True, "at_end": 0.2}, "ended on the edge"),
    ],
)
def test_remarks(signs, words):
    verdict = judge(replace(GOOD, **signs))
    assert verdict.trusted and any(words in remark for remark in verdict.remarks)


@pytest.mark.parametrize(
    ("signs", "code"),
    [
        # A rectified rig in centimetres before a scene of half a metre or more.
        ({"baseline_m": 7.5, "scene_m": 51.0, "rectified": True}, "pose.unit"),
        ({"baseline_m": 7.5, "scene_m": 49.0, "rectified": True}, None),
        # Of other poses, a drone's are that long.
        ({"baseline_m": 7.5, "scene_m": 199.0}, None),
        ({"baseline_m": 7.5, "scene_m": 201.0}, "pose.unit"),
        ({"baseline_m": 4.9, "scene_m": 400.0, "rectified": True}, None),
        ({"baseline_m": 5.1, "scene_m": 400.0, "rectified": True}, "pose.unit"),
        ({"baseline_m": 10.0, "scene_m": 1999.0}, "pose.unit"),
        ({"baseline_m": 10.0, "scene_m": 2001.0}, None),
        ({"baseline_m": 10.0}, None),
        ({"baseline_m": 10.0, "scene_m": 400.0, "points_ratio": 1.0, "points": 50}, "pose.unit"),
        ({"baseline_m": 10.0, "scene_m": 400.0, "range_given": True, "at_end": 0.19}, None),
        ({"baseline_m": 10.0, "scene_m": 400.0, "range_given": True, "at_end": 0.21}, "pose.unit"),
        ({"prior_ratio": 19.0}, None),
        ({"prior_ratio": 21.0}, "prior.unit"),
        ({"prior_ratio": 1 / 19.0}, None),
        ({"prior_ratio": 1 / 21.0}, "prior.unit"),
        ({"prior_ratio": 21.0, "range_given": True}, None),
    ],
)
def test_a_doubted_unit_is_not_trusted_unless_the_range_is_stated(signs, code):
    found = [reason.code for reason in judge(replace(GOOD, **signs)).reasons]
    assert [each for each in found if each != "depth.range"] == ([] if code is None else [code])


@pytest.mark.parametrize(
    ("signs", "code"),
    [
        ({"behind_infinity": 0.049}, None),
        ({"behind_infinity": 0.051}, "views.behind-infinity"),
        ({"behind_infinity": 0.049, "centre_assumed": True}, None),
        ({"behind_infinity": 0.051, "centre_assumed": True}, "camera.other-centre"),
        ({"behind_infinity": math.nan}, None),
        ({"distortion": 0.109}, None),
        ({"distortion": 0.111}, "views.distorted"),
        ({"distortion": -0.109}, None),
        ({"distortion": -0.111}, "views.distorted"),
        ({"distortion": math.nan}, None),
        ({"distortion": -0.3, "distortion_alone": -0.111}, "views.distorted"),
        ({"distortion": -0.3, "distortion_alone": -0.109}, "views.bent"),
        ({"distortion": -0.109, "distortion_alone": 0.0}, None),
        ({"tear": Tear(1, 160, -30)}, "views.torn"),
        ({"tear": None}, None),
        ({"shear": 0.0049}, None),
        ({"shear": 0.0051}, "views.sheared"),
        ({"shear": -0.0051}, "views.sheared"),
    ],
)
def test_what_the_matches_show_of_cameras_and_lenses(signs, code):
    found = [reason.code for reason in judge(replace(GOOD, **signs)).reasons]
    assert found == ([] if code is None else [code])


def test_a_named_mistake_explains_diverging_rays():
    for signs in ({"inverse_fits": True}, {"mistakes": (Message("pose.opengl", "OpenGL."),)}):
        codes = [reason.code for reason in judge(replace(GOOD, behind_infinity=0.9, **signs)).reasons]
        assert codes and "views.behind-infinity" not in codes
    exchanged = replace(GOOD, behind_infinity=0.9, rank_correlation=-0.5)
    assert [reason.code for reason in judge(exchanged).reasons] == ["depth.exchanged"]


def test_a_stated_range_removes_the_doubt_about_a_long_baseline_and_no_other():
    long = Message("baseline.long", "E has a baseline of 25 m.")
    other = Message("camera.principal-point", "K is for another image.")
    doubted = replace(GOOD, baseline_m=25.0, doubts=(long, other))
    assert [reason.code for reason in judge(doubted).reasons] == [long.code, other.code]
    stated = replace(doubted, range_given=True)
    assert [reason.code for reason in judge(stated).reasons] == [other.code]


def test_an_end_at_the_edge_of_the_search_is_told_beside_a_reason():
    (remark,) = judge(replace(GOOD, on_edge=True, off_matches=0.4)).remarks
    assert remark.code == "depth.search-edge"


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
        return pipe(left, guidance=GeometryGuidance(right, K, E, inner_steps=0, **options), strict=strict)

    return call


def test_a_rendered_pair_right_and_wrong(run, scene):
    left, right, K, E, _ = scene
    good = run(strict=True)
    assert good.verdicts[0].trusted and good.warnings == []
    assert "cx is assumed" in good.assumed[0] and run(K=(K, K)).assumed == []
    assert "trusted" in repr(good) and len(repr(good).splitlines()) < 8
    for wrong, words in (
        ({"left": right, "right": left}, "swapped"),
        ({"E": np.linalg.inv(E)}, "swapped"),
        ({"right": left.copy()}, "same picture"),
        ({"right": np.roll(left, -6, axis=1)}, "shifted copy"),
    ):
        out = run(**wrong)
        assert not out.verdicts[0].trusted and words in " ".join(out.warnings)
    black = np.zeros_like(left)
    assert not run(left=black, right=black).verdicts[0].indicators.same
    with pytest.warns(UserWarning, match="Do not trust this depth"):
        run(right=left.copy())
    with pytest.raises(InputError, match="Do not trust this depth"):
        run(right=np.ascontiguousarray(right[:, ::-1]), strict=True)


def test_depth_is_at_most_what_the_cameras_can_measure(run, scene):
    _, _, K, E, depth = scene
    out = run()
    reach_m = K[0, 0] * E[0, 3] / 0.3
    assert out.prediction.max() <= reach_m * 1.01
    # Far things under a tenth of the baseline: the sky of this scene.
    shorter = np.ones((4, 4))
    shorter[:3, 3] = 0.1
    assert run(E=E * shorter).prediction.max() <= 0.1 * reach_m * 1.01


def test_centimetres_for_metres_are_never_trusted(run, scene):
    _, _, _, E, depth = scene
    longer = np.ones((4, 4))
    longer[:3, 3] = 100.0
    wrong = run(E=E * longer)
    (reason,) = wrong.verdicts[0].reasons
    assert reason.code == "pose.unit" and "in centimetres, divide it by 100" in reason
    found = wrong.verdicts[0].indicators
    assert found.rectified and found.scene_m == pytest.approx(100 * np.median(depth), rel=0.1)
    with pytest.raises(InputError, match="in centimetres"):
        run(E=E * longer, strict=True)
    assert run(E=E * longer, unit=None).verdicts[0].trusted, "lengths without a unit are not doubted"
    stated = (50 * depth.min(), 200 * depth.max())
    assert run(E=E * longer, depth_range=stated).verdicts[0].trusted
    assert not run(E=E * longer, depth_range=(depth.min(), depth.max())).verdicts[0].trusted


@pytest.mark.filterwarnings("ignore:points has depths")
@pytest.mark.parametrize(("factor", "words"), [(0.256, "1/256"), (1000.0, "millimetres")])
def test_points_that_contradict_the_views(run, scene, factor, words):
    known = np.zeros_like(scene[4])
    known[4::9, 4::9] = scene[4][4::9, 4::9]
    right = run(points=known)
    assert right.verdicts[0].trusted
    wrong = run(points=factor * known)
    assert not wrong.verdicts[0].trusted and words in " ".join(wrong.warnings)
    assert wrong.confidence.mean() < 0.45 * right.confidence.mean()


def _maps(*values: float) -> torch.Tensor:
    return torch.tensor(values).view(1, 1, 1, -1)


@pytest.mark.parametrize(
    ("support", "spread", "way"),
    [((0.0, 0.95, 1.0), None, 1), ((0.9,) * 3, (0.0, 0.05, 0.5), -1)],
)
def test_rises_with_support_and_falls_with_spread(support, spread, way):
    spread = None if spread is None else _maps(*spread)
    grounds = Grounds(_maps(*support), *(_maps(x, x, x) for x in (1.0, 0.02, 0.03)))
    found = depth_confidence(grounds, spread).flatten()
    assert (way * found.diff() > 0).all() and found.min() > 0 and found.max() < 1


@pytest.mark.parametrize("name", ["apart", "moved", "stepped"])
def test_falls_with_the_distance_of_matches_the_last_correction_and_steps_beside_it(name):
    grounds = Grounds(*(_maps(x, x, x) for x in (0.9, 1.0, 0.02, 0.03)))
    grounds = grounds._replace(**{name: getattr(grounds, name) * _maps(1.0, 3.0, 9.0)})
    found = depth_confidence(grounds, None).flatten()
    assert (found.diff() < -0.02).all()


def test_a_step_of_depth_reaches_some_pixels_to_both_sides():
    depth_m = torch.full((1, 1, 20, 40), 2.0)
    depth_m[..., 20:] = 3.0
    target = Matches(1.0 / depth_m, torch.ones_like(depth_m), torch.tensor([0.004]))
    stepped = grounds_of(depth_m, depth_m, target, torch.ones_like(depth_m)).stepped
    expected = torch.zeros(40)
    expected[16:24] = math.log(1.5)
    torch.testing.assert_close(stepped[0, 0, 10], expected)


def test_grounds_are_means_over_a_window_of_matches():
    """Matches two planes off on the left, none on the right; all depths were lowered by a tenth."""
    depth_m = torch.full((1, 1, 50, 90), 2.0)
    confidence = torch.zeros(1, 1, 50, 90)
    confidence[..., :40] = 0.5
    target = Matches(torch.full_like(confidence, 0.5 + 2 * 0.004), confidence, torch.tensor([0.004]))
    found = grounds_of(1.1 * depth_m, depth_m, target, 0.3 * torch.ones_like(depth_m))
    matched = 0.5 * 40 / 90
    share = matched / (matched + 0.02)
    moved = math.log(1.1) ** share * 0.2 ** (1 - share)  # the fewer matches, the nearer to the largest
    torch.testing.assert_close(found.moved, torch.full_like(depth_m, moved))
    assert (found.support == 0.3).all()
    # Among matches that are there, beside their border, where the window holds half of them, and far from it.
    for column, share in ((10, 1.0), (39, 16 / 31), (89, 0.0)):
        weight = 0.5 * share
        expected = (2.0 * weight + 0.02 * 10.0) / (weight + 0.02)
        assert float(found.apart[0, 0, 25, column]) == pytest.approx(expected, rel=1e-3)
