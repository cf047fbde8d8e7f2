"""What a subclass of ``DepthDiffusionPipeline`` overrides: condition, network call, decoder.

Data flow: image -> condition; latents, time -> network output; clean latents <-> relative map.
Paper: S3.1 (the prior's own sampling), around which Algorithm 1 is put.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

__all__ = ["Condition", "Generators", "PriorHooks", "encode_map"]

Condition = dict[str, Tensor]
Generators = torch.Generator | list[torch.Generator] | None


def encode_map(vae: Any, x: Tensor) -> Tensor:
    """Scaled latents ``(B, C, h, w)`` float32 of a map ``(B, 1, H, W)``, 0 to 1 as the encoder's -1 to 1."""
    picture = (2.0 * x - 1.0).expand(-1, 3, -1, -1).to(vae.dtype)
    encoded = vae.encode(picture)
    latents = encoded.latent_dist.mode() if hasattr(encoded, "latent_dist") else encoded.latents
    return latents.to(torch.promote_types(latents.dtype, torch.float32)) * vae.config.scaling_factor


class PriorHooks:
    """The part of a prior's pipeline that its author writes; ``DepthDiffusionPipeline`` calls it.

    Attributes:
        max_steps: most denoising steps that make sense, ``None`` for any number.
        deterministic: the same image gives the same map, whatever the generator.
        depth_channels: which channels of the latents are depth; others are never guided.
        sees_latents: whether the network is given the latents (else there is no z_t).
        output_resampling: how its authors bring the map to the image's size.
    """

    if TYPE_CHECKING:  # what DiffusionPipeline, the other base of every subclass, brings
        vae: Any
        scheduler: Any
        register_modules: Callable[..., None]
        register_to_config: Callable[..., None]

    max_steps: int | None = None
    deterministic = False
    depth_channels = slice(None)
    sees_latents = True
    output_resampling = "bilinear"

    def register_prior(
        self,
        modules: dict[str, Any],
        prediction_type: str,
        default_denoising_steps: int,
        default_processing_resolution: int,
        image_processor: MarigoldImageProcessor | int = 8,
        **config: Any,
    ) -> None:
        """Register modules and options; the last line of a subclass's constructor.

        Args:
            modules: by the names of the constructor's parameters.
            prediction_type: what the relative map is affine in, key of ``scale.space.SPACES``.
            default_denoising_steps: when a call names none.
            default_processing_resolution: longer side, pixels, when a call names none.
            image_processor: a ``MarigoldImageProcessor``, or the number that padded sides are multiples of.
            **config: further options to be saved.
        """
        self.register_modules(**modules)
        self.register_to_config(
            prediction_type=prediction_type,
            default_denoising_steps=default_denoising_steps,
            default_processing_resolution=default_processing_resolution,
            **config,
        )
        self.default_denoising_steps = default_denoising_steps
        self.default_processing_resolution = default_processing_resolution
        if isinstance(image_processor, int):
            image_processor = MarigoldImageProcessor(vae_scale_factor=image_processor)
        self.image_processor = image_processor

    # What a subclass overrides -----------------------------------------------------------------------------

    def prepare_condition(
        self,
        image: Tensor,
        ensemble_size: int,
        batch_size: int,
        generator: Generators,
        *args: Any,
        **options: Any,
    ) -> Condition:
        """Every input of the network beside latents and time.

        Args:
            image: ``(N, 3, H, W)`` in [-1, 1], padded, of the pipeline's dtype.
            ensemble_size: members E per image.
            batch_size: images or members that one forward may take.
            generator: for a prior that draws here (a posterior sample).
            *args: nothing; with ``options`` it lets a subclass name its own keywords.
            **options: what the subclass adds to the call.

        Returns:
            Tensors by name, leading dimension ``N * E``, the members of an image side by side.
        """
        raise NotImplementedError

    def prepare_latents(self, condition: Condition, generator: Generators) -> Tensor:
        """Initial latents ``(N * E, C, h, w)``: Gaussian, or zeros where the network sees none.

        Shaped as ``condition["image_latent"]``; override where that does not fit.
        """
        like = condition["image_latent"]
        if not self.sees_latents:
            return torch.zeros_like(like)
        return randn_tensor(like.shape, generator=generator, device=like.device, dtype=like.dtype)

    def set_timesteps(self, num_inference_steps: int, device: torch.device) -> None:
        """Start a trajectory of ``self.scheduler``; it must go through ``scheduler.set_timesteps``."""
        self.scheduler.set_timesteps(num_inference_steps, device=device)

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """The network's output as the scheduler's ``step`` takes it; called once a step.

        Args:
            latents: ``(B, C, h, w)``.
            timestep: 0-d, out of ``scheduler.timesteps``.
            condition: as ``prepare_condition`` made it, of these ``B`` members.

        Returns:
            ``(B, C, h, w)``, differentiable in ``latents`` if ``sees_latents``.
        """
        raise NotImplementedError

    def decode_relative(self, z0: Tensor) -> Tensor:
        """Unclipped relative map of clean latents.

        Args:
            z0: ``(B, C, h, w)``, the depth channels only.

        Returns:
            ``(B, 1, H, W)`` about [0, 1] on the padded grid, float32 or wider, with the graph of ``z0``.
        """
        raise NotImplementedError

    def encode_relative(self, x: Tensor) -> Tensor:
        """Clean latents of a relative map, about the inverse of ``decode_relative``; by ``self.vae``.

        Args:
            x: ``(B, 1, H, W)`` on the padded grid; beyond [0, 1] as far as the map goes.

        Returns:
            ``(B, C, h, w)`` float32, the depth channels only.
        """
        return encode_map(self.vae, x)

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """What the unguided call gives: ``(B, 1, H, W)`` in [0, 1]; override for an author's own ending."""
        return self.decode_relative(latents[:, self.depth_channels]).clamp(0.0, 1.0)

    def decode_extras(self, latents: Tensor, ensemble_size: int) -> dict[str, Tensor]:
        """Further maps by name, ``(N, C, H, W)`` on the padded grid, members put together; none by default.

        Args:
            latents: ``(N * E, C, h, w)`` final latents.
            ensemble_size: E.
        """
        return {}

    # What a subclass uses ----------------------------------------------------------------------------------

    def image_latents(
        self,
        image: Tensor,
        ensemble_size: int,
        batch_size: int,
        generator: Generators = None,
        sample: bool = False,
    ) -> Tensor:
        """Scaled latents of the images by ``self.vae``, one per member.

        Args:
            image: ``(N, 3, H, W)`` in [-1, 1].
            ensemble_size: members E per image.
            batch_size: images per forward.
            generator: for the sample.
            sample: draw from the posterior, anew for every member; otherwise its mode.

        Returns:
            ``(N * E, C, h, w)``.
        """
        chunks = image.split(batch_size)
        moments = torch.cat([self.vae.encode(chunk).latent_dist.parameters for chunk in chunks])
        posterior = DiagonalGaussianDistribution(moments.repeat_interleave(ensemble_size, dim=0))
        latents = posterior.sample(generator) if sample else posterior.mode()
        return latents * self.vae.config.scaling_factor

    def decode_latents(self, z0: Tensor) -> Tensor:
        """Scaled latents ``(B, C, h, w)`` through ``self.vae``: ``(B, 3, H, W)``, about [-1, 1], float32."""
        decoded = self.vae.decode((z0 / self.vae.config.scaling_factor).to(self.vae.dtype), return_dict=False)
        return decoded[0].to(torch.promote_types(decoded[0].dtype, torch.float32))  # half precision ends here
