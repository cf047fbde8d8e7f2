"""Converts between network output, clean latent and noise for every prediction type.

Eq. 6 (eq:tweedie) of Algorithm 1 divides by sqrt(alpha_bar), which is 0 at the first step of a
zero-terminal-SNR schedule, and its sign applies to a score, not to noise. This module therefore repeats the
formulas of the diffusers schedulers. Their ``step`` returns the clean latent too late or not at all, and
guidance needs its gradient. tests/parity/test_scheduler_parity.py compares the formulas with every ``step``.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin._internal.checks import bad_value

PREDICTION_TYPES = ("epsilon", "sample", "v_prediction", "flow_prediction")


@dataclass(frozen=True)
class NoiseLevel:
    """Noise level of one timestep, ``z_t = alpha z_0 + sigma eps``; 0-d float32 in [0, 1] and (0, 1].

    The scheduler clamps ``z0_hat`` to ``[-clip, clip]`` unless ``clip`` is ``None``.
    """

    alpha: Tensor
    sigma: Tensor
    prediction_type: str
    clip: float | None = None

    def __post_init__(self) -> None:
        if self.prediction_type not in PREDICTION_TYPES:
            expected = f"one of {PREDICTION_TYPES}"
            got = repr(self.prediction_type)
            bad_value("the scheduler's prediction_type", expected, got)


def z0_from(output: Tensor, z_t: Tensor, level: NoiseLevel) -> Tensor:
    """Compute the clean latent from a network output, as the scheduler does.

    All latents are ``(B, C, h, w)``. Differentiable in both tensors except where the scheduler clips.
    """
    if level.prediction_type == "sample":
        z0 = output
    elif level.prediction_type == "epsilon":
        z0 = (z_t - level.sigma * output) / level.alpha
    elif level.prediction_type == "v_prediction":
        z0 = level.alpha * z_t - level.sigma * output
    else:
        z0 = z_t - level.sigma * output
    return z0 if level.clip is None else z0.clamp(-level.clip, level.clip)


def noise_from(output: Tensor, z_t: Tensor, level: NoiseLevel) -> Tensor:
    """Compute the noise from a network output; shapes and dtype as in ``z0_from``."""
    if level.prediction_type == "epsilon":
        return output
    if level.prediction_type == "sample":
        return (z_t - level.alpha * output) / level.sigma
    if level.prediction_type == "v_prediction":
        return level.alpha * output + level.sigma * z_t
    return z_t + level.alpha * output


def output_from(z0: Tensor, eps: Tensor, level: NoiseLevel) -> tuple[Tensor, Tensor]:
    """Compute the network output and noisy latent that have the clean latent ``z0`` and the noise ``eps``.

    From these two, the ``step`` of any scheduler, including multistep and stochastic ones, continues from the
    updated clean latent, so that no second formula for z_{t-1} is needed.
    """
    z_t = level.alpha * z0 + level.sigma * eps
    if level.prediction_type == "epsilon":
        return eps, z_t
    if level.prediction_type == "sample":
        return z0, z_t
    if level.prediction_type == "v_prediction":
        return level.alpha * eps - level.sigma * z0, z_t
    return eps - z0, z_t
