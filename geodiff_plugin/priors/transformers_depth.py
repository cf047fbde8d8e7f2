"""Adapter of depth models of ``transformers``, from their own folder or ours.

Data flow: ``config.json``, ``preprocessor_config.json``, weights -> ``TransformersDepthPipeline``.
Paper: none.
"""

from __future__ import annotations

import torch
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors.base import OwnPipelinePrior
from geodiff_plugin.priors.hf_depth import DEPTH_ARCHITECTURES, HFDepthModel
from geodiff_plugin.priors.layout import Layout
from geodiff_plugin.priors.loading import build_pipeline
from geodiff_plugin.priors.pipelines.direct_scheduler import DirectScheduler
from geodiff_plugin.priors.pipelines.transformers_depth import TransformersDepthPipeline

__all__ = ["TransformersDepthPrior"]

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
