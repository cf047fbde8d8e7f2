"""Depth models of ``transformers`` as priors that answer in one step, without a latent."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from transformers import PreTrainedModel

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors.base import OwnPipelinePrior
from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.hf_model import DEPTH_ARCHITECTURES, DepthMap, HFDepthModel, Preparation, output_of
from geodiff_plugin.priors.loading import build_pipeline
from geodiff_plugin.priors.pipelines.base import Condition, DirectMapPipeline, Generators
from geodiff_plugin.priors.pipelines.direct_scheduler import DirectScheduler

__all__ = ["TransformersDepthPipeline", "TransformersDepthPrior", "range_of", "unit_range"]

#: What is 1; a few stray pixels shall not press the rest together.
TOP_QUANTILE = 0.98
#: Metres; a network's least depth may be 0.
NEAREST_M = 1e-3


def range_of(values: Tensor) -> tuple[Tensor, Tensor]:
    """Least value and 98 % quantile of maps ``(B, 1, H, W)``, ``(B,)`` each."""
    rows = values.flatten(1)
    # A quantile of every pixel of a large map is more than torch.quantile takes.
    high = torch.quantile(rows[:, :: max(1, rows.shape[1] // 1_000_000)], TOP_QUANTILE, dim=1)
    return rows.amin(dim=1), high


def unit_range(values: Tensor) -> Tensor:
    """Maps ``(B, 1, H, W)`` with their least value at 0 and their 98 % quantile at 1; a flat map is 0."""
    low, high = range_of(values)
    span = (high - low).clamp_min(torch.finfo(values.dtype).tiny)
    return (values - low.view(-1, 1, 1, 1)) / span.view(-1, 1, 1, 1)


class TransformersDepthPipeline(DirectMapPipeline):
    """Every model that ``AutoModelForDepthEstimation`` loads, but that of canopy height.

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

    Attributes:
        own_range: ``(N * E, 2)`` metres at 0 and at 1 of the latest call's maps, of a model that is metric by
            itself or was given a prompt; else ``None``.
    """

    model_cpu_offload_seq = "model"

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
        # A space that the model's class is known for says nothing new: what is saved with it stays metric.
        self._said = None if wrapped.space == _space_of(model) else wrapped.space
        self.takes_prompt = wrapped.takes_prompt
        self.own_range: Tensor | None = None
        self.register_prior(
            {"model": model, "scheduler": scheduler},
            wrapped.space,
            default_denoising_steps,
            default_processing_resolution,
            image_processor=1,
            preparation=preparation,
        )

    def prepare_condition(
        self,
        image: Tensor,
        ensemble_size: int,
        batch_size: int,
        generator: Generators,
        prompt_depth: Tensor | None = None,
    ) -> Condition:
        """The relative map of every image, ``(N * E, 1, H, W)`` float32.

        Args:
            image: as in the base class.
            ensemble_size: as there.
            batch_size: as there.
            generator: as there.
            prompt_depth: ``(N, 1, h, w)`` metres everywhere, for Prompt Depth Anything; a guided call makes
                it of matches and points, unless it is given one.
        """
        prompts = [None] * len(image.split(batch_size))
        if prompt_depth is not None:
            prompt_depth = torch.as_tensor(prompt_depth)
            if prompt_depth.ndim != 4 or len(prompt_depth) != len(image):
                bad_value("prompt_depth", f"({len(image)}, 1, h, w) metres", tuple(prompt_depth.shape))
            prompts = prompt_depth.split(batch_size)
        wrapped = HFDepthModel(self.model, Preparation.from_config(self.config.preparation), self._said)
        maps = [
            wrapped(part.float() / 2 + 0.5, tuple(part.shape[-2:]), prompt)
            for part, prompt in zip(image.split(batch_size), prompts, strict=True)
        ]
        self.own_range = _own_range(maps, ensemble_size)
        values = torch.cat([found.values for found in maps])
        return {"relative": unit_range(values).repeat_interleave(ensemble_size, dim=0)}


def _space_of(model: PreTrainedModel) -> str | None:
    """What the class of a model is known to give, if it is."""
    try:
        return output_of(model)[0]
    except ValueError:
        return None


def _own_range(maps: list[DepthMap], ensemble_size: int) -> Tensor | None:
    """``(N * E, 2)`` metres where the ranged maps are 0 and 1; ``None`` for relative ones."""
    if not all(found.metric for found in maps):
        return None
    ends = [torch.stack([found.metres_of(v) for v in range_of(found.values)], 1) for found in maps]
    return torch.cat(ends).clamp_min(NEAREST_M).repeat_interleave(ensemble_size, dim=0)


PREPARATION_FILES = ("preprocessor_config.json", "processor_config.json")


class TransformersDepthPrior(OwnPipelinePrior):
    """Adapter of ``TransformersDepthPipeline``: scale, shift and a residual per pixel can be guided."""

    pipeline_class = TransformersDepthPipeline
    licence = {
        "depth-anything/Depth-Anything-V2-Small-hf": "apache-2.0",
        "depth-anything/Depth-Anything-V2-Base-hf": "cc-by-nc-4.0",
        "depth-anything/Depth-Anything-V2-Large-hf": "cc-by-nc-4.0",
        "Intel/dpt-large": "apache-2.0",
        "Intel/zoedepth-nyu-kitti": "mit",
        "vinvino02/glpn-nyu": "apache-2.0",
        "apple/DepthPro-hf": "apple-amlr",
    }

    def __init__(self, pipe: TransformersDepthPipeline) -> None:
        super().__init__(pipe)
        self.takes_prompt = pipe.takes_prompt

    def metric_range(self, samples: slice) -> tuple[Tensor, Tensor] | None:
        """Metres of a metric model's map, or of one that was given a prompt."""
        return None if self._pipe.own_range is None else self._pipe.own_range[samples].unbind(1)

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """An architecture that ``AutoModelForDepthEstimation`` knows, alone or as component ``model``."""
        configs = layout.config(""), layout.config("model")
        return any(DEPTH_ARCHITECTURES & set(config.get("architectures") or ()) for config in configs)

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> TransformersDepthPipeline:
        """The model and the preparation of its images.

        Raises:
            ValueError: a folder without safetensors, or without what says how images are prepared.
        """
        if layout.index:
            classes = {"scheduler": DirectScheduler}
            return build_pipeline(cls.pipeline_class, layout, dtype, classes, prediction_type=space)
        if not any(map(layout.has, PREPARATION_FILES)):
            cure = "Fetch the whole folder anew: without it nobody knows how images are prepared."
            bad_value(str(layout.folder), f"a folder with {PREPARATION_FILES[0]}", "none", cure)
        if not any(layout.folder.glob("*.safetensors")):
            cure = "Run `geodiff convert SRC DST` once if it has a .bin file."
            bad_value(str(layout.folder), "a folder with .safetensors weights", "none", cure)
        options = {} if layout.variant is None else {"variant": layout.variant}
        loaded = HFDepthModel.from_pretrained(
            layout.folder, dtype=dtype, space=space, local_files_only=True, **options
        )
        scheduler, preparation = DirectScheduler(timestep=0), loaded.preparation.options
        return cls.pipeline_class(loaded.model, scheduler, preparation, loaded.space)
