"""Small components shared by this package's pipelines: a one-step scheduler, a prompt, image resizing."""

from __future__ import annotations

from typing import Any

import torch
from diffusers import ModelMixin
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from diffusers.schedulers.scheduling_utils import SchedulerMixin, SchedulerOutput
from torch import Tensor

from geodiff_plugin._internal.checks import bad_value


class DirectScheduler(SchedulerMixin, ConfigMixin):
    """One-step scheduler: the network, called with ``timestep``, predicts the clean latent, the result."""

    order = 1
    init_noise_sigma = 1.0

    @register_to_config
    def __init__(self, timestep: int = 999, prediction_type: str = "sample") -> None:
        self.set_timesteps()

    def set_timesteps(self, num_inference_steps: int = 1, device: str | torch.device | None = None) -> None:
        """Restart; any other number of steps than 1 is a ``ValueError``."""
        if num_inference_steps != 1:
            hint = "This prior runs in one step; omit num_inference_steps."
            bad_value("num_inference_steps", "1", num_inference_steps, hint)
        self.num_inference_steps = num_inference_steps
        self.timesteps = torch.tensor([self.config.timestep], device=device)

    def step(
        self,
        model_output: Tensor,
        timestep: Any,
        sample: Tensor,
        generator: torch.Generator | None = None,
        return_dict: bool = True,
    ) -> SchedulerOutput | tuple[Tensor]:
        """Return the clean latent ``(B, C, h, w)``, which is ``model_output``; ignores other arguments."""
        return SchedulerOutput(prev_sample=model_output) if return_dict else (model_output,)


class ResizeToMultiple(MarigoldImageProcessor):
    """Resizes each side to a multiple of ``side`` pixels, the next (``grow``) or nearest one; never pads."""

    def __init__(self, side: int, grow: bool = False) -> None:
        super().__init__(vae_scale_factor=side)
        self.side, self.grow = side, grow

    @staticmethod
    def pad_image(image: Tensor, align: int) -> tuple[Tensor, tuple[int, int]]:
        """Return the image unchanged, and no padding."""
        return image, (0, 0)

    def preprocess(
        self,
        image: Any,
        processing_resolution: int | None = None,
        resample_method_input: str = "bilinear",
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> tuple[Tensor, tuple[int, int], tuple[int, int]]:
        """Preprocess as the stock method, except for the size of the processed image ``(N, 3, H, W)``."""
        # Use float32 until the end: not every device resizes in half precision.
        image, padding, size = super().preprocess(image, 0, resample_method_input, device, torch.float32)
        factor = processing_resolution / max(size) if processing_resolution else 1.0
        grid = tuple(self._multiple(length * factor) for length in size)
        if grid != tuple(size):
            image = self.resize_antialias(image, grid, resample_method_input, is_aa=True)
        return image.to(dtype), padding, size

    def _multiple(self, length: float) -> int:
        parts = -(-round(length) // self.side) if self.grow else round(int(length) / self.side)
        return max(1, parts) * self.side


class FixedPrompt(ModelMixin, ConfigMixin):
    """A text embedding ``(1, length, width)`` saved in place of its text encoder."""

    @register_to_config
    def __init__(self, length: int = 77, width: int = 1024) -> None:
        super().__init__()
        self.embedding = torch.nn.Parameter(torch.zeros(1, length, width), requires_grad=False)

    def forward(self) -> Tensor:
        """Return the embedding; the call brings it back if it is offloaded."""
        return self.embedding
