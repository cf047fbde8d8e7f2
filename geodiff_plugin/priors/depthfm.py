"""DepthFM: rectified flow from the noised image latent to log depth (Gui et al. 2024, arXiv 2403.13788)."""

from __future__ import annotations

import math
from typing import Any

import torch
from diffusers import AutoencoderKL, FlowMatchEulerDiscreteScheduler, UNet2DConditionModel
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin.priors.components import FixedPrompt, SidesOf
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import Condition, DepthDiffusionPipeline, Generators, stretched

#: Steps of the schedule that ``noising_step`` counts in.
NOISING_STEPS = 1000
#: Both sides of the processed image are multiples of this.
SIDE = 64


class DepthFMPipeline(DepthDiffusionPipeline):
    """Log depth by a flow that starts from the image itself, with noise of ``noising_step``, 0 (none) to 999.

    The authors run 2 to 4 steps, at ``processing_resolution=0``.
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
        self.register_prior(modules, *defaults, SidesOf(SIDE), noising_step=noising_step)

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Eight channels in, a saved prompt, a scheduler of rectified flow (which alone has a ``shift``)."""
        return (
            layout.config("unet").get("in_channels") == 8
            and bool(layout.config("prompt"))
            and "shift" in layout.config("scheduler")
        )

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Generators
    ) -> Condition:
        """Mode of the image latent's posterior, and the prompt that came with the weights."""
        latent = self.image_latents(image, ensemble_size, batch_size)  # (N * E, 4, h, w)
        return {"image_latent": latent, "prompt": self.prompt().to(latent).expand(len(latent), -1, -1)}

    def prepare_latents(self, condition: Condition, generator: Generators) -> Tensor:
        """The image latent with noise, anew for every member."""
        latent = condition["image_latent"]
        if self.deterministic:
            return latent
        noise = randn_tensor(latent.shape, generator=generator, device=latent.device, dtype=latent.dtype)
        return self.add_noise(latent, noise)

    def add_noise(self, image_latent: Tensor, noise: Tensor) -> Tensor:
        """Where the flow starts, by the cosine schedule, from an image latent and noise ``(B, 4, h, w)``."""
        log_snr = -2.0 * math.log(math.tan(math.pi * self.config.noising_step / NOISING_STEPS / 2.0) + 1e-5)
        alpha_bar = 1.0 / (1.0 + math.exp(-log_snr))
        return math.sqrt(alpha_bar) * image_latent + math.sqrt(1.0 - alpha_bar) * noise

    def set_timesteps(self, num_inference_steps: int, device: torch.device) -> None:
        """Equal steps of time from 0 to 1."""
        sigmas = [1.0 - i / num_inference_steps for i in range(num_inference_steps)]
        self.scheduler.set_timesteps(sigmas=sigmas, device=device)

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """The network's velocity with its sign turned; its t is in [0, 1), not in [0, 1000)."""
        time = 1.0 - timestep / self.scheduler.config.num_train_timesteps
        return -self.run_unet(torch.cat([latents, condition["image_latent"]], dim=1), time, condition)

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """Log depth as decoded, about [-1, 1]: members are averaged before the exponential."""
        return self.decode_picture(latents).mean(dim=1, keepdim=True)

    def put_together(
        self, maps: Tensor, ensemble_size: int, output_uncertainty: bool, ensembling_kwargs: dict[str, Any]
    ) -> tuple[Tensor, Tensor | None]:
        """Exponential of the members' mean, stretched to [0, 1] image by image; spread in the same units."""
        if ensembling_kwargs:
            cure = "DepthFM averages its members in log depth; leave it out."
            bad_value("ensembling_kwargs", "empty", sorted(ensembling_kwargs), cure)
        members = maps.unflatten(0, (-1, ensemble_size))  # (N, E, 1, H, W)
        depth = members.mean(dim=1).exp()
        if not output_uncertainty:
            return stretched(depth), None
        width = depth.amax((1, 2, 3), keepdim=True) - depth.amin((1, 2, 3), keepdim=True)
        return stretched(depth), members.exp().std(dim=1) / width.clamp_min(torch.finfo(depth.dtype).tiny)
