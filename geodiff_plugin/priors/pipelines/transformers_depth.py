"""A depth model of ``transformers`` as a "diffusion" of one step that knows its answer.

Hop: image -> the model's map, brought to about [0, 1] -> the clean latent, which is decoded by doing nothing.
Paper: none (an honest prior for those who have no diffusion prior).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from transformers import PreTrainedModel

from geodiff_plugin.priors.hf_depth import HFDepthModel
from geodiff_plugin.priors.hf_preparation import Preparation
from geodiff_plugin.priors.pipelines.base import DepthDiffusionPipeline
from geodiff_plugin.priors.pipelines.direct_scheduler import DirectScheduler
from geodiff_plugin.priors.pipelines.hooks import Condition, Generators

__all__ = ["TransformersDepthPipeline", "unit_range"]

#: What is 1; a few stray pixels shall not press the rest together.
TOP_QUANTILE = 0.98


def unit_range(values: Tensor) -> Tensor:
    """Maps ``(B, 1, H, W)`` with their least value at 0 and their 98 % quantile at 1; a flat map is 0."""
    rows = values.flatten(1)
    low = rows.amin(dim=1)
    # A quantile of every pixel of a large map is more than torch.quantile takes.
    high = torch.quantile(rows[:, :: max(1, rows.shape[1] // 1_000_000)], TOP_QUANTILE, dim=1)
    span = (high - low).clamp_min(torch.finfo(values.dtype).tiny)
    return (values - low.view(-1, 1, 1, 1)) / span.view(-1, 1, 1, 1)


class TransformersDepthPipeline(DepthDiffusionPipeline):
    """Depth Anything, DPT, ZoeDepth, GLPN, DepthPro and whatever else ``AutoModelForDepthEstimation`` loads.

    There are no latents to speak of: what guidance moves beside scale and shift is the map itself, pixel by
    pixel. ``processing_resolution`` is the longer side of that map, 0 for the image's own; which size the
    network then works at, its ``preprocessor_config.json`` says.

    Args:
        model: the network.
        scheduler: one step whose result is what it is given.
        preparation: contents of ``preprocessor_config.json``; needed.
        prediction_type: ``"depth"`` or ``"disparity"``; ``None`` for what the model's class is known to give.
        default_denoising_steps: 1.
        default_processing_resolution: see above.
    """

    model_cpu_offload_seq = "model"
    max_steps = 1
    deterministic = True
    sees_latents = False

    def __init__(
        self,
        model: PreTrainedModel,
        scheduler: DirectScheduler,
        preparation: dict[str, Any] | None = None,
        prediction_type: str | None = None,
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 768,
    ) -> None:
        super().__init__()
        wrapped = HFDepthModel(model, Preparation.from_config(preparation or {}), prediction_type)
        self.register_prior(
            {"model": model, "scheduler": scheduler},
            wrapped.space,
            default_denoising_steps,
            default_processing_resolution,
            image_processor=1,
            preparation=preparation,
        )

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Generators, **options: Any
    ) -> Condition:
        """The relative map of every image, ``(N * E, 1, H, W)`` float32."""
        wrapped = HFDepthModel(
            self.model, Preparation.from_config(self.config.preparation), self.config.prediction_type
        )
        maps = [
            wrapped(part.float() / 2 + 0.5, size=tuple(part.shape[-2:])).values
            for part in image.split(batch_size)
        ]
        return {"relative": unit_range(torch.cat(maps)).repeat_interleave(ensemble_size, dim=0)}

    def prepare_latents(self, condition: Condition, generator: Generators) -> Tensor:
        """Zeros; nothing reads them."""
        return torch.zeros_like(condition["relative"])

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """The map that the network gave, whatever the latents are."""
        return condition["relative"]

    def decode_relative(self, z0: Tensor) -> Tensor:
        """The latent is the map."""
        return z0

    def encode_relative(self, x: Tensor) -> Tensor:
        """The map is the latent."""
        return x
