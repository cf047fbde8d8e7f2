"""What a guidance term sees: one estimate and everything it can be compared with.

Data flow: objective -> ``Estimate`` -> one number per sample.
Paper: S4.2, Eq. 14 (eq:geo-loss) and Eq. 17 (no label).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from geodiff_plugin.matching.matches import MatchTarget
from geodiff_plugin.scale.space import AffineState

__all__ = ["Estimate", "MatchTarget", "cauchy", "masked_mean"]


@dataclass(frozen=True)
class Estimate:
    """One metric estimate on the loss grid, and what the terms compare it with.

    Attributes:
        depth_m: ``(B, 1, H, W)`` metres, carries the graph.
        left_01: ``(B, 3, H, W)`` the left image.
        warped_01: ``(B, V, 3, H, W)`` every right image seen from the left through ``depth_m``.
        visible: ``(B, V, 1, H, W)`` bool: in view of that camera, and nothing found to hide it.
        affine: current scale, shift, g_s; carries the graph.
        affine_start: where the search put them; no graph.
        z0: ``(B, C, h, w)`` current clean latent, carries the graph.
        z0_prior: ``(B, C, h, w)`` the network's own clean latent of this step; no graph.
        matches: the views' own evidence, or ``None``.
        points: depths that the user knows, in the same form, or ``None``.
    """

    depth_m: Tensor
    left_01: Tensor
    warped_01: Tensor
    visible: Tensor
    affine: AffineState
    affine_start: AffineState
    z0: Tensor
    z0_prior: Tensor
    matches: MatchTarget | None
    points: MatchTarget | None = None


def cauchy(e: Tensor, width: float) -> Tensor:
    """``width^2 / 2 log(1 + (e / width)^2)``: ``e^2 / 2`` near 0, its gradient falls as 1 / e beyond."""
    return 0.5 * width**2 * torch.log1p((e / width) ** 2)


def masked_mean(value: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean per sample.

    Args:
        value: ``(B, C, H, W)``.
        weight: ``(B, 1, H, W)`` bool or float >= 0.

    Returns:
        ``(B,)``; 0 (and no gradient) for a sample whose weights are all zero. Whoever must not go on
        without a valid pixel checks the visible fraction first (``objective.visible_fraction``).
    """
    weight = weight.to(value.dtype)
    total = (value.mean(1, keepdim=True) * weight).flatten(1).sum(1)
    return total / weight.flatten(1).sum(1).clamp_min(1e-6)
