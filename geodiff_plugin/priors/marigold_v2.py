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

from geodiff_plugin.priors.base import DepthPrior
from geodiff_plugin.priors.components import FixedPrompt, SidesOf
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import Condition, DepthDiffusionPipeline, Generators


def _statistics(vae: AutoencoderKLQwenImage, like: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the latents by channel, ``(1, C, 1, 1)`` each."""
    numbers = vae.config.latents_mean, vae.config.latents_std
    mean, deviation = (like.new_tensor(values).view(1, -1, 1, 1) for values in numbers)
    return mean, deviation


def latents_of(
    vae: AutoencoderKLQwenImage,
    picture: Tensor,
    generator: Generators = None,
    sample: bool = False,
) -> Tensor:
    """Normalised latents ``(B, C, H / 8, W / 8)`` float32 of pictures ``(B, 3, H, W)`` in [-1, 1].

    The posterior's mode, or a sample of it by ``generator``; sides are multiples of 8.
    """
    posterior = vae.encode(picture.to(vae.dtype)[:, :, None]).latent_dist
    latents = posterior.sample(generator) if sample else posterior.mode()
    latents = latents[:, :, 0].to(torch.promote_types(latents.dtype, torch.float32))
    mean, deviation = _statistics(vae, latents)
    return (latents - mean) / deviation


def frame_of(vae: AutoencoderKLQwenImage, latents: Tensor) -> Tensor:
    """Decode normalised latents without the clamp at the end of ``vae.decode``.

    That clamp has no gradient beyond [-1, 1], which is where near and far lie. Slicing and tiling are kept.
    Latents ``(B, C, h, w)`` give ``(B, 3, 8 h, 8 w)``, float32 or wider, with their graph.
    """
    wide = latents.to(torch.promote_types(latents.dtype, torch.float32))
    mean, deviation = _statistics(vae, wide)
    z = (wide * deviation + mean).to(vae.dtype)[:, :, None]
    frames = torch.cat([_decode(vae, part) for part in (z.split(1) if vae.use_slicing else (z,))])
    return frames[:, :, 0].to(wide.dtype)


@apply_forward_hook
def _decode(vae: AutoencoderKLQwenImage, z: Tensor) -> Tensor:
    """``vae._decode`` of one frame, for which nothing is cached; the hook brings an offloaded one back."""
    tile = vae.tile_sample_min_height // 8, vae.tile_sample_min_width // 8
    if vae.use_tiling and (z.shape[-2] > tile[0] or z.shape[-1] > tile[1]):
        return vae.tiled_decode(z, return_dict=False)[0]
    return vae.decoder(vae.post_quant_conv(z))


#: First word of a checkpoint's name -> what its map is affine in.
SPACE_OF_CHECKPOINT = {"log": "log", "uniform": "depth", "disparity": "disparity"}
#: Timestep input of the network, of 1000. The authors write 499 / 1000 in bfloat16, where 499 is 500.
TIMESTEP = 500.0
#: One token is a square of this side, one latent a cell of half of it.
SIDE, CELL = 16, 8


class MarigoldV2Pipeline(DepthDiffusionPipeline):
    """Depth in one step of rectified flow that starts from the image's own latent.

    The transformer recomputes its blocks in a backward pass (``enable_gradient_checkpointing``), without
    which the full gradient does not fit. ``processing_resolution=0`` is what the authors measure at.

    Args:
        transformer: that of Qwen-Image-Edit, with the checkpoint's LoRA.
        vae: that of Qwen-Image, with the checkpoint's decoder where one was trained.
        scheduler: rectified flow; only its arithmetic is used.
        prompt: the embedding that came with the checkpoint, which makes a text encoder superfluous.
        prediction_type: ``"log"``, ``"depth"`` (their "Uniform") or ``"disparity"``.
        sample_latent: draw the image's latent from the posterior, as their ``infer.py``, instead of taking
            its mode, as their depth completion.
        default_processing_resolution: longer side, pixels; they trained at 768.
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

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Generators
    ) -> Condition:
        """Latent of the image, of every member anew where it is drawn, and the prompt."""
        members = image.repeat_interleave(ensemble_size, dim=0) if self.config.sample_latent else image
        parts = []
        for first in range(0, len(members), batch_size):
            chunk = slice(first, first + batch_size)
            own = generator[chunk] if isinstance(generator, list) else generator
            parts.append(latents_of(self.vae, members[chunk], own, self.config.sample_latent))
        latent = torch.cat(parts).to(image.dtype)  # (N * E, 16, h, w)
        if not self.config.sample_latent:
            latent = latent.repeat_interleave(ensemble_size, dim=0)
        return {
            "image_latent": latent,
            "prompt": self.prompt().to(latent.device).expand(len(latent), -1, -1),
        }

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

    def decode_relative(self, z0: Tensor) -> Tensor:
        """Mean of the decoded channels, from [-1, 1] to [0, 1], not clipped."""
        return (frame_of(self.vae, z0).mean(dim=1, keepdim=True) + 1.0) / 2.0

    def encode_relative(self, x: Tensor) -> Tensor:
        """Mode of the code of a grey picture."""
        return latents_of(self.vae, (2.0 * x - 1.0).expand(-1, 3, -1, -1))

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """As the authors end: every channel is clipped, then their mean taken."""
        return (frame_of(self.vae, latents).clamp(-1.0, 1.0).mean(dim=1, keepdim=True) + 1.0) / 2.0


class MarigoldV2Prior(DepthPrior):
    """Marigold V2: one step of a transformer on the image's latent, in log, linear or inverse depth."""

    pipeline_class = MarigoldV2Pipeline
    component_classes = {"prompt": FixedPrompt}
    licence = {"huawei-bayerlab/marigold-v2-0": "apache-2.0"}

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """A transformer over joint image and text tokens, a video autoencoder, a saved prompt."""
        return (
            "joint_attention_dim" in layout.config("transformer")
            and "latents_mean" in layout.config("vae")
            and bool(layout.config("prompt"))
        )
