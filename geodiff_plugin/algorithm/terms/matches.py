"""Distance of the estimate from the matches that the two views give by themselves.

Data flow: ``Estimate`` -> ``(B,)``.
Paper: none (it guides by Eq. 14 alone); what it buys is in docs/reference/results.md.
"""

from __future__ import annotations

from torch import Tensor

from geodiff_plugin.algorithm.terms.base import Estimate, cauchy, masked_mean

__all__ = ["matches"]

#: Residual, in planes, from which the pull of a match falls: a wrong match must not win against its
#: neighbours, but a surface that the prior put far away must still feel where it is.
CAUCHY = 5.0


def matches(estimate: Estimate) -> Tensor:
    """Robust error in inverse depth, in units of one plane of the sweep.

    Args:
        estimate: needs ``depth_m`` and ``matches``.

    Returns:
        ``(B,)`` float: confidence-weighted mean of ``c^2 / 2 log(1 + (e / c)^2)`` with ``e`` in
        planes and ``c = CAUCHY``; far and near pixels weigh alike because one plane is one step of shift in
        the right image. 0 where a sample has no match. The gradient falls as 1 / e and is never zero.
    """
    target = estimate.matches
    assert target is not None  # of Term.needs_matches
    e = (1.0 / estimate.depth_m - target.inverse_depth) / target.plane_step.view(-1, 1, 1, 1)
    return masked_mean(cauchy(e, CAUCHY), target.confidence)
