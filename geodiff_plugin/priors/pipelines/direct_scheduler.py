"""A schedule of one step for networks whose output is the clean latent itself."""

from __future__ import annotations

from typing import Any

import torch
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.schedulers.scheduling_utils import SchedulerMixin, SchedulerOutput
from torch import Tensor

from geodiff_plugin._checks import bad_value

__all__ = ["DirectScheduler"]


class DirectScheduler(SchedulerMixin, ConfigMixin):
    """One step whose result is the network's output; saves and loads as any scheduler of diffusers.

    Args:
        timestep: the timestep input of the network, 999 for Lotus, 1 for DepthMaster.
        prediction_type: always ``"sample"``; kept in the config, where others look for it.
    """

    order = 1
    init_noise_sigma = 1.0

    @register_to_config
    def __init__(self, timestep: int = 999, prediction_type: str = "sample") -> None:
        if prediction_type != "sample":
            bad_value("prediction_type of a DirectScheduler", "'sample'", repr(prediction_type))
        self.set_timesteps()

    def set_timesteps(self, num_inference_steps: int = 1, device: str | torch.device | None = None) -> None:
        """Start over.

        Args:
            num_inference_steps: 1.
            device: where the timestep lies.

        Raises:
            ValueError: more than one step.
        """
        if num_inference_steps != 1:
            cure = "This prior answers in one step; leave num_inference_steps out."
            bad_value("num_inference_steps", "1", num_inference_steps, cure)
        self.num_inference_steps = num_inference_steps
        self.timesteps = torch.tensor([self.config.timestep], device=device)

    def scale_model_input(self, sample: Tensor, timestep: Any = None) -> Tensor:
        """The sample, as it is."""
        return sample

    def step(
        self,
        model_output: Tensor,
        timestep: Any,
        sample: Tensor,
        generator: torch.Generator | None = None,
        return_dict: bool = True,
    ) -> SchedulerOutput | tuple[Tensor]:
        """The clean latent, which is ``model_output``.

        Args:
            model_output: ``(B, C, h, w)``.
            timestep: unused.
            sample: unused.
            generator: unused, nothing is drawn.
            return_dict: record or tuple.
        """
        return SchedulerOutput(prev_sample=model_output) if return_dict else (model_output,)
