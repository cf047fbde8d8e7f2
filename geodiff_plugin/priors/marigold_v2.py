"""Marigold V2: one step of an image-editing transformer on the image latent (arXiv 2609.08084)."""

from __future__ import annotations

import torch
from diffusers import (
    AutoencoderKLQwenImage,
    FlowMatchEulerDiscreteScheduler,
    QwenImageEditPipeline,
    QwenImageTransformer2DModel,
)
from diffusers.utils.accelerate_utils import apply_forward_hook
from torch import Tensor

from geodiff_plugin.priors.components import FixedPrompt, ResizeToMultiple
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import Condition, DepthDiffusionPipeline, Generators, map_of, upcast

#: Space in which the map is affine, by the first word of a checkpoint's name.
SPACE_OF_CHECKPOINT = {"log": "log", "uniform": "depth", "disparity": "disparity"}
#: Timestep input of the network, of 1000. The authors use 499 / 1000 in bfloat16, which rounds to 500.
TIMESTEP = 500.0
#: Side of the square of one token, pixels.
SIDE = 16
#: Side of the cell of one latent, pixels.
CELL = 8


def _statistics(vae: AutoencoderKLQwenImage, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation of the latents per channel, ``(1, C, 1, 1)`` each."""
    numbers = vae.config.latents_mean, vae.config.latents_std
    mean, deviation = (like.new_tensor(values).view(1, -1, 1, 1) for values in numbers)
    return mean, deviation


@apply_forward_hook
def _decode(vae: AutoencoderKLQwenImage, z: Tensor) -> Tensor:
    """Run ``vae._decode`` for one frame without caching; the hook brings an offloaded VAE back."""
    tile = vae.tile_sample_min_height // CELL, vae.tile_sample_min_width // CELL
    if vae.use_tiling and (z.shape[-2] > tile[0] or z.shape[-1] > tile[1]):
        return vae.tiled_decode(z, return_dict=False)[0]
    return vae.decoder(vae.post_quant_conv(z))


class MarigoldV2Pipeline(DepthDiffusionPipeline):
    """Depth in one step of rectified flow that starts from the image latent.

    The transformer recomputes its blocks in the backward pass (``enable_gradient_checkpointing``); otherwise
    the full gradient does not fit in memory. The authors evaluate at ``processing_resolution=0`` and trained
    at 768. With ``sample_latent`` the image latent is sampled from the posterior, as in their ``infer.py``;
    otherwise it is the mode.
    """

    max_steps = 1
    model_cpu_offload_seq = "transformer->vae"

    def __init__(
        self,
        transformer: QwenImageTransformer2DModel,
        vae: AutoencoderKLQwenImage,
        scheduler: FlowMatchEulerDiscreteScheduler,
        prompt: FixedPrompt,
        prediction_type: str = "log",
        sample_latent: bool = False,
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 768,
    ) -> None:
        super().__init__()
        self.deterministic = not sample_latent
        transformer.enable_gradient_checkpointing()
        defaults = prediction_type, default_denoising_steps, default_processing_resolution
        modules = {"transformer": transformer, "vae": vae, "scheduler": scheduler, "prompt": prompt}
        self.register_prior(
            modules, *defaults, ResizeToMultiple(SIDE, grow=True), sample_latent=sample_latent
        )

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Recognise a transformer on image and text tokens, a video autoencoder, and a saved prompt."""
        return (
            "joint_attention_dim" in layout.config("transformer")
            and "latents_mean" in layout.config("vae")
            and bool(layout.config("prompt"))
        )

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Generators
    ) -> Condition:
        """Return the image latent, sampled per member if configured, and the prompt."""
        draws = self.config.sample_latent
        latent = self.image_latents(image, ensemble_size, batch_size, generator, draws).to(image.dtype)
        prompt = self.prompt().to(latent.device).expand(len(latent), -1, -1)
        return {"image_latent": latent, "prompt": prompt}  # (N * E, 16, h, w), (N * E, n, C)

    def encode_moments(self, image: Tensor) -> Tensor:
        """Encode a single frame."""
        return self.vae.encode(image.to(self.vae.dtype)[:, :, None]).latent_dist.parameters[:, :, 0]

    def scale_latents(self, latents: Tensor) -> Tensor:
        """Normalize channel by channel, float32 or wider."""
        mean, deviation = _statistics(self.vae, upcast(latents))
        return (upcast(latents) - mean) / deviation

    def prepare_latents(self, condition: Condition, generator: Generators) -> Tensor:
        """Return the image latent, from which the single step starts."""
        return condition["image_latent"]

    def set_timesteps(self, num_inference_steps: int, device: torch.device) -> None:
        """Set a single step of full length, ``z - v``, for any timestep input of the network."""
        self.scheduler.set_timesteps(sigmas=[1.0], timesteps=[TIMESTEP], device=device)

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """Predict the velocity from the depth latent to the image latent."""
        prompt, (batch, channels, height, width) = condition["prompt"], latents.shape
        tokens = QwenImageEditPipeline._pack_latents(latents, batch, channels, height, width)
        velocity = self.transformer(
            hidden_states=tokens.to(prompt.dtype),
            timestep=(timestep / 1000).to(prompt).expand(batch),
            encoder_hidden_states=prompt,
            img_shapes=[[(1, height // 2, width // 2)]] * batch,
            return_dict=False,
        )[0]
        frames = QwenImageEditPipeline._unpack_latents(velocity, CELL * height, CELL * width, CELL)
        return frames[:, :, 0].to(latents.dtype)

    def decode_image(self, z0: Tensor) -> Tensor:
        """Decode one frame like ``vae.decode`` without its clamp, which has no gradient at near and far."""
        wide = upcast(z0)
        mean, deviation = _statistics(self.vae, wide)
        z = (wide * deviation + mean).to(self.vae.dtype)[:, :, None]
        frames = [_decode(self.vae, part) for part in (z.split(1) if self.vae.use_slicing else (z,))]
        return torch.cat(frames)[:, :, 0].to(wide.dtype)

    def encode_image(self, rgb: Tensor) -> Tensor:
        """Return the mode of the latent of one frame, float32 or wider."""
        return self.scale_latents(self.encode_moments(rgb).chunk(2, dim=1)[0])

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """Decode like the authors: clip every channel, then average."""
        return map_of(self.decode_image(latents).clamp(-1.0, 1.0))
