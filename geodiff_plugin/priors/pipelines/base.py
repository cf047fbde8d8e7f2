"""Base pipeline of depth priors that diffusers has no pipeline for.

Data flow: image -> condition, latents -> ``denoise`` once a step -> clean latent -> relative map
    -> output grid.
Paper: S3.1 (the prior's own sampling), around which Algorithm 1 is put.

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
from diffusers.pipelines.marigold import MarigoldDepthOutput
from torch import Tensor

from geodiff_plugin._checks import bad_type, bad_value, check_choice, check_number
from geodiff_plugin.priors.pipelines.hooks import Condition, Generators, PriorHooks

__all__ = ["RESAMPLING", "DepthDiffusionPipeline", "DepthOutput"]

#: Ways of resampling that the stock pipeline takes.
RESAMPLING = ("nearest", "nearest-exact", "bilinear", "bicubic", "area")


@dataclass
class DepthOutput(MarigoldDepthOutput):
    """``MarigoldDepthOutput`` and what else a prior tells.

    Attributes:
        extras: further maps by name, such as ``"normals"``, shaped as ``prediction`` with their own channels.
    """

    extras: dict[str, np.ndarray | Tensor] = field(default_factory=dict)


class DepthDiffusionPipeline(PriorHooks, DiffusionPipeline):
    """Depth of an image by a latent (or pixel) diffusion prior.

    A subclass registers its modules with ``register_prior`` and overrides ``prepare_condition``,
    ``denoise`` and ``decode_relative``; the rest as it needs.
    """

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

        Args:
            image: PIL, numpy in [0, 1] or uint8, torch in [0, 1]; or a list of images of one size.
            num_inference_steps: denoising steps, the prior's own for ``None``.
            ensemble_size: members E per image.
            processing_resolution: longer side, pixels; 0 for the image's own.
            match_input_resolution: give the map at the image's size.
            resample_method_input: of the image.
            resample_method_output: of the map; ``None`` for ``output_resampling``, bilinear while guided.
            batch_size: members per forward.
            ensembling_kwargs: for ``ensemble_depth``.
            latents: initial latents instead of drawn ones.
            generator: source of everything that is drawn.
            output_type: ``"np"`` or ``"pt"``.
            output_uncertainty: with the spread of the members.
            output_latent: with the final latents.
            return_dict: record or tuple.
            **options: what this prior adds, see its ``prepare_condition``.

        Returns:
            ``DepthOutput``, or the tuple (prediction, uncertainty, latent).

        Raises:
            TypeError, ValueError: an argument of another type, or out of its range.
        """
        steps = self.default_denoising_steps if num_inference_steps is None else num_inference_steps
        resolution = (
            self.default_processing_resolution if processing_resolution is None else processing_resolution
        )
        self.check_call(steps, ensemble_size, resolution, batch_size, output_type, output_uncertainty)
        check_choice(resample_method_input, "resample_method_input", RESAMPLING)
        check_choice(resample_method_output or self.output_resampling, "resample_method_output", RESAMPLING)
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

        def restore(
            maps: Tensor, method: str = resample_method_output or self.output_resampling
        ) -> Tensor | np.ndarray:
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
        common = inspect.signature(PriorHooks.prepare_condition).parameters
        own = inspect.signature(self.prepare_condition).parameters
        return [name for name, p in own.items() if name not in common and p.kind is not p.VAR_KEYWORD]

    def check_call(
        self,
        steps: int,
        ensemble_size: int,
        resolution: int,
        batch_size: int,
        output_type: str,
        output_uncertainty: bool,
    ) -> None:
        """Refuse numbers that make no call.

        Raises:
            TypeError, ValueError: naming the argument.
        """
        most = 1000 if self.max_steps is None else self.max_steps
        check_number(steps, "num_inference_steps", 1, most, integer=True)
        check_number(ensemble_size, "ensemble_size", 1, 1 << 20, integer=True)
        check_number(resolution, "processing_resolution", 0, 1 << 16, integer=True)
        check_number(batch_size, "batch_size", 1, 1 << 20, integer=True)
        check_choice(output_type, "output_type", ("np", "pt"))
        if output_uncertainty and ensemble_size == 1:
            bad_value("ensemble_size", "2 or more with output_uncertainty=True", ensemble_size)

    def run_steps(
        self, latents: Tensor, condition: Condition, steps: int, batch_size: int, generator: Generators
    ) -> Tensor:
        """Denoise all members, chunk by chunk; every chunk is a trajectory of its own.

        Args:
            latents: ``(N * E, C, h, w)`` initial latents.
            condition: of all members.
            steps: denoising steps.
            batch_size: members per chunk.
            generator: for schedulers that draw.

        Returns:
            ``(N * E, C, h, w)`` clean latents.
        """
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
