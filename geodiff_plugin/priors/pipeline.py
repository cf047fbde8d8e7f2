"""``DepthPrior``, the interface of priors, and a denoising loop for those without a pipeline (S4)."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from diffusers import DiffusionPipeline, MarigoldDepthPipeline
from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution
from diffusers.pipelines.marigold import MarigoldDepthOutput
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

from geodiff_plugin._internal.checks import bad_type, bad_value, check_choice, check_number
from geodiff_plugin.priors.loading import Layout, build_pipeline
from geodiff_plugin.scale.space import SPACES, DepthRange, PriorMaps

Condition = dict[str, Tensor]
Generators = torch.Generator | list[torch.Generator] | None
#: Resampling modes of the stock pipeline.
RESAMPLING = ("nearest", "nearest-exact", "bilinear", "bicubic", "area")
#: Mode for further maps, such as normals, whose unit length it keeps.
EXTRA_RESAMPLING = "nearest-exact"


def upcast(x: Tensor) -> Tensor:
    """Convert half precision to float32; wider dtypes are unchanged."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


def image_of_map(x: Tensor) -> Tensor:
    """Convert a map ``(B, 1, H, W)`` in [0, 1] to an image ``(B, 3, H, W)`` in [-1, 1]."""
    return (2.0 * x - 1.0).expand(-1, 3, -1, -1)


def map_of(rgb: Tensor) -> Tensor:
    """Average the channels of an image ``(B, 3, H, W)`` and map [-1, 1] to [0, 1]: ``(B, 1, H, W)``."""
    return (rgb.mean(dim=1, keepdim=True) + 1.0) / 2.0


def normalized(maps: Tensor) -> Tensor:
    """Normalize each of the maps ``(B, 1, H, W)`` to [0, 1]."""
    low, high = maps.amin((1, 2, 3), keepdim=True), maps.amax((1, 2, 3), keepdim=True)
    return (maps - low) / (high - low).clamp_min(torch.finfo(maps.dtype).tiny)


def encode_image(vae: Any, rgb: Tensor) -> Tensor:
    """Encode images to scaled latents ``(B, C, h, w)``, the posterior's mode, float32 or wider."""
    encoded = vae.encode(rgb.to(vae.dtype))
    latents = encoded.latent_dist.mode() if hasattr(encoded, "latent_dist") else encoded.latents
    return upcast(latents) * vae.config.scaling_factor


def decode_image(vae: Any, z0: Tensor) -> Tensor:
    """Decode scaled latents ``(B, C, h, w)`` to images ``(B, 3, H, W)``, about [-1, 1], float32 or wider.

    Unlike in the stock pipelines the result is not clipped: clipping has no gradient at near and far.
    """
    return upcast(vae.decode((z0 / vae.config.scaling_factor).to(vae.dtype), return_dict=False)[0])


@dataclass
class DepthOutput(MarigoldDepthOutput):
    """``MarigoldDepthOutput`` with further maps by name, such as ``"normals"``, of any number of channels."""

    extras: dict[str, np.ndarray | Tensor] = field(default_factory=dict)


class _OutputGrid(NamedTuple):
    """Converts maps on the padded grid of the network to outputs of a call."""

    processor: MarigoldImageProcessor
    padding: tuple[int, int]  # rows and columns
    size: tuple[int, int] | None  # (H, W) of the outputs; None for the network's, without padding
    as_numpy: bool

    def cropped(self, maps: Tensor) -> Tensor:
        """Remove the padding of maps ``(N, C, H, W)``."""
        return self.processor.unpad_image(maps, self.padding)

    def restored(self, maps: Tensor, resampling: str) -> Tensor | np.ndarray:
        """Resize cropped maps ``(N, C, H, W)`` to the size of the outputs, and convert them."""
        if self.size is not None:
            maps = self.processor.resize_antialias(maps, self.size, resampling, is_aa=False)
        return self.processor.pt_to_numpy(maps) if self.as_numpy else maps


class DepthPrior:
    """Interface of a prior, which has no access to cameras.

    A ``DepthDiffusionPipeline`` is itself a prior; others need an adapter, such as ``MarigoldPrior``.

    Attributes:
        config: config of the pipeline; ``prediction_type`` is the space in which the decoded map is affine.
        max_steps: maximum number of denoising steps, ``None`` for no limit. Below ``min_steps`` a guided call
            runs the rounds of all steps within the allowed ones.
        deterministic: whether the same image always gives the same map, so that an ensemble has one member.
        takes_prompt: whether the call takes ``prompt_depth``, depths that the network starts from.
        takes_map: whether the call takes ``depth_map``, the user's map, which is the result without guidance.
        depth_channels: depth channels of the scheduler's latents; guidance does not change the others.
        metric_range: for a metric prior, ``(N * E, 2)`` metres at 0 and at 1 of its maps; else ``None``. With
            ``takes_map``, metres if the user's maps are in metres.
        valid: ``(N * E, 1, H, W)`` bool, pixels of the processing grid with a prior depth; ``None`` for all.
    """

    config: Any
    max_steps: int | None = None
    deterministic = False
    takes_prompt = False
    takes_map = False
    depth_channels = slice(None)
    metric_range: Tensor | None = None
    valid: Tensor | None = None

    @property
    def space(self) -> str:
        """Space in which the decoded map is affine, key of ``SPACES``; depth if the config has none."""
        space = self.config.get("prediction_type") or "depth"
        return check_choice(space, "the pipeline's prediction_type", SPACES)

    def maps_of(self, samples: slice) -> PriorMaps:
        """Return the known properties of the maps of some of the ``N * E`` samples of the current call."""
        depth_range = None
        if self.metric_range is not None:  # nearest first, which is at x = 1 in disparity
            depth_range = DepthRange(*self.metric_range[samples].T.sort(0).values)
        valid = None if self.valid is None else self.valid[samples]
        if self.takes_map:
            return PriorMaps(self.space, valid, given=True, own_range=depth_range)
        return PriorMaps(self.space, valid, depth_range)

    @property
    def network_input(self) -> slice | None:
        """Channels of the network's first argument that are z_t; ``None`` if z_t is not an input."""
        raise NotImplementedError

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Return whether a folder contains this prior, by its component configs, never by ``_class_name``."""
        return False

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> Any:
        """Load the pipeline of a recognised folder; ``space`` is the user's choice, or ``None``."""
        return build_pipeline(cls, layout, dtype, prediction_type=space)

    def network(self) -> tuple[Any, str]:
        """Return the object and the name of its method that the loop calls once per step."""
        raise NotImplementedError

    def decode(self, z0: Tensor) -> Tensor:
        """Decode depth channels to an unclipped map ``(B, 1, H, W)``, about [0, 1], float32 or wider.

        It may lack the rows and columns beyond the last whole latent cell; a guided call replicates them.
        """
        raise NotImplementedError

    def encode(self, x: Tensor) -> Tensor:
        """Encode a map on the padded grid, also beyond [0, 1]; approximate inverse of ``decode``."""
        raise NotImplementedError


class DepthDiffusionPipeline(DepthPrior, DiffusionPipeline):
    """Depth of an image from a latent (or pixel) diffusion prior.

    A subclass defines how its network is called in ``prepare_condition`` and ``denoise``, and overrides other
    methods if needed. Preprocessing, batching, ensembling, resizing and the arguments of the call are as
    in ``MarigoldDepthPipeline``.

    Attributes:
        sees_latents: whether latents are an input of the network (otherwise there is no z_t).
        output_resampling: the authors' mode for resizing the map to the image.
    """

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
        """Register components and options; call this last in a subclass's constructor.

        ``image_processor`` resizes and pads; a number pads sides to its multiples. ``config`` is saved too.
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

    @property
    def network_input(self) -> slice | None:
        """The depth channels, if the network sees the latents."""
        return self.depth_channels if self.sees_latents else None

    def network(self) -> tuple[Any, str]:
        """Return this pipeline and ``"denoise"``."""
        return self, "denoise"

    def prepare_condition(
        self,
        image: Tensor,
        ensemble_size: int,
        batch_size: int,
        generator: Generators,
        *args: Any,
        **options: Any,
    ) -> Condition:
        """Prepare all inputs of the network except latents and time, ``N * E`` each, grouped by image.

        ``image (N, 3, H, W)`` is in [-1, 1], padded, in the pipeline's dtype; E is ``ensemble_size``;
        ``generator`` is for priors that sample here; ``options`` are further arguments of the call.
        """
        raise NotImplementedError

    def prepare_latents(self, condition: Condition, generator: Generators) -> Tensor:
        """Return initial latents shaped like ``condition["image_latent"]``: Gaussian, or zeros if unused."""
        like = condition["image_latent"]
        if not self.sees_latents:
            return torch.zeros_like(like)
        return randn_tensor(like.shape, generator=generator, device=like.device, dtype=like.dtype)

    def set_timesteps(self, num_inference_steps: int, device: torch.device) -> None:
        """Start a trajectory of ``self.scheduler``; must go through ``scheduler.set_timesteps``."""
        self.scheduler.set_timesteps(num_inference_steps, device=device)

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """Run the network on latents ``(B, C, h, w)``; the output is an input of the scheduler's ``step``."""
        raise NotImplementedError

    def decode_image(self, z0: Tensor) -> Tensor:
        """Decode clean latents with ``self.vae`` to unclipped images ``(B, 3, H, W)``, about [-1, 1]."""
        return decode_image(self.vae, z0)

    def encode_image(self, rgb: Tensor) -> Tensor:
        """Encode images, float32 or wider; approximate inverse of decoding."""
        return encode_image(self.vae, rgb)

    def decode(self, z0: Tensor) -> Tensor:
        """Decode through ``decode_image``."""
        return map_of(self.decode_image(z0))

    def encode(self, x: Tensor) -> Tensor:
        """Encode through ``encode_image``."""
        return self.encode_image(image_of_map(x))

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """Decode maps of the unguided call, ``(B, 1, H, W)`` in [0, 1]; override to match the authors."""
        return self.decode(latents[:, self.depth_channels]).clamp(0.0, 1.0)

    def decode_extras(self, latents: Tensor, ensemble_size: int) -> dict[str, Tensor]:
        """Decode further maps by name, ``(N, C, H, W)`` on the padded grid, from ``(N * E, C, h, w)``."""
        return {}

    def image_latents(
        self,
        image: Tensor,
        ensemble_size: int,
        batch_size: int,
        generator: Generators = None,
        sample: bool = False,
    ) -> Tensor:
        """Encode images to scaled latents ``(N * E, C, h, w)``, the mode or a ``sample`` per member."""
        moments = torch.cat([self.encode_moments(chunk) for chunk in image.split(batch_size)])
        posterior = DiagonalGaussianDistribution(moments.repeat_interleave(ensemble_size, dim=0))
        return self.scale_latents(posterior.sample(generator) if sample else posterior.mode())

    def encode_moments(self, image: Tensor) -> Tensor:
        """Return mean and log variance of an image's latent from ``self.vae``."""
        return self.vae.encode(image).latent_dist.parameters

    def scale_latents(self, latents: Tensor) -> Tensor:
        """Scale latents of the autoencoder for the network."""
        return latents * self.vae.config.scaling_factor

    def prompt_embedding(self, like: Tensor, words: str = "") -> Tensor:
        """Embed a prompt, ``(len(like), n, C)``, not padded, as in Marigold's training."""
        most = self.tokenizer.model_max_length
        tokens = self.tokenizer(words, max_length=most, truncation=True, return_tensors="pt")
        embedding = self.text_encoder(tokens.input_ids.to(like.device))[0]
        return embedding.to(like).expand(len(like), -1, -1)

    def run_unet(self, sample: Tensor, timestep: Any, condition: Condition) -> Tensor:
        """Run ``self.unet`` with ``condition["prompt"]`` and, if any, ``condition["class_labels"]``."""
        return self.unet(
            sample,
            timestep,
            encoder_hidden_states=condition["prompt"],
            class_labels=condition.get("class_labels"),
            return_dict=False,
        )[0]

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
        """Estimate relative depth; arguments as in ``MarigoldDepthPipeline``.

        ``None`` for steps and resolution uses the prior's default, for ``resample_method_output`` its
        authors' choice (bilinear while guided). ``options`` are further arguments of ``prepare_condition``.
        """
        steps, resolution = self._steps_and_resolution(num_inference_steps, processing_resolution)
        resampling = resample_method_output or self.output_resampling
        self._check_sizes(ensemble_size, batch_size, output_uncertainty)
        self._check_choices(output_type, resample_method_input, resampling, options)
        padded, padding, size = self.image_processor.preprocess(
            image, resolution, resample_method_input, self._execution_device, self.dtype
        )
        padded = padded.contiguous()  # (N, 3, H, W); in another layout a network rounds differently
        condition = self.prepare_condition(padded, ensemble_size, batch_size, generator, **options)
        z = self._start(condition, latents, generator)  # (N * E, C, h, w)
        z = self._run_steps(z, condition, steps, batch_size, generator)
        grid = _OutputGrid(
            processor=self.image_processor,
            padding=padding,
            size=size if match_input_resolution else None,
            as_numpy=output_type == "np",
        )
        members = torch.cat([self.decode_prediction(chunk) for chunk in z.split(batch_size)])
        maps, spread = self.combine_members(
            grid.cropped(members), ensemble_size, output_uncertainty, ensembling_kwargs or {}
        )
        extras = self.decode_extras(z, ensemble_size)
        output = DepthOutput(
            prediction=grid.restored(maps, resampling),
            uncertainty=None if spread is None else grid.restored(spread, resampling),
            latent=z if output_latent else None,
            extras={name: grid.restored(grid.cropped(x), EXTRA_RESAMPLING) for name, x in extras.items()},
        )
        self.maybe_free_model_hooks()
        return output if return_dict else (output.prediction, output.uncertainty, output.latent)

    def _check_sizes(self, ensemble_size: int, batch_size: int, output_uncertainty: bool) -> None:
        """Raise an ``InputError`` for a number of members or of maps at a time."""
        check_number(ensemble_size, "ensemble_size", 2 if output_uncertainty else 1, 1 << 20, integer=True)
        check_number(batch_size, "batch_size", 1, 1 << 20, integer=True)

    def _check_choices(self, output_type: str, resample_in: str, resample_out: str, options: Any) -> None:
        """Raise an ``InputError`` for an unknown choice or argument of a call."""
        check_choice(output_type, "output_type", ("np", "pt"))
        check_choice(resample_in, "resample_method_input", RESAMPLING)
        check_choice(resample_out, "resample_method_output", RESAMPLING)
        if unknown := set(options) - set(self.call_options()):
            bad_value("arguments of this prior", f"among {self.call_options()}", sorted(unknown))

    def call_options(self) -> list[str]:
        """Return further arguments of the call: the keywords of this prior's ``prepare_condition``."""
        common = inspect.signature(DepthDiffusionPipeline.prepare_condition).parameters
        here = inspect.signature(self.prepare_condition).parameters
        return [name for name, p in here.items() if name not in common and p.kind is not p.VAR_KEYWORD]

    def _steps_and_resolution(self, steps: int | None, resolution: int | None) -> tuple[int, int]:
        """Return the caller's values, checked, or the prior's defaults."""
        steps = self.default_denoising_steps if steps is None else steps
        resolution = self.default_processing_resolution if resolution is None else resolution
        check_number(steps, "num_inference_steps", 1, self.max_steps or 1000, integer=True)
        check_number(resolution, "processing_resolution", 0, 1 << 16, integer=True)
        return steps, resolution

    def _start(self, condition: Condition, latents: Any, generator: Generators) -> Tensor:
        """Return the caller's latents, checked, or the ones from ``prepare_latents``."""
        if latents is None:
            return self.prepare_latents(condition, generator)
        if not isinstance(latents, Tensor):
            bad_type("latents", "None or a torch.Tensor", latents)
        if generator is not None:
            bad_value("latents and generator", "passed one at a time", "both")
        z = self.prepare_latents(condition, None)
        if latents.shape != z.shape:
            bad_value("latents", f"of shape {tuple(z.shape)}", f"shape {tuple(latents.shape)}")
        return latents.to(z)

    def _run_steps(
        self, latents: Tensor, condition: Condition, steps: int, batch_size: int, generator: Generators
    ) -> Tensor:
        """Denoise the members ``(N * E, C, h, w)`` in chunks, one trajectory each."""
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

    def combine_members(
        self, maps: Tensor, ensemble_size: int, output_uncertainty: bool, ensembling_kwargs: dict[str, Any]
    ) -> tuple[Tensor, Tensor | None]:
        """Combine the members of every image, ``(N * E, 1, H, W)``, to ``(N, 1, H, W)`` and its spread."""
        if ensemble_size == 1:
            return maps, None
        pairs = [
            self.ensemble_depth(members, True, True, output_uncertainty, **ensembling_kwargs)
            for members in maps.split(ensemble_size)
        ]
        depths, spreads = zip(*pairs, strict=True)
        return torch.cat(depths), torch.cat(spreads) if output_uncertainty else None


class DirectMapPipeline(DepthDiffusionPipeline):
    """One step that returns ``condition["image_latent"]``, a map ``(N * E, 1, H, W)`` to be guided."""

    max_steps = 1
    deterministic = True
    sees_latents = False

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """Return the map for any latents."""
        return condition["image_latent"]

    def decode(self, z0: Tensor) -> Tensor:
        """Return the latent, which is the map."""
        return z0

    def encode(self, x: Tensor) -> Tensor:
        """Return the map, which is the latent."""
        return x
