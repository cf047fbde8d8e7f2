"""Noise level of a live scheduler at a timestep, with one function per scheduler family (``FAMILIES``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from diffusers import (
    DDIMScheduler,
    DDPMScheduler,
    DPMSolverMultistepScheduler,
    FlowMatchEulerDiscreteScheduler,
    LCMScheduler,
)
from torch import Tensor

from geodiff_plugin._internal.checks import bad_type, bad_value
from geodiff_plugin.algorithm.denoising import NoiseLevel
from geodiff_plugin.priors.components import DirectScheduler


def _discrete(scheduler: Any, timestep: Tensor) -> NoiseLevel:
    """Read the noise level of schedulers that index ``alphas_cumprod`` by timestep."""
    table, config = scheduler.alphas_cumprod, scheduler.config
    alpha_bar = table[timestep.to(table.device)].float()  # diffusers keeps the table on the CPU
    clip = float(config.get("clip_sample_range", 1.0)) if config.get("clip_sample") else None
    return NoiseLevel(alpha_bar.sqrt(), (1.0 - alpha_bar).sqrt(), config.prediction_type, clip)


def _sigma(scheduler: Any, timestep: Tensor) -> Tensor:
    """Return the scheduler's sigma for its next step."""
    index = scheduler.step_index
    return scheduler.sigmas[scheduler.index_for_timestep(timestep) if index is None else index].float()


def _sigmas_vp(scheduler: Any, timestep: Tensor) -> NoiseLevel:
    """Return the noise level of DPM solvers: sigma / alpha by step index, variance preserving."""
    alpha_t, sigma_t = scheduler._sigma_to_alpha_sigma_t(_sigma(scheduler, timestep))
    return NoiseLevel(alpha_t, sigma_t, scheduler.config.prediction_type)


def _flow(scheduler: Any, timestep: Tensor) -> NoiseLevel:
    """Return the noise level of rectified flow: ``z_t = (1 - sigma) z_0 + sigma eps``."""
    sigma = _sigma(scheduler, timestep)
    return NoiseLevel(1.0 - sigma, sigma, "flow_prediction")


def _direct(scheduler: Any, timestep: Tensor) -> NoiseLevel:
    """Return unit levels: the output is the clean latent, and the input minus the output acts as noise."""
    level = torch.ones((), device=timestep.device)
    return NoiseLevel(level, level, scheduler.config.prediction_type)


FAMILIES: dict[type, Callable[[Any, Tensor], NoiseLevel]] = {
    DDIMScheduler: _discrete,
    DDPMScheduler: _discrete,
    LCMScheduler: _discrete,
    DPMSolverMultistepScheduler: _sigmas_vp,
    FlowMatchEulerDiscreteScheduler: _flow,
    DirectScheduler: _direct,
}


def noise_level(scheduler: Any, timestep: Tensor) -> NoiseLevel:
    """Return the signal and noise level that the scheduler's next ``step`` assumes at a 0-d ``timestep``."""
    return _family(scheduler)(scheduler, timestep)


def _family(scheduler: Any) -> Callable[[Any, Tensor], NoiseLevel]:
    for cls, family in FAMILIES.items():
        if isinstance(scheduler, cls):
            return family
    names = ", ".join(cls.__name__ for cls in FAMILIES)
    hint = "Use pipe.scheduler = DDIMScheduler.from_config(pipe.scheduler.config)."
    bad_type("pipe.scheduler", f"one of {names}", scheduler, hint)


def check_scheduler(scheduler: Any) -> None:
    """Raise an error for unsupported schedulers: unknown family, 0 / 0 at zero SNR, or thresholding."""
    _family(scheduler)
    name = type(scheduler).__name__
    config = scheduler.config
    if getattr(config, "rescale_betas_zero_snr", False) and config.prediction_type == "epsilon":
        expected = "able to compute the clean latent from the network's output at every step"
        got = f"{name} with prediction_type='epsilon' and rescale_betas_zero_snr=True"
        hint = "Noise alone does not determine a clean latent; set rescale_betas_zero_snr=False or use "
        bad_value("pipe.scheduler", expected, got, hint + "v_prediction.")
    if getattr(config, "thresholding", False):
        expected = "without dynamic thresholding, which applies to pixels, not latents"
        hint = "pipe.scheduler = type(pipe.scheduler).from_config(pipe.scheduler.config, thresholding=False)"
        bad_value("pipe.scheduler", expected, f"{name} with thresholding=True", hint)


def trailing_timesteps(scheduler: Any, num_inference_steps: int) -> Tensor | None:
    """Return a ``leading`` DDIM schedule with trailing spacing; ``None`` for other schedulers.

    A leading schedule never visits t = 999: it treats pure noise as the noise of a lower level (t = 1 for a
    single step).
    """
    if not isinstance(scheduler, DDIMScheduler) or scheduler.config.timestep_spacing != "leading":
        return None
    twin = type(scheduler).from_config(scheduler.config, timestep_spacing="trailing")
    twin.set_timesteps(num_inference_steps)
    return twin.timesteps
