"""The guided call end to end on tiny random pipelines: what it changes, and what it leaves alone."""

from __future__ import annotations

import gc
import json
import threading
import warnings
import weakref

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
    InputError,
    disable_geometry_guidance,
    enable_geometry_guidance,
)
from geodiff_plugin.algorithm.gradients import RULES
from geodiff_plugin.runtime.run import GuidedRun
from tests.conftest import SCHEDULER, plane_pair

FAST = {"inner_steps": 2, "min_steps": 1}
PHOTOMETRIC = {"photometric": 1.0}  # alone: matches would also correct the map
BOTH_GRADIENTS = pytest.mark.parametrize("gradient", ["denoised", "full"])


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def stock(pipe, image, **kwargs):
    return pipe(image, generator=seeded(), output_latent=True, **kwargs)


def guidance_for(pair, **knobs):
    return GeometryGuidance(pair.right, pair.K, pair.E, **(FAST | knobs))


class Guided:
    """A tiny pipeline, and guided calls of it on a pair: knobs of the guidance, keywords of the call."""

    def __init__(self, pipe, pair):
        self.pipe, self.pair, self.left = enable_geometry_guidance(pipe), pair, Image.fromarray(pair.left)

    def __call__(self, guidance=None, image=None, /, **call):
        given = isinstance(guidance, GeometryGuidance)
        guidance = guidance if given else guidance_for(self.pair, **(guidance or {}))
        image = self.left if image is None else image
        drawn = {} if "latents" in call else {"generator": seeded()}
        return self.pipe(image, guidance=guidance, **(drawn | call))


@pytest.fixture
def guided(make_pipeline, textured_plane):
    return Guided(make_pipeline(), textured_plane)


@pytest.fixture
def left(textured_plane):
    return Image.fromarray(textured_plane.left)


def assert_same(a, b):
    np.testing.assert_array_equal(a.prediction, b.prediction)
    assert torch.equal(a.latent, b.latent)


def test_without_guidance_it_is_the_stock_call(make_pipeline, left):
    reference = stock(make_pipeline(), left, ensemble_size=3, batch_size=2)
    pipe = make_pipeline()
    cls = type(pipe)
    assert enable_geometry_guidance(enable_geometry_guidance(pipe)) is pipe and isinstance(pipe, cls)
    assert_same(stock(pipe, left, ensemble_size=3, batch_size=2), reference)
    disable_geometry_guidance(disable_geometry_guidance(pipe))
    assert type(pipe) is cls
    assert_same(stock(pipe, left, ensemble_size=3, batch_size=2), reference)


@BOTH_GRADIENTS
def test_a_call_gives_metres_leaves_the_pipeline_as_it_was_and_nothing_alive(guided, monkeypatch, gradient):
    """The collector of cycles is off: it knows nothing of a device's memory."""
    pipe, runs, begin = guided.pipe, [], GuidedRun.__init__
    reference = stock(pipe, guided.left)

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
    assert_same(stock(pipe, guided.left), reference)

    shape = (1, 48, 64, 1)
    assert out.prediction.shape == out.visible.shape == out.photometric_error.shape == shape
    assert np.isfinite(out.prediction).all() and (out.prediction > 0).all()
    assert out.relative.shape == shape and out.visible.dtype == bool
    assert out.scale.shape == out.shift.shape == out.global_scale.shape == (1, 1)
    np.testing.assert_allclose(out.K[0], guided.pair.K)
    assert [r.step for r in out.history] == [0, 1]
    assert out.uncertainty is None and out.latent is None


@pytest.mark.parametrize("error", [RuntimeError("mine"), KeyboardInterrupt()])
def test_a_failing_call_leaves_the_pipeline_as_it_was(guided, error):
    def fail(pipe, i, t, values):
        raise error

    reference = stock(guided.pipe, guided.left)
    with pytest.raises(type(error)):
        guided({"gradient": "full", "weights": PHOTOMETRIC}, callback_on_step_end=fail)
    assert not {"step", "set_timesteps"} & set(vars(guided.pipe.scheduler))
    assert all(p.requires_grad for p in guided.pipe.unet.parameters())
    assert_same(stock(guided.pipe, guided.left), reference)


def test_the_loss_falls(guided):
    still, moved = (guided({"inner_steps": n, "weights": PHOTOMETRIC}) for n in (0, 8))
    error = [o.photometric_error.sum() / o.visible.sum() for o in (still, moved)]
    assert error[1] < error[0]


@BOTH_GRADIENTS
def test_scale_and_shift_only_leaves_latents_untouched(guided, gradient):
    """S5.3, Table 4."""
    reference = stock(guided.pipe, guided.left)
    out = guided({"optimize_latents": False, "gradient": gradient}, output_latent=True)
    assert torch.equal(out.latent, reference.latent)
    assert out.history[0].s_hat != out.history[1].s_hat


def test_outside_start_and_stop_nothing_is_updated(guided):
    reference = stock(guided.pipe, guided.left)
    out = guided({"start": 0.9, "stop": 1.0}, output_latent=True)
    assert torch.equal(out.latent, reference.latent)  # 2 steps at fractions 0 and 0.5


@pytest.mark.parametrize(
    "knobs, updates",
    [
        ({}, [0, 0, 0, 2]),  # matches are encoded at every step, photographs refine them at the last
        ({"stop": 0.5}, [0, 2, 0, 0]),
        ({"correct": False}, [2, 2, 2, 2]),
        ({"weights": PHOTOMETRIC}, [2, 2, 2, 2]),
    ],
)
def test_updates_wait_for_the_corrections(guided, monkeypatch, knobs, updates):
    made = [0]

    class Counted(RULES["adam"]):
        def step(self, gradient, *args):
            made[-1] += gradient.ndim == 4
            return super().step(gradient, *args)

    monkeypatch.setitem(RULES, "counted", Counted)
    guided({"rule": "counted"} | knobs, num_inference_steps=4, callback_on_step_end=lambda *_: made.append(0))
    assert made[:-1] == updates


def test_one_update_of_the_paper_is_algorithm_1(guided, textured_plane):
    """z_{t-1} of the guided call is the stock one minus 1e-2 times the gradient to z_t."""
    pair, call = textured_plane, {"num_inference_steps": 1}
    reference, moves = stock(guided.pipe, guided.left, **call).latent, []
    for rate in (1e-2, 2e-2):
        guidance = GeometryGuidance.paper(pair.right, pair.K, pair.E, step_latents=rate)
        moves.append(guided(guidance, output_latent=True, **call).latent - reference)
    assert moves[0].abs().max() > 0
    torch.testing.assert_close(moves[1], 2 * moves[0], atol=1e-6, rtol=0.05)


def test_a_call_that_hides_the_stock_arguments_is_refused(make_pipeline, textured_plane, left):
    pipe = make_pipeline()

    class Own(type(pipe)):
        def __call__(self, image, **kwargs):
            return super().__call__(image, **kwargs)

    pipe.__class__ = Own
    with pytest.raises(ValueError, match=r"must name the arguments .* no output_type.*write them out"):
        enable_geometry_guidance(pipe)(left, guidance=guidance_for(textured_plane))


def test_members_do_not_depend_on_the_batch_size(guided):
    call = {"ensemble_size": 3, "output_uncertainty": True}
    one, two = (guided({"weights": PHOTOMETRIC}, batch_size=size, **call) for size in (1, 2))
    np.testing.assert_allclose(one.prediction, two.prediction, rtol=2e-3)
    torch.testing.assert_close(one.scale, two.scale, rtol=2e-3, atol=0)
    assert one.uncertainty.shape == (1, 48, 64, 1) and one.scale.shape == (1, 3)


def test_a_batch_of_images_takes_one_right_view_each(guided):
    pair, left = guided.pair, guided.left
    bigger = np.asarray(Image.fromarray(pair.right).resize((96, 72)))
    K_bigger = np.diag([1.5, 1.5, 1]) @ pair.K + np.array([[0, 0, 0.25], [0, 0, 0.25], [0, 0, 0]])
    guidance = GeometryGuidance([pair.right, bigger], [pair.K, (pair.K, K_bigger)], pair.E, **FAST)
    noise = torch.randn(1, 4, 24, 32, generator=seeded())
    out = guided(guidance, [left, left], latents=noise.repeat(2, 1, 1, 1), batch_size=2)
    assert out.prediction.shape == (2, 48, 64, 1) and out.K.shape == (2, 3, 3)
    np.testing.assert_allclose(out.prediction[:1], guided(latents=noise).prediction, rtol=2e-3)
    with pytest.raises(ValueError, match="right must be a list of 1 images"):
        guided(guidance)


def test_stock_arguments_keep_their_meaning(guided):
    small = guided(
        processing_resolution=32,
        match_input_resolution=False,
        output_type="pt",
        output_latent=True,
        num_inference_steps=1,
    )
    assert small.prediction.shape == (1, 1, 24, 32) and small.visible.shape == (1, 1, 24, 32)
    assert small.latent.shape == (1, 4, 12, 16)
    assert small.K[0, 0, 0] == pytest.approx(30.0) and small.K[0, 0, 2] == pytest.approx(15.5)
    parts = guided(return_dict=False, num_inference_steps=1)
    assert isinstance(parts, tuple) and len(parts) == 3 and parts[1] is None and parts[2] is None


def test_a_one_step_default_is_not_enough_for_guidance(guided):
    for least, steps in ((1, 2), (3, 3)):  # the pipeline's own default is 2
        made = []
        guided({"min_steps": least}, callback_on_step_end=lambda _pipe, i, *_, made=made: made.append(i))
        assert made == list(range(steps))


def test_padding_is_not_part_of_the_result(guided):
    out = guided(None, Image.fromarray(guided.pair.left[:, :61]), processing_resolution=0)
    assert out.prediction.shape == (1, 48, 61, 1) and out.relative.shape == (1, 48, 61, 1)


def test_callback_sees_and_replaces(guided):
    seen = []

    def callback(pipe, i, t, values):
        seen.append((i, int(t), set(values)))
        return {"latents": torch.zeros_like(values["latents"])}

    out = guided(callback_on_step_end=callback, output_latent=True)
    assert [s[:2] for s in seen] == [(0, 999), (1, 499)]
    assert seen[0][2] == {"latents", "metric_depth", "loss", "scale", "shift"}
    assert out.latent.abs().max() == 0


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ([1.0], "the answer of callback_on_step_end must be a dict or None"),
        ({"latents": None}, "latents in the answer of callback_on_step_end must be a tensor; got NoneType"),
        ({"latents": torch.zeros(1, 2, 24, 32)}, r"of shape \(1, 4, 24, 32\); got shape \(1, 2, 24, 32\)"),
        ({"latents": torch.full((1, 4, 24, 32), torch.nan)}, "must be finite; got NaN or infinity"),
    ],
)
def test_a_bad_answer_of_a_callback_is_told_as_such(guided, answer, message):
    with pytest.raises((InputError, TypeError), match=message):
        guided({"weights": PHOTOMETRIC}, callback_on_step_end=lambda *_: answer)
    assert guided.pipe(guided.left).prediction is not None


def test_a_callback_that_hands_back_its_latents_changes_nothing(guided):
    def add_in_place(pipe, i, t, values):
        values["latents"] += 0.5

    def same(pipe, i, t, values):
        return values

    def copied(pipe, i, t, values):
        return {"latents": values["latents"].clone()}

    alone, *others = (
        guided({"inner_steps": 0}, callback_on_step_end=f).prediction
        for f in (None, same, copied, add_in_place)
    )
    assert [np.array_equal(other, alone) for other in others] == [True, True, False]


@pytest.mark.parametrize("knobs", [{}, {"crisp": False}])
def test_bicubic_enlargement_stays_within_the_map(make_oracle, textured_plane, knobs):
    """It overshoots at a step of depth, below 0 m from 3 m to 60 m."""
    relative = np.zeros((24, 32), np.float32)
    relative[:, 16:] = 1.0
    pair, guided = textured_plane, Guided(make_oracle(relative), textured_plane)
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, depth_range=(3.0, 60.0), **knobs)
    depth_m = guided(guidance, processing_resolution=32, resample_method_output="bicubic").prediction
    assert np.isfinite(depth_m).all() and depth_m.min() > 0


BETAS = {"beta_schedule": "scaled_linear", "beta_start": 0.00085, "beta_end": 0.012}
SCHEDULERS = {
    "ddim-leading": lambda: DDIMScheduler(
        **{**SCHEDULER, "timestep_spacing": "leading", "rescale_betas_zero_snr": False}
    ),
    "ddim-zero-snr": lambda: DDIMScheduler(**SCHEDULER),
    "ddim-epsilon": lambda: DDIMScheduler(
        **{**SCHEDULER, "prediction_type": "epsilon", "rescale_betas_zero_snr": False}
    ),
    "ddim-sample": lambda: DDIMScheduler(**{**SCHEDULER, "prediction_type": "sample"}),
    "lcm": lambda: LCMScheduler(**BETAS, prediction_type="v_prediction"),
    "ddpm": lambda: DDPMScheduler(**BETAS, prediction_type="v_prediction", clip_sample=False),
    "dpm": lambda: DPMSolverMultistepScheduler(**BETAS, prediction_type="v_prediction"),
}


@pytest.mark.parametrize("name", SCHEDULERS)
def test_every_scheduler_is_guided_and_restored(make_pipeline, textured_plane, name):
    """With the gradient through the network at every other one; the kinds of the gradient meet above."""
    guided = Guided(make_pipeline(SCHEDULERS[name]()), textured_plane)
    reference = stock(guided.pipe, guided.left, num_inference_steps=3)
    gradient = "full" if list(SCHEDULERS).index(name) % 2 else "denoised"
    out = guided({"gradient": gradient, "corrections": 3, "inner_steps": 1}, num_inference_steps=3)
    assert np.isfinite(out.prediction).all() and len(out.history) == 3
    assert_same(stock(guided.pipe, guided.left, num_inference_steps=3), reference)


def test_leading_ddim_runs_as_trailing_unless_told(make_pipeline, textured_plane):
    guided, steps = Guided(make_pipeline(SCHEDULERS["ddim-leading"]()), textured_plane), []

    def callback(pipe, i, t, values):
        steps.append(int(t))

    for knobs in ({}, {"respace": False}):
        guided({"inner_steps": 0} | knobs, callback_on_step_end=callback, num_inference_steps=4)
    assert steps == [999, 749, 499, 249, 750, 500, 250, 0]


def test_saved_while_enabled_it_is_a_stock_pipeline(make_pipeline, tmp_path, left):
    reference = stock(make_pipeline(), left)
    made = GuidedMarigoldDepthPipeline(
        **make_pipeline().components,
        prediction_type="depth",
        default_denoising_steps=2,
        default_processing_resolution=64,
    )
    for pipe in (enable_geometry_guidance(make_pipeline()), made):
        pipe.set_progress_bar_config(disable=True)
        pipe.save_pretrained(tmp_path / "p")
        assert isinstance(pipe, GuidedMarigoldDepthPipeline)
        index = json.loads((tmp_path / "p" / "model_index.json").read_text())
        assert index["_class_name"] == "MarigoldDepthPipeline"
        assert index["scheduler"] == ["diffusers", "DDIMScheduler"]
    again = DiffusionPipeline.from_pretrained(tmp_path / "p")
    again.set_progress_bar_config(disable=True)
    assert type(again).__name__ == "MarigoldDepthPipeline"
    np.testing.assert_allclose(stock(again, left).prediction, reference.prediction, rtol=1e-4)
    assert isinstance(
        GuidedMarigoldDepthPipeline.from_pretrained(tmp_path / "p"), GuidedMarigoldDepthPipeline
    )


def test_inference_mode_forbids_updates_alone(guided):
    with torch.inference_mode():
        with pytest.raises(RuntimeError, match="inference_mode"):
            guided()
        assert np.isfinite(guided({"inner_steps": 0}, num_inference_steps=1).prediction).all()


@pytest.mark.slow  # dynamo takes seconds to start
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # dynamo asks every tensor for it
@BOTH_GRADIENTS
def test_compiled_unet(guided, make_pipeline, textured_plane, gradient):
    compiled = Guided(make_pipeline(), textured_plane)
    compiled.pipe.unet = torch.compile(compiled.pipe.unet, backend="eager")
    plain, other = (call({"gradient": gradient}).prediction for call in (guided, compiled))
    np.testing.assert_allclose(plain, other, rtol=1e-4)


def _scheduler(pipe, scheduler):
    pipe.scheduler = scheduler


def _sequential(pipe):
    class FakeAlign:
        offload = True

    FakeAlign.__name__ = "AlignDevicesHook"
    pipe.unet.conv_in._hf_hook = FakeAlign()


@pytest.mark.parametrize(
    ("change", "knobs", "message"),
    [
        (lambda p: _scheduler(p, EulerDiscreteScheduler()), {}, "EulerDiscreteScheduler"),
        (
            lambda p: _scheduler(p, DDIMScheduler(**SCHEDULER, thresholding=True)),
            {},
            "without dynamic thresholding.*got DDIMScheduler with thresholding",
        ),
        (_sequential, {}, "sequential"),
        (lambda p: setattr(p, "_all_hooks", [object()]), {"gradient": "full"}, "enable_model_cpu_offload"),
        (
            lambda p: p.vae.enable_layerwise_casting(torch.bfloat16, torch.float32),
            {},
            "layerwise casting",
        ),
        (
            lambda p: p.unet.enable_layerwise_casting(torch.bfloat16, torch.float32),
            {"gradient": "full"},
            "layerwise casting",
        ),
    ],
)
def test_what_cannot_be_guided_is_refused_before_anything_is_computed(
    guided, monkeypatch, change, knobs, message
):
    monkeypatch.setattr(GeometryGuidance, "prepare", lambda *_: pytest.fail("the views were swept first"))
    change(guided.pipe)
    with pytest.raises((TypeError, ValueError), match=message):
        guided(knobs)


@pytest.mark.parametrize("part", ["vae", "unet"])
def test_layerwise_casting_without_gradients_is_fine(guided, part):
    getattr(guided.pipe, part).enable_layerwise_casting(torch.bfloat16, torch.float32)
    assert guided({"inner_steps": 0}, num_inference_steps=1).prediction.min() > 0


def test_bad_arguments_of_a_call_are_named(guided):
    pair = guided.pair
    with pytest.raises(TypeError, match="guidance must be a GeometryGuidance"):
        guided.pipe(guided.left, guidance={"right": guided.left})
    larger = np.diag([3.0, 3.0, 1.0]) @ pair.K
    with pytest.raises(ValueError, match="another resolution"):
        guided(GeometryGuidance(pair.right, (larger, pair.K), pair.E, **FAST))
    with pytest.raises(TypeError, match="adapter"):
        enable_geometry_guidance(object())


def test_saving_does_not_disturb_a_call_that_begins_meanwhile(guided, monkeypatch):
    inside, done, results = threading.Event(), threading.Event(), []

    def slow(self, *args):
        inside.set()
        assert done.wait(60)

    monkeypatch.setattr(DiffusionPipeline, "save_pretrained", slow)
    saving = threading.Thread(target=guided.pipe.save_pretrained, args=("nowhere",))
    saving.start()
    assert inside.wait(60)
    try:
        results.append(guided({"inner_steps": 0}, num_inference_steps=1).prediction)
    finally:
        done.set()
        saving.join()
    assert np.isfinite(results[0]).all()


def test_half_precision_keeps_the_photometric_gradient(guided, monkeypatch):
    """A pixel's share of the mean is below float16's least number."""
    moved = []

    class Spy(RULES["adam"]):
        def step(self, gradient, *args):
            if gradient.ndim == 4:
                moved.append((gradient != 0).float().mean())
            return super().step(gradient, *args)

    monkeypatch.setitem(RULES, "adam", Spy)
    guided.pipe.to(torch.float16)
    out = guided({"weights": {"photometric": 1e-3}}, num_inference_steps=1)
    assert np.isfinite(out.prediction).all()
    assert min(moved) > 0.9


def test_autocast_leaves_geometry_alone(guided):
    knobs = {"inner_steps": 0, "weights": PHOTOMETRIC}
    plain = guided(knobs)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = guided(knobs)
    assert np.median(np.abs(mixed.prediction / plain.prediction - 1)) < 0.02
    assert mixed.prediction.dtype == np.float32


def test_autocast_holds_for_every_call_of_the_network(guided, monkeypatch):
    """The second update calls the network again, from within the guided step, which leaves autocast."""
    forward, precisions = guided.pipe.unet.forward, []

    def recorded(*args, **kwargs):
        enabled = torch.is_autocast_enabled("cpu")
        precisions.append(torch.get_autocast_dtype("cpu") if enabled else None)
        return forward(*args, **kwargs)

    monkeypatch.setattr(guided.pipe.unet, "forward", recorded)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = guided({"gradient": "full", "inner_steps": 2}, num_inference_steps=1)
    assert precisions == [torch.bfloat16] * 2
    assert np.isfinite(out.prediction).all()


@pytest.mark.parametrize("bounds", [(5.0, 10.0), (0.1, 1.0)])
def test_a_given_range_bounds_the_scale(guided, bounds):
    knobs = FAST | {"inner_steps": 0, "correct": False, "crisp": False}
    points = np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 2.1]])
    out = guided(GeometryGuidance.from_points(points, guided.pair.K, depth_range=bounds, **knobs))
    at_ends = out.global_scale * torch.stack([out.shift, out.scale + out.shift])
    assert (at_ends > 0.9 * bounds[0]).all() and (at_ends < 1.1 * bounds[1]).all()


def test_one_number_never_prefers_what_no_camera_sees(make_oracle):
    pair = plane_pair(baseline=1.6)
    guided = Guided(make_oracle(pair.depth_m / pair.depth_m.max()), pair)
    guidance = GeometryGuidance.paper(pair.right, pair.K, pair.E, inner_steps=0, min_steps=1)
    assert guided(guidance).visible.any()


@pytest.mark.parametrize(
    ("near", "far", "prediction_type"),
    [(0.4, 1.1, "depth"), (0.0, 1.0, "disparity"), (0.4, 1.1, "disparity")],
)
def test_with_an_oracle_prior_the_scale_is_found(make_oracle, textured_plane, near, far, prediction_type):
    """The denoiser knows depth up to an affine map; the right view gives the metres within 2 %."""
    truth = textured_plane.depth_m
    value = truth if prediction_type == "depth" else 1.0 / truth
    relative = near + (far - near) * (value - value.min()) / (value.max() - value.min())
    guided = Guided(make_oracle(relative.astype(np.float32), prediction_type), textured_plane)
    ratio = guided({"inner_steps": 10}).prediction[0, ..., 0] / truth
    assert abs(np.median(ratio) - 1.0) < 0.02
    assert np.mean(np.abs(ratio - 1.0)) < 0.03


def test_a_preprocessing_of_the_users_own_stays(guided):
    own, asked = guided.pipe.image_processor.preprocess, []

    def preprocess(*args, **kwargs):
        asked.append(1)
        return own(*args, **kwargs)

    guided.pipe.image_processor.preprocess = preprocess
    guided({"inner_steps": 0}, num_inference_steps=1)
    assert guided.pipe.image_processor.preprocess is preprocess and asked


def test_in_a_batch_the_image_with_little_overlap_is_named(guided):
    pair, away = guided.pair, guided.pair.E.copy()
    away[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # it looks to the right
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        knobs = FAST | {"pose": "given", "inner_steps": 0}
        guidance = GeometryGuidance([pair.right] * 2, [pair.K] * 2, [pair.E, away], **knobs)
        out = guided(guidance, [guided.left] * 2, num_inference_steps=1)
    said = [sentence for sentence in out.warnings if "of the left image is seen" in sentence]
    assert said and all(sentence.startswith("Image 2: Only ") for sentence in said)
