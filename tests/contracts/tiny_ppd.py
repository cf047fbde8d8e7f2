"""A tiny random Pixel-Perfect Depth, for the contract tests and as a folder to try."""

from __future__ import annotations

import torch
from diffusers import FlowMatchEulerDiscreteScheduler
from transformers import Dinov2Config, Dinov2Model

from geodiff_plugin.priors.pixel_dit import PixelDiT
from geodiff_plugin.priors.ppd import PPDPipeline


def make_ppd(seed: int = 0) -> PPDPipeline:
    """Random weights of a seed, at the area of 64 x 48; PyTorch's own initialisation, where nothing is 0."""
    torch.manual_seed(seed)
    size = {"hidden_size": 64, "num_hidden_layers": 1, "num_attention_heads": 1, "mlp_ratio": 1}
    pipe = PPDPipeline(
        PixelDiT(hidden_size=16, depth=2, num_heads=2, semantic_size=64, mlp_ratio=1.0).eval(),
        Dinov2Model(Dinov2Config(**size, image_size=28, patch_size=14)).eval(),
        FlowMatchEulerDiscreteScheduler(),
        default_denoising_steps=2,
        default_processing_resolution=64,
    )
    pipe.set_progress_bar_config(disable=True)
    return pipe
