"""Arguments of a guided call, what is rejected, and how a batch with ensembles is put together."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import MarigoldDepthPipeline
from torch import nn

from geodiff_plugin import (
    GeometryGuidance,
    disable_geometry_guidance,
    enable_geometry_guidance,
)
from geodiff_plugin._internal import threads as _threads
from geodiff_plugin._internal.threads import BackgroundTask
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline
from geodiff_plugin.runtime import guided_call
from geodiff_plugin.runtime.guided_call import (
    GuidedCall,
    GuidedMarigoldDepthPipeline,
    _bind,
    _check_arguments,
    _check_guidable,
    _check_guided_call,
    _check_weights_stay,
    _close,
    _guided_class,
    _one_member,
    _stock_class,
    count_guided_steps,
)
from geodiff_plugin.runtime.hooks import Layers
from tests.contracts.tiny_priors import make_e2e_ft
from tests.tiny import make_marigold, plane_pair, seeded

CALL = {
    "output_type": "np", "resample_method_input": "bilinear", "resample_method_output": None, "batch_size": 2,
    "num_inference_steps": None, "processing_resolution": None, "ensemble_size": 3, "generator": None,
    "latents": None,
}  # fmt: skip


def test_arguments_are_bound_by_name_with_defaults_and_those_that_a_prior_adds():
    def call(image, steps=4, *, size=64, **more):
        pass

    assert _bind(call, "x", 7, extra=1) == {"image": "x", "steps": 7, "size": 64, "extra": 1}
    assert _bind(call, "x", size=5) == {"image": "x", "steps": 4, "size": 5}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"output_type": "pt", "resample_method_input": "nearest", "resample_method_output": "area"},
        {"num_inference_steps": 1, "processing_resolution": 0, "batch_size": 1, "ensemble_size": 1},
        {"num_inference_steps": 1 << 20, "processing_resolution": 1 << 20, "batch_size": 1 << 20},
        {"generator": torch.Generator()},
        {"generator": [torch.Generator()] * 6},
        {"latents": torch.zeros(1)},
    ],
)
def test_what_a_pipeline_takes_is_accepted(changes):
    _check_arguments(CALL | changes, 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"output_type": "pil"}, "output_type must be one of np, pt"),
        ({"resample_method_input": None}, "resample_method_input"),
        ({"resample_method_output": "lanczos"}, "resample_method_output"),
        ({"num_inference_steps": 0}, "num_inference_steps must be between 1 and 1048576; got 0"),
        ({"num_inference_steps": 2.0}, "num_inference_steps must be an integer"),
        ({"processing_resolution": -1}, "processing_resolution must be between 0 and 1048576; got -1"),
        ({"processing_resolution": 1048577}, "processing_resolution must be between 0"),
        ({"batch_size": 0}, "batch_size must be between 1"),
        ({"batch_size": 1.5}, "batch_size must be an integer"),
        ({"ensemble_size": 0}, "ensemble_size must be between 1"),
        (
            {"generator": [torch.Generator()] * 5},
            "a list of 6, one per image and ensemble member; got a list of 5",
        ),
        ({"generator": [torch.Generator()] * 5 + [3]}, "generator must be None"),
        ({"generator": 3}, "generator must be None, a torch.Generator or a list of them; got int"),
        ({"latents": torch.tensor([0.0, torch.inf])}, "latents must be finite; got NaN or infinity"),
    ],
)
def test_what_no_pipeline_takes_is_rejected(changes, message):
    with pytest.raises((ValueError, TypeError), match=message):
        _check_arguments(CALL | changes, 2)


def test_a_prior_that_always_gives_the_same_map_runs_the_first_member_of_every_image():
    generators, latents = [object() for _ in range(6)], torch.arange(6.0).view(6, 1, 1, 1)
    call = {"ensemble_size": 3, "generator": generators, "latents": latents, "output_uncertainty": True}
    with pytest.warns(match="only one ensemble member is computed") as reported:
        changed = _one_member(call)
    assert reported[0].message.args[0].code == "prior.one-member"
    assert changed.pop("generator") == [generators[0], generators[3]]
    assert changed.pop("latents").flatten().tolist() == [0.0, 3.0]
    assert changed == {"ensemble_size": 1, "output_uncertainty": False}
    with pytest.warns(match="only one"):
        same = _one_member(call | {"generator": torch.Generator(), "latents": None})
    assert set(same) == {"ensemble_size", "output_uncertainty"}


def test_the_warning_about_members_points_at_the_call(monkeypatch):
    """Nothing runs after it."""
    monkeypatch.setattr(guided_call, "compile_kernels", lambda *_: 1 / 0)
    pipe, pair = enable_geometry_guidance(make_e2e_ft()), plane_pair()
    guidance = GeometryGuidance(pair.right, pair.K, pair.E)
    with (
        pytest.warns(match="only one ensemble member is computed") as reported,
        pytest.raises(ZeroDivisionError),
    ):
        pipe(pair.left, guidance=guidance, ensemble_size=2)
    assert [each.filename for each in reported] == [__file__]
    with pytest.raises(ZeroDivisionError):  # one member needs no warning
        pipe(pair.left, guidance=guidance)


class AlignDevicesHook:
    def __init__(self, offload: bool) -> None:
        self.offload = offload


def hooked(layer_hooks=(), accelerate=None) -> nn.Module:
    layer = nn.Linear(1, 1)
    if layer_hooks:
        layer._diffusers_hook = SimpleNamespace(hooks=dict.fromkeys(layer_hooks))
    if accelerate is not None:
        layer._hf_hook = accelerate
    return layer


@pytest.mark.parametrize(
    ("layer", "differentiated", "refused"),
    [
        (hooked(), True, None),
        (hooked(accelerate=AlignDevicesHook(False)), True, None),
        (hooked(accelerate=AlignDevicesHook(True)), False, "offloading"),
        (hooked(accelerate=SimpleNamespace(hooks=[object(), AlignDevicesHook(True)])), False, "offloading"),
        (hooked(accelerate=SimpleNamespace(hooks=[object(), AlignDevicesHook(False)])), False, None),
        (hooked(accelerate=SimpleNamespace(offload=True)), False, None),
        (hooked(["other", "group_offloading_x"]), False, "offloading"),
        (hooked(["layerwise_casting"]), True, "casting"),
        (hooked(["layerwise_casting"]), False, None),
        (hooked(["other"]), True, None),
    ],
)
def test_weights_that_leave_or_are_cast_before_a_backward_pass_are_rejected(layer, differentiated, refused):
    if refused is None:
        _check_weights_stay("UNet", layer, differentiated)
        return
    with pytest.raises(
        ValueError,
        match=rf"pipe must be without .*{refused}.*; got UNet, whose weights .*\. "
        "(The back|Set guidance_steps)",
    ):
        _check_weights_stay("UNet", layer, differentiated)


@pytest.mark.parametrize(
    ("hooked_part", "gradient", "moves", "refused"),
    [
        ("vae", "denoised", True, True),
        ("unet", "denoised", True, False),
        ("unet", "full", True, True),
        ("vae", "denoised", False, False),
        ("unet", "full", False, False),
    ],
)
def test_casting_is_rejected_where_gradients_go_through(hooked_part, gradient, moves, refused):
    pipe = make_marigold()
    getattr(pipe, hooked_part)._diffusers_hook = SimpleNamespace(hooks={"layerwise_casting": 1})
    guidance = SimpleNamespace(
        config=SimpleNamespace(gradient=gradient),
        moves_latents=moves,
        through_network=gradient == "full" and moves,
    )
    prior = SimpleNamespace(network_input=slice(4, None))
    check = (pipe, prior, guidance, Layers.of(pipe))
    if refused:
        with pytest.raises(ValueError, match="casting"):
            _check_guidable(*check)
    else:
        _check_guidable(*check)


def test_a_gradient_through_the_network_needs_its_input_and_its_weights_on_the_device():
    pipe, none = make_marigold(), SimpleNamespace(network_input=None)
    guidance = SimpleNamespace(
        config=SimpleNamespace(gradient="full"), moves_latents=True, through_network=True
    )
    layers = Layers.of(pipe)
    with pytest.raises(
        ValueError, match=r"gradient must be 'denoised' with this prior; got 'full'\. z_t is not an input"
    ):
        _check_guidable(pipe, none, guidance, layers)
    guidance.through_network = False
    _check_guidable(pipe, none, guidance, layers)
    pipe._all_hooks = [object()]
    with pytest.raises(
        ValueError, match=r"gradient must be .*enable_model_cpu_offload\(\); got 'full'\. Decoding moves"
    ):
        _check_guidable(pipe, none, guidance, layers)
    guidance.config.gradient = "denoised"
    _check_guidable(pipe, none, guidance, layers)


def test_the_steps_of_a_call_are_the_users_or_enough_for_the_guidance(monkeypatch):
    for most, requested, expected in (
        (None, 3, (3, 1)), (None, None, (6, 1)), (4, None, (4, 2)), (4, 2, (2, 1)), (1, None, (1, 6)),
    ):  # fmt: skip
        monkeypatch.setattr(guided_call, "prior_of", lambda pipe, most=most: SimpleNamespace(max_steps=most))
        guidance = SimpleNamespace(denoising_steps=lambda requested, default: requested or default + 2)
        assert count_guided_steps(SimpleNamespace(default_denoising_steps=4), guidance, requested) == expected


def test_only_guidance_functions_and_updates_with_gradients_are_taken():
    with pytest.raises(TypeError, match=r"guidance must be a GeometryGuidance; got object\. Create one"):
        _check_guided_call(object(), None)
    pair = plane_pair()
    with_updates, without = (GeometryGuidance(pair.right, pair.K, pair.E, guidance_steps=n) for n in (1, 0))
    with pytest.raises(TypeError, match="callback_on_step_end must be a function; got int"):
        _check_guided_call(without, 3)
    _check_guided_call(with_updates, print)
    with torch.inference_mode():
        _check_guided_call(without, None)
        with pytest.raises(RuntimeError, match="inference_mode"):
            _check_guided_call(with_updates, None)


def test_classes_of_guided_pipelines_are_made_once_and_undone():
    assert _guided_class(MarigoldDepthPipeline) is GuidedMarigoldDepthPipeline

    class Mine(MarigoldDepthPipeline):
        pass

    made = _guided_class(Mine)
    assert made is _guided_class(Mine) and made.__name__ == "GuidedMine" and issubclass(made, GuidedCall)
    assert _stock_class(made) is Mine and _stock_class(GuidedMarigoldDepthPipeline) is MarigoldDepthPipeline
    pipe = make_marigold()
    assert disable_geometry_guidance(pipe) is pipe and type(pipe) is MarigoldDepthPipeline
    enable_geometry_guidance(pipe, kernels=False)
    assert type(pipe) is GuidedMarigoldDepthPipeline and pipe._faster is None and not pipe._uses_kernels
    enable_geometry_guidance(pipe, kernels=True, cuda_graphs=True)
    assert pipe._faster is not None and pipe._uses_kernels
    kept = pipe._faster
    assert enable_geometry_guidance(pipe)._faster is kept


def test_options_of_a_pipeline_are_given_by_name():
    with pytest.raises(TypeError, match="positional"):
        enable_geometry_guidance(make_marigold(), True)


class Stock:
    """What a stock pipeline does, by name and arguments."""

    def progress_bar(self, *arguments, **options):
        return ("progress_bar", arguments, options)

    def decode_prediction(self, *arguments, **options):
        return ("decode_prediction", arguments, options)

    def ensemble_depth(self, *arguments, **options):
        return ("ensemble_depth", arguments, options)

    def combine_members(self, *arguments, **options):
        return ("combine_members", arguments, options)


class Guided(GuidedCall, Stock):
    pass


def test_methods_of_the_pipeline_are_the_stock_ones_outside_of_guided_calls(monkeypatch):
    pipe = Guided()
    assert pipe.progress_bar([1], 3, a=1) == ("progress_bar", ([1], 3), {"a": 1})
    assert pipe.decode_prediction("z") == ("decode_prediction", ("z",), {})
    assert pipe.ensemble_depth("d", True, reduction="mean")[1:] == (("d", True), {"reduction": "mean"})
    assert pipe.combine_members("m", 2, x=3) == ("combine_members", ("m", 2), {"x": 3})
    config = SimpleNamespace(even_ensemble="mean")
    pipe._guided_run = SimpleNamespace(
        metric_prediction=lambda z: ("metres", z), config=config, device="here"
    )
    assert pipe.decode_prediction("z") == ("metres", "z") and pipe._execution_device == "here"
    bar = pipe.progress_bar([1, 2], total=5)
    assert bar.disable and bar.total == 5 and list(bar) == [1, 2]
    depths = torch.tensor([1.0, 2.0, 4.0, 9.0]).view(4, 1, 1, 1).expand(4, 1, 2, 2)
    for even, reduction, expected in (
        ("mean", "median", 3.0),
        ("lower", "median", 2.0),
        ("mean", "mean", 4.0),
    ):
        config.even_ensemble = even
        options = {} if reduction == "median" else {"reduction": reduction}
        depth_m, spread = pipe.ensemble_depth(depths, True, **options)
        assert depth_m.shape == (1, 1, 2, 2) and (depth_m == expected).all() and spread is not None
    monkeypatch.setattr(DepthDiffusionPipeline, "combine_members", lambda self, *args, **kw: (self, args, kw))
    assert pipe.combine_members("m", 2, x=3) == (pipe, ("m", 2), {"x": 3})


def test_the_processing_grid_is_that_of_the_stock_preprocessing(monkeypatch):
    """What it returned is kept for the stock call; images are channels last unless latents are given."""
    pipe, asked = enable_geometry_guidance(make_marigold()), []
    stock = pipe.image_processor.preprocess

    def captured_warnings(image, resolution, method, device):
        asked.append((resolution, method, image.is_contiguous(memory_format=torch.channels_last)))
        return stock(image, resolution, method, device)

    monkeypatch.setattr(pipe.image_processor, "preprocess", captured_warnings)
    image = torch.rand(2, 3, 45, 83)
    call = {"image": image, "latents": None, "processing_resolution": None, "resample_method_input": "area"}
    cpu = torch.device("cpu")
    grid = pipe._processing_grid(call, cpu)
    assert (
        grid.content == (34, 64) and grid.padding[0] == -34 % pipe.vae_scale_factor and grid.padding[1] == 0
    )
    assert torch.equal(grid.preprocessed[0], stock(image, 64, "area", cpu)[0])
    own = pipe._processing_grid(call | {"processing_resolution": 0, "latents": torch.zeros(1)}, cpu)
    assert own.content == (45, 83) and own.size[1] % pipe.vae_scale_factor == 0
    assert asked == [(64, "area", True), (0, "area", False)]


def views(count: int):
    """Pairs of planes that differ in texture, slope and baseline."""
    normals = [(0.25, -0.35, 1.0), (-0.3, 0.2, 1.0), (0.1, 0.4, 1.0)]
    return [
        plane_pair((36, 44), focal=40.0, seed=k, baseline=0.1 + 0.03 * k, normal=normals[k])
        for k in range(count)
    ]


def test_at_its_end_a_call_waits_for_the_work_of_every_plan_and_leaves_a_failure_to_who_asks(monkeypatch):
    closed = []
    plans = [SimpleNamespace(close=lambda i=i: closed.append(i)) for i in range(3)]
    _close(BackgroundTask.known(plans))
    assert closed == [0, 1, 2]

    def fails() -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(_threads, "leaves_cpu_free", lambda device: True)
    failed = BackgroundTask(fails, torch.device("cpu"))
    _close(failed)
    with pytest.raises(ZeroDivisionError):
        failed.result()


PARAMETERS = {"min_steps": 1, "planes": 40, "guidance_steps": 1, "pose": "given", "refine_edges": False}


def test_a_batch_with_ensembles_gives_each_image_what_it_gets_alone(monkeypatch):
    """Two images of two members in chunks of three samples: values of one image never reach the other."""
    monkeypatch.setattr("geodiff_plugin.scale.sampling.BASIN_SAMPLES", 80)  # the slowest stage by far
    pipe, pairs = enable_geometry_guidance(make_marigold()), views(2)
    call = {"ensemble_size": 2, "output_uncertainty": True, "output_latent": True, "output_type": "pt"}
    call["processing_resolution"] = 0
    noise = torch.randn(4, 4, 18, 22, generator=seeded(1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        both = GeometryGuidance(
            [pair.right for pair in pairs], pairs[0].K, [pair.E for pair in pairs], **PARAMETERS
        )
        together = pipe([pair.left for pair in pairs], guidance=both, latents=noise, batch_size=3, **call)
        second = GeometryGuidance(pairs[1].right, pairs[1].K, pairs[1].E, **PARAMETERS)
        alone = pipe(pairs[1].left, guidance=second, latents=noise[2:], batch_size=1, **call)
    maps = ("prediction", "uncertainty", "relative", "photometric_error")
    for name in (*maps, "scale", "shift", "global_scale", "prior_error", "K"):
        found, expected = getattr(together, name)[1:], getattr(alone, name)
        assert found.shape == expected.shape, name
        off = (found - expected).abs() > 0.02 * expected.abs() + 1e-3
        assert off.float().mean() < 0.02, name
    assert not torch.allclose(together.prediction[:1], alone.prediction, rtol=0.02)
    assert together.latent.shape == (4, 4, 18, 22)
    torch.testing.assert_close(together.latent[2:], alone.latent, atol=0.02, rtol=0.02)
    # History: of the first three samples step by step, then of the fourth.
    steps = [(report.step, len(report.s_hat)) for report in together.history]
    assert steps == [(0, 3), (1, 3), (0, 1), (1, 1)]
    last = torch.cat([together.history[1].g_s, together.history[3].g_s])
    torch.testing.assert_close(last, together.global_scale.flatten())
    last = torch.cat([alone.history[i].s_hat for i in (1, 3)])  # one member after the other
    torch.testing.assert_close(torch.nn.functional.softplus(last), alone.scale.flatten())


def test_the_output_is_as_asked_and_an_untrusted_depth_an_error_if_strict():
    pipe, (pair,) = enable_geometry_guidance(make_marigold()), views(1)
    parameters = PARAMETERS | {"guidance_steps": 0}
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, **parameters)
    turned = GeometryGuidance(pair.right, pair.K, np.linalg.inv(pair.E), **parameters)
    for name, given in (
        ("strict", {"strict": True}),
        ("callback_on_step_end", {"callback_on_step_end": print}),
    ):
        with pytest.raises(ValueError, match=f"^{name} must be passed only with guidance; got guidance=None"):
            pipe(pair.left, **given)
    call = {"generator": seeded(), "num_inference_steps": 1, "processing_resolution": 0}
    with pytest.warns(UserWarning) as reported:
        out = pipe(pair.left, guidance=turned, **call)
    (place,) = [each.filename for each in reported if each.message.args[0].code == "verdict.not-trusted"]
    assert place == __file__  # the warning points at the call
    assert not out.verdict.trusted and out.latent is None
    with pytest.raises(ValueError) as refused:
        pipe(pair.left, guidance=turned, strict=True, **call)
    assert str(refused.value).startswith(out.verdict.summary[:40])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        parts = pipe(pair.left, guidance=guidance, return_dict=False, output_latent=True, **call)
    assert len(parts) == 3 and parts[1] is None and parts[2].shape == (1, 4, 18, 22)
    assert parts[0].shape == out.prediction.shape
