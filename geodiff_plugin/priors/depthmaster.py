"""Adapter of DepthMaster, whose folder is in diffusers' layout but for the block that its U-Net adds.

Data flow: folder -> ``DepthMasterPipeline``.
Paper: none.
"""

from __future__ import annotations

import torch

from geodiff_plugin.priors.base import OwnPipelinePrior
from geodiff_plugin.priors.layout import Layout
from geodiff_plugin.priors.loading import build_pipeline
from geodiff_plugin.priors.pipelines.depthmaster import DepthMasterPipeline
from geodiff_plugin.priors.pipelines.fourier_unet import FourierUNet

__all__ = ["DepthMasterPrior"]


class DepthMasterPrior(OwnPipelinePrior):
    """DepthMaster: a U-Net on the image latent alone, and no scheduler."""

    pipeline_class = DepthMasterPipeline
    licence = {"zysong212/DepthMaster": "apache-2.0"}

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Four channels in, no class embedding, a text encoder, no scheduler among the components."""
        unet = layout.config("unet")
        return (
            unet.get("in_channels") == 4
            and not unet.get("class_embed_type")
            and "text_encoder" in layout.index
            and "scheduler" not in layout.index
        )

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> DepthMasterPipeline:
        """The U-Net by our class, whatever the index names."""
        return build_pipeline(
            cls.pipeline_class, layout, dtype, classes={"unet": FourierUNet}, prediction_type=space
        )
