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

FAST = {"inner_steps": 2, "min_steps": 1, "loss_resolution": 64}


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def guidance_for(pair, **kwargs):
    return GeometryGuidance(pair.right, pair.K, pair.E, **(FAST | kwargs))


def stock(pipe, image, **kwargs):
    return pipe(image, generator=seeded(), output_latent=True, **kwargs)


@pytest.fixture
def left(textured_plane):
    return Image.fromarray(textured_plane.left)


def assert_same(a, b):
    np.testing.assert_array_equal(a.prediction, b.prediction)
    assert torch.equal(a.latent, b.latent)


def test_without_guidance_it_is_the_stock_call(make_pipeline, left):
    reference = stock(make_pipeline(), left, ensemble_size=3, batch_size=2)
    pipe = enable_geometry_guidance(make_pipeline())
    assert_same(stock(pipe, left, ensemble_size=3, batch_size=2), reference)
    assert_same(stock(disable_geometry_guidance(pipe), left, ensemble_size=3, batch_size=2), reference)


def test_enable_and_disable_are_idempotent(make_pipeline):
    pipe = make_pipeline()
    cls = type(pipe)
    assert enable_geometry_guidance(enable_geometry_guidance(pipe)) is pipe
    assert isinstance(pipe, cls)
    disable_geometry_guidance(disable_geometry_guidance(pipe))
    assert type(pipe) is cls


@pytest.mark.parametrize("gradient", ["denoised", "full"])
def test_guided_call_gives_metres_and_everything_known(make_pipeline, textured_plane, left, gradient):
    pipe = enable_geometry_guidance(make_pipeline())
    out = pipe(left, guidance=guidance_for(textured_plane, gradient=gradient), generator=seeded())
    assert out.prediction.shape == (1, 48, 64, 1)
    assert np.isfinite(out.prediction).all() and (out.prediction > 0).all()
    assert out.visible.shape == (1, 48, 64, 1) and out.visible.dtype == bool
    assert out.photometric_error.shape == out.relative.shape == (1, 48, 64, 1)
    assert out.scale.shape == out.shift.shape == out.global_scale.shape == (1, 1)
    np.testing.assert_allclose(out.K[0], textured_plane.K)
    assert [r.step for r in out.history] == [0, 1]
    assert out.uncertainty is None and out.latent is None


@pytest.mark.parametrize("gradient", ["denoised", "full"])
def test_the_pipeline_is_left_as_it_was(make_pipeline, textured_plane, left, gradient):
    reference = stock(make_pipeline(), left)
    pipe = enable_geometry_guidance(make_pipeline())
    pipe.unet.conv_in.weight.requires_grad_(False)
    scheduler = pipe.scheduler
    pipe(left, guidance=guidance_for(textured_plane, gradient=gradient), generator=seeded())
    assert pipe.scheduler is scheduler and not {"step", "set_timesteps"} & set(vars(scheduler))
    assert "forward" not in vars(pipe.unet) and not hasattr(pipe.unet, "_diffusers_hook")
    assert not pipe.unet.conv_in.weight.requires_grad and pipe.unet.conv_out.weight.requires_grad
    assert all(p.grad is None for p in pipe.unet.parameters())
    assert_same(stock(pipe, left), reference)


@pytest.mark.parametrize("error", [RuntimeError("mine"), KeyboardInterrupt()])
def test_a_failing_call_leaves_the_pipeline_as_it_was(make_pipeline, textured_plane, left, error):
    def fail(pipe, i, t, values):
        raise error

    reference = stock(make_pipeline(), left)
    pipe = enable_geometry_guidance(make_pipeline())
    with pytest.raises(type(error)):
        pipe(left, guidance=guidance_for(textured_plane, gradient="full"), callback_on_step_end=fail)
    assert not {"step", "set_timesteps"} & set(vars(pipe.scheduler))
    assert all(p.requires_grad for p in pipe.unet.parameters())
    assert_same(stock(pipe, left), reference)


def test_the_loss_falls(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    weights = {"photometric": 1.0}  # alone: matches would also correct the map of the one without updates
    still, moved = (
        pipe(left, guidance=guidance_for(textured_plane, inner_steps=n, weights=weights), generator=seeded())
        for n in (0, 8)
    )
    error = [o.photometric_error.sum() / o.visible.sum() for o in (still, moved)]
    assert error[1] < error[0]


@pytest.mark.parametrize("gradient", ["denoised", "full"])
def test_scale_and_shift_only_leaves_latents_untouched(make_pipeline, textured_plane, left, gradient):
    """S5.3, Table 4."""
    reference = stock(make_pipeline(), left)
    pipe = enable_geometry_guidance(make_pipeline())
    guidance = guidance_for(textured_plane, optimize_latents=False, gradient=gradient)
    out = pipe(left, guidance=guidance, generator=seeded(), output_latent=True)
    assert torch.equal(out.latent, reference.latent)
    assert out.history[0].s_hat != out.history[1].s_hat


def test_outside_start_and_stop_nothing_is_updated(make_pipeline, textured_plane, left):
    reference = stock(make_pipeline(), left)
    pipe = enable_geometry_guidance(make_pipeline())
    guidance = guidance_for(textured_plane, start=0.9, stop=1.0)
    out = pipe(left, guidance=guidance, generator=seeded(), output_latent=True)
    assert torch.equal(out.latent, reference.latent)  # 2 steps at fractions 0 and 0.5


@pytest.mark.parametrize(
    "knobs, updates",
    [
        ({}, [0, 0, 0, 2]),  # matches are encoded at every step, photographs refine them at the last
        ({"stop": 0.5}, [0, 2, 0, 0]),
        ({"correct": False}, [2, 2, 2, 2]),
        ({"weights": {"photometric": 1.0}}, [2, 2, 2, 2]),
    ],
)
def test_updates_wait_for_the_corrections(make_pipeline, textured_plane, left, monkeypatch, knobs, updates):
    made = [0]

    class Counted(RULES["adam"]):
        def step(self, gradient, *args):
            made[-1] += gradient.ndim == 4
            return super().step(gradient, *args)

    monkeypatch.setitem(RULES, "counted", Counted)
    pipe = enable_geometry_guidance(make_pipeline())
    guidance = guidance_for(textured_plane, rule="counted", **knobs)
    call = {"generator": seeded(), "num_inference_steps": 4}
    pipe(left, guidance=guidance, callback_on_step_end=lambda *_: made.append(0), **call)
    assert made[:-1] == updates


def test_one_update_of_the_paper_is_algorithm_1(make_pipeline, textured_plane, left):
    """z_{t-1} of the guided call is the stock one minus 1e-2 times the gradient to z_t."""
    pipe = enable_geometry_guidance(make_pipeline())
    reference = stock(pipe, left, num_inference_steps=1).latent
    moves = []
    for rate in (1e-2, 2e-2):
        guidance = GeometryGuidance.paper(
            textured_plane.right, textured_plane.K, textured_plane.E, step_latents=rate
        )
        out = pipe(left, guidance=guidance, generator=seeded(), num_inference_steps=1, output_latent=True)
        moves.append(out.latent - reference)
    assert moves[0].abs().max() > 0
    torch.testing.assert_close(moves[1], 2 * moves[0], atol=1e-6, rtol=0.05)


def test_a_call_that_hides_the_stock_arguments_is_refused(make_pipeline, textured_plane, left):
    pipe = make_pipeline()

    class Own(type(pipe)):
        def __call__(self, image, **kwargs):
            return super().__call__(image, **kwargs)

    pipe.__class__ = Own
    with pytest.raises(ValueError, match=r"must name the arguments .* no output_type.*write them out"):
        enable_geometry_guidance(pipe)(left, guidance=guidance_for(textured_plane, **FAST))


@pytest.mark.parametrize("batch_size", [1, 2, 4])
def test_members_do_not_depend_on_the_batch_size(make_pipeline, textured_plane, left, batch_size):
    pipe = enable_geometry_guidance(make_pipeline())
    call = {"ensemble_size": 4, "output_uncertainty": True}
    outs = [
        pipe(left, guidance=guidance_for(textured_plane), generator=seeded(), batch_size=b, **call)
        for b in (batch_size, 3)
    ]
    np.testing.assert_allclose(outs[0].prediction, outs[1].prediction, rtol=2e-3)
    assert outs[0].uncertainty.shape == (1, 48, 64, 1)
    assert outs[0].scale.shape == (1, 4)
    torch.testing.assert_close(outs[0].scale, outs[1].scale, rtol=2e-3, atol=0)


def test_a_batch_of_images_takes_one_right_view_each(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    pair = textured_plane
    bigger = np.asarray(Image.fromarray(pair.right).resize((96, 72)))
    K_bigger = np.diag([1.5, 1.5, 1]) @ pair.K + np.array([[0, 0, 0.25], [0, 0, 0.25], [0, 0, 0]])
    guidance = GeometryGuidance([pair.right, bigger], [pair.K, (pair.K, K_bigger)], pair.E, **FAST)
    noise = torch.randn(1, 4, 24, 32, generator=seeded())
    out = pipe([left, left], guidance=guidance, latents=noise.repeat(2, 1, 1, 1), batch_size=2)
    assert out.prediction.shape == (2, 48, 64, 1) and out.K.shape == (2, 3, 3)
    alone = pipe(left, guidance=guidance_for(pair), latents=noise)
    np.testing.assert_allclose(out.prediction[:1], alone.prediction, rtol=2e-3)
    with pytest.raises(ValueError, match="right must be a list of 1 images"):
        pipe(left, guidance=guidance)


def test_stock_arguments_keep_their_meaning(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    guidance = guidance_for(textured_plane)
    small = pipe(
        left,
        guidance=guidance,
        processing_resolution=32,
        match_input_resolution=False,
        output_type="pt",
        output_latent=True,
        num_inference_steps=1,
        generator=seeded(),
    )
    assert small.prediction.shape == (1, 1, 24, 32) and small.visible.shape == (1, 1, 24, 32)
    assert small.latent.shape == (1, 4, 12, 16)
    assert small.K[0, 0, 0] == pytest.approx(30.0) and small.K[0, 0, 2] == pytest.approx(15.5)
    parts = pipe(left, guidance=guidance, return_dict=False, generator=seeded())
    assert isinstance(parts, tuple) and len(parts) == 3 and parts[1] is None and parts[2] is None


def test_a_one_step_default_is_not_enough_for_guidance(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())  # its own default is 2
    for least, steps in ((1, 2), (3, 3)):
        made = []
        guidance = guidance_for(textured_plane, min_steps=least)
        pipe(left, guidance=guidance, callback_on_step_end=lambda _pipe, i, *_, made=made: made.append(i))
        assert made == list(range(steps))


def test_padding_is_not_part_of_the_result(make_pipeline, textured_plane):
    pipe = enable_geometry_guidance(make_pipeline())
    cropped = Image.fromarray(textured_plane.left[:, :61])
    out = pipe(cropped, guidance=guidance_for(textured_plane), processing_resolution=0, generator=seeded())
    assert out.prediction.shape == (1, 48, 61, 1) and out.relative.shape == (1, 48, 61, 1)


def test_callback_sees_and_replaces(make_pipeline, textured_plane, left):
    seen = []

    def callback(pipe, i, t, values):
        seen.append((i, int(t), set(values)))
        return {"latents": torch.zeros_like(values["latents"])}

    pipe = enable_geometry_guidance(make_pipeline())
    out = pipe(
        left,
        guidance=guidance_for(textured_plane),
        callback_on_step_end=callback,
        output_latent=True,
        generator=seeded(),
    )
    assert [s[:2] for s in seen] == [(0, 999), (1, 499)]
    assert seen[0][2] == {"latents", "metric_depth", "loss", "scale", "shift"}
    assert out.latent.abs().max() == 0


def test_a_callback_that_answers_with_something_else_is_told_so(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    with pytest.raises(TypeError, match="the answer of callback_on_step_end must be a dict or None"):
        pipe(left, guidance=guidance_for(textured_plane), callback_on_step_end=lambda *_: [1.0])
    assert pipe(left).prediction is not None


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, "latents in the answer of callback_on_step_end must be a tensor; got NoneType"),
        (torch.zeros(1, 2, 24, 32), r"must be of shape \(1, 4, 24, 32\); got shape \(1, 2, 24, 32\)"),
        (torch.full((1, 4, 24, 32), torch.nan), "must be finite; got NaN or infinity"),
    ],
)
def test_bad_latents_of_a_callback_are_told_as_such(make_pipeline, textured_plane, left, answer, message):
    pipe = enable_geometry_guidance(make_pipeline())
    with pytest.raises(InputError, match=message):
        pipe(
            left,
            guidance=guidance_for(textured_plane),
            callback_on_step_end=lambda *_: {"latents": answer},
            generator=seeded(),
        )


def test_a_callback_that_hands_back_its_latents_changes_nothing(make_pipeline, textured_plane, left):
    def add_in_place(pipe, i, t, values):
        values["latents"] += 0.5

    def call(callback):
        pipe = enable_geometry_guidance(make_pipeline())
        guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E)
        extra = {"callback_on_step_end": callback, "generator": seeded(), "num_inference_steps": 2}
        return pipe(left, guidance=guidance, **extra).prediction

    alone = call(None)
    for same in (
        lambda p, i, t, values: values,
        lambda p, i, t, values: {"latents": values["latents"].clone()},
    ):
        np.testing.assert_array_equal(call(same), alone)
    assert not np.array_equal(call(add_in_place), alone)


@pytest.mark.parametrize("knobs", [{}, {"refine": False}])
def test_bicubic_enlargement_stays_within_the_map(make_oracle, textured_plane, knobs):
    """It overshoots at a step of depth, below 0 m from 3 m to 60 m."""
    pair = textured_plane
    relative = np.zeros((24, 32), np.float32)
    relative[:, 16:] = 1.0
    pipe = enable_geometry_guidance(make_oracle(relative))
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, depth_range=(3.0, 60.0), **knobs)
    call = {"processing_resolution": 32, "resample_method_output": "bicubic", "generator": seeded()}
    depth_m = pipe(pair.left, guidance=guidance, **call).prediction
    assert np.isfinite(depth_m).all() and depth_m.min() > 0


def test_same_seed_same_answer(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    outs = [pipe(left, guidance=guidance_for(textured_plane), generator=seeded(3)) for _ in range(2)]
    np.testing.assert_array_equal(outs[0].prediction, outs[1].prediction)


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


@pytest.mark.parametrize("gradient", ["denoised", "full"])
@pytest.mark.parametrize("name", SCHEDULERS)
def test_every_scheduler_is_guided_and_restored(make_pipeline, textured_plane, left, name, gradient):
    reference = stock(make_pipeline(SCHEDULERS[name]()), left, num_inference_steps=3)
    pipe = enable_geometry_guidance(make_pipeline(SCHEDULERS[name]()))
    guidance = guidance_for(textured_plane, gradient=gradient, corrections=3)
    out = pipe(left, guidance=guidance, num_inference_steps=3, generator=seeded())
    assert np.isfinite(out.prediction).all() and len(out.history) == 3
    assert_same(stock(pipe, left, num_inference_steps=3), reference)


def test_leading_ddim_runs_as_trailing_unless_told(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline(SCHEDULERS["ddim-leading"]()))
    steps = []

    def callback(pipe, i, t, values):
        steps.append(int(t))

    call = {"callback_on_step_end": callback, "num_inference_steps": 4}
    pipe(left, guidance=guidance_for(textured_plane), **call)
    pipe(left, guidance=guidance_for(textured_plane, respace=False), **call)
    assert steps == [999, 749, 499, 249, 750, 500, 250, 0]


def test_saved_while_enabled_it_is_a_stock_pipeline(make_pipeline, tmp_path, left):
    reference = stock(make_pipeline(), left)
    for pipe in (
        enable_geometry_guidance(make_pipeline()),
        GuidedMarigoldDepthPipeline(
            **make_pipeline().components,
            prediction_type="depth",
            default_denoising_steps=2,
            default_processing_resolution=64,
        ),
    ):
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
    guided = GuidedMarigoldDepthPipeline.from_pretrained(tmp_path / "p")
    assert isinstance(guided, GuidedMarigoldDepthPipeline)


def test_inference_mode_forbids_updates_alone(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    with torch.inference_mode():
        with pytest.raises(RuntimeError, match="inference_mode"):
            pipe(left, guidance=guidance_for(textured_plane))
        without = guidance_for(textured_plane, inner_steps=0)
        assert np.isfinite(pipe(left, guidance=without, num_inference_steps=1).prediction).all()


def test_guidance_of_the_wrong_type(make_pipeline, left):
    pipe = enable_geometry_guidance(make_pipeline())
    with pytest.raises(TypeError, match="guidance must be a GeometryGuidance"):
        pipe(left, guidance={"right": left})


def test_left_image_of_another_size_than_its_K(make_pipeline, textured_plane, left):
    pair, pipe = textured_plane, enable_geometry_guidance(make_pipeline())
    larger = np.diag([3.0, 3.0, 1.0]) @ pair.K
    with pytest.raises(ValueError, match="another resolution"):
        pipe(left, guidance=GeometryGuidance(pair.right, (larger, pair.K), pair.E, **FAST))


def test_a_pipeline_without_adapter_is_refused():
    with pytest.raises(TypeError, match="adapter"):
        enable_geometry_guidance(object())


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # dynamo asks every tensor for it
@pytest.mark.parametrize("gradient", ["denoised", "full"])
def test_compiled_unet(make_pipeline, textured_plane, left, gradient):
    pipe, compiled = enable_geometry_guidance(make_pipeline()), enable_geometry_guidance(make_pipeline())
    compiled.unet = torch.compile(compiled.unet, backend="eager")
    outs = [
        p(left, guidance=guidance_for(textured_plane, gradient=gradient), generator=seeded())
        for p in (pipe, compiled)
    ]
    np.testing.assert_allclose(outs[0].prediction, outs[1].prediction, rtol=1e-4)


def test_what_cannot_be_guided_is_refused_before_anything_is_computed(
    make_pipeline, textured_plane, left, monkeypatch
):
    def prepare(self, lefts_01):
        raise AssertionError("the views were swept first")

    monkeypatch.setattr(GeometryGuidance, "prepare", prepare)
    pipe = enable_geometry_guidance(make_pipeline())
    pipe.scheduler = EulerDiscreteScheduler()
    with pytest.raises(TypeError, match="EulerDiscreteScheduler"):
        pipe(left, guidance=guidance_for(textured_plane))


def test_dynamic_thresholding_is_refused(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    pipe.scheduler = DDIMScheduler(**SCHEDULER, thresholding=True)
    with pytest.raises(InputError, match="without dynamic thresholding.*got DDIMScheduler with thresholding"):
        pipe(left, guidance=guidance_for(textured_plane))


def test_saving_does_not_disturb_a_call_that_begins_meanwhile(
    make_pipeline, textured_plane, left, monkeypatch
):
    pipe, inside, results = enable_geometry_guidance(make_pipeline()), threading.Event(), []
    done = threading.Event()

    def slow(self, *args):
        inside.set()
        assert done.wait(60)

    monkeypatch.setattr(DiffusionPipeline, "save_pretrained", slow)
    saving = threading.Thread(target=pipe.save_pretrained, args=("nowhere",))
    saving.start()
    assert inside.wait(60)
    try:
        results.append(pipe(left, guidance=guidance_for(textured_plane), generator=seeded()).prediction)
    finally:
        done.set()
        saving.join()
    assert np.isfinite(results[0]).all()


def test_half_precision_keeps_the_photometric_gradient(make_pipeline, textured_plane, left, monkeypatch):
    """A pixel's share of the mean is below float16's least number."""
    moved = []

    class Spy(RULES["adam"]):
        def step(self, gradient, *args):
            if gradient.ndim == 4:
                moved.append((gradient != 0).float().mean())
            return super().step(gradient, *args)

    monkeypatch.setitem(RULES, "adam", Spy)
    pipe = enable_geometry_guidance(make_pipeline().to(torch.float16))
    guidance = guidance_for(textured_plane, weights={"photometric": 1e-3})
    out = pipe(left, guidance=guidance, generator=seeded())
    assert np.isfinite(out.prediction).all()
    assert min(moved) > 0.9


def test_autocast_leaves_geometry_alone(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    guidance = guidance_for(textured_plane, inner_steps=0, weights={"photometric": 1.0})
    plain = pipe(left, guidance=guidance, generator=seeded())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = pipe(left, guidance=guidance, generator=seeded())
    assert np.median(np.abs(mixed.prediction / plain.prediction - 1)) < 0.02
    assert mixed.prediction.dtype == np.float32


def test_autocast_holds_for_every_call_of_the_network(make_pipeline, textured_plane, left, monkeypatch):
    """The second update calls the network again, from within the guided step, which leaves autocast."""
    pipe = enable_geometry_guidance(make_pipeline())
    monkeypatch.setattr(pipe.unet, "forward", own := Recorded(pipe.unet.forward))
    guidance = guidance_for(textured_plane, gradient="full", inner_steps=2)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = pipe(left, guidance=guidance, generator=seeded(), num_inference_steps=1)
    assert own.precisions == [torch.bfloat16] * 2
    assert np.isfinite(out.prediction).all()


class Recorded:
    """A network's forward that notes under which autocast it runs; ``None`` under none."""

    def __init__(self, forward):
        self.forward, self.precisions = forward, []

    def __call__(self, *args, **kwargs):
        enabled = torch.is_autocast_enabled("cpu")
        self.precisions.append(torch.get_autocast_dtype("cpu") if enabled else None)
        return self.forward(*args, **kwargs)


class FakeAlign:
    offload = True


FakeAlign.__name__ = "AlignDevicesHook"


def test_sequential_offloading_is_refused(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    pipe.unet.conv_in._hf_hook = FakeAlign()
    with pytest.raises(ValueError, match="sequential"):
        pipe(left, guidance=guidance_for(textured_plane))


@pytest.mark.parametrize("part, gradient", [("vae", "denoised"), ("unet", "full")])
def test_layerwise_casting_is_refused_where_gradients_go(make_pipeline, textured_plane, left, part, gradient):
    pipe = enable_geometry_guidance(make_pipeline())
    getattr(pipe, part).enable_layerwise_casting(torch.bfloat16, torch.float32)
    assert pipe(left, guidance=guidance_for(textured_plane, inner_steps=0)).prediction.min() > 0
    with pytest.raises(ValueError, match="layerwise casting"):
        pipe(left, guidance=guidance_for(textured_plane, inner_steps=1, gradient=gradient))


def test_model_offloading_works_with_the_cheap_gradient_only(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    pipe._all_hooks = [object()]
    with pytest.raises(ValueError, match="enable_model_cpu_offload"):
        pipe(left, guidance=guidance_for(textured_plane, gradient="full"))


@pytest.mark.parametrize("bounds", [(5.0, 10.0), (0.1, 1.0)])
def test_a_given_range_bounds_the_scale(make_pipeline, textured_plane, left, bounds):
    pair = textured_plane
    pipe = enable_geometry_guidance(make_pipeline())
    knobs = FAST | {"inner_steps": 0, "correct": False, "refine": False}
    points = np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 2.1]])
    guidance = GeometryGuidance.from_points(points, pair.K, depth_range=bounds, **knobs)
    out = pipe(left, guidance=guidance, generator=seeded())
    at_ends = out.global_scale * torch.stack([out.shift, out.scale + out.shift])
    assert (at_ends > 0.9 * bounds[0]).all() and (at_ends < 1.1 * bounds[1]).all()


def test_one_number_never_prefers_what_no_camera_sees(make_oracle):
    pair = plane_pair(baseline=1.6)
    pipe = enable_geometry_guidance(make_oracle(pair.depth_m / pair.depth_m.max()))
    guidance = GeometryGuidance.paper(pair.right, pair.K, pair.E, inner_steps=0, min_steps=1)
    out = pipe(Image.fromarray(pair.left), guidance=guidance, generator=seeded())
    assert out.visible.any()


@pytest.mark.parametrize(("near", "far"), [(0.4, 1.1), (0.0, 1.0)])
@pytest.mark.parametrize("prediction_type", ["depth", "disparity"])
def test_with_an_oracle_prior_the_scale_is_found(make_oracle, textured_plane, near, far, prediction_type):
    """The denoiser knows depth up to an affine map; the right view gives the metres within 2 %."""
    truth = textured_plane.depth_m
    value = truth if prediction_type == "depth" else 1.0 / truth
    relative = near + (far - near) * (value - value.min()) / (value.max() - value.min())
    pipe = enable_geometry_guidance(make_oracle(relative.astype(np.float32), prediction_type))
    out = pipe(
        Image.fromarray(textured_plane.left),
        guidance=guidance_for(textured_plane, inner_steps=10),
        generator=seeded(),
    )
    ratio = out.prediction[0, ..., 0] / truth
    assert abs(np.median(ratio) - 1.0) < 0.02
    assert np.mean(np.abs(ratio - 1.0)) < 0.03


@pytest.mark.parametrize("gradient", ["denoised", "full"])
def test_a_call_leaves_nothing_alive(make_pipeline, textured_plane, left, monkeypatch, gradient):
    """Without the collector of cycles, which knows nothing of a device's memory."""
    runs, own = [], GuidedRun.__init__

    def remembered(run, *args, **kwargs):
        runs.append(weakref.ref(run))
        own(run, *args, **kwargs)

    monkeypatch.setattr(GuidedRun, "__init__", remembered)
    pipe = enable_geometry_guidance(make_pipeline())
    gc.collect()
    gc.disable()
    try:
        pipe(left, guidance=guidance_for(textured_plane, gradient=gradient), generator=seeded())
        assert [run() for run in runs] == [None]
    finally:
        gc.enable()


def test_a_preprocessing_of_the_users_own_stays(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    own = pipe.image_processor.preprocess
    asked = []

    def preprocess(*args, **kwargs):
        asked.append(1)
        return own(*args, **kwargs)

    pipe.image_processor.preprocess = preprocess
    pipe(left, guidance=guidance_for(textured_plane), generator=seeded())
    assert pipe.image_processor.preprocess is preprocess and asked


def test_in_a_batch_the_image_with_little_overlap_is_named(make_pipeline, textured_plane, left):
    pipe = enable_geometry_guidance(make_pipeline())
    away = textured_plane.E.copy()
    away[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # it looks to the right
    rights, poses = [textured_plane.right] * 3, [textured_plane.E, away, textured_plane.E]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        guidance = GeometryGuidance(rights, [textured_plane.K] * 3, poses, pose="given", **FAST)
        out = pipe([left] * 3, guidance=guidance, generator=seeded())
    said = [sentence for sentence in out.warnings if "of the left image is seen" in sentence]
    assert said and all(sentence.startswith("Image 2: Only ") for sentence in said)
