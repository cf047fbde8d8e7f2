"""Marigold v1-1 with random weights, to measure what it costs without a download.

Hop: a seed -> ``MarigoldDepthPipeline`` of 866 M (U-Net) and 84 M (VAE) parameters.
Paper: S5.1 (the prior of the experiments).
"""

from __future__ import annotations

import torch
from diffusers import AutoencoderKL, DDIMScheduler, MarigoldDepthPipeline, UNet2DConditionModel

from geodiff_plugin.development.full_sizes import SCHEDULER, UNET, VAE

__all__ = ["random_marigold"]

EMPTY_PROMPT_TOKENS = 2


def random_marigold(seed: int = 0, device: torch.device | str = "cpu") -> MarigoldDepthPipeline:
    """Marigold v1-1's configuration, float32, random weights.

    Args:
        seed: of the weights.
        device: where to.

    Returns:
        A pipeline without text encoder, whose embedding of the empty prompt is 0 already.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        unet, vae = UNet2DConditionModel(**UNET).eval(), AutoencoderKL(**VAE).eval()
    pipe = MarigoldDepthPipeline(
        unet=unet,
        vae=vae,
        scheduler=DDIMScheduler(**SCHEDULER),
        text_encoder=None,
        tokenizer=None,
        prediction_type="depth",
        default_denoising_steps=4,
        default_processing_resolution=768,
    ).to(device)
    pipe.empty_text_embedding = torch.zeros(
        1, EMPTY_PROMPT_TOKENS, UNET["cross_attention_dim"], device=device
    )
    return pipe
