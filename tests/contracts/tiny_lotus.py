"""Tiny random Lotuses, for the contract tests and as folders to try."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.lotus import LotusPipeline
from tests.parity import lotus_reference as reference


def make_lotus(kind: str = "g", space: str = "disparity", seed: int = 0) -> LotusPipeline:
    """Lotus ``"g"`` or ``"d"`` with random weights of a seed, at 64 px."""
    torch.manual_seed(seed)
    with tempfile.TemporaryDirectory() as folder:
        tokenizer = CLIPTokenizer(*reference.write_tokenizer(Path(folder)), model_max_length=77)
    pipe = LotusPipeline(
        unet=UNet2DConditionModel(**reference.UNET, in_channels={"g": 8, "d": 4}[kind]).eval(),
        vae=AutoencoderKL(**reference.VAE).eval(),
        text_encoder=CLIPTextModel(CLIPTextConfig(**reference.TEXT)).eval(),
        tokenizer=tokenizer,
        scheduler=DirectScheduler(timestep=999),
        prediction_type=space,
        default_processing_resolution=64,
    )
    pipe.set_progress_bar_config(disable=True)
    return pipe
