"""Noise levels of schedulers against their tables, computed in NumPy from the betas."""

import numpy as np
import pytest
import torch
from diffusers import (
    DDIMScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    FlowMatchEulerDiscreteScheduler,
    LCMScheduler,
)

from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.runtime.noise_levels import check_scheduler, noise_level, trailing_timesteps

BETAS = {"beta_schedule": "scaled_linear", "beta_start": 0.00085, "beta_end": 0.012}
ALPHA_BAR = np.cumprod(1.0 - np.linspace(0.00085**0.5, 0.012**0.5, 1000) ** 2)


@pytest.mark.parametrize("cls", [DDIMScheduler, LCMScheduler])
@pytest.mark.parametrize("clip", [None, 1.0, 2.5])
def test_discrete_schedulers_give_the_roots_of_their_table(cls, clip):
    given = {"clip_sample": clip is not None} | ({} if clip is None else {"clip_sample_range": clip})
    scheduler = cls(**BETAS, **given, prediction_type="v_prediction")
    for t in (0, 1, 437, 999):
        level = noise_level(scheduler, torch.tensor(t))
        assert level.alpha.item() == pytest.approx(ALPHA_BAR[t] ** 0.5, rel=1e-4)
        assert level.sigma.item() == pytest.approx((1 - ALPHA_BAR[t]) ** 0.5, rel=1e-4)
        assert (level.prediction_type, level.clip) == ("v_prediction", clip)
        assert level.alpha.dtype == torch.float32


def test_solvers_follow_their_index_or_the_timestep_before_the_first_step():
    scheduler = DPMSolverMultistepScheduler(**BETAS, prediction_type="sample")
    scheduler.set_timesteps(5)
    for index in (None, 0, 3):
        scheduler._step_index = index
        t = scheduler.timesteps[2 if index is None else index]
        level = noise_level(scheduler, t)
        assert level.alpha.item() == pytest.approx(ALPHA_BAR[int(t)] ** 0.5, rel=2e-3)
        assert level.alpha**2 + level.sigma**2 == pytest.approx(1.0)
        assert (level.prediction_type, level.clip) == ("sample", None)


def test_a_flow_goes_straight_from_noise_to_data():
    scheduler = FlowMatchEulerDiscreteScheduler()
    scheduler.set_timesteps(4)
    for index in (None, 0, 2):
        scheduler._step_index = index
        level = noise_level(scheduler, scheduler.timesteps[1 if index is None else index])
        sigma = scheduler.timesteps[1 if index is None else index] / 1000.0
        assert level.sigma.item() == pytest.approx(sigma.item(), rel=1e-5)
        assert level.alpha.item() == pytest.approx(1 - sigma.item(), rel=1e-5)
        assert level.prediction_type == "flow_prediction"


def test_a_direct_scheduler_takes_the_output_for_the_clean_latent():
    level = noise_level(DirectScheduler(), torch.tensor(1))
    assert level.alpha == level.sigma == 1.0 and level.prediction_type == "sample"


def test_leading_schedules_of_ddim_become_trailing_ones():
    scheduler = DDIMScheduler(**BETAS, timestep_spacing="leading", steps_offset=1)
    scheduler.set_timesteps(3)
    before = scheduler.timesteps.tolist()
    found = trailing_timesteps(scheduler, 5)
    np.testing.assert_array_equal(found, np.round(np.arange(1000, 0, -200)) - 1)
    assert scheduler.timesteps.tolist() == before
    for other in (
        DDIMScheduler(**BETAS, timestep_spacing="linspace"),
        LCMScheduler(**BETAS, timestep_spacing="leading"),
    ):
        assert trailing_timesteps(other, 5) is None


@pytest.mark.parametrize(
    ("scheduler", "message"),
    [
        (
            EulerDiscreteScheduler(),
            r"pipe.scheduler must be one of DDIMScheduler.*; got EulerDiscreteScheduler\. Use .*from_config",
        ),
        (
            DDIMScheduler(rescale_betas_zero_snr=True),
            r"must be able to compute .*; got DDIMScheduler with prediction_type='epsilon' and "
            r".*\. Noise alone",
        ),
        (
            DDIMScheduler(thresholding=True),
            r"must be without dynamic .*; got DDIMScheduler with thresholding=True\. pipe.scheduler = ",
        ),
        (DDIMScheduler(rescale_betas_zero_snr=True, prediction_type="sample"), None),
        (DDIMScheduler(), None),
        (DirectScheduler(), None),
    ],
)
def test_schedulers_that_determine_no_clean_latent_are_rejected(scheduler, message):
    if message is None:
        check_scheduler(scheduler)
        return
    with pytest.raises((ValueError, TypeError), match=message):
        check_scheduler(scheduler)
