"""A guided call beside other calls: shared components, callbacks, replaced methods, threads."""

from __future__ import annotations

import copy
import json
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler, MarigoldDepthPipeline
from diffusers.configuration_utils import FrozenDict

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from tests.conftest import SCHEDULER
from tests.contracts.tiny_lotus import make_lotus

BETAS = {"beta_schedule": "scaled_linear", "beta_start": 0.00085, "beta_end": 0.012}
SCHEDULERS = {
    "ddim": lambda: DDIMScheduler(**SCHEDULER),
    "dpm": lambda: DPMSolverMultistepScheduler(**BETAS, prediction_type="v_prediction"),
}


def guidance_for(pair, **knobs) -> GeometryGuidance:
    """Without a sweep, for the sake of time."""
    return GeometryGuidance.paper(pair.right, pair.K, pair.E, **knobs)


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def sharing(pipe: MarigoldDepthPipeline) -> MarigoldDepthPipeline:
    """A stock pipeline of the same components, as users make one beside a guided one."""
    twin = MarigoldDepthPipeline(
        **pipe.components,
        prediction_type="depth",
        default_denoising_steps=2,
        default_processing_resolution=64,
    )
    twin.set_progress_bar_config(disable=True)
    return twin


def calls_of(pipe, pair, **knobs):
    """A stock call and a guided one of two steps each."""
    call = {"num_inference_steps": 2}
    return (
        lambda: pipe(pair.left, generator=seeded(), **call).prediction,
        lambda callback=None: (
            pipe(
                pair.left,
                guidance=guidance_for(pair, **knobs),
                generator=seeded(),
                callback_on_step_end=callback,
                **call,
            ).prediction
        ),
    )


@pytest.mark.parametrize(
    ("name", "gradient", "other"),
    [("dpm", "denoised", "itself"), ("ddim", "full", "sharing"), ("ddim", "full", "guided")],
)
def test_any_call_from_a_callback_is_what_it_is_alone(make_pipeline, textured_plane, name, gradient, other):
    pipe = enable_geometry_guidance(make_pipeline(SCHEDULERS[name]()))
    stock, guided = calls_of(pipe, textured_plane, gradient=gradient)
    inner = {"itself": stock, "guided": guided, "sharing": calls_of(sharing(pipe), textured_plane)[0]}[other]
    alone_inner, alone_outer, found = inner(), guided(), []
    outer = guided(lambda *_: found.append(inner()))
    np.testing.assert_array_equal(outer, alone_outer)
    assert len(found) == 2
    for one in found:
        np.testing.assert_array_equal(one, alone_inner)


def test_the_users_scheduler_is_not_touched(make_pipeline, textured_plane):
    pipe = enable_geometry_guidance(make_pipeline(SCHEDULERS["dpm"]()))
    stock, guided = calls_of(pipe, textured_plane)
    stock()
    scheduler, config = pipe.scheduler, dict(pipe.config)
    before, seen = copy.deepcopy(vars(scheduler)), []
    guided(lambda p, *_: seen.append(p.scheduler))
    assert pipe.scheduler is scheduler and all(one is scheduler for one in seen)
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
    own_step, own_set_timesteps = scheduler.step, scheduler.set_timesteps

    def step(*args, **kwargs):
        calls.append("step")
        return own_step(*args, **kwargs)

    def set_timesteps(*args, **kwargs):
        calls.append("set")
        return own_set_timesteps(*args, **kwargs)

    scheduler.step, scheduler.set_timesteps = step, set_timesteps
    np.testing.assert_array_equal(guided(), reference)
    assert calls == ["set", "step", "step"]
    assert scheduler.step is step and scheduler.set_timesteps is set_timesteps
    inside = []
    np.testing.assert_array_equal(guided(lambda *_: inside.append(stock())), reference)
    np.testing.assert_array_equal(inside[0], plain)


def test_saved_in_a_callback_it_is_the_stock_pipeline(make_pipeline, textured_plane, tmp_path):
    pipe = enable_geometry_guidance(make_pipeline())
    calls_of(pipe, textured_plane)[1](lambda p, *_: p.save_pretrained(tmp_path / "saved"))
    make_pipeline().save_pretrained(tmp_path / "stock")
    for name in ("model_index.json", "scheduler/scheduler_config.json", "unet/config.json"):
        saved, stock = (json.loads((tmp_path / kind / name).read_text()) for kind in ("saved", "stock"))
        assert saved == stock


def test_a_scheduler_assigned_in_a_callback_stays(make_pipeline, textured_plane):
    pipe, other = enable_geometry_guidance(make_pipeline()), SCHEDULERS["dpm"]()
    guided = calls_of(pipe, textured_plane)[1]
    reference = guided()

    def assign(p, *_):
        p.scheduler = other

    np.testing.assert_array_equal(guided(assign), reference)  # the call goes on with its own
    assert pipe.scheduler is other and pipe.config["scheduler"][1] == "DPMSolverMultistepScheduler"


def test_threads_on_one_pipeline_wait_for_each_other(make_pipeline, textured_plane):
    pipe = enable_geometry_guidance(make_pipeline())
    stock, guided = calls_of(pipe, textured_plane, gradient="full")
    twin_stock, _ = calls_of(sharing(pipe), textured_plane)
    expected = [stock(), guided(), twin_stock()]
    start = threading.Barrier(4)

    def together(call):
        start.wait()
        return call()

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(together, [stock, guided, twin_stock, guided]))
    for one, reference in zip(found, [*expected, expected[1]], strict=True):
        np.testing.assert_array_equal(one, reference)
    assert all(p.requires_grad for p in pipe.unet.parameters())


def test_two_pipelines_of_the_same_networks_are_guided_one_after_the_other(make_pipeline, textured_plane):
    pipe = enable_geometry_guidance(make_pipeline())
    pipes = [pipe, enable_geometry_guidance(sharing(pipe))]
    calls = [calls_of(p, textured_plane, gradient="full")[1] for p in pipes]
    reference = calls[0]()
    with ThreadPoolExecutor(2) as pool:
        for found in pool.map(lambda call: call(), calls):
            np.testing.assert_array_equal(found, reference)
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


def test_a_prior_of_our_own_is_itself_in_a_callback(textured_plane):
    pipe = enable_geometry_guidance(make_lotus("g"))
    stock, guided = (
        lambda **k: pipe(textured_plane.left, generator=seeded(), **k).prediction,
        lambda f=None: (
            pipe(
                textured_plane.left,
                guidance=guidance_for(textured_plane, gradient="full"),
                generator=seeded(),
                callback_on_step_end=f,
            ).prediction
        ),
    )
    small, alone, found = stock(processing_resolution=40), guided(), []
    outer = guided(lambda *_: found.append(stock(processing_resolution=40)))
    np.testing.assert_array_equal(found[0], small)
    np.testing.assert_array_equal(outer, alone)
