"""Distance of the estimate from the matches that the two views give by themselves.

Hop: ``Estimate`` -> ``(B,)``.
Paper: none (it guides by Eq. 14 alone); what it buys is in docs/results.md.
"""

from __future__ import annotations

import torch
from torch import Tensor

from geodiff_plugin.terms.base import Estimate, masked_mean

__all__ = ["matches"]

#: Residuals beyond this many planes count alike: a wrong match must not pull for ever.
CLAMP_PLANES = 20.0


def matches(estimate: Estimate) -> Tensor:
    """Robust error in inverse depth, in units of one plane of the sweep.

    Args:
        estimate: needs ``depth_m`` and ``matches``.

    Returns:
        ``(B,)`` float: confidence-weighted mean of ``sqrt(1 + e^2) - 1`` with ``e`` clamped at 20
        planes; far and near pixels weigh alike because one plane is one step of shift in the right
        image. 0 where a sample has no match. No gradient from residuals beyond the clamp.
    """
    target = estimate.matches
    e = (1.0 / estimate.depth_m - target.inverse_depth) / target.plane_step.view(-1, 1, 1, 1)
    e = e.clamp(-CLAMP_PLANES, CLAMP_PLANES)
    return masked_mean(torch.sqrt(1.0 + e * e) - 1.0, target.confidence)
