"""Every field of a batch's output, of which no two images, members or numbers are alike."""

import math
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin._internal.camera_checks import check_posed_camera
from geodiff_plugin._internal.reprojection import maps_in_camera
from geodiff_plugin.cameras import Camera, PosedViews
from geodiff_plugin.capture.results import _write_agreed
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.points import read_ply_points
from geodiff_plugin.jobs.report import depth_summary, valid_depth
from geodiff_plugin.jobs.writing import pixels_of, write_maps
from geodiff_plugin.pose.estimate import NO_UNIT
from geodiff_plugin.result.finish import ImageResult
from geodiff_plugin.result.output import MetricDepthOutput, image_labels, stack_results
from geodiff_plugin.result.sigma import depth_sigma, geometric_sigma
from geodiff_plugin.trust import KINDS, FactSheet, MatchedFraction, Verdict
from geodiff_plugin.types import PoseReport, StepReport
from tests.unit.trust.walls import BASELINE_M, guided, pair_of_shifts
from tests.views import posed_frame, view_of

END_TO_END = pytest.mark.end_to_end

COUNT, MEMBERS, SIZE = 3, 2, (5, 7)
MAPS = {
    "depth_m": "prediction",
    "uncertainty": "uncertainty",
    "relative": "relative",
    "visible": "visible",
    "photometric_error": "photometric_error",
    "confidence": "confidence",
    "support": "support",
}
WRONG, REMARK, REFINED, CENTRE = (
    Finding(KINDS["views.identical"], "The same image."),
    Finding(KINDS["views.letterbox"], "Bars."),
    Finding(KINDS["pose.refined"], "Refined."),
    Finding("camera.assumed-cx", "cx is assumed."),
)


def pose(seed: int) -> np.ndarray:
    E = np.eye(4)
    E[:3] = np.random.default_rng(seed).normal(size=(3, 4))
    return E


def report(i: int) -> PoseReport:
    """Of two right views."""
    given, used = (pose(4 * i), pose(4 * i + 1)), (pose(4 * i + 2), pose(4 * i + 3))
    return PoseReport("refined", given, used)


def result_of(i: int, **changes) -> ImageResult:
    """The result of image ``i``, drawn at random."""
    rng = np.random.default_rng(10 + i)
    left = torch.zeros(3, *SIZE)
    native = PosedViews(view_of(left, torch.eye(3)), ())
    maps = {name: torch.from_numpy(rng.random((1, 1, *SIZE))).float() for name in MAPS if name != "visible"}
    numbers = {
        name: torch.from_numpy(rng.random(MEMBERS)).float() for name in ("scale", "shift", "global_scale")
    }
    status, findings = (("trusted", (REMARK,)), ("trusted", (REFINED,)), ("not trusted", (WRONG, REFINED)))[i]
    result = ImageResult(
        evidence=Evidence(native, native, None, None, report=report(i)),
        camera=Camera(rng.random((3, 3)).astype(np.float32), SIZE[::-1]),
        **numbers,
        **maps,
        verdict=Verdict(status, findings, FactSheet()),
        visible=torch.from_numpy(rng.random((1, 1, *SIZE)) > 0.5),
        prior_error=torch.from_numpy(rng.random((1, 1, 4, 6))).float(),
        over_prior=torch.from_numpy(rng.uniform(2.0, 3.0, (MEMBERS, 24))).float(),
        measurable_m=torch.tensor([20.0 + i]),
    )
    return replace(result, **changes)


def step(k: int) -> StepReport:
    numbers = (torch.rand(COUNT, generator=torch.Generator().manual_seed(10 * k + j)) for j in range(3))
    return StepReport(k, 900.0 - k, *numbers)


def guidance(**changes):
    return SimpleNamespace(**{"estimated": None, "unit": "m", "makes_holes": False} | changes)


@pytest.mark.parametrize("as_numpy", [True, False])
def test_every_field_of_the_output_is_that_of_its_image(as_numpy):
    results = [result_of(i) for i in range(COUNT)]
    history, extras = [step(0), step(1)], {"normals": torch.rand(COUNT, 3, *SIZE), "nothing": None}
    found = stack_results(
        results, guidance(), history, findings=(CENTRE, REFINED, CENTRE), extras=extras, as_numpy=as_numpy
    )

    def expected(name: str) -> np.ndarray:
        together = np.concatenate([getattr(result, name).numpy() for result in results])
        return together.transpose(0, 2, 3, 1) if as_numpy else together

    kind = np.ndarray if as_numpy else torch.Tensor
    for name, field in MAPS.items():
        assert isinstance(getattr(found, field), kind)
        np.testing.assert_array_equal(getattr(found, field), expected(name), err_msg=name)
    normals = extras["normals"].permute(0, 2, 3, 1) if as_numpy else extras["normals"]
    np.testing.assert_array_equal(found.extras["normals"], normals)
    assert found.extras["nothing"] is None
    for name in ("scale", "shift", "global_scale"):
        np.testing.assert_array_equal(getattr(found, name), np.stack([getattr(r, name) for r in results]))
    medians = np.stack([np.quantile(r.over_prior, 0.5, axis=1, method="lower") for r in results])
    np.testing.assert_allclose(found.prior_scale, medians)
    np.testing.assert_array_equal(found.prior_error, [result.prior_error.min() for result in results])
    np.testing.assert_array_equal(found.measurable_m, [20.0 + i for i in range(COUNT)])
    np.testing.assert_array_equal(found.K, np.stack([result.camera.K for result in results]))
    assert isinstance(found.K, kind)
    assert found.history == history and found.poses == [result.evidence.report for result in results]
    assert found.verdicts == [result.verdict for result in results]
    assert found.unit == "m" and found.latent is None
    assert found.scale_from is None and found.scale_rel_std is None and found.rescaled == 1.0
    assert [(finding.code, str(finding)) for finding in found.findings] == [
        ("views.letterbox", "Image 1: Bars."),
        ("pose.refined", "Image 2: Refined."),
        ("views.identical", "Image 3: The same image."),
        ("pose.refined", "Image 3: Refined."),
        ("camera.assumed-cx", "cx is assumed."),
        ("pose.refined", "Refined."),
    ]
    names = {field.name for field in fields(MetricDepthOutput)}
    checked = {*MAPS.values(), "scale", "shift", "global_scale", "prior_scale", "prior_error", "K", "history"}
    checked |= {"poses", "verdicts", "unit", "latent", "scale_from", "scale_rel_std", "rescaled"}
    assert names == checked | {"findings", "extras", "measurable_m"}


def test_ratios_to_the_prior_are_unknown_where_pixels_are_not_valid():
    """They change neither the scale from the prior nor its spread."""
    results = [result_of(i) for i in range(COUNT)]
    partly = [
        replace(each, over_prior=torch.cat([each.over_prior, torch.full((MEMBERS, 40), math.nan)], 1))
        for each in results
    ]
    expected, found = (stack_results(each, guidance(unit=None), []) for each in (results, partly))
    for name in ("prior_scale", "rescaled", "scale_rel_std", "prediction"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


@pytest.mark.parametrize("name", [*list(MAPS)[1:], "prior_error", "over_prior"])
def test_what_one_image_lacks_the_output_lacks(name):
    results = [result_of(0), result_of(1, **{name: None})]
    found = stack_results(results, guidance(), [])
    changed = {"over_prior": "prior_scale"}.get(name, MAPS.get(name, name))
    for field in (*MAPS.values(), "prior_error", "prior_scale"):
        assert (getattr(found, field) is None) == (field == changed)


def test_a_single_image_has_no_number_and_no_map_is_copied():
    bare = replace(result_of(2).evidence, report=None)
    result = result_of(2, evidence=bare)
    found = stack_results([result], guidance(), [], as_numpy=False)
    assert found.findings == [WRONG, REFINED] and found.poses == []
    assert found.prediction is result.depth_m and found.extras == {}
    assert image_labels(1) == [""] and image_labels(3) == ["Image 1: ", "Image 2: ", "Image 3: "]


def test_estimated_cameras_bring_their_scale():
    estimated = SimpleNamespace(scale=SimpleNamespace(source="known length", spread=0.07))
    found = stack_results([result_of(1)], guidance(estimated=estimated), [], findings=(NO_UNIT, REMARK))
    assert (found.scale_from, found.scale_rel_std) == ("known length", 0.07)
    assert found.findings == [REFINED, NO_UNIT, REMARK]


@pytest.mark.parametrize("lacking", [(), ("uncertainty",)])
def test_lengths_without_a_unit_become_the_priors_metres(lacking):
    """Every length is divided by the median ratio to the prior; what has no length stays as it is."""
    results = [result_of(i, **dict.fromkeys(lacking)) for i in range(COUNT)]
    estimated = SimpleNamespace(scale=SimpleNamespace(source="none", spread=None))
    history = [step(0), step(1)]
    given = results, guidance(unit=None, estimated=estimated), history
    found = stack_results(*given, findings=(NO_UNIT, CENTRE))
    same = stack_results(results, guidance(estimated=estimated), history, findings=(NO_UNIT, CENTRE))
    ratios = np.concatenate([result.over_prior.numpy().ravel() for result in results])
    factor = 1 / np.quantile(ratios, 0.5, method="lower")
    spread = 1.4826 * np.quantile(np.abs(np.log(ratios * factor)), 0.5, method="lower")
    np.testing.assert_allclose(found.prediction, same.prediction * factor, rtol=1e-6)
    if lacking:
        assert found.uncertainty is None
    else:
        np.testing.assert_allclose(found.uncertainty, same.uncertainty * factor, rtol=1e-6)
    for name in ("global_scale", "prior_scale"):
        np.testing.assert_allclose(getattr(found, name), getattr(same, name) * factor, rtol=1e-6)
    for name in ("scale", "shift", "relative", "confidence", "K", "prior_error"):
        np.testing.assert_array_equal(getattr(found, name), getattr(same, name))
    for step_found, step_given in zip(found.history, history, strict=True):
        np.testing.assert_allclose(step_found.g_s, step_given.g_s * factor, rtol=1e-6)
        assert step_found.s_hat is step_given.s_hat and step_found.timestep == step_given.timestep
    for pose_found, pose_given in zip(found.poses, same.poses, strict=True):
        for E_found, E in zip(
            (*pose_found.E, *pose_found.E_given), (*pose_given.E, *pose_given.E_given), strict=True
        ):
            np.testing.assert_array_equal(E_found[:3, :3], E[:3, :3])
            np.testing.assert_allclose(E_found[:3, 3], E[:3, 3] * factor)
            np.testing.assert_array_equal(E_found[3], (0, 0, 0, 1))
    assert (found.unit, found.scale_from) == ("m", "prior") and found.rescaled == pytest.approx(factor)
    assert found.scale_rel_std == pytest.approx(spread, rel=1e-5) and 0.05 < spread < 0.5
    assert NO_UNIT in same.findings and NO_UNIT not in found.findings
    *others, last = found.findings
    assert others == [finding for finding in same.findings if finding != NO_UNIT]
    assert last.code == "scale.from-prior" and f"differ by {100 * spread:.0f} % (median)" in last


def test_without_a_metric_prior_lengths_keep_their_unit():
    found = stack_results([result_of(0, over_prior=None)], guidance(unit=None), [])
    assert found.unit is None and found.scale_from is None and found.rescaled == 1.0
    np.testing.assert_array_equal(found.prediction[..., 0], result_of(0).depth_m[:, 0])


K = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
FAR = np.s_[:10]  # rows of a sky
REACH_M = 40.0


def output(**changed) -> MetricDepthOutput:
    """A wall 2 m away below a sky as far away as the cameras can measure."""
    depth_m, confidence = np.full((48, 64), 2.0, np.float32), np.full((48, 64), 0.9, np.float32)
    depth_m[FAR], confidence[FAR] = REACH_M, 0.0
    shaped = {"prediction": depth_m[None, ..., None], "confidence": confidence[None, ..., None], "K": K[None]}
    return MetricDepthOutput(**(shaped | changed))


@END_TO_END
def test_there_is_a_depth_where_it_and_its_confidence_are_above_0():
    for confidence, known in ((output().confidence, 38 * 64), (None, 48 * 64)):
        made = output(confidence=confidence)
        assert made.valid.dtype == bool and made.valid.shape == (1, 48, 64, 1) and made.valid.sum() == known
    zero = output(prediction=np.zeros((1, 48, 64, 1), np.float32))
    assert not zero.valid.any()
    tensors = {
        name: torch.from_numpy(getattr(output(), name)).permute(0, 3, 1, 2)
        for name in ("prediction", "confidence")
    }
    made = output(**tensors)
    assert made.valid.shape == (1, 1, 48, 64) and made.valid.sum() == 38 * 64


@pytest.mark.parametrize("as_numpy", [True, False])
def test_sigma_follows_every_images_own_confidence_pose_and_spread(as_numpy):
    results = [result_of(i) for i in range(COUNT)]
    stacked = stack_results(results, guidance(), [], as_numpy=as_numpy)
    assert stacked.sigma.shape == stacked.prediction.shape
    assert isinstance(stacked.sigma, np.ndarray if as_numpy else torch.Tensor)
    assert stacked.sigma is stacked.sigma, "computed once"
    for i, result in enumerate(results):
        depth_m, confidence, deviation_m = (
            getattr(result, name)[0, 0].numpy() for name in ("depth_m", "confidence", "uncertainty")
        )
        geometric_m = geometric_sigma(depth_m, result.camera.K.astype(float), report(i).E, FactSheet())
        alone = depth_sigma(depth_m, confidence, geometric_m, deviation_m)
        np.testing.assert_allclose(np.asarray(stacked.sigma[i]).reshape(SIZE), alone, rtol=1e-5)
    assert replace(stacked, confidence=None).sigma is None


def made_with_holes(as_numpy: bool, **thresholds):
    stacked = stack_results([result_of(i) for i in range(COUNT)], guidance(), [], as_numpy=as_numpy)
    return stacked, stacked.with_holes(**thresholds)


@pytest.mark.parametrize("as_numpy", [True, False])
def test_holes_are_depths_below_the_confidence_or_above_the_sigma(as_numpy):
    stacked, _ = made_with_holes(as_numpy)
    confidence, sigma = np.asarray(stacked.confidence), np.asarray(stacked.sigma)
    largest = float(np.nanmedian(sigma))
    for thresholds, kept in (
        ({}, confidence > 0),
        ({"min_confidence": 0.4}, confidence >= 0.4),
        ({"max_sigma": largest}, sigma <= largest),
        ({"min_confidence": 0.4, "max_sigma": largest}, (confidence >= 0.4) & (sigma <= largest)),
    ):
        stacked, holed = made_with_holes(as_numpy, **thresholds)
        assert kept.sum() > 0 and (not thresholds or kept.sum() < kept.size)
        np.testing.assert_array_equal(np.asarray(stacked.reliable(**thresholds)), kept)
        for name in ("prediction", "confidence", "uncertainty"):
            values = np.asarray(getattr(stacked, name))
            np.testing.assert_array_equal(np.asarray(getattr(holed, name)), np.where(kept, values, 0), name)
        np.testing.assert_array_equal(np.isnan(np.asarray(holed.sigma)), ~kept)
        np.testing.assert_array_equal(np.asarray(holed.valid), kept)
        assert type(holed.prediction) is type(stacked.prediction) and holed.verdicts is stacked.verdicts


def test_no_depth_is_known_to_pass_a_threshold_without_a_confidence():
    bare = replace(made_with_holes(True)[0], confidence=None)
    assert bare.reliable().all()
    assert not bare.reliable(min_confidence=0.01).any() and not bare.reliable(max_sigma=99.0).any()


def test_a_call_removes_depths_only_if_its_guidance_asks_for_it():
    results = [result_of(i) for i in range(COUNT)]
    plain = stack_results(results, guidance(), [])
    given = {"min_confidence": 0.4, "max_sigma": None}
    same = stack_results(results, guidance(**given), [])
    np.testing.assert_array_equal(same.prediction, plain.prediction)
    holed = stack_results(results, guidance(**given, makes_holes=True), [])
    np.testing.assert_array_equal(holed.prediction, np.where(plain.confidence >= 0.4, plain.prediction, 0))


@END_TO_END
def test_maps_stay_finite_and_everything_else_leaves_it_out(tmp_path):
    image = np.full((48, 64, 3), 0.5, np.float32)
    counts = write_maps(tmp_path, output(), image)
    assert np.load(tmp_path / "depth.npy")[FAR].tolist() == np.full((10, 64), REACH_M).tolist()
    millimetres = np.asarray(Image.open(tmp_path / "depth_mm.png"))
    assert (millimetres[FAR] == 0).all() and (millimetres[10:] == 2000).all()
    points = read_ply_points(tmp_path / "cloud.ply")
    assert len(points) == counts["cloud_points"] <= 38 * 64 and points[:, 2].max() == 2.0
    assert counts["points_out_of_reach"] == 640 and counts["doubtful_points"] == 0
    depth_m, _, _, keep = pixels_of(output(), image, 0.0)
    assert not keep[FAR].any() and keep[12:].all() and depth_m[0, 0] == REACH_M
    assert depth_summary(depth_m, None, output().valid[0, ..., 0])["max_m"] == 2.0


@END_TO_END
def test_another_camera_does_not_see_it():
    E, size = np.eye(4), (64, 48)
    camera = check_posed_camera(K, E, size)
    unknown = np.where(output().valid, output().prediction, 0.0)[0, ..., 0]
    seen, sigma = (maps[0, ..., 0] for maps in output().reproject(K, E, size))
    expected = maps_in_camera(unknown, output().sigma[0, ..., 0], Camera(K), camera)
    np.testing.assert_array_equal((seen, sigma), expected)
    assert (seen[:9] == 0).all() and (seen[12:40] == 2.0).all()
    np.testing.assert_array_equal(np.isfinite(sigma), seen > 0)


@END_TO_END
def test_bags_and_frames_of_captures_leave_it_out(tmp_path):
    depth, confidence = (getattr(output(), name)[0, ..., 0] for name in ("prediction", "confidence"))
    np.save(tmp_path / "depth.npy", depth)
    np.testing.assert_array_equal(valid_depth(tmp_path), depth)  # of a preset without confidence
    np.save(tmp_path / "confidence.npy", confidence)
    np.testing.assert_array_equal(valid_depth(tmp_path), np.where(confidence > 0, depth, 0))
    count = np.ones((48, 64), np.uint8)
    frame = posed_frame("a", depth, confidence, K, np.eye(4), count, count)
    _write_agreed(tmp_path, replace(frame, sigma=0.01 * depth), "m")
    assert (np.asarray(Image.open(tmp_path / "depth_mm.png"))[FAR] == 0).all()
    assert (np.load(tmp_path / "depth.npy")[FAR] == REACH_M).all()


@END_TO_END
@pytest.mark.parametrize("far_px", [0, 3])
def test_a_sky_has_none_and_that_makes_no_result_less_trusted(far_px):
    """A sky that shifts by nothing between the views, or by what can be measured, above two walls."""
    pair = pair_of_shifts(far_px, 8, 14)
    reach_m = 120 * BASELINE_M / 0.3
    out = guided(*pair)
    at_reach = out.prediction[0, ..., 0] > 0.999 * reach_m
    assert np.isfinite(out.prediction).all() and not at_reach[36:].any()
    assert at_reach[:28].mean() > 0.9 if far_px == 0 else not at_reach.any()
    np.testing.assert_array_equal(out.confidence[0, ..., 0] == 0, at_reach)
    (verdict,) = out.verdicts
    assert verdict.trusted, verdict.reasons
    higher = verdict.facts[MatchedFraction].confidence - out.confidence.mean()
    assert higher > 0.1 if far_px == 0 else higher == pytest.approx(0, abs=1e-6)
    given = guided(*pair, depth_range=(0.5, 10 * reach_m))
    assert (given.confidence > 0).all(), "the user says that things are further away"
