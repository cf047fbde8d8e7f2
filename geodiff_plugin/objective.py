"""From a relative map to one loss per sample.

Hop: ``x (B, 1, h, w)`` -> metric depth on the loss grid -> warp -> terms -> ``loss (B,)``.
Paper: Eq. 14 (eq:geo-loss) with Eq. 16 and 17.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.geometry.projection import PlaneRays
from geodiff_plugin.geometry.warping import warp_right_to_left
from geodiff_plugin.metric import AffineState, MetricMap
from geodiff_plugin.terms import TERMS, Estimate, MatchTarget

__all__ = ["Loss", "Objective", "Views"]


@dataclass(frozen=True)
class Views:
    """Both views of every sample of a chunk, on the grid where losses are computed.

    Attributes:
        left_01: ``(B, 3, H, W)`` in [0, 1].
        right_01: ``(B, 3, Hr, Wr)`` in [0, 1].
        K_left: ``(B, 3, 3)`` pixels of ``left_01``.
        K_right: ``(B, 3, 3)`` pixels of ``right_01``.
        T_right_from_left: ``(B, 4, 4)`` metres.
        rays: the three matrices above as one affine map per pixel, made once a chunk.
    """

    left_01: Tensor
    right_01: Tensor
    K_left: Tensor
    K_right: Tensor
    T_right_from_left: Tensor
    rays: PlaneRays

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the loss grid."""
        return self.left_01.shape[-2], self.left_01.shape[-1]


@dataclass(frozen=True)
class Loss:
    """One evaluation: ``total (B,)`` with its graph, the unweighted ``terms``, the visible share ``(B,)``."""

    total: Tensor
    terms: dict[str, Tensor]
    visible_fraction: Tensor


@dataclass(frozen=True)
class Objective:
    """The weighted sum of guidance terms for one chunk of samples.

    Attributes:
        views: what the cameras saw.
        metric: the prior's metric parametrisation.
        weights: weight by name of ``TERMS``; a term of weight 0 is not computed.
        options: configuration values that the terms ask for by name.
        min_visible: below this visible share a sample's photometric term is switched off, [0, 1]:
            a depth that pushes the scene out of the right image leaves nothing to compare and would win.
    """

    views: Views
    metric: MetricMap
    weights: Mapping[str, float]
    options: Mapping[str, Any]
    min_visible: float

    def metric_depth(self, x: Tensor, affine: AffineState) -> Tensor:
        """``x (B, 1, h, w)`` upsampled to the loss grid, then Eq. 16: ``(B, 1, H, W)`` metres."""
        if x.shape[-2:] != self.views.size:
            x = F.interpolate(x, self.views.size, mode="bilinear", align_corners=False)
        return self.metric(x, affine)

    def __call__(
        self,
        x: Tensor,
        affine: AffineState,
        affine_start: AffineState,
        z0: Tensor,
        z0_prior: Tensor,
        matches: MatchTarget | None,
    ) -> Loss:
        """Loss of one estimate; differentiable in ``x``, ``z0`` and the affine state.

        Args:
            x: ``(B, 1, h, w)`` float32 unclipped relative map without padding.
            affine: current scale, shift, g_s.
            affine_start: the search's result.
            z0: ``(B, C, h', w')`` float32 latent that ``x`` was decoded from.
            z0_prior: the network's own.
            matches: on the loss grid, or ``None``.
        """
        active = {
            name: weight
            for name, weight in self.weights.items()
            if weight and not (TERMS[name].needs_matches and matches is None)
        }
        depth_m = self.metric_depth(x, affine)
        v = self.views
        needs_warp = any(TERMS[name].needs_warp for name in active)
        with torch.set_grad_enabled(torch.is_grad_enabled() and needs_warp):
            warped = warp_right_to_left(
                v.right_01, depth_m, v.K_left, v.K_right, v.T_right_from_left, rays=v.rays
            )
        estimate = Estimate(
            depth_m, v.left_01, warped.image, warped.visible, affine, affine_start, z0, z0_prior, matches
        )
        visible_fraction = warped.visible.float().flatten(1).mean(1)
        total = torch.zeros_like(visible_fraction)
        values = {}
        for name, weight in active.items():
            term = TERMS[name]
            value = term.function(estimate, **{key: self.options[key] for key in term.options})
            if term.needs_warp:
                value = value * (visible_fraction >= self.min_visible)
            values[name] = value
            total = total + weight * value
        return Loss(total, values, visible_fraction)
