"""Marigold v1-1 with random weights: what it costs can be measured without fetching what it has learnt.

Hop: a seed -> ``MarigoldDepthPipeline`` of 866 M (U-Net) and 84 M (VAE) parameters.
Paper: S5.1 (the prior of the experiments).
"""

from __future__ import annotations

import torch
from diffusers import AutoencoderKL, DDIMScheduler, MarigoldDepthPipeline, UNet2DConditionModel

__all__ = ["random_marigold"]

#: The U-Net of Stable Diffusion 2 with 8 input channels: image latent beside depth latent.
UNET = {
    "sample_size": 96,
    "in_channels": 8,
    "out_channels": 4,
    "block_out_channels": (320, 640, 1280, 1280),
    "down_block_types": ("CrossAttnDownBlock2D",) * 3 + ("DownBlock2D",),
    "up_block_types": ("UpBlock2D",) + ("CrossAttnUpBlock2D",) * 3,
    "layers_per_block": 2,
    "cross_attention_dim": 1024,
    "attention_head_dim": (5, 10, 20, 20),
    "use_linear_projection": True,
}
VAE = {
    "sample_size": 768,
    "block_out_channels": (128, 256, 512, 512),
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "layers_per_block": 2,
    "latent_channels": 4,
    "scaling_factor": 0.18215,
}
SCHEDULER = {
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "prediction_type": "v_prediction",
    "rescale_betas_zero_snr": True,
    "timestep_spacing": "trailing",
    "set_alpha_to_one": False,
    "steps_offset": 1,
    "clip_sample": False,
}
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
