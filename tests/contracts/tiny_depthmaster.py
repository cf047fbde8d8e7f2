"""A tiny random DepthMaster, for the contract tests and as a folder to try."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from diffusers import AutoencoderKL
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

from geodiff_plugin.priors.depthmaster import DepthMasterPipeline, FourierUNet
from tests.parity import depthmaster_reference as reference
from tests.parity.lotus_reference import TEXT, write_tokenizer

#: Under the groups of 32 that Stable Diffusion's has.
TINY_VAE = {"block_out_channels": (8,) * 4, "norm_num_groups": 4}


def make_depthmaster(seed: int = 0) -> DepthMasterPipeline:
    """Random weights of a seed, at 64 px."""
    torch.manual_seed(seed)
    with tempfile.TemporaryDirectory() as folder:
        tokenizer = CLIPTokenizer(*write_tokenizer(Path(folder)), model_max_length=77)
    small = {"block_out_channels": (32, 32), "cross_attention_dim": TEXT["hidden_size"]}
    pipe = DepthMasterPipeline(
        FourierUNet(**reference.UNET | small).eval(),
        AutoencoderKL(**reference.VAE | TINY_VAE).eval(),
        CLIPTextModel(CLIPTextConfig(**TEXT)).eval(),
        tokenizer,
        default_processing_resolution=64,
    )
    pipe.set_progress_bar_config(disable=True)
    return pipe
