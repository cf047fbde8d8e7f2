"""Adapter of Marigold V2, from the folder that ``geodiff convert marigold-v2`` writes.

Data flow: folder -> ``MarigoldV2Pipeline``.
Paper: none (Marigold V2, arXiv 2609.08084).
"""

from __future__ import annotations

import torch

from geodiff_plugin.priors.base import OwnPipelinePrior
from geodiff_plugin.priors.layout import Layout
from geodiff_plugin.priors.loading import build_pipeline
from geodiff_plugin.priors.pipelines.marigold_v2 import MarigoldV2Pipeline
from geodiff_plugin.priors.pipelines.prompts import FixedPrompt
from geodiff_plugin.priors.unmerged_lora import LORA_FOLDER, load_with_lora

__all__ = ["MarigoldV2Prior"]


class MarigoldV2Prior(OwnPipelinePrior):
    """Marigold V2: one step of a transformer on the image's latent, in log, linear or inverse depth."""

    pipeline_class = MarigoldV2Pipeline
    licence = {"huawei-bayerlab/marigold-v2-0": "apache-2.0"}

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """A transformer over joint image and text tokens, a video autoencoder, a saved prompt."""
        return (
            "joint_attention_dim" in layout.config("transformer")
            and "latents_mean" in layout.config("vae")
            and bool(layout.config("prompt"))
        )

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> MarigoldV2Pipeline:
        """Components as the index names them, and our prompt; a LoRA kept apart is put on.

        Raises:
            ValueError: weights that do not fit; a LoRA kept apart, without the packages that it needs.
        """
        transformer = load_with_lora(layout, dtype) if layout.has(LORA_FOLDER) else None
        return build_pipeline(
            cls.pipeline_class,
            layout,
            dtype,
            classes={"prompt": FixedPrompt},
            transformer=transformer,
            prediction_type=space,
        )
