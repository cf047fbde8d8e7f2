"""Guided methods without a network: their loop runs on one fixed answer (paper S5.3.1, Figure 6)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from PIL import Image
from torch import Tensor

from geodiff_plugin.config import PAPER
from geodiff_plugin.evaluation.baselines.base import Method, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.baselines.guided import (
    call_arguments,
    guided_configuration,
    guided_prediction,
    posed_views,
    prior_space,
)
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.priors import find_adapter
from geodiff_plugin.priors.pipelines.base import DepthDiffusionPipeline
from geodiff_plugin.priors.pipelines.direct_scheduler import DirectScheduler
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance
from geodiff_plugin.scale.space import SPACES

__all__ = ["NO_DIFFUSION", "REPROJECTION_ONLY", "ConstantPrior", "constant_method"]


class ConstantPrior(DepthDiffusionPipeline):
    """A pipeline of one step whose network is ``answer``; guided, it makes the updates of all steps in it.

    Args:
        module: any network of the prior that it stands in for, which says where the work is done.
        scheduler: a ``DirectScheduler``.
        prediction_type: what the relative map is affine in.
        default_denoising_steps: rounds of updates when guided.
        default_processing_resolution: longer side, pixels; 0 for the image's own.

    Attributes:
        answer: padded image ``(1, 3, H, W)`` in [-1, 1] -> latent ``(1, C, h, w)``.
        decode: latent -> unclipped relative map ``(1, 1, H, W)``, differentiable.
        encode: its inverse.
    """

    max_steps = 1
    deterministic = True
    sees_latents = False
    answer: Callable[[Tensor], Tensor]
    decode: Callable[[Tensor], Tensor]
    encode: Callable[[Tensor], Tensor]

    def __init__(
        self,
        module: torch.nn.Module,
        scheduler: Any,
        prediction_type: str = "depth",
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 0,
    ) -> None:
        super().__init__()
        self.register_prior(
            {"module": module, "scheduler": scheduler},
            prediction_type,
            default_denoising_steps,
            default_processing_resolution,
        )

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Any, **options: Any
    ) -> dict[str, Tensor]:
        """The answer, which is all that there is."""
        return {"image_latent": self.answer(image)}

    def denoise(self, latents: Tensor, timestep: Tensor, condition: dict[str, Tensor]) -> Tensor:
        """The answer, whatever the latents."""
        return condition["image_latent"]

    def decode_relative(self, z0: Tensor) -> Tensor:
        """The prior's decoder, or none."""
        return self.decode(z0)

    def encode_relative(self, x: Tensor) -> Tensor:
        """The prior's encoder, or none."""
        return self.encode(x)


#: ``answer``, ``decode`` and ``encode`` of a ``ConstantPrior``, and what resizes and pads for its latent.
Start = tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor], Callable[[Tensor], Tensor], Any]


def _stand_in(pipe: Any, start: Start, rounds: int) -> Any:
    """A pipeline that can be guided and answers with ``start``, at the resolution of a live prior."""
    resolution = pipe.default_processing_resolution or 0
    module = next(part for part in pipe.components.values() if isinstance(part, torch.nn.Module))
    constant = ConstantPrior(module, DirectScheduler(), prior_space(pipe), rounds, resolution)
    constant.answer, constant.decode, constant.encode, constant.image_processor = start
    constant.set_progress_bar_config(disable=True)
    return enable_geometry_guidance(constant)


def constant_method(
    name: str,
    title: str,
    summary: str,
    preset: Callable[..., GeometryGuidance],
    start: Callable[[Any, StereoSample, Settings], Start],
    rounds: int | None = None,
) -> Method:
    """A guided method without a network in its loop.

    Args:
        name: key in ``METHODS``.
        title: column heading.
        summary: one sentence.
        preset: ``(right, K, E, **changes)`` -> guidance.
        start: live prior, sample, settings -> where the updates begin.
        rounds: of ``inner_steps`` updates; ``None`` for as many as the default takes with this prior.

    Returns:
        The method; its configuration is ``guided_configuration``.
    """

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        pipe, views = priors.get(settings), posed_views(sample, settings.views)
        taken = rounds
        if taken is None:
            taken = preset(*views).denoising_steps(settings.steps, pipe.default_denoising_steps)
        with torch.no_grad():
            begun = start(pipe, sample, settings)
        arguments = {} if settings.resolution is None else {"processing_resolution": settings.resolution}
        guidance = preset(*views, min_steps=taken)
        guidance.evidence_store = priors.evidence
        return guided_prediction(_stand_in(pipe, begun, taken), sample, guidance, arguments)

    return Method(name, title, summary, run, partial(guided_configuration, preset), uses_prior=True)


def _ramp(pipe: Any, sample: StereoSample, settings: Settings) -> Start:
    """The latent of a ground plane: near at the bottom, far at the top."""
    adapter = find_adapter(pipe)(pipe)
    near, far = (0.0, 1.0) if SPACES[adapter.space].grows_with_depth else (1.0, 0.0)

    def answer(image: Tensor) -> Tensor:
        rows = torch.linspace(far, near, image.shape[-2], device=image.device)
        return adapter.encode(rows.view(1, 1, -1, 1).expand(len(image), 1, -1, image.shape[-1]))

    return answer, adapter.decode, adapter.encode, pipe.image_processor


NO_DIFFUSION = constant_method(
    "no-diffusion",
    "no diffusion",
    "the default preset without the U-Net: its search, corrections and refinement on the latent of a ramp",
    partial(GeometryGuidance, reject_reflections=False),  # a ramp contradicts nothing
    _ramp,
)


ITERATIONS = 50


def _photometric_updates(right: Any, K: Any, E: Any, **changes: Any) -> GeometryGuidance:
    """Photometric error and pull only, started by the default's search, so that pixels are the change.

    The paper names a rate of 1e-2 and no optimiser. A plain step of that size moves no pixel, because the
    gradient of a mean over all pixels is tiny in each; Adam's do.
    """
    preset: dict[str, Any] = {"weights": PAPER.weights, "inner_steps": ITERATIONS, "step_latents": 0.01}
    preset |= {"correct": False, "refine": False}
    return GeometryGuidance(right, K, E, **(preset | changes))


def _as_it_is(pixels: Tensor) -> Tensor:
    return pixels


def _plain_map(pipe: Any, sample: StereoSample, settings: Settings) -> Start:
    stock = pipe(
        Image.fromarray(sample.left),
        match_input_resolution=False,
        output_type="pt",
        **call_arguments(settings),
    )
    relative = stock.prediction.float()  # (1, 1, h, w), in [0, 1]

    def answer(image: Tensor) -> Tensor:
        size = image.shape[-2:]
        if relative.shape[-2:] == size:
            return relative
        return F.interpolate(relative, size, mode="bilinear", align_corners=False)

    return answer, _as_it_is, _as_it_is, MarigoldImageProcessor(vae_scale_factor=1)


REPROJECTION_ONLY = constant_method(
    "reprojection-only",
    "reprojection only",
    "no diffusion: the prior's map, its pixels moved by 50 updates of the photometric error",
    _photometric_updates,
    _plain_map,
    rounds=1,
)
