"""``Matches``: inverse depth and confidence per pixel, of matches between the views or of known points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import torch

__all__ = ["Matches"]


@dataclass(frozen=True)
class Matches:
    """Matches between the views, or known points, on one grid of the left view; of one image or of a chunk.

    Attributes:
        inverse_depth: ``(1, H, W)`` float32, 1/m, of one image, or ``(B, 1, H, W)``; defined everywhere, to
        be
            read where ``confidence > 0``.
        confidence: of the same shape, in [0, 1]; 0 where nothing is matched or known.
        plane_step: ``()`` or ``(B,)`` 1/m, the unit in which errors are measured: between two planes of the
            sweep, or ``matching.points.UNIT`` of the points' median inverse depth.
    """

    inverse_depth: torch.Tensor
    confidence: torch.Tensor
    plane_step: torch.Tensor
    _above: dict[float, torch.Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)

    @classmethod
    def stack(cls, images: Sequence[Self | None]) -> Self | None:
        """Matches of several images as a chunk, all on grids of one size; ``None`` if some image has none."""
        given = [matches for matches in images if matches is not None]
        if len(given) < len(images):
            return None
        names = ("inverse_depth", "confidence", "plane_step")
        return cls(*(torch.stack([getattr(matches, name) for matches in given]) for name in names))

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the grid."""
        return self.confidence.shape[-2], self.confidence.shape[-1]

    def above(self, confidence: float) -> torch.Tensor:
        """``(P,)`` flat indices of the pixels of one image with more confidence than that.

        Counting them waits for the device, so it is done once; ``prepare_evidence`` does it for every
        threshold that the loop asks for.
        """
        if confidence not in self._above:
            self._above[confidence] = (self.confidence.flatten() > confidence).nonzero()[:, 0]
        return self._above[confidence]
