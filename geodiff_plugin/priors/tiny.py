"""Tiny autoencoders for the decoding and encoding between the denoising steps."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import Any

import torch
from diffusers import AutoencoderTiny

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors.loading import reading

#: Values of ``decoder`` that are no folder and no hub id.
FULL, TINY = "full", "tiny"
#: Channels, pixels a cell and scaling factor of a latent -> hub id of the tiny autoencoder that knows it.
KNOWN: dict[tuple[Any, ...], str] = {
    (4, 8, 0.18215): "madebyollin/taesd",
    (4, 8, 0.13025): "madebyollin/taesdxl",
    (16, 8, 1.5305): "madebyollin/taesd3",
    (16, 8, 0.3611): "madebyollin/taef1",
}


def _latent_of(vae: Any) -> tuple[int | None, int | None]:
    """Channels of an autoencoder's latent, and pixels a cell; ``None`` where it does not say."""
    config = vae.config
    stages = config.get("decoder_block_out_channels") or config.get("block_out_channels")
    return config.get("latent_channels", config.get("z_dim")), 2 ** (len(stages) - 1) if stages else None


def tiny_autoencoder(pipe: Any, decoder: str) -> AutoencoderTiny | None:
    """The autoencoder for the loop, on the pipeline's device and of its dtype, frozen; ``None`` for its own.

    ``decoder`` is that of ``GuidanceConfig``; what cannot decode the pipeline's latent is an ``InputError``.
    """
    if decoder == FULL:
        return None
    vae: Any = getattr(pipe, "vae", None)
    channels, cell = (None, None) if vae is None else _latent_of(vae)
    cure, known = "", None if vae is None else KNOWN.get((channels, cell, vae.config.get("scaling_factor")))
    if cell is None:
        cure = "It has no latent of a single image: it works on pixels, or its autoencoder is one of videos."
    elif decoder == TINY and known is None:
        cure = f"None is published for its latent of {channels} channels; give a folder or a hub id of one."
    if cure:
        bad_value("decoder", f"{FULL!r} with {type(pipe).__name__}", repr(decoder), cure)
    decoder = known if decoder == TINY and known else decoder
    tiny = _loaded(decoder, pipe.dtype, str(pipe._execution_device))
    if _latent_of(tiny) != (channels, cell):
        got = "{} channels, {} px a cell, in {!r}".format(*_latent_of(tiny), decoder)
        bad_value("decoder", f"of the prior's latent ({channels} channels, {cell} px a cell)", got)
    return tiny


@lru_cache(maxsize=1)
def _loaded(name: str, dtype: torch.dtype, device: str) -> AutoencoderTiny:
    if not os.path.isdir(name) and (name.count("/") != 1 or name.startswith((".", "/", "~"))):
        bad_value("decoder", f"{FULL!r}, {TINY!r}, a folder that is there, or a hub id", repr(name))
    expected = "a folder of an AutoencoderTiny, or a hub id of one that is cached or can be reached"
    cure = "Fetch it once with `hf download ID` while online, or give a folder that save_pretrained wrote."
    with reading("decoder", expected, repr(name), cure):
        tiny = AutoencoderTiny.from_pretrained(name, dtype=dtype, use_safetensors=True)
    return tiny.to(device).eval().requires_grad_(False)
