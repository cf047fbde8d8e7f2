"""The prior's estimate at one denoising step: clean latent and relative map, decoded and encoded.

Maps cover the image on the processing grid, latents also its padding.
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

from geodiff_plugin._checks import bad_value
from geodiff_plugin.algorithm.denoising import NoiseLevel, noise_from, output_from, z0_from
from geodiff_plugin.priors import DepthPrior
from geodiff_plugin.priors.loading import reading
from geodiff_plugin.runtime.hooks import DenoiserTap, put_channels

#: Value of the knob ``decoder`` for the pipeline's own autoencoder.
FULL = "full"
#: Value of the knob for the tiny autoencoder that is published for its latent.
TINY = "tiny"


class LatentGrid(NamedTuple):
    """The latent of an autoencoder; ``None`` where its config does not say."""

    channels: int | None
    cell_px: int | None  # pixels of the image per cell, along a side

    @classmethod
    def of(cls, vae: Any) -> LatentGrid:
        """Of an autoencoder of diffusers."""
        config = vae.config
        stages = config.get("decoder_block_out_channels") or config.get("block_out_channels")
        channels = config.get("latent_channels", config.get("z_dim"))
        return cls(channels, 2 ** (len(stages) - 1) if stages else None)

    def __str__(self) -> str:
        return f"{self.channels} channels, {self.cell_px} px a cell"


class TinyAutoencoder(NamedTuple):
    """A tiny autoencoder that is published, and the latent that it stands in for."""

    latent: LatentGrid
    scaling_factor: float
    hub_id: str


#: The tiny autoencoders of Stable Diffusion 1 and 2, XL and 3, and of FLUX.
PUBLISHED = (
    TinyAutoencoder(LatentGrid(4, 8), 0.18215, "madebyollin/taesd"),
    TinyAutoencoder(LatentGrid(4, 8), 0.13025, "madebyollin/taesdxl"),
    TinyAutoencoder(LatentGrid(16, 8), 1.5305, "madebyollin/taesd3"),
    TinyAutoencoder(LatentGrid(16, 8), 0.3611, "madebyollin/taef1"),
)


class StepInputs(NamedTuple):
    """What the scheduler's step is given, and what is added to its result; ``(B, C, h, w)`` each."""

    output: Tensor  # the network's
    z_t: Tensor  # the noisy latent
    move: Tensor | None = None


@dataclass(frozen=True)
class ProcessingGrid:
    """The grid that a pipeline denoises on: ``(H, W)`` of the image, and rows and columns of padding.

    ``preprocessed`` is what the image processor returned for the images of the call, if it ran already.
    """

    content: tuple[int, int]
    padding: tuple[int, int]
    preprocessed: Any = None

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` with padding."""
        return self.content[0] + self.padding[0], self.content[1] + self.padding[1]

    def cropped(self, x: Tensor) -> Tensor:
        """``(B, C, H, W)`` without its padding."""
        height, width = self.content
        return x[:, :, :height, :width]

    def padded(self, x: Tensor) -> Tensor:
        """A map, also one that covers whole cells only, extended to the grid by its last row and column."""
        bottom, right = (full - side for full, side in zip(self.size, x.shape[-2:], strict=True))
        return F.pad(x, (0, right, 0, bottom), mode="replicate") if bottom or right else x


class MapCodec:
    """A pipeline and its prior as a guided call uses them: it decodes and encodes relative maps on a grid.

    ``tiny`` stands in for the pipeline's VAE.
    """

    def __init__(self, pipe: Any, prior: DepthPrior, grid: ProcessingGrid, tiny: Any | None = None) -> None:
        self.pipe, self.prior, self.grid, self.tiny = pipe, prior, grid, tiny

    @contextmanager
    def _autoencoder(self, tiny: Any | None) -> Iterator[None]:
        original = getattr(self.pipe, "vae", None)
        if tiny is not None:  # past ``__setattr__``, which would rewrite the pipeline's config
            object.__setattr__(self.pipe, "vae", tiny)
        try:
            yield
        finally:
            if tiny is not None:
                object.__setattr__(self.pipe, "vae", original)

    def decode(self, z0: Tensor, final: bool = False) -> Tensor:
        """Unclipped relative map ``(B, 1, H, W)`` float32 of a clean latent's depth channels, differentiable.

        A ``final`` map is the result, so the pipeline's autoencoder decodes it and not the tiny one.
        """
        with self._autoencoder(None if final else self.tiny):
            x = self.prior.decode(z0).float()  # float32 even for a prior in float64, as the views are
        return self.grid.cropped(self.grid.padded(x))

    def encode(self, x: Tensor) -> Tensor:
        """Clean latent of a relative map ``(B, 1, H, W)``, padded as the image was."""
        with self._autoencoder(self.tiny):
            return self.prior.encode(self.grid.padded(x))


def tiny_autoencoder(pipe: Any, decoder: str) -> AutoencoderTiny | None:
    """The autoencoder that ``decoder`` of ``GuidanceConfig`` names, frozen; ``None`` for the VAE."""
    if decoder == FULL:
        return None
    vae: Any = getattr(pipe, "vae", None)
    latent = None if vae is None else LatentGrid.of(vae)
    if latent is None or latent.cell_px is None:
        cure = "It has no latent of a single image: it works on pixels, or its autoencoder is for videos."
        bad_value("decoder", f"{FULL!r} with {type(pipe).__name__}", repr(decoder), cure)
    if decoder == TINY:
        decoder = _published(pipe, latent, vae.config.get("scaling_factor"))
    tiny = _loaded(decoder, pipe.dtype, str(pipe._execution_device))
    own = LatentGrid.of(tiny)
    if own != latent:
        bad_value("decoder", f"of the prior's latent ({latent})", f"{own}, in {decoder!r}")
    return tiny


def _published(pipe: Any, latent: LatentGrid, scaling_factor: float | None) -> str:
    """The hub id of the tiny autoencoder that is published for the latent of a pipeline."""
    for each in PUBLISHED:
        if (each.latent, each.scaling_factor) == (latent, scaling_factor):
            return each.hub_id
    cure = (
        f"None is published for its latent of {latent.channels} channels; give a folder or a hub id of one."
    )
    bad_value("decoder", f"{FULL!r} with {type(pipe).__name__}", repr(TINY), cure)


@lru_cache(maxsize=1)
def _loaded(name: str, dtype: torch.dtype, device: str) -> AutoencoderTiny:
    if not os.path.isdir(name) and (name.count("/") != 1 or name.startswith((".", "/", "~"))):
        bad_value("decoder", f"{FULL!r}, {TINY!r}, a folder that is there, or a hub id", repr(name))
    expected = "a folder of an AutoencoderTiny, or a hub id of one that is cached or can be reached"
    cure = "Fetch it once with `hf download ID` while online, or give a folder that save_pretrained wrote."
    with reading("decoder", expected, repr(name), cure):
        tiny = AutoencoderTiny.from_pretrained(name, dtype=dtype, use_safetensors=True)
    return tiny.to(device).eval().requires_grad_(False)


class StepEstimate:
    """The ``algorithm.step.Estimate`` of one denoising step.

    Made from the network's ``output`` and ``z_t``, ``(B, C, h, w)`` each with all channels, in the pipeline's
    precision. Guidance moves z_t if there is a ``tap``, else the clean latent. ``latent_is_read`` is false if
    only the map is needed after this step.

    Attributes:
        latent: ``(B, c, h, w)`` float32, what guidance moves: z_t ("full") or z0_hat ("denoised").
        eps: ``(B, c, h, w)`` float32, the predicted noise.
        output: ``(B, c, h, w)`` float32, the network's depth channels.
    """

    def __init__(
        self,
        codec: MapCodec,
        level: NoiseLevel,
        output: Tensor,
        z_t: Tensor,
        tap: DenoiserTap | None,
        latent_is_read: bool,
    ) -> None:
        self._codec, self._level, self._output, self._z_t, self._tap = codec, level, output, z_t, tap
        self._wide = torch.promote_types(z_t.dtype, torch.float32)  # half precision ends here
        self.output, wide_z_t = (x[:, codec.prior.depth_channels].to(self._wide) for x in (output, z_t))
        self.eps = noise_from(self.output, wide_z_t, level)
        self.latent = z0_from(self.output, wide_z_t, level) if tap is None else tap.leaf
        self.encode, self.latent_is_read = codec.encode, latent_is_read

    def z0(self, latent: Tensor) -> Tensor:
        """The clean latent of ``latent``: Tweedie through the network ("full"), or the identity."""
        if self._tap is None:
            return latent
        output = self._tap.output_at(latent)[:, self._codec.prior.depth_channels].to(self._wide)
        return z0_from(output, latent, self._level)

    def decode(self, z0: Tensor, final: bool = False) -> Tensor:
        """As ``MapCodec.decode``; a ``final`` map is the result, unless the latent is read."""
        return self._codec.decode(z0, final and not self.latent_is_read)

    def step_inputs(self, move: Tensor, from_moved: bool) -> StepInputs:
        """Inputs of the scheduler's step after guidance changes the latent by ``move (B, c, h, w)``.

        With the full gradient and ``from_moved`` the step starts from the moved z_t; without ``from_moved``
        the move is added to the step's result.
        """
        moved, prior = (self.latent + move).detach(), self._codec.prior
        if self._tap is None:
            output, z_t = output_from(moved, self.eps, self._level)
            return StepInputs(self._put(self._output, output), self._put(self._z_t, z_t))
        if prior.max_steps == 1:
            # The step returns the clean latent: evaluate the network at the moved z_t.
            return StepInputs(self._tap.output_at(moved).detach(), self._put(self._z_t, moved))
        if from_moved:
            return StepInputs(self._output, self._put(self._z_t, moved))
        nothing = torch.zeros_like(self._z_t, dtype=self._wide)
        added = put_channels(nothing, prior.depth_channels, move)
        return StepInputs(self._output, self._z_t, added)

    def _put(self, whole: Tensor, part: Tensor) -> Tensor:
        return put_channels(whole, self._codec.prior.depth_channels, part.to(whole.dtype))
