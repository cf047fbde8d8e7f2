"""Distance of the estimate from depths that the user knows: lidar, structure from motion, a tape measure.

Data flow: ``Estimate`` -> ``(B,)``.
Paper: none; ``l1l2`` is the loss of Marigold-DC (Viola et al. 2024, Eq. 4).
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.terms.base import Estimate, cauchy, masked_mean
from geodiff_plugin.config import DEFAULT

__all__ = ["points"]

#: Residual, in units of 1 % of the median inverse depth, from which the pull of a point falls.
CAUCHY = 5.0
# Errors up to this share of the unit are float32's rounding and pull no more: a rule that gives every
# gradient the same length would follow their sign.
_MET = 1e-3


def points(estimate: Estimate, *, points_loss: str = DEFAULT.points_loss) -> Tensor:
    """Error at the known points.

    Args:
        estimate: needs ``depth_m`` and ``points``.
        points_loss: ``"robust"``: the Cauchy loss of the matches, in inverse depth, with 1 % of the points'
            median inverse depth as the unit; ``"l1l2"``: mean absolute plus mean squared error, metres.

    Returns:
        ``(B,)`` float; 0 where a sample has no point on the grid. Robust, far and near points weigh alike and
        a wrong point (seen through a window, from the other side of an edge) does not win against the rest;
        in metres the far ones decide.
    """
    target = estimate.points
    assert target is not None  # of Term.needs_points
    if points_loss == "robust":
        e = (1.0 / estimate.depth_m - target.inverse_depth) / target.plane_step.view(-1, 1, 1, 1)
        return masked_mean(cauchy(F.hardshrink(e, _MET), CAUCHY), target.confidence)
    known = target.confidence > 0
    e = (estimate.depth_m - 1.0 / target.inverse_depth.where(known, target.inverse_depth.new_ones(()))).abs()
    return masked_mean(e + e * e, known)
