"""Decodes and encodes the prior's estimate at one denoising step: clean latent and relative map.

Maps cover the image on the processing grid. Latents also cover its padding.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from diffusers import AutoencoderTiny
from torch import Tensor

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.algorithm.denoising import NoiseLevel, noise_from, output_from, z0_from
from geodiff_plugin.priors import DepthPrior
from geodiff_plugin.priors.loading import reading
from geodiff_plugin.runtime.hooks import DenoiserHook, put_channels

#: Value of the parameter ``decoder`` for the pipeline's own autoencoder.
FULL = "full"
#: Value of ``decoder`` for the tiny autoencoder published for the pipeline's latent space.
TINY = "tiny"


class LatentGrid(NamedTuple):
    """Size of an autoencoder's latent; ``None`` where its config does not define it."""

    channels: int | None
    cell_px: int | None  # image pixels per latent cell, along a side

    @classmethod
    def of(cls, vae: Any) -> LatentGrid:
        """Read the latent grid from the config of a diffusers autoencoder."""
        config = vae.config
        stages = config.get("decoder_block_out_channels") or config.get("block_out_channels")
        channels = config.get("latent_channels", config.get("z_dim"))
        return cls(channels, 2 ** (len(stages) - 1) if stages else None)

    def __str__(self) -> str:
        return f"{self.channels} channels, {self.cell_px} px a cell"


class TinyAutoencoder(NamedTuple):
    """A published tiny autoencoder and the latent space that it decodes."""

    latent: LatentGrid
    scaling_factor: float
    hub_id: str


#: Published tiny autoencoders for Stable Diffusion 1, 2, XL and 3, and for FLUX.
PUBLISHED = (
    TinyAutoencoder(LatentGrid(4, 8), 0.18215, "madebyollin/taesd"),
    TinyAutoencoder(LatentGrid(4, 8), 0.13025, "madebyollin/taesdxl"),
    TinyAutoencoder(LatentGrid(16, 8), 1.5305, "madebyollin/taesd3"),
    TinyAutoencoder(LatentGrid(16, 8), 0.3611, "madebyollin/taef1"),
)


class StepInputs(NamedTuple):
    """Inputs of the scheduler's step and the offset added to its result; ``(B, C, h, w)`` each."""

    output: Tensor  # output of the network
    z_t: Tensor  # noisy latent
    offset: Tensor | None = None


@dataclass(frozen=True)
class ProcessingGrid:
    """The grid that a pipeline denoises on: image size ``(H, W)``, and rows and columns of padding.

    ``preprocessed`` is the image processor's output for the images of the call, if it already ran.
    """

    content: tuple[int, int]
    padding: tuple[int, int]
    preprocessed: Any = None

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` with padding."""
        return self.content[0] + self.padding[0], self.content[1] + self.padding[1]

    def cropped(self, x: Tensor) -> Tensor:
        """Crop the padding from ``x (B, C, H, W)``."""
        height, width = self.content
        return x[:, :, :height, :width]

    def padded(self, x: Tensor) -> Tensor:
        """Pad ``x`` to the full grid by replicating its last row and column.

        ``x`` may be a map that covers whole latent cells only.
        """
        bottom, right = (full - side for full, side in zip(self.size, x.shape[-2:], strict=True))
        return F.pad(x, (0, right, 0, bottom), mode="replicate") if bottom or right else x


class MapCodec:
    """Decodes and encodes relative maps with a pipeline and its prior on a processing grid.

    ``tiny`` replaces the pipeline's VAE if given.
    """

    def __init__(self, pipe: Any, prior: DepthPrior, grid: ProcessingGrid, tiny: Any | None = None) -> None:
        self.pipe, self.prior, self.grid, self.tiny = pipe, prior, grid, tiny

    @contextmanager
    def _autoencoder(self, tiny: Any | None) -> Iterator[None]:
        original = getattr(self.pipe, "vae", None)
        if tiny is not None:  # bypass ``__setattr__``, which would rewrite the pipeline's config
            object.__setattr__(self.pipe, "vae", tiny)
        try:
            yield
        finally:
            if tiny is not None:
                object.__setattr__(self.pipe, "vae", original)

    def decode(self, z0: Tensor, final: bool = False) -> Tensor:
        """Decode the depth channels of a clean latent to an unclipped relative map ``(B, 1, H, W)`` float32.

        Differentiable. A ``final`` map is part of the result, so the pipeline's own autoencoder decodes it.
        """
        with self._autoencoder(None if final else self.tiny):
            x = self.prior.decode(z0).float()  # float32 even for a float64 prior, like the views
        return self.grid.cropped(self.grid.padded(x))

    def encode(self, x: Tensor) -> Tensor:
        """Encode a relative map ``(B, 1, H, W)`` to a clean latent, padded like the image."""
        with self._autoencoder(self.tiny):
            return self.prior.encode(self.grid.padded(x))


def tiny_autoencoder(pipe: Any, decoder: str) -> AutoencoderTiny | None:
    """Load the frozen autoencoder named by ``GuidanceConfig.decoder``; ``None`` for the VAE."""
    if decoder == FULL:
        return None
    vae: Any = getattr(pipe, "vae", None)
    latent = None if vae is None else LatentGrid.of(vae)
    if latent is None or latent.cell_px is None:
        hint = "This prior has no single-image latent: it works on pixels or uses a video autoencoder."
        bad_value("decoder", f"{FULL!r} with {type(pipe).__name__}", repr(decoder), hint)
    if decoder == TINY:
        decoder = _published(pipe, latent, vae.config.get("scaling_factor"))
    tiny = _loaded(decoder, pipe.dtype, str(pipe._execution_device))
    own = LatentGrid.of(tiny)
    if own != latent:
        bad_value("decoder", f"an autoencoder with the prior's latent ({latent})", f"{own}, in {decoder!r}")
    return tiny


def _published(pipe: Any, latent: LatentGrid, scaling_factor: float | None) -> str:
    """Return the hub id of the tiny autoencoder published for a pipeline's latent space."""
    for each in PUBLISHED:
        if (each.latent, each.scaling_factor) == (latent, scaling_factor):
            return each.hub_id
    hint = (
        f"No tiny autoencoder is published for {latent.channels} latent channels; pass a folder or a "
        "Hugging Face model ID."
    )
    bad_value("decoder", f"{FULL!r} with {type(pipe).__name__}", repr(TINY), hint)


@lru_cache(maxsize=1)
def _loaded(name: str, dtype: torch.dtype, device: str) -> AutoencoderTiny:
    if not os.path.isdir(name) and (name.count("/") != 1 or name.startswith((".", "/", "~"))):
        bad_value(
            "decoder", f"{FULL!r}, {TINY!r}, an existing folder, or a Hugging Face model ID", repr(name)
        )
    expected = "a folder with an AutoencoderTiny, or a Hugging Face model ID that is cached or reachable"
    hint = "Download it once with `hf download ID`, or pass a folder written by save_pretrained."
    with reading("decoder", expected, repr(name), hint):
        tiny = AutoencoderTiny.from_pretrained(name, dtype=dtype, use_safetensors=True)
    return tiny.to(device).eval().requires_grad_(False)


class StepEstimate:
    """Estimate of one denoising step; implements ``algorithm.step.Estimate``.

    Built from the network's ``output`` and ``z_t``, ``(B, C, h, w)`` each with all channels, in the
    pipeline's precision. With a ``hook`` guidance updates z_t, otherwise the clean latent. ``latent_is_read``
    is false if only the map is needed after this step.

    Attributes:
        latent: ``(B, c, h, w)`` float32, the tensor that guidance updates: z_t ("full") or z0_hat
            ("denoised").
        eps: ``(B, c, h, w)`` float32, the predicted noise.
        output: ``(B, c, h, w)`` float32, the network's depth channels.
    """

    def __init__(
        self,
        codec: MapCodec,
        level: NoiseLevel,
        output: Tensor,
        z_t: Tensor,
        hook: DenoiserHook | None,
        latent_is_read: bool,
    ) -> None:
        self._codec, self._level, self._output, self._z_t, self._hook = codec, level, output, z_t, hook
        self._wide = torch.promote_types(z_t.dtype, torch.float32)  # upcast half precision
        self.output, wide_z_t = (x[:, codec.prior.depth_channels].to(self._wide) for x in (output, z_t))
        self.eps = noise_from(self.output, wide_z_t, level)
        self.latent = z0_from(self.output, wide_z_t, level) if hook is None else hook.leaf
        self.encode = codec.encode
        self.latent_is_read = latent_is_read

    def z0(self, latent: Tensor) -> Tensor:
        """Compute the clean latent of ``latent``: Tweedie through the network ("full"), or the identity."""
        if self._hook is None:
            return latent
        output = self._hook.output_at(latent)[:, self._codec.prior.depth_channels].to(self._wide)
        return z0_from(output, latent, self._level)

    def decode(self, z0: Tensor, final: bool = False) -> Tensor:
        """Decode as in ``MapCodec.decode``; a ``final`` map is the result unless the latent is read."""
        return self._codec.decode(z0, final and not self.latent_is_read)

    def step_inputs(self, offset: Tensor, from_updated: bool) -> StepInputs:
        """Compute the scheduler's inputs after guidance adds ``offset (B, c, h, w)`` to the latent.

        With the full gradient and ``from_updated`` the step starts from the updated z_t. Without
        ``from_updated`` the offset is added to the step's result.
        """
        updated = (self.latent + offset).detach()
        prior = self._codec.prior
        if self._hook is None:
            output, z_t = output_from(updated, self.eps, self._level)
            return StepInputs(self._put(self._output, output), self._put(self._z_t, z_t))
        if prior.max_steps == 1:
            # The step returns the clean latent, so evaluate the network at the updated z_t.
            return StepInputs(self._hook.output_at(updated).detach(), self._put(self._z_t, updated))
        if from_updated:
            return StepInputs(self._output, self._put(self._z_t, updated))
        nothing = torch.zeros_like(self._z_t, dtype=self._wide)
        added = put_channels(nothing, prior.depth_channels, offset)
        return StepInputs(self._output, self._z_t, added)

    def _put(self, whole: Tensor, part: Tensor) -> Tensor:
        return put_channels(whole, self._codec.prior.depth_channels, part.to(whole.dtype))
