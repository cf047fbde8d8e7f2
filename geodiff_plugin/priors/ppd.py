"""Pixel-Perfect Depth with the semantics of Depth Anything V2, as ``geodiff convert`` writes it.

Data flow: ``dit/``, ``semantic_encoder/``, ``scheduler/`` -> ``PPDPipeline``, whose latents are the map
    itself.
Paper: none; Pixel-Perfect Depth (arXiv 2510.07316).
"""

from __future__ import annotations

import torch
from transformers import Dinov2Model

from geodiff_plugin.priors.base import OwnPipelinePrior
from geodiff_plugin.priors.layout import Layout
from geodiff_plugin.priors.loading import build_pipeline
from geodiff_plugin.priors.pipelines.pixel_dit import PixelDiT
from geodiff_plugin.priors.pipelines.ppd import PPDPipeline

__all__ = ["LICENCE", "PPDPrior"]

LICENCE = "apache-2.0, and cc-by-nc-4.0 for the encoder of Depth Anything V2 Large"


class PPDPrior(OwnPipelinePrior):
    """Adapter of ``PPDPipeline``: no VAE, so that decoding is an offset and the gradient its own."""

    pipeline_class = PPDPipeline
    licence = {"gangweix/Pixel-Perfect-Depth": LICENCE}

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """A transformer on semantic tokens, beside the encoder that computes them."""
        semantic_size = layout.config("dit").get("semantic_size")
        encoder = layout.config("semantic_encoder")
        return semantic_size is not None and encoder.get("model_type") == "dinov2"

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> PPDPipeline:
        """Components by name; the transformer's class is ours."""
        classes = {"dit": PixelDiT, "semantic_encoder": Dinov2Model}
        return build_pipeline(cls.pipeline_class, layout, dtype, classes, prediction_type=space)
