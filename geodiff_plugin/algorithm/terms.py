"""Guidance terms, their table, and their weighted sum: the loss of a relative map.

Source: ``photometric`` and ``prior_pull`` are Eq. 14 (eq:geo-loss) and Eq. 17, on the metric depth of Eq. 16.
The other terms go beyond the paper. A new term is a function and one line in ``TERMS``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.evidence import Views
from geodiff_plugin.algorithm.photometric import masked_mean, photometric
from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.geometry import hidden_in_right, image_size, warp_right_to_left
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.space import AffineState, MetricMap

#: Errors at points up to this share of the unit are float32's rounding and pull no more: a rule that gives
#: every gradient the same length would follow their sign.
ROUNDING = 1e-3
#: Residual of matches, in planes, and of points, in their unit, from which their pull falls: a wrong match
#: must not win against its neighbours, but a surface that the prior put far away must still feel where it is.
CAUCHY = 5.0
#: Share of the anchor's pull that remains where every pixel is matched.
ANCHOR_FLOOR = 0.05


class Compared(NamedTuple):
    """One metric estimate on the loss grid, and what the terms compare it with.

    Attributes:
        depth_m: ``(B, 1, H, W)`` metres, carries the graph.
        left_01: ``(B, 3, H, W)`` the left image.
        warped_01: ``(B, V, 3, H, W)`` every right image seen from the left through ``depth_m``.
        visible: ``(B, V, 1, H, W)`` bool: in view of that camera, and not hidden from it as far as we know.
        affine: current scale, shift, g_s; carries the graph.
        affine_start: where the search put them; no graph.
        z0: ``(B, C, h, w)`` current clean latent, carries the graph.
        z0_prior: ``(B, C, h, w)`` the network's clean latent of this step, moved by its corrections if it
            has any; no graph.
        matches: those that are believed, or ``None``.
        points: depths that the user knows, or ``None``.
        config: the terms' numbers.
    """

    depth_m: Tensor
    left_01: Tensor
    warped_01: Tensor
    visible: Tensor
    affine: AffineState
    affine_start: AffineState
    z0: Tensor
    z0_prior: Tensor
    matches: Matches | None
    points: Matches | None = None
    config: GuidanceConfig = DEFAULT


class Term(NamedTuple):
    """A function from ``Compared`` to ``(B,)``, and the input without which it is left out.

    ``needs`` is ``"views"``, ``"matches"``, ``"points"``, or empty for what every call has.
    """

    function: Callable[[Compared], Tensor]
    needs: str = ""


def cauchy(e: Tensor, width: float) -> Tensor:
    """``width^2 / 2 log(1 + (e / width)^2)``: ``e^2 / 2`` near 0, its gradient falls as 1 / e beyond."""
    return 0.5 * width**2 * ((e / width) ** 2).log1p()


def _relative_error(depth_m: Tensor, target: Matches) -> Tensor:
    """Error in inverse depth, in units of the target's step."""
    return (1.0 / depth_m - target.inverse_depth) / target.plane_step.view(-1, 1, 1, 1)


def photometric_term(compared: Compared) -> Tensor:
    """``photometric`` of the right images seen from the left, over the pixels that some right camera sees."""
    return photometric(compared.left_01, compared.warped_01, compared.visible, compared.config)


def matches_term(compared: Compared) -> Tensor:
    """Robust distance from the matches in inverse depth, ``(B,)``; 0 where a sample has no match.

    In units of one plane of the sweep, which is one step of shift in the right image, so that far and near
    pixels weigh alike.
    """
    target = compared.matches
    assert target is not None  # Term.needs
    return masked_mean(cauchy(_relative_error(compared.depth_m, target), CAUCHY), target.confidence)


def points_term(compared: Compared) -> Tensor:
    """Error at depths that the user knows (lidar, structure from motion, a tape), ``(B,)``; 0 without any.

    ``points_loss="robust"`` is the Cauchy loss of the matches: far and near points weigh alike, and a wrong
    one (seen through a window, or from the other side of an edge) does not win against the rest. ``"l1l2"``,
    mean absolute plus mean squared error in metres, is that of Marigold-DC (Viola et al. 2024, Eq. 4).
    """
    target = compared.points
    assert target is not None  # Term.needs
    if compared.config.points_loss == "robust":
        e = _relative_error(compared.depth_m, target)
        return masked_mean(cauchy(F.hardshrink(e, ROUNDING), CAUCHY), target.confidence)
    given = target.confidence > 0
    e = (compared.depth_m - 1.0 / target.inverse_depth.where(given, target.inverse_depth.new_ones(()))).abs()
    return masked_mean(e + e * e, given)


def prior_pull(compared: Compared) -> Tensor:
    """``||s_hat - s*||^2 + ||t_hat - t*||^2``, ``(B,)``, to be weighted by gamma.

    Source: Eq. 17, with ``pull_to="zero"``. Deviation: by default s*, t* are the search's result, because
    the paper's pull of the raw values towards 0 makes softplus(0) = 0.693 of both: far / near = 2 for every
    scene.
    """
    s, t = compared.affine.s_hat, compared.affine.t_hat
    if compared.config.pull_to == "start":
        s = s - compared.affine_start.s_hat
        t = t - compared.affine_start.t_hat
    return s * s + t * t


def anchor(compared: Compared) -> Tensor:
    """Mean squared distance of the clean latent from ``z0_prior``, ``(B,)``, less where matches are.

    With several inner updates it keeps unmatched regions with the prior, and leaves matched ones to the
    matches: the proximal form of one diffusion posterior step (S3.2 takes a single gradient step instead).
    """
    square = (compared.z0 - compared.z0_prior).pow(2).mean(1, keepdim=True)  # (B, 1, h, w)
    if compared.matches is not None:
        matched = F.interpolate(compared.matches.confidence, square.shape[-2:], mode="area")
        square = square * (1.0 - matched).clamp_min(ANCHOR_FLOOR)
    return square.flatten(1).mean(1)


TERMS: dict[str, Term] = {
    "photometric": Term(photometric_term, "views"),
    "matches": Term(matches_term, "matches"),
    "points": Term(points_term, "points"),
    "prior_pull": Term(prior_pull),
    "anchor": Term(anchor),
}


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
        config: weights by name of ``TERMS``, of which one of weight 0 is not computed, the terms' numbers,
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

        ``x (B, 1, h, w)`` is the unclipped relative map without padding, decoded from ``z0``; ``hidden
        (B, V, 1, H, W)`` bool are pixels not to be compared. The other arguments are those of ``Compared``.
        """
        given = {"": True, "views": self.views.further, "matches": matches, "points": points}
        active = {name: w for name, w in self.config.weights.items() if w and given[TERMS[name].needs]}
        depth_m = self.metric_depth(x, affine)
        warps = any(TERMS[name].needs == "views" for name in active)
        with torch.set_grad_enabled(torch.is_grad_enabled() and warps):
            warped_01, in_view = self._warp(depth_m)
        visible = in_view if hidden is None else in_view & ~hidden
        compared = Compared(
            depth_m=depth_m,
            left_01=self.views.left_01,
            warped_01=warped_01,
            visible=visible,
            affine=affine,
            affine_start=affine_start,
            z0=z0,
            z0_prior=z0_prior,
            matches=matches,
            points=points,
            config=self.config,
        )
        visible_fraction = in_view.any(1).float().flatten(1).mean(1)
        total, values = torch.zeros_like(visible_fraction), {}
        for name, weight in active.items():
            value = TERMS[name].function(compared)
            if TERMS[name].needs == "views":
                value = value * (visible_fraction >= self.config.min_visible)
            values[name] = value
            total = total + weight * value
        return Loss(total, values, visible_fraction)

    def hidden(self, x: Tensor, affine: AffineState) -> Tensor:
        """``(B, V, 1, H, W)`` bool: what another part of this estimate hides from each right view."""
        depth_m, v = self.metric_depth(x, affine), self.views
        hidden = [
            hidden_in_right(depth_m, v.K_left, K, T, image_size(image), rays=rays)
            for (image, K, T), rays in zip(v.further, v.rays, strict=True)
        ]
        return torch.stack(hidden, 1)

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
