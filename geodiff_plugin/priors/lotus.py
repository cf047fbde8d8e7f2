"""Lotus: depth and disparity, generative (G) and discriminative (D).

Data flow: folder in diffusers' layout, and its name -> ``LotusPipeline``.
Paper: none (He et al., Lotus, ICLR 2025).
"""

from __future__ import annotations

import re

import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors.base import OwnPipelinePrior
from geodiff_plugin.priors.layout import Layout
from geodiff_plugin.priors.loading import build_pipeline
from geodiff_plugin.priors.pipelines.direct_scheduler import DirectScheduler
from geodiff_plugin.priors.pipelines.lotus import TIMESTEP, LotusPipeline

__all__ = ["LotusPrior", "space_of_name"]


def space_of_name(name: str) -> str:
    """Depth or disparity, as the name of a repository says it; no config of Lotus does.

    Args:
        name: hub id or path, such as ``"jingheya/lotus-depth-g-v2-1-disparity"``.

    Returns:
        ``"disparity"`` if the part of the name that holds "lotus" holds "disparity" too, else ``"depth"``.

    Raises:
        ValueError: no part of it is named as the authors' repositories are, or it predicts normals.
    """
    parts = [part for part in re.split(r"[/\\]", name.lower()) if "lotus" in part]
    named = parts[-1] if parts else ""
    if "normal" in named:
        cure = "It predicts normals; take a lotus-depth-* one."
        bad_value("prior", "a Lotus that predicts depth or disparity", repr(name), cure)
    if "disparity" in named:
        return "disparity"
    if "lotus-depth-" in named:
        return "depth"
    bad_value(
        "prior",
        "named as its authors named it (lotus-depth-g-v1-0, lotus-depth-g-v2-1-disparity)",
        repr(name),
        "Only the name tells depth from disparity; say which with --space or space=.",
    )


class LotusPrior(OwnPipelinePrior):
    """Adapter of ``LotusPipeline``."""

    pipeline_class = LotusPipeline

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """A U-Net with 4-d projected class labels, on the image latent alone (D) or with noise (G)."""
        unet = layout.config("unet")
        return (
            unet.get("class_embed_type") == "projection"
            and unet.get("projection_class_embeddings_input_dim") == 4
            and unet.get("in_channels") in (4, 8)
            and unet.get("_class_name") == "UNet2DConditionModel"
        )

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> LotusPipeline:
        """The folder's networks; its scheduler, if any, is not used.

        Raises:
            ValueError: weights that do not fit; a space that neither argument, folder nor name tells.
        """
        return build_pipeline(
            LotusPipeline,
            layout,
            dtype,
            scheduler=DirectScheduler(timestep=TIMESTEP),
            prediction_type=space or layout.index.get("prediction_type") or space_of_name(layout.name),
        )
