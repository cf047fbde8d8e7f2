"""Our arithmetic against every supported scheduler's own ``step``."""

import pytest
import torch
from diffusers import (
    DDIMScheduler,
    DDPMScheduler,
    DPMSolverMultistepScheduler,
    FlowMatchEulerDiscreteScheduler,
    LCMScheduler,
)

from geodiff_plugin.algorithm.denoising import noise_from, output_from, z0_from
from geodiff_plugin.runtime.noise_levels import noise_level, trailing_timesteps

BETAS = {"beta_schedule": "scaled_linear", "beta_start": 0.00085, "beta_end": 0.012}
TYPES = ["epsilon", "v_prediction", "sample"]


def ddim(**kwargs):
    return DDIMScheduler(**BETAS, clip_sample=False, **kwargs)


V, ZERO_SNR = BETAS | {"prediction_type": "v_prediction"}, {"rescale_betas_zero_snr": True}
TRAILING, LEADING = {"timestep_spacing": "trailing"}, {"timestep_spacing": "leading"}
SCHEDULERS = {
    **{f"ddim-trailing-{p}": lambda p=p: ddim(**TRAILING, prediction_type=p) for p in TYPES},
    **{f"ddim-leading-{p}": lambda p=p: ddim(**LEADING, prediction_type=p) for p in TYPES},
    "ddim-zero-snr": lambda: ddim(**TRAILING, **ZERO_SNR, prediction_type="v_prediction"),
    "ddim-clip": lambda: DDIMScheduler(**V, clip_sample=True),
    **{f"ddpm-{p}": lambda p=p: DDPMScheduler(**BETAS, clip_sample=False, prediction_type=p) for p in TYPES},
    "lcm": lambda: LCMScheduler(**V, original_inference_steps=50),
    **{f"dpm-{p}": lambda p=p: DPMSolverMultistepScheduler(**BETAS, prediction_type=p) for p in TYPES},
    "flow": FlowMatchEulerDiscreteScheduler,
    "dpm-zero-snr": lambda: DPMSolverMultistepScheduler(**V, **ZERO_SNR, **TRAILING),
}


def draw(seed):
    g = torch.Generator().manual_seed(seed)
    return torch.randn(2, 4, 3, 5, generator=g), 0.5 * torch.randn(2, 4, 3, 5, generator=g)


def walk(make, edit=None, steps=4):
    """Run a schedule on fixed network outputs; yields z0_hat, z_{t-1} and the scheduler's own z0."""
    scheduler = make()
    scheduler.set_timesteps(steps)
    z_t, _ = draw(0)
    for i, t in enumerate(scheduler.timesteps):
        output = draw(i + 1)[1]
        level = noise_level(scheduler, t)
        z0 = z0_from(output, z_t, level)
        fed = (output, z_t)
        if edit is not None:
            fed = output_from(edit(z0), noise_from(output, z_t, level), level)
        result = scheduler.step(fed[0], t, fed[1], generator=torch.Generator().manual_seed(i))
        own = getattr(result, "pred_original_sample", getattr(result, "denoised", None))
        z_t = result.prev_sample
        yield z0, z_t, own


@pytest.mark.parametrize("name", SCHEDULERS)
def test_z0_hat_is_the_schedulers_own(name):
    for z0, _, own in walk(SCHEDULERS[name]):
        if own is not None:  # the DPM solvers return no clean latent
            torch.testing.assert_close(z0, own, atol=2e-5, rtol=2e-5)


@pytest.mark.parametrize("name", [n for n in SCHEDULERS if "clip" not in n])
def test_steps_are_rebuilt_and_an_edit_reaches_the_end(name):
    """A clipped clean latent and the unclipped noise do not make up z_t; of all others they do."""
    plain, rebuilt = ([z for _, z, _ in walk(SCHEDULERS[name], edit)] for edit in (None, lambda z0: z0))
    for a, b in zip(plain, rebuilt, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)
    target = torch.full((2, 4, 3, 5), 0.25)
    *_, (_, last, _) = walk(SCHEDULERS[name], edit=lambda z0: target, steps=5)
    torch.testing.assert_close(last, target, atol=0.12 if name.startswith("ddpm") else 1e-3, rtol=0)


def test_a_changed_clean_latent_enters_the_multistep_history():
    scheduler = SCHEDULERS["dpm-v_prediction"]()
    scheduler.set_timesteps(6)
    t, (z_t, output) = scheduler.timesteps[0], draw(0)
    level = noise_level(scheduler, t)
    edited = z0_from(output, z_t, level) + 1.0
    output, z_t = output_from(edited, noise_from(output, z_t, level), level)
    scheduler.step(output, t, z_t)
    torch.testing.assert_close(scheduler.model_outputs[-1], edited, atol=1e-4, rtol=1e-4)


def test_leading_ddim_is_respaced_and_nothing_else():
    leading = ddim(timestep_spacing="leading", steps_offset=1)
    assert trailing_timesteps(leading, 4).tolist() == [999, 749, 499, 249]
    assert trailing_timesteps(leading, 1).tolist() == [999]
    assert trailing_timesteps(ddim(timestep_spacing="trailing"), 4) is None
    assert trailing_timesteps(SCHEDULERS["lcm"](), 4) is None
