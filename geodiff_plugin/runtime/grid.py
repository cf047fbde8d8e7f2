"""``ProcessingGrid``: the grid that a pipeline denoises on, with and without its padding.

Data flow: maps with or without padding -> maps without or with it.
Paper: none.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch.nn.functional as F
from torch import Tensor

__all__ = ["ProcessingGrid"]


@dataclass(frozen=True)
class ProcessingGrid:
    """The processing grid of one call.

    Attributes:
        content: ``(H, W)`` without padding.
        padding: rows at the bottom and columns at the right that were added to it.
    """

    content: tuple[int, int]
    padding: tuple[int, int]

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` with padding."""
        return self.content[0] + self.padding[0], self.content[1] + self.padding[1]

    def cropped(self, x: Tensor) -> Tensor:
        """``(B, C, H, W)`` without its padding."""
        height, width = self.content
        return x[:, :, :height, :width]

    def padded(self, x: Tensor) -> Tensor:
        """A map without padding, padded as the image was: its last row and column repeat."""
        bottom, right = self.padding
        return F.pad(x, (0, right, 0, bottom), mode="replicate")

    def filled(self, x: Tensor) -> Tensor:
        """A decoded map on the whole grid; beyond the last whole cell of the latent the last row repeats."""
        bottom, right = (
            content + added - side
            for content, added, side in zip(self.content, self.padding, x.shape[-2:], strict=True)
        )
        return F.pad(x, (0, right, 0, bottom), mode="replicate") if bottom or right else x
