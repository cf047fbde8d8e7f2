"""Depth channels of a latent that holds other maps as well.

Data flow: whole latent, channels, new part -> whole latent.
Paper: none.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["put_channels"]


def put_channels(whole: Tensor, channels: slice, part: Tensor) -> Tensor:
    """``whole (B, C, h, w)`` with ``part (B, c, h, w)`` at ``channels``; differentiable in both.

    A slice of all channels gives back ``part`` itself.
    """
    start, stop, _ = channels.indices(whole.shape[1])
    if stop - start == whole.shape[1]:
        return part
    return torch.cat([whole[:, :start], part, whole[:, stop:]], dim=1)
