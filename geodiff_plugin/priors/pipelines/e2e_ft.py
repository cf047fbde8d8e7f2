"""Marigold and Stable Diffusion fine-tuned end to end: one step from zeros.

Data flow: image latent, zeros -> v at t = 999 -> clean latent -> relative map.
Paper: none (Martin Garcia et al., arXiv 2409.11355, WACV 2025).
"""

from __future__ import annotations

from typing import Any

import torch
from diffusers import AutoencoderKL, DDIMScheduler, MarigoldDepthPipeline, UNet2DConditionModel
from torch import Tensor
from transformers import CLIPTextModel, CLIPTokenizer

from geodiff_plugin._checks import bad_value

__all__ = ["E2EFTPipeline"]


class E2EFTPipeline(MarigoldDepthPipeline):
    """``MarigoldDepthPipeline`` that starts from zeros and takes one step, whose result is the clean latent.

    Args:
        unet: of image and depth latent.
        vae: of both.
        scheduler: any over the same betas; a DDIM with trailing spacing is made of it, whose last step ends
            at no noise at all (the authors read ``pred_original_sample`` instead).
        text_encoder: for the empty prompt.
        tokenizer: likewise.
        prediction_type: what the map is affine in.
        scale_invariant: as Marigold's.
        shift_invariant: as Marigold's.
        default_denoising_steps: 1.
        default_processing_resolution: longer side, pixels.
        initial_latents: ``"zeros"``; saved, so that the folder can be distinguished from Marigold's.
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
        if initial_latents != "zeros":
            bad_value("initial_latents", "'zeros'", repr(initial_latents), "A Marigold starts from noise.")
        to_the_end = DDIMScheduler.from_config(
            scheduler.config, timestep_spacing="trailing", set_alpha_to_one=True
        )
        super().__init__(
            unet,
            vae,
            to_the_end,
            text_encoder,
            tokenizer,
            prediction_type=prediction_type,
            scale_invariant=scale_invariant,
            shift_invariant=shift_invariant,
            default_denoising_steps=default_denoising_steps,
            default_processing_resolution=default_processing_resolution,
        )
        self.register_to_config(initial_latents=initial_latents)

    def check_inputs(self, image: Any, num_inference_steps: int, *args: Any, **kwargs: Any) -> int:
        """Marigold's checks, and one step only.

        Raises:
            ValueError: more steps than one.
        """
        if num_inference_steps is not None and num_inference_steps > 1:
            bad_value("num_inference_steps", "1 with a prior that was tuned for it", num_inference_steps)
        return super().check_inputs(image, num_inference_steps, *args, **kwargs)

    def prepare_latents(
        self, image: Tensor, latents: Tensor | None, generator: Any, *args: Any, **kwargs: Any
    ) -> tuple[Tensor, Tensor]:
        """Image latents, and zeros where the caller gives no latents; nothing is drawn."""
        image_latent, start = super().prepare_latents(image, latents, generator, *args, **kwargs)
        return image_latent, torch.zeros_like(start) if latents is None else start
