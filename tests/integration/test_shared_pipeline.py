"""A guided call beside other calls: shared components, callbacks, replaced methods, threads."""

import copy
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler, MarigoldDepthPipeline
from diffusers.configuration_utils import FrozenDict

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from tests.conftest import SCHEDULER
from tests.contracts.tiny_priors import AT_64, make_lotus, quiet

BETAS = {"beta_schedule": "scaled_linear", "beta_start": 0.00085, "beta_end": 0.012}
SCHEDULERS = {
    "ddim": lambda: DDIMScheduler(**SCHEDULER),
    "dpm": lambda: DPMSolverMultistepScheduler(**BETAS, prediction_type="v_prediction"),
}


def sharing(pipe: MarigoldDepthPipeline) -> MarigoldDepthPipeline:
    """A stock pipeline of the same components, as users make one beside a guided one."""
    told = {"prediction_type": "depth", "default_denoising_steps": 2, **AT_64}
    return quiet(MarigoldDepthPipeline(**pipe.components, **told))


def calls_of(pipe, pair, steps=2, **knobs):
    """A stock call and a guided one, which takes a callback; without a sweep, for the sake of time."""

    def stock(**more):
        seeded = torch.Generator().manual_seed(0)
        return pipe(pair.left, generator=seeded, num_inference_steps=steps, **more).prediction

    def guided(callback=None):
        guidance = GeometryGuidance.paper(pair.right, pair.K, pair.E, **knobs)
        return stock(guidance=guidance, callback_on_step_end=callback)

    return stock, guided


@pytest.mark.parametrize(
    ("name", "gradient", "other"),
    [
        ("dpm", "denoised", "itself"),
        ("ddim", "full", "sharing"),
        ("ddim", "full", "guided"),
        ("lotus", "full", "small"),
    ],
)
def test_any_call_from_a_callback_is_what_it_is_alone(make_pipeline, textured_plane, name, gradient, other):
    pipe = make_lotus("g") if name == "lotus" else make_pipeline(SCHEDULERS[name]())
    pipe = enable_geometry_guidance(pipe)
    stock, guided = calls_of(pipe, textured_plane, 1 if name == "lotus" else 2, gradient=gradient)
    inner = {
        "itself": stock,
        "guided": guided,
        "small": lambda: stock(processing_resolution=40),
        "sharing": lambda: calls_of(sharing(pipe), textured_plane)[0](),
    }[other]
    alone_inner, alone_outer, found = inner(), guided(), []
    np.testing.assert_array_equal(guided(lambda *_: found.append(inner())), alone_outer)
    assert len(found) == (1 if name == "lotus" else 2)
    for prediction in found:
        np.testing.assert_array_equal(prediction, alone_inner)


def test_the_users_scheduler_is_not_touched(make_pipeline, textured_plane):
    pipe = enable_geometry_guidance(make_pipeline(SCHEDULERS["dpm"]()))
    stock, guided = calls_of(pipe, textured_plane)
    stock()
    scheduler, config = pipe.scheduler, dict(pipe.config)
    before, seen = copy.deepcopy(vars(scheduler)), []
    guided(lambda p, *_: seen.append(p.scheduler))
    assert pipe.scheduler is scheduler and all(found is scheduler for found in seen)
    assert dict(pipe.config) == config and isinstance(pipe.config, FrozenDict)
    torch.testing.assert_close(_tensors(vars(scheduler)), _tensors(before), rtol=0, atol=0)
    assert before.keys() == vars(scheduler).keys() and scheduler.step_index == 2


def _tensors(attributes: dict) -> dict[str, torch.Tensor]:
    return {name: value for name, value in attributes.items() if torch.is_tensor(value)}


def test_methods_that_the_user_replaced_are_used_and_kept(make_pipeline, textured_plane):
    pipe = enable_geometry_guidance(make_pipeline())
    stock, guided = calls_of(pipe, textured_plane)
    reference, plain = guided(), stock()
    scheduler, calls = pipe.scheduler, []

    def counted(method):
        def call(*args, **kwargs):
            calls.append(method.__name__)
            return method(*args, **kwargs)

        return call

    scheduler.step, scheduler.set_timesteps = step, _ = (
        counted(scheduler.step),
        counted(scheduler.set_timesteps),
    )
    np.testing.assert_array_equal(guided(), reference)
    assert calls == ["set_timesteps", "step", "step"] and scheduler.step is step
    inside = []
    np.testing.assert_array_equal(guided(lambda *_: inside.append(stock())), reference)
    np.testing.assert_array_equal(inside[0], plain)


def test_a_scheduler_assigned_in_a_callback_stays(make_pipeline, textured_plane):
    pipe, other = enable_geometry_guidance(make_pipeline()), SCHEDULERS["dpm"]()
    guided = calls_of(pipe, textured_plane)[1]
    reference = guided()
    found = guided(lambda p, *_: setattr(p, "scheduler", other))
    np.testing.assert_array_equal(found, reference)  # the call goes on with its own
    assert pipe.scheduler is other and pipe.config["scheduler"][1] == "DPMSolverMultistepScheduler"


def test_threads_on_shared_networks_wait_for_each_other(make_pipeline, textured_plane):
    pipe = enable_geometry_guidance(make_pipeline())
    stock, guided = calls_of(pipe, textured_plane, gradient="full")
    twin_guided = calls_of(enable_geometry_guidance(sharing(pipe)), textured_plane, gradient="full")[1]
    calls = [stock, guided, calls_of(sharing(pipe), textured_plane)[0], twin_guided]
    expected = [call() for call in calls]
    start = threading.Barrier(4)

    def together(call):
        start.wait()
        return call()

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(together, calls))
    for prediction, reference in zip(found, expected, strict=True):
        np.testing.assert_array_equal(prediction, reference)
    assert all(p.requires_grad for p in pipe.unet.parameters()) and "forward" not in vars(pipe.unet)


def test_a_callback_may_wait_for_a_thread_that_calls_the_pipeline(make_pipeline, textured_plane):
    pipe = enable_geometry_guidance(make_pipeline())
    stock, guided = calls_of(pipe, textured_plane)
    expected, found = stock(), []

    def from_a_thread(*_):
        with ThreadPoolExecutor(1) as pool:
            found.append(pool.submit(stock).result(timeout=60))

    guided(from_a_thread)
    np.testing.assert_array_equal(found[0], expected)


@pytest.mark.parametrize("guided_again", [False, True])
def test_a_call_from_a_hook_of_the_network_is_refused(make_pipeline, textured_plane, guided_again):
    pipe = enable_geometry_guidance(make_pipeline())
    stock, guided = calls_of(pipe, textured_plane)
    hook = pipe.unet.register_forward_hook(lambda *_: (guided if guided_again else stock)())
    with pytest.raises(RuntimeError, match="in the middle of a guided call"):
        guided()
    hook.remove()
    assert np.isfinite(stock()).all()
