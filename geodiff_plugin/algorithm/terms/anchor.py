"""Keep the guided latent near what the network said at this step.

Data flow: ``Estimate`` -> ``(B,)``.
Paper: none; the proximal form of one diffusion posterior step (S3.2 takes a single gradient step instead).
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.terms.base import Estimate

__all__ = ["anchor"]

#: Share of the pull that remains where every pixel is matched.
FLOOR = 0.05


def anchor(estimate: Estimate) -> Tensor:
    """Mean squared distance of the clean latent from the network's own, where the views say nothing.

    Args:
        estimate: needs ``z0`` and ``z0_prior``; with ``matches`` the pull falls as their confidence rises.

    Returns:
        ``(B,)`` float. With several inner updates it is what keeps unmatched regions with the prior,
        and leaves matched ones to the matches.
    """
    square = (estimate.z0 - estimate.z0_prior).pow(2).mean(1, keepdim=True)  # (B, 1, h, w)
    if estimate.matches is not None:
        known = F.interpolate(estimate.matches.confidence, square.shape[-2:], mode="area")
        square = square * (1.0 - known).clamp_min(FLOOR)
    return square.flatten(1).mean(1)
