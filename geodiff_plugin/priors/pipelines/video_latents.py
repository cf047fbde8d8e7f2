"""One frame through a video autoencoder, and its latents as a transformer's tokens.

Data flow: picture ``(B, 3, H, W)`` <-> normalised latents ``(B, 16, h, w)`` <-> tokens ``(B, hw / 4, 64)``.
Paper: none (Qwen-Image's autoencoder and patches, arXiv 2508.02324).

The autoencoder works on ``(B, C, T, H, W)``; here T is 1 and stays inside this file.
"""

from __future__ import annotations

import torch
from diffusers import AutoencoderKLQwenImage
from diffusers.utils.accelerate_utils import apply_forward_hook
from torch import Tensor

__all__ = ["frame_of", "latents_of", "pack", "unpack"]


def _statistics(vae: AutoencoderKLQwenImage, like: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the latents by channel, ``(1, C, 1, 1)`` each."""
    numbers = vae.config.latents_mean, vae.config.latents_std
    mean, deviation = (like.new_tensor(values).view(1, -1, 1, 1) for values in numbers)
    return mean, deviation


def latents_of(
    vae: AutoencoderKLQwenImage,
    picture: Tensor,
    generator: torch.Generator | list[torch.Generator] | None = None,
    sample: bool = False,
) -> Tensor:
    """Normalised latents of pictures.

    Args:
        vae: the autoencoder.
        picture: ``(B, 3, H, W)`` in [-1, 1], sides multiples of 8.
        generator: of the sample.
        sample: draw from the posterior; otherwise its mode.

    Returns:
        ``(B, C, H / 8, W / 8)`` float32.
    """
    posterior = vae.encode(picture.to(vae.dtype)[:, :, None]).latent_dist
    latents = posterior.sample(generator) if sample else posterior.mode()
    latents = latents[:, :, 0].to(torch.promote_types(latents.dtype, torch.float32))
    mean, deviation = _statistics(vae, latents)
    return (latents - mean) / deviation


def frame_of(vae: AutoencoderKLQwenImage, latents: Tensor) -> Tensor:
    """Decode normalised latents without the clamp at the end of ``vae.decode``.

    That clamp has no gradient beyond [-1, 1], which is where near and far lie. Slicing and tiling are kept.

    Args:
        vae: the autoencoder.
        latents: ``(B, C, h, w)``.

    Returns:
        ``(B, 3, 8 h, 8 w)`` float32 or wider, about [-1, 1], with the graph of ``latents``.
    """
    wide = latents.to(torch.promote_types(latents.dtype, torch.float32))
    mean, deviation = _statistics(vae, wide)
    z = (wide * deviation + mean).to(vae.dtype)[:, :, None]
    frames = torch.cat([_decode(vae, part) for part in (z.split(1) if vae.use_slicing else (z,))])
    return frames[:, :, 0].to(wide.dtype)


@apply_forward_hook
def _decode(vae: AutoencoderKLQwenImage, z: Tensor) -> Tensor:
    """``vae._decode`` of one frame, for which nothing is cached; the hook brings an offloaded one back."""
    tile = vae.tile_sample_min_height // 8, vae.tile_sample_min_width // 8
    if vae.use_tiling and (z.shape[-2] > tile[0] or z.shape[-1] > tile[1]):
        return vae.tiled_decode(z, return_dict=False)[0]
    return vae.decoder(vae.post_quant_conv(z))


def pack(latents: Tensor) -> Tensor:
    """Squares of 2 x 2 latents as tokens: ``(B, C, h, w)``, h and w even, to ``(B, hw / 4, 4 C)``."""
    squares = latents.unflatten(3, (-1, 2)).unflatten(2, (-1, 2))  # (B, C, h / 2, 2, w / 2, 2)
    return squares.permute(0, 2, 4, 1, 3, 5).flatten(3).flatten(1, 2)


def unpack(tokens: Tensor, height: int, width: int) -> Tensor:
    """Latents ``(B, C, height, width)`` of tokens ``(B, hw / 4, 4 C)``; inverse of ``pack``."""
    squares = tokens.unflatten(1, (height // 2, width // 2)).unflatten(3, (-1, 2, 2))
    return squares.permute(0, 3, 1, 4, 2, 5).flatten(4, 5).flatten(2, 3)
