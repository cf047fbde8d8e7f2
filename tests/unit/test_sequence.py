"""Rendered sequences, their flicker, and calls that go on from the frame before."""

from __future__ import annotations

import copy
import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, LCMScheduler

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin._checks import InputError, InputTypeError
from geodiff_plugin.evaluation.baselines import PriorCache
from geodiff_plugin.evaluation.options import SequenceOptions
from geodiff_plugin.evaluation.sequence import SEQUENCES, flicker, run_sequence
from geodiff_plugin.priors import find_adapter
from geodiff_plugin.runtime.start import plan_warm_start
from geodiff_plugin.types import MetricDepthOutput
from tests.contracts.tiny_priors import make_geowizard
from tests.scenes import render_sequence

FAST = {"inner_steps": 0, "corrections": 4}


@pytest.fixture(scope="module")
def sequence():
    return render_sequence(3, 3, size=(48, 64))


def test_flicker_is_what_changes_on_the_same_points(sequence):
    still = [np.full((48, 64), 0.1)] * 3
    assert flicker(still, sequence) == (0.0, 0.0)  # wrong, but steadily so
    breathing = [np.full((48, 64), value) for value in (0.0, 0.02, 0.0)]
    assert flicker(breathing, sequence) == pytest.approx((0.02, 0.02))
    noise = np.random.default_rng(0).normal(size=(3, 48, 64)) * 0.1
    points, breath = flicker(list(noise), sequence)
    # The mean of |a - b| of two normal numbers of deviation s is 2 s / sqrt(pi).
    assert points == pytest.approx(0.2 / np.sqrt(np.pi), rel=0.1) and breath < 0.02


def test_the_command_measures_and_goes_on(tmp_path, monkeypatch):
    given = {"size": (64, 96), "ways": ("alone", "warm"), "steps": 2, "out": tmp_path, "quiet": True}
    options = SequenceOptions(scenes=1, frames=2, **given)
    page = run_sequence("sequence", options)
    assert [row[0] for row in page.tables[0].rows] == ["each frame alone", "warm start, a quarter left out"]
    records = [json.loads(line) for line in (tmp_path / "sequence.jsonl").read_text().splitlines()]
    assert all(0 < record["abs_rel"] < 2 and record["seconds"] > 0 for record in records)
    measured = []

    def measure(pipe, render, seed, way, *_):
        measured.append(way.title)
        return dict.fromkeys(("abs_rel", "worst", "flicker", "breath", "seconds"), 0.5)

    rendered = SimpleNamespace(seed=0, kind="room")
    monkeypatch.setitem(SEQUENCES, "synthetic", lambda *_, **__: rendered)
    monkeypatch.setattr("geodiff_plugin.evaluation.sequence._measure", measure)
    assert run_sequence("sequence", options).tables == page.tables and not measured  # nothing left to do
    path = tmp_path / "sequence.jsonl"
    path.write_bytes(path.read_bytes()[:-20])  # killed while it wrote
    assert run_sequence("sequence", options).tables != page.tables and measured == [
        "warm start, a quarter left out"
    ]
    assert run_sequence("sequence", options) and len(measured) == 1
    monkeypatch.setattr(PriorCache, "fingerprint", lambda self, settings: "trained further")
    assert run_sequence("sequence", options) and len(measured) == 3


# Calls that go on


@pytest.fixture
def pipe(make_pipeline):
    return enable_geometry_guidance(make_pipeline())


def call(pipe, pair, steps=4, previous=None, size=1, latents=None, **knobs):
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, previous=previous, **FAST, **knobs)
    return pipe(
        pair.left,
        guidance=guidance,
        num_inference_steps=steps,
        ensemble_size=size,
        generator=torch.Generator().manual_seed(0),
        output_latent=True,
        latents=latents,
    )


def test_a_call_goes_on_in_the_middle_of_the_schedule(pipe, textured_plane):
    first = call(pipe, textured_plane)
    for share, steps in ((0.5, 2), (0.25, 3), (0.99, 1), (0.0, 4)):
        second = call(pipe, textured_plane, previous=first, warm_start=share)
        assert [float(report.timestep) for report in second.history] == [
            float(report.timestep) for report in first.history[4 - steps :]
        ]
    assert type(pipe.scheduler) is DDIMScheduler and len(pipe.scheduler.timesteps) == 1000  # as it was


def test_its_latents_are_the_frame_before_at_the_level_of_that_step(pipe, textured_plane):
    """Mean over many draws: alpha z0; spread: sigma, by the scheduler's own table."""
    first = call(pipe, textured_plane)
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E, previous=first)
    prior, draws = find_adapter(pipe)(pipe), []
    generator = torch.Generator().manual_seed(1)
    told = {"ensemble_size": 1, "num_inference_steps": 4, "latents": None, "generator": generator}
    for _ in range(100):
        warm = plan_warm_start(pipe, prior, guidance, told, (48, 64))
        draws.append(warm.latents)
    assert warm.skipped == 1
    alpha_bar = pipe.scheduler.alphas_cumprod[749]
    drawn = torch.stack(draws)
    torch.testing.assert_close(drawn.mean(0), alpha_bar.sqrt() * first.latent, atol=0.5, rtol=0)
    assert float(drawn.std(0).mean()) == pytest.approx(float((1 - alpha_bar).sqrt()), rel=0.05)


def test_its_scale_is_that_of_the_frame_before(pipe, textured_plane):
    """With no search and no fit of its own, a call has the depths of the ends that it was given."""
    first = call(pipe, textured_plane)
    told = {"ensemble_size": 1, "num_inference_steps": 4, "latents": torch.zeros_like(first.latent)}
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E, previous=first)
    warm = plan_warm_start(pipe, find_adapter(pipe)(pipe), guidance, told, (48, 64))
    scale, shift, g_s = first.scale[0, 0], first.shift[0, 0], first.global_scale[0, 0]
    assert float(warm.near_m[0]) == pytest.approx(float(g_s * shift), rel=1e-5)
    assert float(warm.far_m[0]) == pytest.approx(float(g_s * (scale + shift)), rel=1e-5)
    second = call(pipe, textured_plane, previous=first)
    ratio = second.prediction / first.prediction
    assert abs(np.log(np.median(ratio))) < 0.05


def test_metres_of_a_prior_become_baselines_again(pipe, textured_plane):
    """Poses without a unit, a frame before whose lengths were multiplied to a metric prior's."""
    first = call(pipe, textured_plane)
    told = {"ensemble_size": 1, "num_inference_steps": 4, "latents": None, "generator": None}
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E, previous=first)
    prior = find_adapter(pipe)(pipe)
    plain = plan_warm_start(pipe, prior, guidance, told, (48, 64))
    first.rescaled, first.global_scale = 4.0, 4.0 * first.global_scale
    in_metres = plan_warm_start(pipe, prior, guidance, told, (48, 64))
    no_unit = GeometryGuidance(
        textured_plane.right, textured_plane.K, textured_plane.E, previous=first, unit=None
    )
    in_baselines = plan_warm_start(pipe, prior, no_unit, told, (48, 64))
    torch.testing.assert_close(in_metres.near_m, 4.0 * plain.near_m)
    torch.testing.assert_close(in_baselines.near_m, plain.near_m)
    torch.testing.assert_close(in_baselines.far_m, plain.far_m)


def test_another_scheduler_takes_over_the_scale_alone(make_pipeline, textured_plane):
    scheduler = LCMScheduler.from_config(make_pipeline().scheduler.config)
    pipe = enable_geometry_guidance(make_pipeline(scheduler))
    first = call(pipe, textured_plane)
    assert len(call(pipe, textured_plane, previous=first).history) == 4


def test_what_cannot_be_gone_on_from_is_refused(pipe, textured_plane):
    first = call(pipe, textured_plane)
    with pytest.raises(InputError, match="previous must be a MetricDepthOutput"):
        call(pipe, textured_plane, previous=first.prediction)
    with pytest.raises(InputError, match="output_latent=True"):
        call(pipe, textured_plane, previous=MetricDepthOutput(first.prediction))
    with pytest.raises(InputError, match="output of 1 image of 2 members; got one of 1 image of 1 member"):
        call(pipe, textured_plane, previous=first, size=2)
    members = copy.copy(first)
    members.latent = first.latent.repeat(2, 1, 1, 1)
    members.scale, members.shift, members.global_scale = (
        value.repeat(1, 2) for value in (first.scale, first.shift, first.global_scale)
    )
    two = GeometryGuidance([textured_plane.right] * 2, textured_plane.K, textured_plane.E, previous=members)
    with pytest.raises(InputError, match="previous must be the output of 2 images of 1 member"):
        pipe([textured_plane.left] * 2, guidance=two)
    other = copy.copy(first)
    other.space = "disparity"
    with pytest.raises(InputError, match="a prior whose map is affine in depth; got one in disparity"):
        call(pipe, textured_plane, previous=other)
    small = copy.copy(first)
    small.latent = first.latent[..., :-1]
    with pytest.raises(InputError, match="a sequence of its own"):
        call(pipe, textured_plane, previous=small)
    for latents in (first.latent[..., :-1], first.latent[:, :1]):  # the latter would be spread silently
        with pytest.raises(InputError, match="latents must be of shape"):
            call(pipe, textured_plane, previous=first, latents=latents)
    with pytest.raises(InputTypeError, match="latents must be None or a torch.Tensor; got list"):
        call(pipe, textured_plane, previous=first, latents=[first.latent])


def test_depth_and_normals_start_from_one_noise(textured_plane):
    """As in GeoWizard's own call."""
    pipe = enable_geometry_guidance(make_geowizard())
    first = call(pipe, textured_plane)
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E, previous=first)
    told = {"ensemble_size": 1, "num_inference_steps": 4, "latents": None, "generator": None}
    factor = pipe.image_processor.config.vae_scale_factor
    size = tuple(side * factor for side in first.latent.shape[-2:])
    warm = plan_warm_start(pipe, find_adapter(pipe)(pipe), guidance, told, size)
    alpha_bar = pipe.scheduler.alphas_cumprod[int(first.history[warm.skipped].timestep)]
    depth, normals = (warm.latents - alpha_bar.sqrt() * first.latent).chunk(2, dim=1)
    torch.testing.assert_close(depth, normals, rtol=0, atol=1e-4)


def test_a_frame_of_another_precision_goes_on(pipe, textured_plane):
    first = call(pipe, textured_plane)
    half = call(pipe.to(torch.bfloat16), textured_plane, previous=first)
    assert np.isfinite(half.prediction).all()
