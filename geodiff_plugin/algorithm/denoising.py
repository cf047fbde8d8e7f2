"""The arithmetic between a network's output, the clean latent and the noise, for every prediction type.

Eq. 6 (eq:tweedie) of Algorithm 1 divides by sqrt(alpha_bar), which is 0 at the first step of a
zero-terminal-SNR schedule, and its sign fits a score, not noise. These are the formulas of the schedulers of
diffusers, repeated: their ``step`` gives the clean latent only afterwards, some give none, and guidance needs
its gradient. tests/parity/test_scheduler_parity.py compares them with every ``step``.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin._checks import bad_value

PREDICTION_TYPES = ("epsilon", "sample", "v_prediction", "flow_prediction")


@dataclass(frozen=True)
class NoiseLevel:
    """``z_t = alpha z_0 + sigma eps`` at one timestep; both 0-d float32, in [0, 1] and (0, 1].

    The scheduler clamps ``z0_hat`` to ``[-clip, clip]``, unless ``clip`` is ``None``.
    """

    alpha: Tensor
    sigma: Tensor
    prediction_type: str
    clip: float | None = None

    def __post_init__(self) -> None:
        if self.prediction_type not in PREDICTION_TYPES:
            expected, got = f"one of {PREDICTION_TYPES}", repr(self.prediction_type)
            bad_value("the scheduler's prediction_type", expected, got)


def z0_from(output: Tensor, z_t: Tensor, level: NoiseLevel) -> Tensor:
    """The clean latent that a network output implies, as the scheduler computes it.

    All latents are ``(B, C, h, w)``; differentiable in both tensors, except where the scheduler clips.
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
    """The noise that a network output implies; shapes and dtype as ``z0_from``."""
    if level.prediction_type == "epsilon":
        return output
    if level.prediction_type == "sample":
        return (z_t - level.alpha * output) / level.sigma
    if level.prediction_type == "v_prediction":
        return level.alpha * output + level.sigma * z_t
    return z_t + level.alpha * output


def output_from(z0: Tensor, eps: Tensor, level: NoiseLevel) -> tuple[Tensor, Tensor]:
    """The network output and noisy latent whose clean latent is ``z0`` and whose noise is ``eps``.

    Given these two, the ``step`` of any scheduler, multistep and stochastic ones included, continues from the
    moved clean latent, without a second formula for z_{t-1}.
    """
    z_t = level.alpha * z0 + level.sigma * eps
    if level.prediction_type == "epsilon":
        return eps, z_t
    if level.prediction_type == "sample":
        return z0, z_t
    if level.prediction_type == "v_prediction":
        return level.alpha * eps - level.sigma * z0, z_t
    return eps - z0, z_t
