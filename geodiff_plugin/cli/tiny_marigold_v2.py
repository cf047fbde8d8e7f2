"""A tiny Marigold V2 with random weights, for examples and benchmarks without a download.

Data flow: a seed -> ``MarigoldV2Pipeline`` that is tiny.
Paper: none.
"""

from __future__ import annotations

import torch
from diffusers import AutoencoderKLQwenImage, FlowMatchEulerDiscreteScheduler, QwenImageTransformer2DModel

from geodiff_plugin.priors.marigold_v2 import MarigoldV2Pipeline
from geodiff_plugin.priors.pipelines.prompts import FixedPrompt

__all__ = ["tiny_marigold_v2"]

#: A transformer and an autoencoder of Qwen-Image's classes, some 280 000 weights together.
TINY_TRANSFORMER = {
    "num_layers": 2,
    "attention_head_dim": 16,
    "num_attention_heads": 2,
    "joint_attention_dim": 16,
    "axes_dims_rope": (4, 6, 6),
}
TINY_VAE = {"base_dim": 4, "dim_mult": [1, 2, 4, 4], "num_res_blocks": 1}


def tiny_marigold_v2(seed: int = 0, space: str = "log") -> MarigoldV2Pipeline:
    """A Marigold V2 that has learnt nothing and runs in a blink, float32, at 64 px.

    Args:
        seed: of the weights.
        space: what its map is affine in.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        transformer = QwenImageTransformer2DModel(**TINY_TRANSFORMER).eval()
        vae, prompt = AutoencoderKLQwenImage(**TINY_VAE).eval(), FixedPrompt(5, 16)
        torch.nn.init.normal_(prompt.embedding)
        torch.nn.init.normal_(vae.decoder.conv_out.weight, std=0.3)  # as initialised the map is nearly flat
    pipe = MarigoldV2Pipeline(
        transformer,
        vae,
        FlowMatchEulerDiscreteScheduler(),
        prompt,
        prediction_type=space,
        default_processing_resolution=64,
    )
    pipe.set_progress_bar_config(disable=True)
    return pipe
