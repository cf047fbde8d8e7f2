"""Keep the guided latent near what the network said at this step.

Hop: ``Estimate`` -> ``(B,)``.
Paper: none; the proximal form of one diffusion posterior step (S3.2 takes a single gradient step instead).
"""

from __future__ import annotations

from torch import Tensor

from geodiff_plugin.terms.base import Estimate

__all__ = ["anchor"]


def anchor(estimate: Estimate) -> Tensor:
    """Mean squared distance of the clean latent from the network's own.

    Args:
        estimate: needs ``z0`` and ``z0_prior``.

    Returns:
        ``(B,)`` float. With several inner updates it is what keeps unmatched regions with the prior.
    """
    return (estimate.z0 - estimate.z0_prior).flatten(1).pow(2).mean(1)
