"""A guided call next to other calls: shared components, callbacks, replaced methods, threads."""

import copy
import threading
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler, MarigoldDepthPipeline
from diffusers.configuration_utils import FrozenDict

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from tests.contracts.tiny_priors import AT_64, make_lotus
from tests.tiny import SCHEDULER, quiet, seeded

pytestmark = pytest.mark.end_to_end

BETAS = {"beta_schedule": "scaled_linear", "beta_start": 0.00085, "beta_end": 0.012}
SCHEDULERS = {
    "ddim": lambda: DDIMScheduler(**SCHEDULER),
    "dpm": lambda: DPMSolverMultistepScheduler(**BETAS, prediction_type="v_prediction"),
}


def sharing(pipe: MarigoldDepthPipeline) -> MarigoldDepthPipeline:
    """A stock pipeline of the same components, as users make one next to a guided one."""
    reported = {"prediction_type": "depth", "default_denoising_steps": 2, **AT_64}
    return quiet(MarigoldDepthPipeline(**pipe.components, **reported))


def calls_of(pipe, pair, steps=2, **overrides):
    """A stock call and a guided one, which takes a callback; without a sweep, for the sake of time."""
    guidance = GeometryGuidance.paper(pair.right, pair.K, pair.E, **overrides)

    def stock(**more):
        return pipe(pair.left, generator=seeded(), num_inference_steps=steps, **more).prediction

    def guided(callback=None):
        return stock(guidance=guidance, callback_on_step_end=callback)

    return stock, guided


@pytest.fixture
def calls(pipe, textured_plane):
    return calls_of(pipe, textured_plane)


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
    enable_geometry_guidance(pipe)
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


def test_methods_that_the_user_replaced_are_used_and_kept(pipe, calls):
    stock, guided = calls
    reference, plain, scheduler, inside = guided(), stock(), pipe.scheduler, []
    for name in ("step", "set_timesteps"):
        setattr(scheduler, name, Mock(wraps=getattr(scheduler, name)))
    step, set_timesteps = scheduler.step, scheduler.set_timesteps
    np.testing.assert_array_equal(guided(), reference)
    assert (step.call_count, set_timesteps.call_count) == (2, 1) and scheduler.step is step
    np.testing.assert_array_equal(guided(lambda *_: inside.append(stock())), reference)
    np.testing.assert_array_equal(inside[0], plain)


def test_threads_on_shared_networks_wait_for_each_other(pipe, textured_plane):
    full, twin = {"gradient": "full"}, enable_geometry_guidance(sharing(pipe))
    calls = [*calls_of(pipe, textured_plane, **full), calls_of(twin, textured_plane, **full)[1]]
    calls.append(calls_of(sharing(pipe), textured_plane)[0])
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


def test_a_callback_may_wait_for_a_thread_that_calls_the_pipeline(calls):
    stock, guided = calls
    expected, found = stock(), []

    def from_a_thread(*_):
        with ThreadPoolExecutor(1) as pool:
            found.append(pool.submit(stock).result(timeout=60))

    guided(from_a_thread)
    np.testing.assert_array_equal(found[0], expected)


@pytest.mark.parametrize("guided_again", [False, True])
def test_a_call_from_a_hook_of_the_network_is_rejected(pipe, calls, guided_again):
    stock, guided = calls
    hook = pipe.unet.register_forward_hook(lambda *_: (guided if guided_again else stock)())
    with pytest.raises(RuntimeError, match="A guided call of this pipeline is in progress"):
        guided()
    hook.remove()
    assert np.isfinite(stock()).all()
