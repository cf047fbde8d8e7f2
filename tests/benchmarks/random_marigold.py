"""Marigold v1-1 with random weights, to measure its cost without a download.

Data flow: a seed -> ``MarigoldDepthPipeline`` of 866 M (U-Net) and 84 M (VAE) parameters, or a narrower one.
Paper: S5.1 (the prior of the experiments).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from diffusers import (
    AutoencoderKL,
    AutoencoderTiny,
    DDIMScheduler,
    MarigoldDepthPipeline,
    UNet2DConditionModel,
)

from tests.benchmarks.full_sizes import SCHEDULER, UNET, VAE

__all__ = ["EMPTY_PROMPT_TOKENS", "drawn_on", "narrowed", "random_marigold", "random_tiny"]

EMPTY_PROMPT_TOKENS = 2
#: Channels come in groups of so many.
GROUP = 32
#: Of TAESD's convolutions, encoder and decoder.
TINY_WIDTH = 64


def narrowed(config: dict[str, Any], width: float) -> dict[str, Any]:
    """A network's configuration with its channels times ``width``, in whole groups; 1: as published."""
    if width == 1.0:
        return config
    channels = tuple(max(1, round(width * c / GROUP)) * GROUP for c in config["block_out_channels"])
    changed: dict[str, Any] = {"block_out_channels": channels}
    if "attention_head_dim" in config:  # diffusers' name for the number of heads
        changed["attention_head_dim"] = tuple(max(1, c // 64) for c in channels)
    return config | changed


@contextmanager
def drawn_on(device: torch.device | str, seed: int = 0) -> Iterator[None]:
    """Draw the weights of networks on their device, which a GPU does in a moment; random states stay."""
    device = torch.device(device)
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []), device:
        torch.manual_seed(seed)
        yield


def random_marigold(
    seed: int = 0, device: torch.device | str = "cpu", width: float = 1.0, dtype: torch.dtype = torch.float32
) -> MarigoldDepthPipeline:
    """Marigold v1-1's configuration, random weights.

    Args:
        seed: of the weights.
        device: where to.
        width: share of the published channels.
        dtype: of the networks.

    Returns:
        A pipeline without text encoder, whose embedding of the empty prompt is 0 already.
    """
    with drawn_on(device, seed):
        unet = UNet2DConditionModel(**narrowed(UNET, width)).eval()
        vae = AutoencoderKL(**narrowed(VAE, width)).eval()
    pipe = MarigoldDepthPipeline(
        unet=unet,
        vae=vae,
        scheduler=DDIMScheduler(**SCHEDULER),
        text_encoder=None,
        tokenizer=None,
        prediction_type="depth",
        default_denoising_steps=4,
        default_processing_resolution=768,
    ).to(device, dtype)
    pipe.empty_text_embedding = torch.zeros(
        1, EMPTY_PROMPT_TOKENS, UNET["cross_attention_dim"], device=device, dtype=dtype
    )
    return pipe


def random_tiny(seed: int = 0, width: float = 1.0) -> AutoencoderTiny:
    """A tiny autoencoder of TAESD's size, random weights; ``width`` is the fraction of its channels."""
    channels = (max(8, round(width * TINY_WIDTH)),) * 4
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return AutoencoderTiny(
            encoder_block_out_channels=channels, decoder_block_out_channels=channels
        ).eval()
