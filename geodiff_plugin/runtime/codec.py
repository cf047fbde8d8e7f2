"""Relative maps to clean latents and back, on the pixels of the image, by the tiny or the full autoencoder.

Data flow: clean latent -> unclipped relative map without padding -> clean latent.
Paper: D of Algorithm 1; encoding a map goes beyond it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torch import Tensor

from geodiff_plugin.priors import DepthPrior
from geodiff_plugin.runtime.grid import ProcessingGrid

__all__ = ["MapCodec"]


class MapCodec:
    """Decodes and encodes relative maps during one guided call.

    Args:
        pipe: the live pipeline.
        prior: its adapter.
        grid: the processing grid; latents cover it with its padding, maps without.
        tiny: autoencoder for ``decode`` and ``encode``; ``None`` for the pipeline's.
    """

    def __init__(self, pipe: Any, prior: DepthPrior, grid: ProcessingGrid, tiny: Any | None) -> None:
        self._pipe, self._prior, self._grid, self._tiny = pipe, prior, grid, tiny

    @property
    def has_tiny(self) -> bool:
        """Whether ``decode`` differs from ``decode_result``."""
        return self._tiny is not None

    @contextmanager
    def _tiny_in_place(self) -> Iterator[None]:
        if self._tiny is None:
            yield
            return
        full = self._pipe.vae
        # ``object.__setattr__`` leaves the config of the pipeline as it is.
        object.__setattr__(self._pipe, "vae", self._tiny)
        try:
            yield
        finally:
            object.__setattr__(self._pipe, "vae", full)

    def decode(self, z0: Tensor) -> Tensor:
        """Unclipped relative map of a clean latent, ``(B, 1, H, W)`` float32, differentiable; in the loop."""
        with self._tiny_in_place():
            return self.decode_result(z0)

    def decode_result(self, z0: Tensor) -> Tensor:
        """The same by the pipeline's full autoencoder, for a map that is a result."""
        x = self._prior.decode(z0).float()  # of a prior in float64 as well: the views are in float32
        return self._grid.cropped(self._grid.filled(x))

    def encode(self, x: Tensor) -> Tensor:
        """Clean latent of a relative map ``(B, 1, H, W)``, padded as the image was; in the loop."""
        with self._tiny_in_place():
            return self._prior.encode(self._grid.padded(x))
