"""Keep scale and shift near where they should be.

Data flow: ``Estimate`` -> ``(B,)``.
Paper: S4.2 (Regularization), Eq. 17 (no label).
"""

from __future__ import annotations

from torch import Tensor

from geodiff_plugin.algorithm.terms.base import Estimate
from geodiff_plugin.config import DEFAULT

__all__ = ["prior_pull"]


def prior_pull(estimate: Estimate, *, pull_to: str = DEFAULT.pull_to) -> Tensor:
    """Squared distance of the raw scale and shift from their anchor.

    Args:
        estimate: needs ``affine`` and ``affine_start``.
        pull_to: ``"zero"`` is the paper's; ``"start"`` is the search's result.

    Returns:
        ``(B,)`` float, ``||s_hat - s*||^2 + ||t_hat - t*||^2``, to be weighted by gamma.

    Source: Eq. 17. Deviation: ``"start"``, because the paper's pull of the raw values towards 0 makes
    softplus(0) = 0.693 for both, that is far / near = 2 for every scene.
    """
    s, t = estimate.affine.s_hat, estimate.affine.t_hat
    if pull_to == "start":
        s = s - estimate.affine_start.s_hat
        t = t - estimate.affine_start.t_hat
    return s * s + t * t
