"""From a relative map to one loss per sample.

Data flow: ``x (B, 1, h, w)`` -> metric depth on the loss grid -> warp -> terms -> ``loss (B,)``.
Paper: Eq. 14 (eq:geo-loss) with Eq. 16 and 17.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.terms import TERMS, Estimate, MatchTarget
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.geometry.cameras import image_size
from geodiff_plugin.geometry.projection import PlaneRays
from geodiff_plugin.geometry.warping import hidden_in_right, warp_right_to_left
from geodiff_plugin.scale.space import AffineState, MetricMap

__all__ = ["Loss", "Objective", "FurtherView", "Views"]


@dataclass(frozen=True)
class FurtherView:
    """One further view of every sample of a chunk.

    Attributes:
        image_01: ``(B, 3, Hr, Wr)`` in [0, 1].
        K: ``(B, 3, 3)`` pixels of ``image_01``.
        T_right_from_left: ``(B, 4, 4)`` metres.
        rays: these cameras and the left one as one affine map per left pixel, made once a chunk.
    """

    image_01: Tensor
    K: Tensor
    T_right_from_left: Tensor
    rays: PlaneRays

    @property
    def size(self) -> tuple[int, int]:
        """``(Hr, Wr)``."""
        return image_size(self.image_01)


@dataclass(frozen=True)
class Views:
    """What the cameras saw of every sample of a chunk, on the grid where losses are computed.

    Attributes:
        left_01: ``(B, 3, H, W)`` in [0, 1].
        K_left: ``(B, 3, 3)`` pixels of ``left_01``.
        further: the further views, as many for every sample; none where only points are known.
    """

    left_01: Tensor
    K_left: Tensor
    further: tuple[FurtherView, ...]

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the loss grid."""
        return image_size(self.left_01)


@dataclass(frozen=True)
class Loss:
    """One evaluation: ``total (B,)`` with its graph, the unweighted ``terms``, the share in view ``(B,)``.

    A pixel is in view where any further camera has it in its picture.
    """

    total: Tensor
    terms: dict[str, Tensor]
    visible_fraction: Tensor


@dataclass(frozen=True)
class Objective:
    """The weighted sum of guidance terms for one chunk of samples.

    Attributes:
        views: what the cameras saw.
        metric: the prior's metric parametrisation.
        config: weights by name of ``TERMS``, a term of weight 0 is not computed; what the terms ask for by
            name; and ``min_visible``, the share in view below which a sample's photometric term is switched
            off: a depth that pushes the scene out of the right image leaves nothing to compare and would win.
    """

    views: Views
    metric: MetricMap
    config: GuidanceConfig

    def metric_depth(self, x: Tensor, affine: AffineState) -> Tensor:
        """``x (B, 1, h, w)`` upsampled to the loss grid, then Eq. 16: ``(B, 1, H, W)`` metres."""
        x = self.metric.confine(x)
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
        points: MatchTarget | None = None,
        hidden: Tensor | None = None,
    ) -> Loss:
        """Loss of one estimate; differentiable in ``x``, ``z0`` and the affine state.

        Args:
            x: ``(B, 1, h, w)`` float32 unclipped relative map without padding.
            affine: current scale, shift, g_s.
            affine_start: the search's result.
            z0: ``(B, C, h', w')`` float32 latent that ``x`` was decoded from.
            z0_prior: the network's own.
            matches: on the loss grid, as far as they are believed, or ``None``.
            points: what the user knows, on the loss grid, or ``None``.
            hidden: ``(B, V, 1, H, W)`` bool, pixels not to be compared, as ``hidden`` gave them.
        """
        lacking = {
            "needs_warp": not self.views.further,
            "needs_matches": matches is None,
            "needs_points": points is None,
        }
        active = {
            name: weight
            for name, weight in self.config.weights.items()
            if weight and not any(absent and getattr(TERMS[name], need) for need, absent in lacking.items())
        }
        depth_m = self.metric_depth(x, affine)
        needs_warp = any(TERMS[name].needs_warp for name in active)
        with torch.set_grad_enabled(torch.is_grad_enabled() and needs_warp):
            warped_01, in_view = self._warp(depth_m)
        left_01 = self.views.left_01
        visible = in_view if hidden is None else in_view & ~hidden
        estimate = Estimate(
            depth_m, left_01, warped_01, visible, affine, affine_start, z0, z0_prior, matches, points
        )
        visible_fraction = in_view.any(1).float().flatten(1).mean(1)
        total = torch.zeros_like(visible_fraction)
        values = {}
        for name, weight in active.items():
            term = TERMS[name]
            value = term.function(
                estimate, **{option: getattr(self.config, option) for option in term.options}
            )
            if term.needs_warp:
                value = value * (visible_fraction >= self.config.min_visible)
            values[name] = value
            total = total + weight * value
        return Loss(total, values, visible_fraction)

    def hidden(self, x: Tensor, affine: AffineState) -> Tensor:
        """``(B, V, 1, H, W)`` bool: what another part of this estimate hides from each right view."""
        depth_m, v = self.metric_depth(x, affine), self.views
        return torch.stack(
            [
                hidden_in_right(depth_m, v.K_left, r.K, r.T_right_from_left, r.size, rays=r.rays)
                for r in v.further
            ],
            1,
        )

    def _warp(self, depth_m: Tensor) -> tuple[Tensor, Tensor]:
        """Every further image seen from the left ``(B, V, 3, H, W)``, and where its camera has it in view."""
        v = self.views
        warps = [
            warp_right_to_left(r.image_01, depth_m, v.K_left, r.K, r.T_right_from_left, rays=r.rays)
            for r in v.further
        ]
        if not warps:
            nothing = v.left_01[:, None][:, :0]
            return nothing, nothing[:, :, :1].bool()
        return torch.stack([w.image for w in warps], 1), torch.stack([w.visible for w in warps], 1)
