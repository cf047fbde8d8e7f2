"""What a live pipeline must tell us to be guided; a prior never sees a camera.

Hop: pipeline -> ``DepthPrior`` -> decode, space, denoiser, grid.
Paper: S4 ("can be integrated with any DB-MDE framework following a similar schema").
"""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

__all__ = ["DepthPrior"]


class DepthPrior(Protocol):
    """Adapter of one kind of pipeline.

    Attributes:
        space: what the decoded map is affine in, key of ``metric.SPACES``.
    """

    space: str

    @staticmethod
    def matches(pipe: Any) -> bool:
        """Whether this adapter understands the pipeline."""

    def __init__(self, pipe: Any) -> None: ...

    def denoiser(self) -> torch.nn.Module:
        """The module that predicts from z_t, called once a step."""

    def split_input(self, model_input: Tensor) -> tuple[Tensor, Tensor]:
        """Condition and depth latent of the denoiser's input, in the order in which it concatenates them."""

    def decode(self, z0: Tensor) -> Tensor:
        """Unclipped relative map ``(B, 1, H, W)`` float32, about [0, 1], with the graph of the latents."""
