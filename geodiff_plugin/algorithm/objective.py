"""From a relative map to one loss per sample: metric depth on the loss grid, warped views, weighted terms.

Source: Eq. 14 (eq:geo-loss) with Eq. 16 and 17.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.evidence import Views
from geodiff_plugin.algorithm.terms import TERMS, Compared
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.geometry.cameras import image_size
from geodiff_plugin.geometry.warping import hidden_in_right, warp_right_to_left
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.space import AffineState, MetricMap


class Loss(NamedTuple):
    """One evaluation: ``total (B,)`` with its graph, the unweighted ``terms``, the share in view ``(B,)``.

    A pixel is in view where any further camera has it in its picture.
    """

    total: Tensor
    terms: dict[str, Tensor]
    visible_fraction: Tensor


class Objective:
    """The weighted sum of guidance terms for one chunk of samples.

    Args:
        views: what the cameras saw.
        metric: the prior's metric parametrisation.
        config: weights by name of ``TERMS``, of which one of weight 0 is not computed; the options of the
        terms;
            and ``min_visible``, the share in view below which a sample's photometric term is switched off: a
            depth that pushes the scene out of the right image leaves nothing to compare and would win.
    """

    def __init__(self, views: Views, metric: MetricMap, config: GuidanceConfig) -> None:
        self.views, self.metric, self.config = views, metric, config

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
        matches: Matches | None,
        points: Matches | None = None,
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
        visible = in_view if hidden is None else in_view & ~hidden
        compared = Compared(
            depth_m,
            self.views.left_01,
            warped_01,
            visible,
            affine,
            affine_start,
            z0,
            z0_prior,
            matches,
            points,
        )
        visible_fraction = in_view.any(1).float().flatten(1).mean(1)
        total, values = torch.zeros_like(visible_fraction), {}
        for name, weight in active.items():
            term = TERMS[name]
            value = term.function(compared, **{o: getattr(self.config, o) for o in term.options})
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
                hidden_in_right(depth_m, v.K_left, K, T, image_size(image), rays=rays)
                for (image, K, T), rays in zip(v.further, v.rays, strict=True)
            ],
            1,
        )

    def _warp(self, depth_m: Tensor) -> tuple[Tensor, Tensor]:
        """Every further image seen from the left ``(B, V, 3, H, W)``, and where its camera has it in view."""
        v = self.views
        warps = [
            warp_right_to_left(image, depth_m, v.K_left, K, T, rays=rays)
            for (image, K, T), rays in zip(v.further, v.rays, strict=True)
        ]
        if not warps:
            nothing = v.left_01[:, None][:, :0]
            return nothing, nothing[:, :, :1].bool()
        return torch.stack([w.image for w in warps], 1), torch.stack([w.visible for w in warps], 1)
