"""Confidence: the probability that a pixel's depth is within 10 % of the truth.

Data flow: support by matches, photometric error, error of the prior, spread of an ensemble
    -> confidence in [0, 1].
Paper: none; it names wrong depth where views say nothing as a limit (Limitations).
"""

from __future__ import annotations

import torch
from torch import Tensor

from geodiff_plugin.formats.strips import row_strips

__all__ = ["BY_EVIDENCE", "RIGHT_WITHIN", "SIGNS", "depth_confidence", "depth_evidence"]

#: What confidence is the probability of: a relative error below this.
RIGHT_WITHIN = 0.1
#: Log-odds, by logistic regression on pairs with truth, every pair weighing the same
#: (``python -m geodiff_plugin.evaluation.calibrate`` refits them): constant, by log-odds of the support below
#: 0, from 0 to 3 and above 3, by photometric agreement, by the prior's strength where nothing supports a
#: depth, by the relative spread of an ensemble (set by hand: members that differ by 10 % halve the odds
#: twice).
BY_EVIDENCE = (0.548, 0.805, 0.527, 0.31, 0.223, 0.564, -15.0)
#: Which sign each of them may have; 0 for any. Agreement can only raise confidence, and a pixel that no right
#: camera sees has none, so not being in view can never raise it.
SIGNS = (0, 1, 1, 1, 1, 1, -1)
# Support and error beyond these tell nothing more; where the slope of the support changes.
_LEAST_SUPPORT, _MOST_SUPPORT, _LEAST_ERROR, _MOST_ERROR = 0.15, 0.999, 0.01, 0.1
# Errors of the prior in log depth: of one that is of no use, and of the best that matches can tell.
_USELESS, _BEST = 0.5, 0.01
_BEND = 3.0


def depth_evidence(
    support: Tensor, error: Tensor, visible: Tensor, spread: Tensor | None, prior_error: Tensor | None = None
) -> Tensor:
    """What the log-odds of ``depth_confidence`` are linear in.

    Args:
        support: as for ``depth_confidence``.
        error: likewise.
        visible: likewise.
        spread: likewise.
        prior_error: likewise.

    Returns:
        ``(B, 7, H, W)``: 1, log-odds of the support in three pieces, agreement, the prior's strength, spread.
        Agreement is how far the log of the photometric error lies below that of .1: from 0 (error .1 and
        more, or not seen) to 2.3 (error .01 and less). Strength is how far the log of the prior's error lies
        below that of .5, up to 3.9, times the share of the depth that nothing supports.
    """
    agreement = -(error.clamp(_LEAST_ERROR, _MOST_ERROR) / _MOST_ERROR).log()
    known = support.new_tensor(_USELESS) if prior_error is None else prior_error
    strength = -(known.clamp(_BEST, _USELESS) / _USELESS).log()
    supported = torch.logit(support.clamp(_LEAST_SUPPORT, _MOST_SUPPORT))
    evidence = [
        torch.ones_like(support),
        supported.clamp_max(0.0),
        supported.clamp(0.0, _BEND),
        (supported - _BEND).clamp_min(0.0),
        torch.where(visible, agreement, torch.zeros_like(agreement)),
        (1.0 - support) * strength,
        torch.zeros_like(support) if spread is None else spread,
    ]
    return torch.cat(evidence, dim=1)


def depth_confidence(
    support: Tensor, error: Tensor, visible: Tensor, spread: Tensor | None, prior_error: Tensor | None = None
) -> Tensor:
    """Probability that a depth is within 10 % of the truth.

    Args:
        support: ``(B, 1, H, W)`` in [0, 1], of ``algorithm.correction.refine_depth``.
        error: ``(B, 1, H, W)`` photometric error in [0, 1], in the left image's exposure.
        visible: ``(B, 1, H, W)`` bool, whether a right camera sees the pixel.
        spread: ``(B, 1, H, W)`` relative spread of the ensemble's members, >= 0, or ``None`` for one member.
        prior_error: ``(B, 1, 1, 1)`` of the prior in log depth, as ``algorithm.correction.prior_error``
            measures it; ``None`` where it is not known, which counts as useless.

    Returns:
        ``(B, 1, H, W)`` in (0, 1).
    """
    weights = support.new_tensor(BY_EVIDENCE).view(1, -1, 1, 1)
    confidence = torch.empty_like(support)
    for rows in row_strips(*support.shape[-2:]):  # evidence is seven times as large as what it says
        own, at, seen = (part[:, :, rows] for part in (support, error, visible))
        evidence = depth_evidence(own, at, seen, None if spread is None else spread[:, :, rows], prior_error)
        confidence[:, :, rows] = torch.sigmoid((weights * evidence).sum(1, keepdim=True))
    return confidence
