"""Every field of a batch's output, of which no two images, members or numbers are alike."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin._threads import BackgroundTask
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.estimate import NO_UNIT
from geodiff_plugin.result.finish import ImageResult
from geodiff_plugin.result.output import MetricDepthOutput, image_labels, stack_results
from geodiff_plugin.types import Indicators, PosedViews, PoseReport, StepReport, Verdict

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
WRONG = Message("views.same", "The same picture.")
REMARK, MISTAKE, REFINED = (
    Message("views.bars", "Bars."),
    Message("camera.scaled", "K is scaled."),
    Message("pose.refined", "Refined."),
)


def pose(seed: int) -> np.ndarray:
    E = np.eye(4)
    E[:3] = np.random.default_rng(seed).normal(size=(3, 4))
    return E


def report(i: int) -> PoseReport:
    """Of two right views."""
    given, used = (pose(4 * i), pose(4 * i + 1)), (pose(4 * i + 2), pose(4 * i + 3))
    return PoseReport("refined", given, used, warnings=(REFINED, MISTAKE) if i == 1 else ())


def result_of(i: int, **changes) -> ImageResult:
    """The result of image ``i``, drawn at random."""
    rng = np.random.default_rng(10 + i)
    left = torch.zeros(3, *SIZE)
    task = BackgroundTask.known(report(i))
    native = PosedViews(left, (), torch.eye(3))
    maps = {name: torch.from_numpy(rng.random((1, 1, *SIZE))).float() for name in MAPS if name != "visible"}
    numbers = {
        name: torch.from_numpy(rng.random(MEMBERS)).float() for name in ("scale", "shift", "global_scale")
    }
    status, reasons = ("not trusted", (WRONG,)) if i == 2 else ("trusted", ())
    remarks = (REMARK,) if i == 0 else ()
    result = ImageResult(
        evidence=Evidence(native, native, None, None, report=task),
        K=torch.from_numpy(rng.random((3, 3))).float(),
        **numbers,
        **maps,
        verdict=Verdict(status, reasons, remarks, Indicators()),
        visible_share=(0.31, 0.29, 1.0)[i],
        visible=torch.from_numpy(rng.random((1, 1, *SIZE)) > 0.5),
        prior_error=torch.from_numpy(rng.random((1, 1, 4, 6))).float(),
        over_prior=torch.from_numpy(rng.uniform(2.0, 3.0, (MEMBERS, 24))).float(),
    )
    return replace(result, **changes)


def step(k: int) -> StepReport:
    numbers = (torch.rand(COUNT, generator=torch.Generator().manual_seed(10 * k + j)) for j in range(3))
    return StepReport(k, 900.0 - k, *numbers)


def guidance(**changes):
    return SimpleNamespace(**{"estimated": None, "unit": "m", "assumed": []} | changes)


@pytest.mark.parametrize("as_numpy", [True, False])
def test_every_field_of_the_output_is_that_of_its_image(as_numpy):
    results = [result_of(i) for i in range(COUNT)]
    history, extras = [step(0), step(1)], {"normals": torch.rand(COUNT, 3, *SIZE), "nothing": None}
    assumed = [Message("camera.same-centre", "cx is assumed.")]
    found = stack_results(
        results, guidance(assumed=assumed), history, remarks=(REFINED,), extras=extras, as_numpy=as_numpy
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
    np.testing.assert_array_equal(found.K, np.stack([result.K for result in results]))
    assert isinstance(found.K, kind)
    assert found.history == history and found.poses == [result.evidence.report.result() for result in results]
    assert found.verdicts == [result.verdict for result in results]
    assert found.assumed == assumed and found.unit == "m" and found.latent is None
    assert found.scale_from is None and found.scale_spread is None and found.rescaled == 1.0
    assert found.warnings == [
        "Image 1: Bars.",
        "Image 2: Only 29% of the left image is seen by a right camera at this depth; few pixels determine "
        "the scale.",
        "Image 2: Refined.",
        "Image 3: Do not trust this depth: The same picture.",
        "Refined.",
    ]
    assert [m.code for m in found.warnings] == [
        "views.bars",
        "views.overlap",
        "pose.refined",
        "verdict.not-trusted",
        "pose.refined",
    ]
    names = {field.name for field in fields(MetricDepthOutput)}
    checked = {*MAPS.values(), "scale", "shift", "global_scale", "prior_scale", "prior_error", "K", "history"}
    checked |= {"poses", "verdicts", "assumed", "unit", "latent", "scale_from", "scale_spread", "rescaled"}
    assert names == checked | {"warnings", "extras"}


@pytest.mark.parametrize("name", [*list(MAPS)[1:], "prior_error", "over_prior"])
def test_what_one_image_lacks_the_output_lacks(name):
    results = [result_of(0), result_of(1, **{name: None})]
    found = stack_results(results, guidance(), [])
    changed = {"over_prior": "prior_scale"}.get(name, MAPS.get(name, name))
    for field in (*MAPS.values(), "prior_error", "prior_scale"):
        assert (getattr(found, field) is None) == (field == changed)


def test_a_single_image_has_no_number_and_no_map_is_copied():
    bare = replace(result_of(2).evidence, report=None)
    result = result_of(2, visible_share=0.3, evidence=bare)
    found = stack_results([result], guidance(), [], as_numpy=False)
    assert found.warnings == ["Do not trust this depth: The same picture."] and found.poses == []
    assert found.prediction is result.depth_m and found.extras == {}
    assert image_labels(1) == [""] and image_labels(3) == ["Image 1: ", "Image 2: ", "Image 3: "]


def test_estimated_cameras_bring_their_scale_and_warnings():
    scale = SimpleNamespace(source="known length", spread=0.07)
    estimated = SimpleNamespace(warnings=(NO_UNIT,), scale=scale)
    found = stack_results(
        [result_of(1, visible_share=0.9)], guidance(estimated=estimated), [], remarks=(REMARK,)
    )
    assert (found.scale_from, found.scale_spread) == ("known length", 0.07)
    assert found.warnings == ["Refined.", NO_UNIT, "Bars."]


@pytest.mark.parametrize("lacking", [(), ("uncertainty",)])
def test_lengths_without_a_unit_become_the_priors_metres(lacking):
    """Every length is divided by the median ratio to the prior; what has no length stays as it is."""
    results = [result_of(i, **dict.fromkeys(lacking)) for i in range(COUNT)]
    estimated = SimpleNamespace(warnings=(NO_UNIT, REMARK), scale=SimpleNamespace(source="none", spread=None))
    history = [step(0), step(1)]
    given = results, guidance(unit=None, estimated=estimated), history
    found = stack_results(*given)
    same = stack_results(results, guidance(estimated=estimated), history)
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
    assert found.scale_spread == pytest.approx(spread, rel=1e-5) and 0.05 < spread < 0.5
    assert NO_UNIT in same.warnings and NO_UNIT not in found.warnings
    *others, last = found.warnings
    assert others == [message for message in same.warnings if message != NO_UNIT]
    assert last.code == "scale.from-prior" and f"differ by {100 * spread:.0f} % in the median" in last


def test_without_a_metric_prior_lengths_keep_their_unit():
    found = stack_results([result_of(0, over_prior=None)], guidance(unit=None), [])
    assert found.unit is None and found.scale_from is None and found.rescaled == 1.0
    np.testing.assert_array_equal(found.prediction[..., 0], result_of(0).depth_m[:, 0])
