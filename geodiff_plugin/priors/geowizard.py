"""GeoWizard v1 and v2.

Data flow: authors' folder or ours -> ``GeoWizardPipeline`` -> contract.
Paper: S4 (any diffusion-based depth model).
"""

from __future__ import annotations

from typing import Any

import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from transformers import CLIPTextModel, CLIPTokenizer, CLIPVisionModelWithProjection

from geodiff_plugin.priors.base import OwnPipelinePrior
from geodiff_plugin.priors.layout import Layout
from geodiff_plugin.priors.loading import LIBRARIES, build_pipeline, load_component
from geodiff_plugin.priors.pipelines.geowizard import IMAGE_EMBEDDING, TEXT_PROMPT, GeoWizardPipeline

__all__ = ["GeoWizardPrior"]

#: What the authors' scripts load from a folder whose index names classes of their own, or that has no index.
CLASSES = {
    "unet": UNet2DConditionModel,
    "vae": AutoencoderKL,
    "scheduler": DDIMScheduler,
    "image_encoder": CLIPVisionModelWithProjection,
    "text_encoder": CLIPTextModel,
    "tokenizer": CLIPTokenizer,
}
UNET_V2 = "unet_v2"


class GeoWizardPrior(OwnPipelinePrior):
    """Depth and normals from one noise; guidance touches the depth half alone.

    The domain is an argument of the call: ``pipe(image, domain="outdoor", guidance=...)``.
    """

    pipeline_class = GeoWizardPipeline
    licence = {"lemonaddie/geowizard": "cc-by-4.0", "lemonaddie/Geowizard": "cc-by-4.0"}

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """A U-Net from 8 to 4 channels with a class embedding of 10 numbers (v1) or of 4 (v2).

        The U-Net of a Lotus-G has the same config as that of v2, so v2 is asked for more: the subfolder's
        name in the authors' repository, or the domain that only our pipeline saves.
        """
        unet = layout.config(_unet_folder(layout))
        if (unet.get("in_channels"), unet.get("out_channels")) != (8, 4):
            return False
        width = unet.get("projection_class_embeddings_input_dim")
        is_v2 = _unet_folder(layout) == UNET_V2 or "default_domain" in layout.index
        return width == IMAGE_EMBEDDING or (width == TEXT_PROMPT and is_v2)

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> GeoWizardPipeline:
        """From our folder or the authors'.

        Theirs for v2 holds ``unet_v2`` beside ``vae``, ``text_encoder``, ``tokenizer`` and ``scheduler`` of
        Stable Diffusion 2, and no ``unet``.
        """
        classes = {
            name: found
            for name, found in CLASSES.items()
            if layout.has(name) and (layout.index.get(name) or [None])[0] not in LIBRARIES
        }
        options: dict[str, Any] = {"prediction_type": space}
        if _unet_folder(layout) == UNET_V2:
            options["unet"] = load_component(layout, UNET_V2, UNet2DConditionModel, dtype)
        statistics = layout.read_json("feature_extractor/preprocessor_config.json")
        if statistics:
            options["clip_statistics"] = {k: statistics[f"image_{k}"] for k in ("mean", "std")}
        return build_pipeline(GeoWizardPipeline, layout, dtype, classes, **options)


def _unet_folder(layout: Layout) -> str:
    return "unet" if layout.has("unet") or not layout.has(UNET_V2) else UNET_V2
