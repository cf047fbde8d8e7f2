"""Marigold and Stable Diffusion fine-tuned end to end: one step from zeros (arXiv 2409.11355)."""

from __future__ import annotations

from typing import Any

import torch
from diffusers import AutoencoderKL, DDIMScheduler, MarigoldDepthPipeline, UNet2DConditionModel
from torch import Tensor
from transformers import CLIPTextModel, CLIPTokenizer

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.marigold import MarigoldPrior


class E2EFTPipeline(MarigoldDepthPipeline):
    """``MarigoldDepthPipeline`` that starts from zeros and takes one step, whose result is the clean latent.

    Of its scheduler the betas count: it becomes a DDIM with trailing spacing whose last step ends at no noise
    at all (the authors read ``pred_original_sample`` instead). Arguments as ``MarigoldDepthPipeline``'s;
    ``initial_latents`` is saved, so that the folder differs from Marigold's.
    """

    max_steps = 1
    deterministic = True

    def __init__(
        self,
        unet: UNet2DConditionModel,
        vae: AutoencoderKL,
        scheduler: Any,
        text_encoder: CLIPTextModel,
        tokenizer: CLIPTokenizer,
        prediction_type: str = "depth",
        scale_invariant: bool = True,
        shift_invariant: bool = True,
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 768,
        initial_latents: str = "zeros",
    ) -> None:
        scheduler = DDIMScheduler.from_config(
            scheduler.config, timestep_spacing="trailing", set_alpha_to_one=True
        )
        parts = unet, vae, scheduler, text_encoder, tokenizer
        defaults = default_denoising_steps, default_processing_resolution
        super().__init__(*parts, prediction_type, scale_invariant, shift_invariant, *defaults)
        self.register_to_config(initial_latents=initial_latents)

    def check_inputs(self, image: Any, num_inference_steps: int, *args: Any, **kwargs: Any) -> int:
        """Marigold's checks, and a ``ValueError`` for more steps than one."""
        if num_inference_steps is not None and num_inference_steps > 1:
            bad_value("num_inference_steps", "1 with a prior that was tuned for it", num_inference_steps)
        return super().check_inputs(image, num_inference_steps, *args, **kwargs)

    def prepare_latents(
        self, image: Tensor, latents: Tensor | None, generator: Any, *args: Any, **kwargs: Any
    ) -> tuple[Tensor, Tensor]:
        """Image latents, and zeros where the caller gives no latents; nothing is drawn."""
        image_latent, start = super().prepare_latents(image, latents, generator, *args, **kwargs)
        return image_latent, torch.zeros_like(start) if latents is None else start


class E2EFTPrior(MarigoldPrior):
    """Adapter of ``E2EFTPipeline``; network, input and decoder are Marigold's."""

    pipeline_class = E2EFTPipeline
    licence = {}  # the authors' repository does not say

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Marigold's components, and a schedule that Marigold has not: trailing, betas as they were.

        That is what the authors' training script saves. Marigold v1-0 is leading, v1-1 rescales its betas,
        the LCM says how many steps it was distilled from. A folder that keeps Marigold's own scheduler
        cannot be recognised by its configs: there "e2e-ft" in the name decides, or ``e2e-ft:`` before it.
        """
        if not MarigoldPrior.recognises(layout):
            return False
        schedule = layout.config("scheduler")
        return (
            layout.index.get("initial_latents") == "zeros"
            or "e2e-ft" in layout.name.lower()
            or (
                schedule.get("timestep_spacing") == "trailing"
                and not schedule.get("rescale_betas_zero_snr")
                and "original_inference_steps" not in schedule
                and layout.index.get("default_denoising_steps", 1) == 1
            )
        )
