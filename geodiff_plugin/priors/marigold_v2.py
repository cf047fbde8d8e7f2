"""Marigold V2: one step of an image editing transformer on the image's latent (arXiv 2609.08084)."""

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

from geodiff_plugin.priors.components import FixedPrompt, SidesOf
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import Condition, DepthDiffusionPipeline, Generators, map_of, widened

#: First word of a checkpoint's name -> what its map is affine in.
SPACE_OF_CHECKPOINT = {"log": "log", "uniform": "depth", "disparity": "disparity"}
#: Timestep input of the network, of 1000. The authors write 499 / 1000 in bfloat16, where 499 is 500.
TIMESTEP = 500.0
#: Pixels along the side of the square of one token.
SIDE = 16
#: Pixels along the side of the cell of one latent.
CELL = 8


def _statistics(vae: AutoencoderKLQwenImage, like: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the latents by channel, ``(1, C, 1, 1)`` each."""
    numbers = vae.config.latents_mean, vae.config.latents_std
    mean, deviation = (like.new_tensor(values).view(1, -1, 1, 1) for values in numbers)
    return mean, deviation


@apply_forward_hook
def _decode(vae: AutoencoderKLQwenImage, z: Tensor) -> Tensor:
    """``vae._decode`` of one frame, for which nothing is cached; the hook brings an offloaded one back."""
    tile = vae.tile_sample_min_height // CELL, vae.tile_sample_min_width // CELL
    if vae.use_tiling and (z.shape[-2] > tile[0] or z.shape[-1] > tile[1]):
        return vae.tiled_decode(z, return_dict=False)[0]
    return vae.decoder(vae.post_quant_conv(z))


class MarigoldV2Pipeline(DepthDiffusionPipeline):
    """Depth in one step of rectified flow that starts from the image's own latent.

    The transformer recomputes its blocks in a backward pass (``enable_gradient_checkpointing``), without
    which the full gradient does not fit. ``processing_resolution=0`` is what the authors measure at; they
    trained at 768. With ``sample_latent`` the image's latent is drawn from the posterior, as in their
    ``infer.py``; else it is its mode.
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
        self.register_prior(modules, *defaults, SidesOf(SIDE, grow=True), sample_latent=sample_latent)

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """A transformer over joint image and text tokens, a video autoencoder, a saved prompt."""
        return (
            "joint_attention_dim" in layout.config("transformer")
            and "latents_mean" in layout.config("vae")
            and bool(layout.config("prompt"))
        )

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Generators
    ) -> Condition:
        """Latent of the image, of every member anew where it is drawn, and the prompt."""
        draws = self.config.sample_latent
        latent = self.image_latents(image, ensemble_size, batch_size, generator, draws).to(image.dtype)
        prompt = self.prompt().to(latent.device).expand(len(latent), -1, -1)
        return {"image_latent": latent, "prompt": prompt}  # (N * E, 16, h, w), (N * E, n, C)

    def encode_moments(self, image: Tensor) -> Tensor:
        """Of the one frame."""
        return self.vae.encode(image.to(self.vae.dtype)[:, :, None]).latent_dist.parameters[:, :, 0]

    def scale_latents(self, latents: Tensor) -> Tensor:
        """Normalised channel by channel, float32 or wider."""
        mean, deviation = _statistics(self.vae, widened(latents))
        return (widened(latents) - mean) / deviation

    def prepare_latents(self, condition: Condition, generator: Generators) -> Tensor:
        """The image's latent, from which the one step starts."""
        return condition["image_latent"]

    def set_timesteps(self, num_inference_steps: int, device: torch.device) -> None:
        """A step of the whole length, ``z - v``, whatever the timestep input of the network."""
        self.scheduler.set_timesteps(sigmas=[1.0], timesteps=[TIMESTEP], device=device)

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """Velocity from the depth's latent to the image's."""
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

    def decode_picture(self, z0: Tensor) -> Tensor:
        """One frame, as ``vae.decode`` but for its clamp, which has no gradient where near and far lie."""
        wide = widened(z0)
        mean, deviation = _statistics(self.vae, wide)
        z = (wide * deviation + mean).to(self.vae.dtype)[:, :, None]
        frames = [_decode(self.vae, part) for part in (z.split(1) if self.vae.use_slicing else (z,))]
        return torch.cat(frames)[:, :, 0].to(wide.dtype)

    def encode_picture(self, picture: Tensor) -> Tensor:
        """Mode of the code of one frame, float32 or wider."""
        return self.scale_latents(self.encode_moments(picture).chunk(2, dim=1)[0])

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """As the authors end: every channel is clipped, then their mean taken."""
        return map_of(self.decode_picture(latents).clamp(-1.0, 1.0))
