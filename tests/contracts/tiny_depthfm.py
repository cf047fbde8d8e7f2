"""A tiny random DepthFM, for the contract tests and as a folder to try."""

from __future__ import annotations

import torch
from diffusers import AutoencoderKL, FlowMatchEulerDiscreteScheduler, UNet2DConditionModel

from geodiff_plugin.cli.converters.depthfm import unet_config
from geodiff_plugin.priors.components import FixedPrompt
from geodiff_plugin.priors.depthfm import DepthFMPipeline
from tests.parity import depthfm_reference as reference

#: Under the groups of 32 that Stable Diffusion's has.
TINY_VAE = {"block_out_channels": (8,) * 4, "norm_num_groups": 4}


def make_depthfm(seed: int = 0, noising_step: int = 400) -> DepthFMPipeline:
    """Random weights of a seed, diffusers' own initialisation, where no layer is 0; at 64 px."""
    torch.manual_seed(seed)
    small = {"channel_mult": [1, 1], "num_res_blocks": 1, "attention_resolutions": [1]}
    pipe = DepthFMPipeline(
        UNet2DConditionModel(**unet_config(reference.HPARAMS | small)).eval(),
        AutoencoderKL(**reference.VAE | TINY_VAE).eval(),
        FlowMatchEulerDiscreteScheduler(),
        FixedPrompt(5, reference.HPARAMS["context_dim"]),
        noising_step=noising_step,
        default_denoising_steps=2,
        default_processing_resolution=64,
    )
    pipe.set_progress_bar_config(disable=True)
    return pipe
