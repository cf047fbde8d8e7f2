"""The loop of the priors that diffusers has no pipeline for, with what a prior's author writes for it.

A subclass says how its network is called; preprocessing, batching, ensembling and resizing are those of
``MarigoldDepthPipeline``, whose call signature and meaning are kept, so that guidance works on it unchanged.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from diffusers import DiffusionPipeline, MarigoldDepthPipeline
from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution
from diffusers.pipelines.marigold import MarigoldDepthOutput
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

from geodiff_plugin._checks import bad_type, bad_value, check_choice, check_number

Condition = dict[str, Tensor]
Generators = torch.Generator | list[torch.Generator] | None
#: Ways of resampling that the stock pipeline takes.
RESAMPLING = ("nearest", "nearest-exact", "bilinear", "bicubic", "area")


def encode_map(vae: Any, x: Tensor) -> Tensor:
    """Scaled latents ``(B, C, h, w)`` float32 of a map ``(B, 1, H, W)``, 0 to 1 as the encoder's -1 to 1."""
    picture = (2.0 * x - 1.0).expand(-1, 3, -1, -1).to(vae.dtype)
    encoded = vae.encode(picture)
    latents = encoded.latent_dist.mode() if hasattr(encoded, "latent_dist") else encoded.latents
    return latents.to(torch.promote_types(latents.dtype, torch.float32)) * vae.config.scaling_factor


def decode_picture(vae: Any, z0: Tensor) -> Tensor:
    """Scaled latents ``(B, C, h, w)`` as pictures ``(B, 3, H, W)``, about [-1, 1], float32, not clipped."""
    decoded = vae.decode((z0 / vae.config.scaling_factor).to(vae.dtype), return_dict=False)[0]
    return decoded.to(torch.promote_types(decoded.dtype, torch.float32))  # half precision ends here


def decode_map(vae: Any, z0: Tensor) -> Tensor:
    """Mean of the decoded channels ``(B, 1, H, W)``, from [-1, 1] to [0, 1] and not clipped.

    The pipelines' own endings clip, which silences the gradient exactly at near and far.
    """
    return (decode_picture(vae, z0).mean(dim=1, keepdim=True) + 1.0) / 2.0


@dataclass
class DepthOutput(MarigoldDepthOutput):
    """``MarigoldDepthOutput`` and what else a prior tells.

    Attributes:
        extras: further maps by name, such as ``"normals"``, shaped as ``prediction`` with their own channels.
    """

    extras: dict[str, np.ndarray | Tensor] = field(default_factory=dict)


class DepthDiffusionPipeline(DiffusionPipeline):
    """Depth of an image by a latent (or pixel) diffusion prior.

    A subclass registers its modules with ``register_prior`` and overrides ``prepare_condition`` and
    ``denoise``; the rest as it needs.

    Attributes:
        max_steps: most denoising steps that make sense, ``None`` for any number.
        deterministic: the same image gives the same map, whatever the generator.
        depth_channels: which channels of the latents are depth; others are never guided.
        sees_latents: whether the network is given the latents (else there is no z_t).
        output_resampling: how its authors bring the map to the image's size.
    """

    vae: Any  # registered by the subclasses that have them
    scheduler: Any
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
        """Register modules and options; the last line of a subclass's constructor, whose parameters they are.

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
        """Unclipped relative map of clean latents, by ``self.vae``.

        Args:
            z0: ``(B, C, h, w)``, the depth channels only.

        Returns:
            ``(B, 1, H, W)`` about [0, 1] on the padded grid, float32 or wider, with the graph of ``z0``.
        """
        return decode_map(self.vae, z0)

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

    # The call ------------------------------------------------------------------------------------------

    scale_invariant = shift_invariant = True

    progress_bar = MarigoldDepthPipeline.progress_bar
    ensemble_depth = staticmethod(MarigoldDepthPipeline.ensemble_depth)

    @torch.no_grad()
    def __call__(
        self,
        image: Any,
        num_inference_steps: int | None = None,
        ensemble_size: int = 1,
        processing_resolution: int | None = None,
        match_input_resolution: bool = True,
        resample_method_input: str = "bilinear",
        resample_method_output: str | None = None,
        batch_size: int = 1,
        ensembling_kwargs: dict[str, Any] | None = None,
        latents: Tensor | None = None,
        generator: Generators = None,
        output_type: str = "np",
        output_uncertainty: bool = False,
        output_latent: bool = False,
        return_dict: bool = True,
        **options: Any,
    ) -> DepthOutput | tuple[Any, ...]:
        """Estimate relative depth; arguments as ``MarigoldDepthPipeline`` takes them.

        ``None`` for steps and resolution is the prior's own, for ``resample_method_output`` its authors'
        (bilinear while guided). ``options`` are what this prior adds, see its ``prepare_condition``.

        Returns:
            ``DepthOutput``, or the tuple (prediction, uncertainty, latent).

        Raises:
            TypeError, ValueError: an argument of another type, or out of its range.
        """
        steps = self.default_denoising_steps if num_inference_steps is None else num_inference_steps
        resolution = processing_resolution
        if resolution is None:
            resolution = self.default_processing_resolution
        method_output = resample_method_output or self.output_resampling
        self._check_numbers(steps, ensemble_size, resolution, batch_size)
        check_choice(output_type, "output_type", ("np", "pt"))
        if output_uncertainty and ensemble_size == 1:
            bad_value("ensemble_size", "2 or more with output_uncertainty=True", ensemble_size)
        check_choice(resample_method_input, "resample_method_input", RESAMPLING)
        check_choice(method_output, "resample_method_output", RESAMPLING)
        if latents is not None and not isinstance(latents, Tensor):
            bad_type("latents", "None or a torch.Tensor", latents)
        if latents is not None and generator is not None:
            bad_value("latents and generator", "given one at a time", "both")
        unknown = set(options) - set(self.call_options())
        if unknown:
            bad_value("arguments of this prior", f"out of {self.call_options()}", sorted(unknown))
        device, processor = self._execution_device, self.image_processor
        padded, padding, size = processor.preprocess(
            image, resolution, resample_method_input, device, self.dtype
        )  # (N, 3, H, W)
        padded = padded.contiguous()  # in another layout a network rounds otherwise
        condition = self.prepare_condition(padded, ensemble_size, batch_size, generator, **options)
        z = self.prepare_latents(condition, None if latents is not None else generator)  # (N * E, C, h, w)
        if latents is not None:
            if latents.shape != z.shape:
                bad_value("latents", f"of shape {tuple(z.shape)}", f"shape {tuple(latents.shape)}")
            z = latents.to(z)
        z = self.run_steps(z, condition, steps, batch_size, generator)

        def restore(maps: Tensor, method: str = method_output) -> Tensor | np.ndarray:
            """From the padded processing grid to what the caller gets."""
            if match_input_resolution:
                maps = processor.resize_antialias(maps, size, method, is_aa=False)
            return processor.pt_to_numpy(maps) if output_type == "np" else maps

        maps = torch.cat([self.decode_prediction(chunk) for chunk in z.split(batch_size)])
        maps, spread = self.put_together(
            processor.unpad_image(maps, padding), ensemble_size, output_uncertainty, ensembling_kwargs or {}
        )
        output = DepthOutput(
            prediction=restore(maps),
            uncertainty=None if spread is None else restore(spread),
            latent=z if output_latent else None,
            extras={
                name: restore(processor.unpad_image(extra, padding), "nearest-exact")  # unit normals stay so
                for name, extra in self.decode_extras(z, ensemble_size).items()
            },
        )
        self.maybe_free_model_hooks()
        return output if return_dict else (output.prediction, output.uncertainty, output.latent)

    def call_options(self) -> list[str]:
        """What this prior adds to the call: the keywords of its ``prepare_condition``."""
        common = inspect.signature(DepthDiffusionPipeline.prepare_condition).parameters
        own = inspect.signature(self.prepare_condition).parameters
        return [name for name, p in own.items() if name not in common and p.kind is not p.VAR_KEYWORD]

    def _check_numbers(self, steps: int, members: int, resolution: int, batch_size: int) -> None:
        most = 1000 if self.max_steps is None else self.max_steps
        check_number(steps, "num_inference_steps", 1, most, integer=True)
        check_number(members, "ensemble_size", 1, 1 << 20, integer=True)
        check_number(resolution, "processing_resolution", 0, 1 << 16, integer=True)
        check_number(batch_size, "batch_size", 1, 1 << 20, integer=True)

    def run_steps(
        self, latents: Tensor, condition: Condition, steps: int, batch_size: int, generator: Generators
    ) -> Tensor:
        """Denoise the members ``(N * E, C, h, w)`` in chunks, each of which is a trajectory of its own."""
        done = []
        for i in self.progress_bar(range(0, len(latents), batch_size), leave=True, desc="Depth predictions"):
            z = latents[i : i + batch_size]
            part = {name: value[i : i + batch_size] for name, value in condition.items()}
            self.set_timesteps(steps, latents.device)
            for t in self.progress_bar(self.scheduler.timesteps, leave=False, desc="Denoising steps"):
                output = self.denoise(z, t, part)
                z = self.scheduler.step(output, t, z, generator=generator).prev_sample
            done.append(z)
        return torch.cat(done)

    def put_together(
        self, maps: Tensor, ensemble_size: int, output_uncertainty: bool, ensembling_kwargs: dict[str, Any]
    ) -> tuple[Tensor, Tensor | None]:
        """Ensemble the members of every image: ``(N * E, 1, H, W)`` to ``(N, 1, H, W)`` and its spread."""
        if ensemble_size == 1:
            return maps, None
        pairs = [
            self.ensemble_depth(
                members, self.scale_invariant, self.shift_invariant, output_uncertainty, **ensembling_kwargs
            )
            for members in maps.split(ensemble_size)
        ]
        depths, spreads = zip(*pairs, strict=True)
        return torch.cat(depths), torch.cat(spreads) if output_uncertainty else None


class DirectMapPipeline(DepthDiffusionPipeline):
    """One step that gives ``condition["relative"]``, ``(N * E, 1, H, W)``; what guidance moves is the map."""

    max_steps = 1
    deterministic = True
    sees_latents = False

    def prepare_latents(self, condition: Condition, generator: Generators) -> Tensor:
        """Zeros; nothing reads them."""
        return torch.zeros_like(condition["relative"])

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """The map, whatever the latents are."""
        return condition["relative"]

    def decode_relative(self, z0: Tensor) -> Tensor:
        """The latent is the map."""
        return z0

    def encode_relative(self, x: Tensor) -> Tensor:
        """The map is the latent."""
        return x
