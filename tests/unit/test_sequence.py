"""Rendered sequences, their flicker, and calls that go on from the frame before."""

import copy

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin._checks import InputError, InputTypeError
from geodiff_plugin.evaluation import frames
from geodiff_plugin.evaluation.baselines import PriorCache
from geodiff_plugin.evaluation.options import SequenceOptions
from geodiff_plugin.priors import prior_of
from geodiff_plugin.runtime.run import plan_warm_start
from geodiff_plugin.types import MetricDepthOutput
from tests.scenes import render_sequence


def test_flicker_is_what_changes_on_the_same_points():
    truth = frames.true_frames(render_sequence(3, 3, size=(48, 64)))
    still = [np.full((48, 64), 0.1)] * 3
    assert frames.flicker(still, truth) == (0.0, 0.0)  # wrong, but steadily so
    breathing = [np.full((48, 64), value) for value in (0.0, 0.02, 0.0)]
    assert frames.flicker(breathing, truth) == pytest.approx((0.02, 0.02))
    noise = np.random.default_rng(0).normal(size=(3, 48, 64)) * 0.1
    points, breath = frames.flicker(list(noise), truth)
    # The mean of |a - b| of two normal numbers of deviation s is 2 s / sqrt(pi).
    assert points == pytest.approx(0.2 / np.sqrt(np.pi), rel=0.1) and breath < 0.02


def test_the_command_measures_and_goes_on(tmp_path, monkeypatch):
    given = {"size": (64, 96), "ways": ("alone", "warm"), "steps": 2, "out": tmp_path, "quiet": True}
    options = SequenceOptions(scenes=1, frames=2, **given)
    page = frames.run_sequence("sequence", options)
    assert [row[0] for row in page.tables[0].rows] == ["each frame alone", "warm start, a quarter left out"]
    assert all(0 < float(row[1]) < 2 and float(row[-1]) > 0 for row in page.tables[0].rows)
    monkeypatch.setattr(frames, "_measure_sequence", lambda *_: pytest.fail("it was measured"))
    assert frames.run_sequence("sequence", options).tables == page.tables
    monkeypatch.setattr(PriorCache, "fingerprint", lambda self, settings: "trained further")
    with pytest.raises(pytest.fail.Exception):
        frames.run_sequence("sequence", options)


# Calls that go on


@pytest.fixture
def pipe(make_pipeline):
    return enable_geometry_guidance(make_pipeline())


@pytest.fixture
def first(pipe, textured_plane):
    return call(pipe, textured_plane)


def guided(pair, previous, **more):
    return GeometryGuidance(pair.right, pair.K, pair.E, previous=previous, **more)


def planned(pipe, guidance, size=(48, 64), **told):
    """What a call of 4 steps would start with."""
    told = {"ensemble_size": 1, "num_inference_steps": 4, "latents": None, "generator": None} | told
    return plan_warm_start(pipe, prior_of(pipe), guidance, told, size)


def call(pipe, pair, previous=None, warm_start=0.25, **told):
    guidance = guided(pair, previous, warm_start=warm_start, inner_steps=0, corrections=4)
    told = {"generator": torch.Generator().manual_seed(0), "num_inference_steps": 4} | told
    return pipe(pair.left, guidance=guidance, output_latent=True, **told)


def test_a_call_goes_on_in_the_middle_of_the_schedule(pipe, textured_plane, first):
    every = [float(report.timestep) for report in first.history]
    for share, steps in ((0.5, 2), (0.25, 3), (0.99, 1), (0.0, 4)):
        second = call(pipe, textured_plane, first, share)
        assert [float(report.timestep) for report in second.history] == every[4 - steps :]
    assert type(pipe.scheduler) is DDIMScheduler and len(pipe.scheduler.timesteps) == 1000  # as it was
    half = call(pipe.to(torch.bfloat16), textured_plane, first)
    assert np.isfinite(half.prediction).all()


def test_its_latents_are_the_frame_before_at_the_level_of_that_step(pipe, textured_plane, first):
    """Mean over many draws: alpha z0; spread: sigma, by the scheduler's own table."""
    guidance, generator = guided(textured_plane, first), torch.Generator().manual_seed(1)
    warm = [planned(pipe, guidance, generator=generator) for _ in range(100)]
    assert warm[0].skipped == 1
    alpha_bar = pipe.scheduler.alphas_cumprod[749]
    drawn = torch.stack([each.latents for each in warm])
    torch.testing.assert_close(drawn.mean(0), alpha_bar.sqrt() * first.latent, atol=0.5, rtol=0)
    assert float(drawn.std(0).mean()) == pytest.approx(float((1 - alpha_bar).sqrt()), rel=0.05)


def test_its_scale_is_that_of_the_frame_before(pipe, textured_plane, first):
    """With no search and no fit of its own, a call has the depths of the ends that it was given."""
    ratio = call(pipe, textured_plane, first).prediction / first.prediction
    assert abs(np.log(np.median(ratio))) < 0.05
    plain = planned(pipe, guided(textured_plane, first), latents=torch.zeros_like(first.latent))
    g_s, shift = first.global_scale[0], first.shift[0]
    torch.testing.assert_close(plain.near_m, g_s * shift, rtol=1e-5, atol=0)
    torch.testing.assert_close(plain.far_m, g_s * shift + g_s * first.scale[0], rtol=1e-5, atol=0)
    # Poses without a unit, a frame before whose lengths were multiplied to a metric prior's.
    first.rescaled, first.global_scale = 4.0, 4.0 * first.global_scale
    for unit, factor in (("m", 4.0), (None, 1.0)):
        again = planned(pipe, guided(textured_plane, first, unit=unit))
        torch.testing.assert_close(again.near_m, factor * plain.near_m)
        torch.testing.assert_close(again.far_m, factor * plain.far_m)


def test_what_cannot_be_gone_on_from_is_refused(pipe, textured_plane, first):
    def changed(**entries):
        other = copy.copy(first)
        vars(other).update(entries)
        return other

    for previous, told, said in (
        (first.prediction, {}, "previous must be a MetricDepthOutput"),
        (MetricDepthOutput(first.prediction), {}, "output_latent=True"),
        (first, {"ensemble_size": 2}, r"of 1 images of 2 members; got \(1, 1\)"),
        (changed(space="disparity"), {}, "a prior whose map is affine in depth; got one in disparity"),
        (changed(latent=first.latent[..., :-1]), {}, "a sequence of its own"),
        (first, {"latents": first.latent[:, :1]}, "latents must be of shape"),  # would be spread silently
        (first, {"latents": [first.latent]}, "latents must be None or a torch.Tensor; got list"),
    ):
        with pytest.raises((InputError, InputTypeError), match=said):
            call(pipe, textured_plane, previous, **told)
