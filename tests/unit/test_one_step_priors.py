"""Priors with one step: their schedule, and as many updates as other priors make in several."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.algorithm.denoising import noise_from, output_from, z0_from
from geodiff_plugin.algorithm.gradients import RULES, Plain
from geodiff_plugin.algorithm.schedule import count_steps
from geodiff_plugin.priors.pipelines.direct_scheduler import DirectScheduler
from geodiff_plugin.runtime.noise_levels import check_scheduler, noise_level
from tests.conftest import SCHEDULER
from tests.contracts.tiny_priors import make_e2e_ft


def test_direct_scheduler_gives_the_output_and_saves(tmp_path):
    DirectScheduler(timestep=1).save_pretrained(tmp_path)
    scheduler = DirectScheduler.from_pretrained(tmp_path)
    scheduler.set_timesteps(1, device="cpu")
    assert scheduler.timesteps.tolist() == [1]
    output, z = torch.ones(1, 4, 2, 2), torch.zeros(1, 4, 2, 2)
    assert scheduler.step(output, scheduler.timesteps[0], z).prev_sample is output
    assert scheduler.step(output, 1, z, return_dict=False)[0] is output
    check_scheduler(scheduler)
    with pytest.raises(ValueError, match="num_inference_steps must be 1"):
        scheduler.set_timesteps(4)
    with pytest.raises(ValueError, match="must be 'sample'"):
        DirectScheduler(prediction_type="epsilon")


def test_direct_output_is_the_clean_latent_and_can_be_moved():
    level = noise_level(DirectScheduler(), torch.tensor(999))
    output, z = torch.randn(1, 4, 2, 2), torch.zeros(1, 4, 2, 2)
    z0, eps = z0_from(output, z, level), noise_from(output, z, level)
    assert torch.equal(z0, output) and eps.norm() > 0  # a yardstick for the norm-matched rule
    assert torch.equal(output_from(z0 + 1, eps, level)[0], output + 1)


def test_e2e_ft_ends_at_the_clean_latent():
    """Its DDIM's prev_sample is the authors' pred_original_sample."""
    pipe = make_e2e_ft()
    assert isinstance(pipe.scheduler, DDIMScheduler)
    pipe.scheduler.set_timesteps(1)
    (t,) = pipe.scheduler.timesteps
    v, z = torch.randn(2, 1, 4, 3, 3)
    step = pipe.scheduler.step(v, t, z)
    assert t == 999 and torch.equal(step.prev_sample, step.pred_original_sample)
    plain = DDIMScheduler(**SCHEDULER | {"rescale_betas_zero_snr": False})
    plain.set_timesteps(1)
    assert not torch.equal(plain.step(v, t, z).prev_sample, step.prev_sample)


@pytest.mark.parametrize(
    ("most", "asked", "default", "planned"),
    [
        (None, None, 1, (4, 1)),
        (None, 2, 10, (2, 1)),
        (1, None, 1, (1, 4)),
        (1, 1, 1, (1, 1)),
        (3, None, 3, (3, 2)),
    ],
)
def test_plan_of_steps_and_rounds(textured_plane, most, asked, default, planned):
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E, min_steps=4)
    assert count_steps(guidance.denoising_steps(asked, default), asked, most) == planned


@pytest.mark.parametrize(("start", "rounds"), [(0.0, 3), (0.5, 1)])
def test_one_step_makes_the_updates_of_all(textured_plane, monkeypatch, start, rounds):
    """3 rounds of 2 updates in the one step; ``start`` leaves out rounds as it would leave out steps."""
    steps = []

    class Counted(Plain):
        def step(self, gradient, reference=None):
            steps.extend([gradient] * (gradient.ndim == 4))  # not those of scale and shift
            return super().step(gradient, reference)

    monkeypatch.setitem(RULES, "counted", Counted)
    pipe = enable_geometry_guidance(make_e2e_ft())
    guidance = GeometryGuidance(
        textured_plane.right,
        textured_plane.K,
        textured_plane.E,
        rule="counted",
        inner_steps=2,
        min_steps=3,
        start=start,
        weights={"photometric": 1.0},
        loss_resolution=64,
    )
    out = pipe(Image.fromarray(textured_plane.left), guidance=guidance)
    assert len(steps) == 2 * rounds and len(out.history) == rounds
    assert {report.step for report in out.history} == {0}
    assert np.isfinite(out.prediction).all()
