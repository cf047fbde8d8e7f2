"""Marigold V2: one step of an image-editing transformer from the image's latent to that of depth.

Data flow: image -> its latent z -> velocity v -> ``z - v`` -> decode -> mean of three channels
    -> relative map.
Paper: none (Marigold V2, arXiv 2609.08084).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import torch
from diffusers import AutoencoderKLQwenImage, FlowMatchEulerDiscreteScheduler, QwenImageTransformer2DModel
from torch import Tensor

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.priors.layout import Layout
from geodiff_plugin.priors.pipelines.base import DepthDiffusionPipeline
from geodiff_plugin.priors.pipelines.hooks import Condition, Generators
from geodiff_plugin.priors.pipelines.prompts import FixedPrompt
from geodiff_plugin.priors.pipelines.sides import SidesOf
from geodiff_plugin.priors.pipelines.video_latents import frame_of, latents_of, pack, unpack
from geodiff_plugin.priors.unmerged_lora import LORA_FOLDER, LORAS, has_lora, load_with_lora

__all__ = ["SPACE_OF_CHECKPOINT", "MarigoldV2Pipeline"]

#: First word of a checkpoint's name -> what its map is affine in.
SPACE_OF_CHECKPOINT = {"log": "log", "uniform": "depth", "disparity": "disparity"}
#: Timestep input of the network, of 1000. The authors write 499 / 1000 in bfloat16, where 499 is 500.
TIMESTEP = 500.0
#: One token is a square of this side.
SIDE = 16


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
        lora: where the LoRA is, one of ``LORAS``; what is not merged, ``load_prior`` and ``from_pretrained``
            put on.
        default_denoising_steps: 1.
        default_processing_resolution: longer side, pixels; they trained at 768.

    Raises:
        ValueError: an unknown ``lora``; a transformer without the LoRA that is kept apart from it.
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
        lora: str = "merged",
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 768,
    ) -> None:
        super().__init__()
        if check_choice(lora, "lora", LORAS) != "merged" and not has_lora(transformer):
            cure = "Load the folder by load_prior or MarigoldV2Pipeline.from_pretrained."
            bad_value("transformer", "with the LoRA that its folder keeps apart", "one without", cure)
        self.deterministic = not sample_latent
        transformer.enable_gradient_checkpointing()
        self.register_prior(
            {"transformer": transformer, "vae": vae, "scheduler": scheduler, "prompt": prompt},
            prediction_type,
            default_denoising_steps,
            default_processing_resolution,
            image_processor=SidesOf(SIDE, grow=True),
            sample_latent=sample_latent,
            lora=lora,
        )

    @classmethod
    def from_pretrained(cls, name: str | Path, **kwargs: Any) -> Self:
        """As of any pipeline; a LoRA that the folder keeps apart is put on the transformer."""
        folder = Path(name)
        if "transformer" not in kwargs and (folder / LORA_FOLDER).is_dir():
            layout = Layout(folder, str(name))
            kwargs["transformer"] = load_with_lora(layout, kwargs.get("dtype", torch.float32))
        return super().from_pretrained(name, **kwargs)

    def save_pretrained(self, *args: Any, **kwargs: Any) -> None:
        """As of any pipeline.

        Raises:
            ValueError: its LoRA is kept apart: the folder that it came from is what there is to save.
        """
        if self.config.lora != "merged":
            cure = "Copy the folder that it came from, or convert the checkpoint with --lora merged."
            bad_value("the pipeline", "with a merged LoRA to be saved", f"lora={self.config.lora!r}", cure)
        super().save_pretrained(*args, **kwargs)

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
        prompt, (height, width) = condition["prompt"], latents.shape[-2:]
        velocity = self.transformer(
            hidden_states=pack(latents).to(prompt.dtype),
            timestep=(timestep / 1000).to(prompt).expand(len(latents)),
            encoder_hidden_states=prompt,
            img_shapes=[[(1, height // 2, width // 2)]] * len(latents),
            return_dict=False,
        )[0]
        return unpack(velocity, height, width).to(latents.dtype)

    def decode_relative(self, z0: Tensor) -> Tensor:
        """Mean of the decoded channels, from [-1, 1] to [0, 1], not clipped."""
        return (frame_of(self.vae, z0).mean(dim=1, keepdim=True) + 1.0) / 2.0

    def encode_relative(self, x: Tensor) -> Tensor:
        """Mode of the code of a grey picture."""
        return latents_of(self.vae, (2.0 * x - 1.0).expand(-1, 3, -1, -1))

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """As the authors end: every channel is clipped, then their mean taken."""
        return (frame_of(self.vae, latents).clamp(-1.0, 1.0).mean(dim=1, keepdim=True) + 1.0) / 2.0
