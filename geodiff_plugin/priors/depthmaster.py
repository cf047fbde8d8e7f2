"""DepthMaster: one pass of a U-Net from the image latent to the depth latent (arXiv 2501.02576)."""

from __future__ import annotations

import torch
from diffusers import AutoencoderKL
from torch import Tensor
from transformers import CLIPTextModel, CLIPTokenizer

from geodiff_plugin.priors.base import OwnPipelinePrior
from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.loading import build_pipeline
from geodiff_plugin.priors.pipelines.base import Condition, DepthDiffusionPipeline, Generators
from geodiff_plugin.priors.pipelines.direct_scheduler import DirectScheduler
from geodiff_plugin.priors.pipelines.fourier_unet import FourierUNet
from geodiff_plugin.priors.pipelines.prompts import text_embedding

__all__ = ["DepthMasterPipeline", "DepthMasterPrior"]

#: The timestep that the network is always told.
TIMESTEP = 1


class DepthMasterPipeline(DepthDiffusionPipeline):
    """Deterministic depth in one step; affine in the square root of disparity.

    Args:
        unet: takes the image latent alone and answers with the clean depth latent.
        vae: of Stable Diffusion 2.
        text_encoder: for the empty prompt.
        tokenizer: for the empty prompt.
        prediction_type: what the map is affine in.
        default_denoising_steps: 1.
        default_processing_resolution: longer side, pixels.
    """

    max_steps = 1
    deterministic = True
    sees_latents = False
    model_cpu_offload_seq = "text_encoder->unet->vae"

    def __init__(
        self,
        unet: FourierUNet,
        vae: AutoencoderKL,
        text_encoder: CLIPTextModel,
        tokenizer: CLIPTokenizer,
        prediction_type: str = "sqrt_disparity",
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 768,
    ) -> None:
        super().__init__()
        # Not a component: the authors' folders have none, and ours are like theirs.
        self.scheduler = DirectScheduler(TIMESTEP)
        self.register_prior(
            {"unet": unet, "vae": vae, "text_encoder": text_encoder, "tokenizer": tokenizer},
            prediction_type,
            default_denoising_steps,
            default_processing_resolution,
        )

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Generators
    ) -> Condition:
        """Mode of the image latent's posterior, and the empty prompt."""
        latent = self.image_latents(image, ensemble_size, batch_size)  # (N * E, 4, h, w)
        prompt = text_embedding(self.tokenizer, self.text_encoder, latent.device).to(latent)
        return {"image_latent": latent, "prompt": prompt.expand(len(latent), -1, -1)}

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """The clean depth latent; ``latents`` are not looked at."""
        return self.unet(
            condition["image_latent"], timestep, encoder_hidden_states=condition["prompt"], return_dict=False
        )[0]

    def decode_relative(self, z0: Tensor) -> Tensor:
        """Mean of the decoded channels, from [-1, 1] to [0, 1], not clipped; near is 1."""
        return (self.decode_latents(z0).mean(dim=1, keepdim=True) + 1.0) / 2.0


class DepthMasterPrior(OwnPipelinePrior):
    """DepthMaster: a U-Net on the image latent alone, and no scheduler."""

    pipeline_class = DepthMasterPipeline
    licence = {"zysong212/DepthMaster": "apache-2.0"}

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Four channels in, no class embedding, a text encoder, no scheduler among the components."""
        unet = layout.config("unet")
        return (
            unet.get("in_channels") == 4
            and not unet.get("class_embed_type")
            and "text_encoder" in layout.index
            and "scheduler" not in layout.index
        )

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> DepthMasterPipeline:
        """The U-Net by our class, whatever the index names."""
        return build_pipeline(
            cls.pipeline_class, layout, dtype, classes={"unet": FourierUNet}, prediction_type=space
        )
