"""Tiny random GeoWizards, for the contract tests and as folders to try."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from transformers import (
    CLIPTextConfig,
    CLIPTextModel,
    CLIPTokenizer,
    CLIPVisionConfig,
    CLIPVisionModelWithProjection,
)

from geodiff_plugin.priors.geowizard import IMAGE_EMBEDDING, TEXT_PROMPT, GeoWizardPipeline
from tests.parity import geowizard_reference as reference


def make_geowizard(version: int = 1, seed: int = 0) -> GeoWizardPipeline:
    """GeoWizard of a version with random weights of a seed, two steps at 64 px."""
    torch.manual_seed(seed)
    width = IMAGE_EMBEDDING if version == 1 else TEXT_PROMPT
    if version == 1:
        encoder = CLIPVisionModelWithProjection(CLIPVisionConfig(**reference.VISION))
        told = {"image_encoder": encoder.eval()}
    else:
        with tempfile.TemporaryDirectory() as folder:
            reference.write_tokenizer(Path(folder))
            tokenizer = CLIPTokenizer(f"{folder}/vocab.json", f"{folder}/merges.txt", model_max_length=77)
        told = {
            "text_encoder": CLIPTextModel(CLIPTextConfig(**reference.TEXT)).eval(),
            "tokenizer": tokenizer,
        }
    pipe = GeoWizardPipeline(
        unet=UNet2DConditionModel(**reference.UNET, projection_class_embeddings_input_dim=width).eval(),
        vae=AutoencoderKL(**reference.VAE).eval(),
        scheduler=DDIMScheduler(**reference.SCHEDULER),
        **told,
        default_denoising_steps=2,
        default_processing_resolution=64,
    )
    pipe.set_progress_bar_config(disable=True)
    return pipe
