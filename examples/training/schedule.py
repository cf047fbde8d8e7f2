"""Training schedule: stages, learning rate and timesteps by the spent fraction of the time budget.

Data flow: fraction in [0, 1] -> learning rate, image size, fraction of pure regression; batch -> loss.
Paper: none; v-prediction with zero terminal signal-to-noise ratio, as Marigold v1-1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from diffusers import DDIMScheduler

__all__ = ["Stage", "diffusion_loss", "draw_timesteps", "learning_rate", "stage_at"]


@dataclass(frozen=True)
class Stage:
    """One stage of the training.

    Attributes:
        until: fraction of the budget at which the stage ends, in (0, 1].
        divisors: rendered images are used at ``1 / divisor`` of their size; steps cycle through the divisors.
        last: fraction of samples at the last timestep, where the denoiser is a regression from the image.
    """

    until: float
    divisors: tuple[int, ...]
    last: float


# With full size only, the prior loses accuracy at half size within an hour. Wide images need half size.
SCRATCH = (Stage(0.45, (2,), 0.9), Stage(0.65, (2,), 0.5), Stage(1.0, (2, 1), 0.5))
CONTINUED = (Stage(0.6, (2,), 0.8), Stage(1.0, (2, 1), 0.6))


def stage_at(fraction: float, continued: bool) -> Stage:
    """Return the stage at a spent fraction of the budget; a continued prior skips learning the chain."""
    stages = CONTINUED if continued else SCRATCH
    return next((stage for stage in stages if fraction < stage.until), stages[-1])


def learning_rate(top: float, fraction: float, step: int, warm_up: int = 300) -> float:
    """Linear warm-up over ``warm_up`` steps, then a cosine over the budget down to 1 % of ``top``."""
    cosine = 0.5 * (1.0 + math.cos(math.pi * min(fraction, 1.0)))
    return top * min(1.0, (step + 1) / warm_up) * (0.01 + 0.99 * cosine)


def draw_timesteps(count: int, last: float, generator: torch.Generator, steps: int = 1000) -> torch.Tensor:
    """Timesteps ``(count,)``: a fraction ``last`` at the end of the chain, and more noisy than clean ones."""
    uniform = torch.rand(count, generator=generator)
    spread = (steps * (1.0 - uniform**1.5)).long().clamp(0, steps - 1)
    at_end = torch.rand(count, generator=generator) < last
    return torch.where(at_end, torch.full_like(spread, steps - 1), spread)


def diffusion_loss(
    unet: torch.nn.Module,
    scheduler: DDIMScheduler,
    image: torch.Tensor,
    depth: torch.Tensor,
    text: torch.Tensor,
    timesteps: torch.Tensor,
    noise: torch.Tensor,
) -> torch.Tensor:
    """Compute the squared error plus half the absolute error of the predicted v.

    With the absolute error, the one-step prediction is a median, which keeps edges that a mean would blur.

    Args:
        unet: denoiser.
        scheduler: holds the noise schedule.
        image: image latents ``(N, 4, h, w)``.
        depth: clean depth latents ``(N, 4, h, w)``.
        text: empty-prompt embedding ``(1, L, C)``.
        timesteps: ``(N,)`` in [0, 999].
        noise: ``(N, 4, h, w)`` standard normal.

    Returns:
        Scalar.
    """
    noisy = scheduler.add_noise(depth, noise, timesteps)
    target = scheduler.get_velocity(depth, noise, timesteps)
    states = text.expand(len(image), -1, -1)
    v = unet(torch.cat([image, noisy], dim=1), timesteps, encoder_hidden_states=states, return_dict=False)[0]
    error = v.float() - target
    return error.square().mean() + 0.5 * error.abs().mean()
