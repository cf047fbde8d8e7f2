"""How far each pixel of a metric map is to be believed, as a probability.

Hop: support by matches, photometric error, spread of an ensemble -> confidence in [0, 1].
Paper: none; it names wrong depth where views say nothing as a limit (Limitations).
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["RIGHT_WITHIN", "depth_confidence"]

#: What confidence is the probability of: a relative error below this.
RIGHT_WITHIN = 0.1
# Log-odds by logistic regression on real and rendered pairs together, every pair weighing the same (what one
# half of them gives holds on the other): constant, by log-odds of the support, by log of the photometric
# error, in whose place a constant stands where no right camera sees the pixel. By the relative spread of an
# ensemble: set by hand, members that differ by 10 % halve the odds twice.
_CONSTANT, _BY_SUPPORT, _BY_ERROR, _UNSEEN, _BY_SPREAD = -2.05, 0.87, -0.29, 3.08, -15.0
# Support and error beyond these tell nothing more.
_LEAST_SUPPORT, _MOST_SUPPORT, _LEAST_ERROR = 0.03, 0.999, 0.01


def depth_confidence(support: Tensor, error: Tensor, visible: Tensor, spread: Tensor | None) -> Tensor:
    """Probability that a depth is within 10 % of the truth.

    Args:
        support: ``(B, 1, H, W)`` in [0, 1], of ``refinement.refine_depth``.
        error: ``(B, 1, H, W)`` photometric error in [0, 1], in the left image's exposure.
        visible: ``(B, 1, H, W)`` bool, whether a right camera sees the pixel.
        spread: ``(B, 1, H, W)`` relative spread of the ensemble's members, >= 0, or ``None`` for one member.

    Returns:
        ``(B, 1, H, W)`` in (0, 1).
    """
    odds = _CONSTANT + _BY_SUPPORT * torch.logit(support.clamp(_LEAST_SUPPORT, _MOST_SUPPORT))
    seen = _BY_ERROR * error.clamp_min(_LEAST_ERROR).log()
    odds = odds + torch.where(visible, seen, torch.full_like(seen, _UNSEEN))
    if spread is not None:
        odds = odds + _BY_SPREAD * spread
    return torch.sigmoid(odds)
