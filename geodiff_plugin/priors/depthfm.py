"""DepthFM: rectified flow from the noised image latent to log depth (Gui et al. 2024, arXiv 2403.13788)."""

from __future__ import annotations

import math
from typing import Any

import torch
from diffusers import AutoencoderKL, FlowMatchEulerDiscreteScheduler, UNet2DConditionModel
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

from geodiff_plugin._internal.checks import bad_value, check_number
from geodiff_plugin.priors.components import FixedPrompt, ResizeToMultiple
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import Condition, DepthDiffusionPipeline, Generators, normalized

#: Number of steps of the schedule that ``noising_step`` indexes.
NOISING_STEPS = 1000
#: Both sides of the processed image are multiples of this, pixels.
SIDE = 64


class DepthFMPipeline(DepthDiffusionPipeline):
    """Log depth by a flow from the image latent, noised with ``noising_step`` from 0 (none) to 999.

    The authors use 2 to 4 steps, at ``processing_resolution=0``.
    """

    model_cpu_offload_seq = "unet->vae"

    def __init__(
        self,
        unet: UNet2DConditionModel,
        vae: AutoencoderKL,
        scheduler: FlowMatchEulerDiscreteScheduler,
        prompt: FixedPrompt,
        noising_step: int = 400,
        prediction_type: str = "log",
        default_denoising_steps: int = 4,
        default_processing_resolution: int = 768,
    ) -> None:
        super().__init__()
        check_number(noising_step, "noising_step", 0, NOISING_STEPS - 1, integer=True)
        self.deterministic = noising_step == 0
        defaults = prediction_type, default_denoising_steps, default_processing_resolution
        modules = {"unet": unet, "vae": vae, "scheduler": scheduler, "prompt": prompt}
        self.register_prior(modules, *defaults, ResizeToMultiple(SIDE), noising_step=noising_step)

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Recognise 8 input channels, a saved prompt, and a rectified-flow scheduler (with a ``shift``)."""
        return (
            layout.config("unet").get("in_channels") == 8
            and bool(layout.config("prompt"))
            and "shift" in layout.config("scheduler")
        )

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Generators
    ) -> Condition:
        """Return the mode of the image latent's posterior, and the prompt saved with the weights."""
        latent = self.image_latents(image, ensemble_size, batch_size)  # (N * E, 4, h, w)
        return {"image_latent": latent, "prompt": self.prompt().to(latent).expand(len(latent), -1, -1)}

    def prepare_latents(self, condition: Condition, generator: Generators) -> Tensor:
        """Return the image latent with new noise for every member."""
        latent = condition["image_latent"]
        if self.deterministic:
            return latent
        noise = randn_tensor(latent.shape, generator=generator, device=latent.device, dtype=latent.dtype)
        return self.add_noise(latent, noise)

    def add_noise(self, image_latent: Tensor, noise: Tensor) -> Tensor:
        """Noise an image latent with noise ``(B, 4, h, w)`` by the cosine schedule: the start of the flow."""
        log_snr = -2.0 * math.log(math.tan(math.pi * self.config.noising_step / NOISING_STEPS / 2.0) + 1e-5)
        alpha_bar = 1.0 / (1.0 + math.exp(-log_snr))
        return math.sqrt(alpha_bar) * image_latent + math.sqrt(1.0 - alpha_bar) * noise

    def set_timesteps(self, num_inference_steps: int, device: torch.device) -> None:
        """Set equal time steps from 0 to 1."""
        sigmas = [1.0 - i / num_inference_steps for i in range(num_inference_steps)]
        self.scheduler.set_timesteps(sigmas=sigmas, device=device)

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """Compute the network's velocity with opposite sign; its t is in [0, 1), not in [0, 1000)."""
        time = 1.0 - timestep / self.scheduler.config.num_train_timesteps
        return -self.run_unet(torch.cat([latents, condition["image_latent"]], dim=1), time, condition)

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """Decode log depth, about [-1, 1]; members are averaged before the exponential."""
        return self.decode_image(latents).mean(dim=1, keepdim=True)

    def combine_members(
        self, maps: Tensor, ensemble_size: int, output_uncertainty: bool, ensembling_kwargs: dict[str, Any]
    ) -> tuple[Tensor, Tensor | None]:
        """Exponentiate the members' mean and normalize it to [0, 1] per image; spread in the same units."""
        if ensembling_kwargs:
            hint = "DepthFM averages its members in log depth; omit it."
            bad_value("ensembling_kwargs", "empty", sorted(ensembling_kwargs), hint)
        members = maps.unflatten(0, (-1, ensemble_size))  # (N, E, 1, H, W)
        depth = members.mean(dim=1).exp()
        if not output_uncertainty:
            return normalized(depth), None
        width = depth.amax((1, 2, 3), keepdim=True) - depth.amin((1, 2, 3), keepdim=True)
        return normalized(depth), members.exp().std(dim=1) / width.clamp_min(torch.finfo(depth.dtype).tiny)
