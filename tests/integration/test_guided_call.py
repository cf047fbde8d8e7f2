"""The guided call end to end on tiny random pipelines: what it changes, and what it leaves alone."""

import gc
import json
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import (
    DDIMScheduler,
    DDPMScheduler,
    DiffusionPipeline,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    LCMScheduler,
)
from PIL import Image

from geodiff_plugin import (
    GeometryGuidance,
    GuidedMarigoldDepthPipeline,
    disable_geometry_guidance,
    enable_geometry_guidance,
)
from geodiff_plugin.algorithm.optimizers import OPTIMIZERS
from geodiff_plugin.algorithm.terms import TERMS, Term
from geodiff_plugin.config import GuidanceConfig, UpdatePlan
from geodiff_plugin.runtime.run import GuidedRun
from tests.contracts.tiny_priors import make_e2e_ft
from tests.tiny import SCHEDULER, guided_call, quiet, seeded

pytestmark = pytest.mark.end_to_end

FAST = {"guidance_steps": 2, "min_steps": 1, "sweep_pixels": 64 * 48}
PHOTOMETRIC = {"photometric": 1.0}  # alone: matches would also correct the map
FULL = {"gradient": "full"}
BOTH_GRADIENTS = pytest.mark.parametrize("gradient", ["denoised", "full"])


class Guided:
    """A tiny pipeline with guided calls of few updates on a pair, and its stock call."""

    def __init__(self, pipe, pair):
        self.pipe, self.pair = enable_geometry_guidance(pipe), pair

    def __call__(self, parameters=None, **call):
        return guided_call(self.pipe, self.pair, FAST | (parameters or {}), **call)

    def stock(self, **call):
        return self.pipe(self.pair.left, generator=seeded(), output_latent=True, **call)


@pytest.fixture
def guided(make_pipeline, textured_plane):
    return Guided(make_pipeline(), textured_plane)


def assert_same(a, b):
    np.testing.assert_array_equal(a.prediction, b.prediction)
    assert torch.equal(a.latent, b.latent)


@BOTH_GRADIENTS
def test_a_call_gives_metres_leaves_the_pipeline_as_it_was_and_nothing_alive(guided, monkeypatch, gradient):
    """The collector of cycles is off: it knows nothing of a device's memory."""
    pipe, runs, begin = guided.pipe, [], GuidedRun.__init__
    reference = guided.stock()

    def remembered(run, *args, **kwargs):
        runs.append(weakref.ref(run))
        begin(run, *args, **kwargs)

    monkeypatch.setattr(GuidedRun, "__init__", remembered)
    pipe.unet.conv_in.weight.requires_grad_(False)
    scheduler = pipe.scheduler
    gc.collect()
    gc.disable()
    try:
        out = guided({"gradient": gradient})
        assert [run() for run in runs] == [None]
    finally:
        gc.enable()
    assert pipe.scheduler is scheduler and not {"step", "set_timesteps"} & set(vars(scheduler))
    assert "forward" not in vars(pipe.unet) and not hasattr(pipe.unet, "_diffusers_hook")
    assert not pipe.unet.conv_in.weight.requires_grad and pipe.unet.conv_out.weight.requires_grad
    assert all(p.grad is None for p in pipe.unet.parameters())
    assert_same(guided.stock(), reference)
    shape = (1, 48, 64, 1)
    for values in (out.prediction, out.visible, out.photometric_error, out.relative):
        assert values.shape == shape
    assert np.isfinite(out.prediction).all() and (out.prediction > 0).all() and out.visible.dtype == bool
    assert out.scale.shape == out.shift.shape == out.global_scale.shape == (1, 1)
    np.testing.assert_allclose(out.K[0], guided.pair.K)
    assert [r.step for r in out.history] == [0, 1] and out.uncertainty is None and out.latent is None


@pytest.mark.parametrize("error", [RuntimeError("mine"), KeyboardInterrupt()])
def test_a_failing_call_leaves_the_pipeline_as_it_was(guided, error):
    def fail(pipe, i, t, values):
        raise error

    reference = guided.stock()
    with pytest.raises(type(error)):
        guided(FULL | {"weights": PHOTOMETRIC}, callback_on_step_end=fail)
    assert all(p.requires_grad for p in guided.pipe.unet.parameters())
    assert_same(guided.stock(), reference)


@BOTH_GRADIENTS
def test_scale_and_shift_only_leaves_latents_untouched(guided, gradient):
    """S5.3, Table 4."""
    out = guided({"optimize_latents": False, "gradient": gradient}, output_latent=True)
    assert torch.equal(out.latent, guided.stock().latent)
    assert out.history[0].s_hat != out.history[1].s_hat


def test_batches_and_ensembles(guided):
    call = {"ensemble_size": 3, "output_uncertainty": True}
    one, two = (guided({"weights": PHOTOMETRIC}, batch_size=size, **call) for size in (1, 2))
    np.testing.assert_allclose(one.prediction, two.prediction, rtol=2e-3)
    assert one.uncertainty.shape == (1, 48, 64, 1) and one.scale.shape == (1, 3)
    pair = guided.pair
    bigger = np.asarray(Image.fromarray(pair.right).resize((96, 72)))
    K_bigger = np.diag([1.5, 1.5, 1]) @ pair.K + np.array([[0, 0, 0.25], [0, 0, 0.25], [0, 0, 0]])
    both = GeometryGuidance([pair.right, bigger], [pair.K, (pair.K, K_bigger)], pair.E, **FAST)
    noise = torch.randn(1, 4, 24, 32, generator=seeded())
    out = guided.pipe([pair.left] * 2, guidance=both, latents=noise.repeat(2, 1, 1, 1), batch_size=2)
    assert out.prediction.shape == (2, 48, 64, 1) and out.K.shape == (2, 3, 3)
    np.testing.assert_allclose(out.prediction[:1], guided(latents=noise).prediction, rtol=2e-3)


def test_stock_arguments_keep_their_meaning(guided):
    call = {"match_input_resolution": False, "output_type": "pt", "output_latent": True}
    small = guided(processing_resolution=32, num_inference_steps=1, **call)
    assert small.prediction.shape == (1, 1, 24, 32) and small.visible.shape == (1, 1, 24, 32)
    assert small.latent.shape == (1, 4, 12, 16)
    assert small.K[0, 0, 0] == pytest.approx(30.0) and small.K[0, 0, 2] == pytest.approx(15.5)
    parts = guided(return_dict=False, num_inference_steps=1)
    assert isinstance(parts, tuple) and len(parts) == 3 and parts[1] is None and parts[2] is None


def test_a_callback_sees_and_replaces(guided):
    seen = []

    def zero(pipe, i, t, values):
        seen.append((i, int(t), set(values)))
        return {"latents": torch.zeros_like(values["latents"])}

    assert guided(callback_on_step_end=zero, output_latent=True).latent.abs().max() == 0
    names = {"latents", "metric_depth", "loss", "scale", "shift"}
    assert seen == [(0, 999, names), (1, 499, names)]

    def add_in_place(pipe, i, t, values):
        values["latents"] += 0.5

    alone, same, moved = (
        guided({"guidance_steps": 0}, callback_on_step_end=f).prediction
        for f in (None, lambda _pipe, _i, _t, values: values, add_in_place)
    )
    assert np.array_equal(same, alone) and not np.array_equal(moved, alone)


def test_what_a_callback_changes_after_the_last_step_is_in_the_result(guided):
    """Also where the result would start from the corrected map of that step without another decode."""

    def add_at_last(pipe, i, t, values):
        if i == 1:
            values["latents"] += 0.5

    alone, moved = (
        guided({"guidance_steps": 0}, callback_on_step_end=f).prediction for f in (None, add_at_last)
    )
    assert not np.array_equal(moved, alone)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ([1.0], "the return value of callback_on_step_end must be a dict or None"),
        (
            {"latents": None},
            "latents in the return value of callback_on_step_end must be a tensor of.*; got NoneType",
        ),
        ({"latents": torch.zeros(1, 2, 24, 32)}, r"of shape \(1, 4, 24, 32\); got \(1, 2, 24, 32\)"),
        ({"latents": torch.full((1, 4, 24, 32), torch.nan)}, "must be finite; got NaN or infinity"),
    ],
)
def test_an_invalid_return_value_of_a_callback_is_reported(guided, answer, message):
    with pytest.raises((ValueError, TypeError), match=message):
        guided({"weights": PHOTOMETRIC}, callback_on_step_end=lambda *_: answer)


@pytest.mark.parametrize("refine_edges", [True, False])
def test_bicubic_enlargement_stays_within_the_map(make_oracle, textured_plane, refine_edges):
    """It overshoots at a step of depth, below 0 m from 3 m to 60 m."""
    relative = np.zeros((24, 32), np.float32)
    relative[:, 16:] = 1.0
    parameters = {"depth_range": (3.0, 60.0), "refine_edges": refine_edges}
    call = {"processing_resolution": 32, "resample_method_output": "bicubic"}
    depth_m = guided_call(make_oracle(relative), textured_plane, parameters, **call).prediction
    assert np.isfinite(depth_m).all() and depth_m.min() > 0


BETAS = {"beta_schedule": "scaled_linear", "beta_start": 0.00085, "beta_end": 0.012}
V = BETAS | {"prediction_type": "v_prediction"}
EPSILON = {"prediction_type": "epsilon", "rescale_betas_zero_snr": False}
LEADING = {"timestep_spacing": "leading", "rescale_betas_zero_snr": False}
SCHEDULERS = {
    "ddim-leading": lambda: DDIMScheduler(**SCHEDULER | LEADING),
    "ddim-zero-snr": lambda: DDIMScheduler(**SCHEDULER),
    "ddim-epsilon": lambda: DDIMScheduler(**SCHEDULER | EPSILON),
    "ddim-sample": lambda: DDIMScheduler(**SCHEDULER | {"prediction_type": "sample"}),
    "lcm": lambda: LCMScheduler(**V),
    "ddpm": lambda: DDPMScheduler(**V, clip_sample=False),
    "dpm": lambda: DPMSolverMultistepScheduler(**V),
}


@pytest.mark.parametrize("name", SCHEDULERS)
def test_every_scheduler_is_guided_and_restored(make_pipeline, textured_plane, name):
    """With the gradient through the network at every other one; the kinds of the gradient meet above."""
    guided = Guided(make_pipeline(SCHEDULERS[name]()), textured_plane)
    reference = guided.stock(num_inference_steps=3)
    gradient = "full" if list(SCHEDULERS).index(name) % 2 else "denoised"
    out = guided({"gradient": gradient, "match_fits": 3, "guidance_steps": 1}, num_inference_steps=3)
    assert np.isfinite(out.prediction).all() and len(out.history) == 3
    assert_same(guided.stock(num_inference_steps=3), reference)


def test_leading_ddim_runs_as_trailing_unless_disabled(make_pipeline, textured_plane):
    guided, steps = Guided(make_pipeline(SCHEDULERS["ddim-leading"]()), textured_plane), []
    call = {"callback_on_step_end": lambda _pipe, _i, t, _values: steps.append(int(t))}
    for parameters in ({}, {"trailing_spacing": False}):
        guided({"guidance_steps": 0} | parameters, num_inference_steps=4, **call)
    assert steps == [999, 749, 499, 249, 750, 500, 250, 0]


def test_saved_while_enabled_it_is_a_stock_pipeline(make_pipeline, tmp_path, guided):
    stock = make_pipeline()
    assert enable_geometry_guidance(guided.pipe) is guided.pipe  # once more
    guided.pipe.save_pretrained(tmp_path)
    index = json.loads((tmp_path / "model_index.json").read_text())
    assert index["_class_name"] == "MarigoldDepthPipeline"
    assert index["scheduler"] == ["diffusers", "DDIMScheduler"]
    again = quiet(DiffusionPipeline.from_pretrained(tmp_path))
    assert type(again) is type(stock)
    expected, found = (pipe(guided.pair.left, generator=seeded()).prediction for pipe in (stock, again))
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    made = GuidedMarigoldDepthPipeline.from_pretrained(tmp_path)
    for pipe in (made, guided.pipe):
        assert isinstance(pipe, GuidedMarigoldDepthPipeline)
    assert type(disable_geometry_guidance(disable_geometry_guidance(guided.pipe))) is type(stock)


def test_inference_mode_forbids_updates_alone(guided):
    with torch.inference_mode():
        with pytest.raises(RuntimeError, match="inference_mode"):
            guided()
        assert np.isfinite(guided({"guidance_steps": 0}, num_inference_steps=1).prediction).all()


def _sequential(pipe):
    pipe.unet.conv_in._hf_hook = type("AlignDevicesHook", (), {"offload": True})()


def _scheduled(make, **options):
    return lambda pipe: setattr(pipe, "scheduler", make(**options))


CAST = torch.bfloat16, torch.float32


@pytest.mark.parametrize(
    ("change", "parameters", "message"),
    [
        (_scheduled(EulerDiscreteScheduler), {}, "EulerDiscreteScheduler"),
        (_scheduled(DDIMScheduler, **SCHEDULER, thresholding=True), {}, "thresholding"),
        (
            _scheduled(DDIMScheduler, **SCHEDULER | {"prediction_type": "epsilon"}),
            {},
            "rescale_betas_zero_snr",
        ),
        (_sequential, {}, "sequential"),
        (lambda p: setattr(p, "_all_hooks", [object()]), FULL, "enable_model_cpu_offload"),
        (lambda p: p.vae.enable_layerwise_casting(*CAST), {}, "layerwise casting"),
        (lambda p: p.unet.enable_layerwise_casting(*CAST), FULL, "layerwise casting"),
    ],
)
def test_what_cannot_be_guided_is_rejected_before_anything_is_computed(
    guided, monkeypatch, change, parameters, message
):
    monkeypatch.setattr(GeometryGuidance, "prepare", lambda *_: pytest.fail("the views were swept first"))
    change(guided.pipe)
    with pytest.raises((TypeError, ValueError), match=message):
        guided(parameters)


def test_bad_arguments_of_a_call_are_named(guided):
    pair = guided.pair
    with pytest.raises(TypeError, match="guidance must be a GeometryGuidance"):
        guided.pipe(pair.left, guidance={"right": pair.right})
    larger = np.diag([3.0, 3.0, 1.0]) @ pair.K
    with pytest.raises(ValueError, match="a different resolution"):
        guided_call(guided.pipe, pair, GeometryGuidance(pair.right, (larger, pair.K), pair.E))
    with pytest.raises(TypeError, match="adapter"):
        enable_geometry_guidance(object())


def test_a_subclass_that_hides_the_stock_arguments_is_rejected(make_pipeline):
    pipe = make_pipeline()
    pipe.__class__ = type("Hides", (type(pipe),), {"__call__": lambda self, image, **kwargs: None})
    with pytest.raises(ValueError, match=r"must name the arguments .*missing: output_type.*Write them out"):
        enable_geometry_guidance(pipe)


@pytest.mark.parametrize("prediction_type", ["depth", "disparity"])
def test_with_an_oracle_prior_the_scale_is_found(make_oracle, textured_plane, prediction_type):
    """The denoiser knows depth up to an affine map; the right view gives the metres within 2 %."""
    ground_truth = textured_plane.depth_m
    value = ground_truth if prediction_type == "depth" else 1.0 / ground_truth
    relative = 0.4 + 0.7 * (value - value.min()) / (value.max() - value.min())
    guided = Guided(make_oracle(relative.astype(np.float32), prediction_type), textured_plane)
    ratio = guided({"guidance_steps": 10}).prediction[0, ..., 0] / ground_truth
    assert abs(np.median(ratio) - 1.0) < 0.02
    assert np.mean(np.abs(ratio - 1.0)) < 0.03


STEP = 0.02


def constant(rate):
    """The same step whatever the gradient is, so that a test knows where an update ends."""
    return SimpleNamespace(step=lambda gradient, reference=None: torch.full_like(gradient, STEP))


def test_later_rounds_are_anchored_to_the_network_and_all_corrections(textured_plane, monkeypatch):
    """Each correction moves the anchor as far as the latent; an update moves the latent alone."""
    seen = []

    def spy(estimate):
        if estimate.z0.requires_grad:
            seen.append((estimate.z0.detach().clone(), estimate.anchor.clone()))
        return (estimate.z0 - estimate.anchor).square().flatten(1).mean(1)

    monkeypatch.setitem(TERMS, "spy", Term(spy))
    monkeypatch.setitem(OPTIMIZERS, "constant", constant)
    monkeypatch.setattr(GuidanceConfig, "plan_updates", lambda *_args, **_kw: UpdatePlan(1, 0.0, 0.03))
    parameters = {
        "optimizer": "constant",
        "guidance_steps": 1,
        "min_steps": 3,
        "weights": {"matches": 1.0, "spy": 1.0},
    }
    guided_call(make_e2e_ft(), textured_plane, parameters)
    assert len(seen) == 3
    torch.testing.assert_close(seen[0][0], seen[0][1])  # the first round starts from the anchor
    for (z, anchor), (next_z, next_anchor) in zip(seen, seen[1:], strict=False):
        moved = next_z - (z + STEP)
        assert moved.abs().max() > 1e-3
        torch.testing.assert_close(next_anchor - anchor, moved, atol=1e-5, rtol=0)
