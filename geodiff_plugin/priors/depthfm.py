"""Adapter of DepthFM, from the folder that ``geodiff convert`` writes.

Data flow: folder -> ``DepthFMPipeline``.
Paper: none.
"""

from __future__ import annotations

import torch

from geodiff_plugin.priors.base import OwnPipelinePrior
from geodiff_plugin.priors.layout import Layout
from geodiff_plugin.priors.loading import build_pipeline
from geodiff_plugin.priors.pipelines.depthfm import DepthFMPipeline
from geodiff_plugin.priors.pipelines.prompts import FixedPrompt

__all__ = ["DepthFMPrior"]


class DepthFMPrior(OwnPipelinePrior):
    """DepthFM: rectified flow, log depth, a prompt that is part of the weights."""

    pipeline_class = DepthFMPipeline

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Eight channels in, a saved prompt, a scheduler of rectified flow (which alone has a ``shift``)."""
        return (
            layout.config("unet").get("in_channels") == 8
            and bool(layout.config("prompt"))
            and "shift" in layout.config("scheduler")
        )

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> DepthFMPipeline:
        """Components as the index names them, and our prompt."""
        return build_pipeline(
            cls.pipeline_class, layout, dtype, classes={"prompt": FixedPrompt}, prediction_type=space
        )
