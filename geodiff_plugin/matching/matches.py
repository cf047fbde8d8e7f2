"""``Matches``: inverse depth and confidence per pixel.

Data flow: ``match_volume`` -> ``Matches`` of one image -> ``MatchTarget`` of a chunk of samples.
Paper: none; the evidence that a photometric loss does not have.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

__all__ = ["MatchTarget", "Matches"]


@dataclass(frozen=True)
class MatchTarget:
    """Matches between the views, or known points, on one grid of the left view.

    Attributes:
        inverse_depth: ``(B, 1, H, W)`` 1/m, ``(1, H, W)`` of one image; to be read where ``confidence > 0``.
        confidence: of the same shape, in [0, 1]; 0 where nothing is known.
        plane_step: ``(B,)`` 1/m, ``()`` of one image, the unit of the residual: between two planes of the
            sweep, or ``matching.points.UNIT`` of the points' median inverse depth.
    """

    inverse_depth: torch.Tensor
    confidence: torch.Tensor
    plane_step: torch.Tensor


@dataclass(frozen=True)
class Matches(MatchTarget):
    """What the views alone say about the depth of one image, with its grid.

    Attributes:
        inverse_depth: ``(1, H, W)`` float32, 1/m; defined everywhere, to be read where ``confidence > 0``.
        confidence: ``(1, H, W)`` float32 in [0, 1].
        plane_step: ``()`` float32, 1/m, the unit in which errors of matches are measured.
        K: ``(3, 3)`` pixels of this grid.
        size: ``(H, W)``.
    """

    K: torch.Tensor
    size: tuple[int, int]
    _above: dict[float, torch.Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)

    def above(self, confidence: float) -> torch.Tensor:
        """``(P,)`` flat indices of the pixels that are believed more than that.

        To count them is to wait for the device, so it is done once; ``prepare_evidence`` does it for all that
        the loop asks for.
        """
        if confidence not in self._above:
            self._above[confidence] = (self.confidence.flatten() > confidence).nonzero()[:, 0]
        return self._above[confidence]
