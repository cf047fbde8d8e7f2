"""The arithmetic between a network's output, the clean latent and the noise, for every prediction type.

The Tweedie line of Algorithm 1, Eq. 6 (eq:tweedie), divides by sqrt(alpha_bar), which is 0 at the first step
of a zero-terminal-SNR schedule, and its sign fits a score, not a noise prediction; this is the schedulers'
own arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin._checks import bad_value

PREDICTION_TYPES = ("epsilon", "sample", "v_prediction", "flow_prediction")


@dataclass(frozen=True)
class NoiseLevel:
    """``z_t = alpha z_0 + sigma eps`` at one timestep.

    Attributes:
        alpha: signal level, [0, 1], 0-d float32.
        sigma: noise level, (0, 1], 0-d float32.
        prediction_type: one of ``PREDICTION_TYPES``.
        clip: the scheduler clamps ``z0_hat`` to ``[-clip, clip]``, ``None`` for no clamp.
    """

    alpha: Tensor
    sigma: Tensor
    prediction_type: str
    clip: float | None = None

    def __post_init__(self) -> None:
        if self.prediction_type not in PREDICTION_TYPES:
            bad_value(
                "the scheduler's prediction_type", f"one of {PREDICTION_TYPES}", repr(self.prediction_type)
            )


def z0_from(output: Tensor, z_t: Tensor, level: NoiseLevel) -> Tensor:
    """The clean latent that a network output implies, as the scheduler computes it.

    Args:
        output: ``(B, C, h, w)`` network output.
        z_t: ``(B, C, h, w)`` noisy latent.
        level: noise level and prediction type.

    Returns:
        ``(B, C, h, w)`` of their dtype; differentiable in both tensors (not where the scheduler clips).
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

    Handing both to the scheduler's own ``step`` moves the clean latent in any of them, multistep
    history and stochastic ones included, without a second formula for z_{t-1}.

    Args:
        z0: ``(B, C, h, w)`` clean latent.
        eps: ``(B, C, h, w)`` noise.
        level: noise level and prediction type.

    Returns:
        ``(output, z_t)``, both ``(B, C, h, w)``, inverse of ``z0_from`` and ``noise_from``.
    """
    z_t = level.alpha * z0 + level.sigma * eps
    if level.prediction_type == "epsilon":
        return eps, z_t
    if level.prediction_type == "sample":
        return z0, z_t
    if level.prediction_type == "v_prediction":
        return level.alpha * eps - level.sigma * z0, z_t
    return eps - z0, z_t
