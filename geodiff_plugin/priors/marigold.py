"""Priors of ``MarigoldDepthPipeline`` (S3.1), including those fine-tuned end to end (arXiv 2409.11355)."""

from __future__ import annotations

from typing import Any

import torch
from diffusers import AutoencoderKL, DDIMScheduler, MarigoldDepthPipeline, UNet2DConditionModel
from torch import Tensor
from transformers import CLIPTextModel, CLIPTokenizer

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.priors.loading import Layout, build_pipeline
from geodiff_plugin.priors.pipeline import DepthPrior, decode_image, encode_image, image_of_map, map_of


class MarigoldPrior(DepthPrior):
    """Adapter for ``MarigoldDepthPipeline``; its ``prediction_type`` must be a key of ``SPACES``."""

    pipeline_class: type[Any] = MarigoldDepthPipeline

    def __init__(self, pipe: Any) -> None:
        self._pipe = pipe
        self.config = pipe.config

    @property
    def network_input(self) -> slice:
        """Channels after the image latent."""
        return slice(self._pipe.vae.config.latent_channels, None)

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Recognise a U-Net on image and depth latent, without class labels, and a text encoder."""
        unet = layout.config("unet")
        latent = layout.config("vae").get("latent_channels", 4)
        return (
            unet.get("in_channels") == 2 * latent
            and unet.get("out_channels") == latent
            and unet.get("class_embed_type") is None
            and "text_encoder" in layout.index
        )

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> Any:
        """Load the stock pipeline; v1-0 folders do not state what they predict, which is depth."""
        space = space or layout.index.get("prediction_type") or "depth"
        return build_pipeline(cls.pipeline_class, layout, dtype, prediction_type=space)

    def network(self) -> tuple[torch.nn.Module, str]:
        """Return the U-Net's forward method; its input is ``cat[image latent, depth latent]``."""
        return self._pipe.unet, "forward"

    def decode(self, z0: Tensor) -> Tensor:
        """Average the channels decoded by the pipeline's VAE, unclipped."""
        return map_of(decode_image(self._pipe.vae, z0))

    def encode(self, x: Tensor) -> Tensor:
        """Encode with the pipeline's VAE."""
        return encode_image(self._pipe.vae, image_of_map(x))


class E2EFTPipeline(MarigoldDepthPipeline):
    """``MarigoldDepthPipeline`` that starts from zeros and takes one step, whose result is the clean latent.

    Only the betas of its scheduler are used: it becomes a DDIM with trailing spacing whose last step ends
    without noise (the authors read ``pred_original_sample`` instead). Arguments as in
    ``MarigoldDepthPipeline``; ``initial_latents`` is saved to distinguish the folder from Marigold's.
    """

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
        """Run Marigold's checks, and raise ``ValueError`` for more than one step."""
        if num_inference_steps is not None and num_inference_steps > 1:
            bad_value("num_inference_steps", "1 with a prior fine-tuned for one step", num_inference_steps)
        return super().check_inputs(image, num_inference_steps, *args, **kwargs)

    def prepare_latents(
        self, image: Tensor, latents: Tensor | None, generator: Any, *args: Any, **kwargs: Any
    ) -> tuple[Tensor, Tensor]:
        """Return image latents, and zeros if the caller gives no latents; nothing is sampled."""
        image_latent, start = super().prepare_latents(image, latents, generator, *args, **kwargs)
        return image_latent, torch.zeros_like(start) if latents is None else start


class E2EFTPrior(MarigoldPrior):
    """Adapter for ``E2EFTPipeline``; network, input and decoder are Marigold's."""

    pipeline_class = E2EFTPipeline
    max_steps = 1
    deterministic = True

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Recognise Marigold's components with a schedule that Marigold lacks: trailing with unscaled betas.

        Marigold v1-0 is leading, v1-1 rescales its betas, and the LCM states the number of steps it was
        distilled from. If a folder keeps Marigold's scheduler, "e2e-ft" in the name decides, or the prefix
        ``e2e-ft:``.
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
