"""Lotus G and D: one step of an x0-predicting SD-2 U-Net with a task embedding (He et al., ICLR 2025)."""

from __future__ import annotations

import re
from typing import Any

import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from torch import Tensor
from transformers import CLIPTextModel, CLIPTokenizer

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.priors.components import DirectScheduler, ResizeToMultiple
from geodiff_plugin.priors.loading import Layout, build_pipeline
from geodiff_plugin.priors.pipeline import Condition, DepthDiffusionPipeline, Generators, map_of

#: The only timestep that Lotus was trained with.
TIMESTEP = 999
#: One-hot task: [1, 0] predicts depth, [0, 1] reconstructs the image (used in training only).
DEPTH_TASK = (1.0, 0.0)
#: Length of the embedded task: sine and cosine of both numbers.
TASK_SIZE = 4
#: Input channels of the U-Net of Lotus-D, and of Lotus-G, which also sees the noisy latent.
IMAGE_CHANNELS, WITH_NOISE = 4, 8


class LotusPipeline(DepthDiffusionPipeline):
    """Lotus-G (8 input channels: image and noise) or Lotus-D (4: image only), depending on the U-Net.

    Even D is not deterministic: the image latent is sampled from the VAE's posterior. A noise-predicting
    scheduler (SD-2's own, which such a folder may contain) is replaced, since the network was trained without
    one.
    """

    model_cpu_offload_seq = "text_encoder->unet->vae"
    max_steps = 1
    output_resampling = "nearest-exact"

    def __init__(
        self,
        unet: UNet2DConditionModel,
        vae: AutoencoderKL,
        text_encoder: CLIPTextModel,
        tokenizer: CLIPTokenizer,
        scheduler: Any,
        prediction_type: str | None = None,
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 768,
    ) -> None:
        super().__init__()
        if prediction_type not in ("depth", "disparity"):
            hint = "No Lotus config states it; the disparity versions have disparity in their name."
            bad_value("prediction_type", "'depth' or 'disparity'", repr(prediction_type), hint)
        channels, task = unet.config.in_channels, unet.config.projection_class_embeddings_input_dim
        if channels not in (IMAGE_CHANNELS, WITH_NOISE) or task != TASK_SIZE:
            got = f"{channels} channels, {task}-d class embedding"
            bad_value("unet", "a Lotus U-Net (4 or 8 input channels, 4-d class embedding)", got)
        self.sees_latents = channels == WITH_NOISE
        if not isinstance(scheduler, DirectScheduler):
            scheduler = DirectScheduler(timestep=TIMESTEP)
        defaults = prediction_type, default_denoising_steps, default_processing_resolution
        modules = {"unet": unet, "vae": vae, "text_encoder": text_encoder, "tokenizer": tokenizer}
        self.register_prior(modules | {"scheduler": scheduler}, *defaults, ResizeToMultiple(1))

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Recognise a U-Net with 4-d projected class labels, on the image latent alone (D) or with noise."""
        unet = layout.config("unet")
        return (
            unet.get("class_embed_type") == "projection"
            and unet.get("projection_class_embeddings_input_dim") == TASK_SIZE
            and unet.get("in_channels") in (IMAGE_CHANNELS, WITH_NOISE)
            and unet.get("_class_name") == "UNet2DConditionModel"
        )

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> LotusPipeline:
        """Load the folder's networks; its scheduler, if any, is not used."""
        space = space or layout.index.get("prediction_type") or space_of_name(layout.name)
        scheduler = DirectScheduler(timestep=TIMESTEP)
        return build_pipeline(cls, layout, dtype, scheduler=scheduler, prediction_type=space)

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Generators
    ) -> Condition:
        """Return image latents (one sample each), embedded task and empty prompt, ``N * E`` of each."""
        latents = self.image_latents(image, ensemble_size, batch_size, generator, sample=True)
        task = torch.tensor(DEPTH_TASK, dtype=torch.float32, device="cpu")
        task = torch.cat([task.sin(), task.cos()]).to(latents)  # (4,)
        return {
            "image_latent": latents,  # (N * E, 4, h, w)
            "class_labels": task.expand(len(latents), -1),
            "prompt": self.prompt_embedding(latents),  # (N * E, 2, C)
        }

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """Predict the clean latent ``(B, 4, h, w)``; D ignores ``latents``."""
        sample = condition["image_latent"]
        if self.sees_latents:
            sample = torch.cat([sample, latents], dim=1)
        return self.run_unet(sample, timestep, condition)

    def encode(self, x: Tensor) -> Tensor:
        """Encode whole cells of 8 pixels only, like the decoded map; a guided call replicates the rest.

        The authors stretch instead, which shifts the map by up to 7 pixels.
        """
        cell = 2 ** (len(self.vae.config.block_out_channels) - 1)
        height, width = (side // cell * cell for side in x.shape[-2:])
        return super().encode(x[..., :height, :width])

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """Decode like the authors: every channel is clipped; only whole cells, which resizing stretches."""
        return map_of(self.decode_image(latents).clamp(-1.0, 1.0))


def space_of_name(name: str) -> str:
    """Return depth or disparity from a repository's or path's name; no Lotus config states it."""
    parts = [part for part in re.split(r"[/\\]", name.lower()) if "lotus" in part]
    named = parts[-1] if parts else ""
    if "disparity" in named:
        return "disparity"
    if "lotus-depth-" in named:
        return "depth"
    expected = "a name like its authors' (lotus-depth-g-v1-0, lotus-depth-g-v2-1-disparity)"
    hint = "Only the name distinguishes depth from disparity; pass --space or space= instead."
    bad_value("prior", expected, repr(name), hint)
