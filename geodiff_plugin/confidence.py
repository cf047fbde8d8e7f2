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
# Log-odds, fitted on real and rendered pairs together: constant, by log-odds of the support, by log of the
# photometric error (0 where no right camera sees the pixel), for a pixel that none sees, by the relative
# spread of an ensemble.
_CONSTANT, _BY_SUPPORT, _BY_ERROR, _UNSEEN, _BY_SPREAD = 0.0, 0.6, -0.5, -0.5, -10.0
# Support and error beyond these tell nothing more.
_SUPPORT_EDGE, _ERROR_FLOOR = 1e-3, 0.01


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
    support = support.clamp(_SUPPORT_EDGE, 1.0 - _SUPPORT_EDGE)
    odds = _CONSTANT + _BY_SUPPORT * torch.logit(support)
    seen = _BY_ERROR * error.clamp_min(_ERROR_FLOOR).log()
    odds = odds + torch.where(visible, seen, torch.full_like(seen, _UNSEEN))
    if spread is not None:
        odds = odds + _BY_SPREAD * spread
    return torch.sigmoid(odds)
