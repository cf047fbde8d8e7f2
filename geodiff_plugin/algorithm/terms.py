"""The loss of a relative map: guidance terms, their table, and their weighted sum.

``photometric`` and ``prior_pull`` are Eq. 14 (eq:geo-loss) and Eq. 17, on the metric depth of Eq. 16; the
other terms go beyond the paper, as do the mask, the exposure and the pyramid of the photometric one. A new
term is a function and one line in ``TERMS``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.geometry import PlaneRays, hidden_in_right, image_size, rays_of, warp_right_to_left
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.space import AffineState, MetricMap
from geodiff_plugin.types import PosedViews

#: Pyramid levels with a shorter side than this are left out.
MIN_SIDE = 24
#: SSIM's constant of the means, for images in [0, 1], as its authors set it.
C1 = 0.01**2
#: SSIM's constant of the variances, likewise.
C2 = 0.03**2
# The outer taps of its Gaussian window of 1.5 pixels, before the 3 of them sum to 1.
_TAP = math.exp(-0.5 / 1.5**2)
#: The outer taps.
TAP_BESIDE = _TAP / (1.0 + 2.0 * _TAP)
#: The middle tap.
TAP_CENTRE = 1.0 / (1.0 + 2.0 * _TAP)
#: Photometric error of a view that does not see the pixel: above any other.
UNSEEN = 2.0
#: Added to a spread, so that a blank image causes no division by zero.
BLANK_SPREAD = 1e-3
#: Bounds of the exposure gain; beyond them two photographs do not show the same scene.
GAINS = (0.2, 5.0)
#: Rows and columns of the smooth shading field (vignetting, sun from one side).
CELLS = (4, 5)
#: Share of a cell in view at which the cell's mean counts half: the mean of a few pixels is no shading.
CELL_PRIOR = 0.2
#: Errors at points up to this share of the unit are float32's rounding and pull no more: a rule that gives
#: every gradient the same length would follow their sign.
ROUNDING = 1e-3
#: Residual of matches, in planes, and of points, in their unit, from which their pull falls: a wrong match
#: must not win against its neighbours, but a surface that the prior misplaces must still be pulled back.
TERM_CAUCHY = 5.0
#: Share of the anchor's pull that remains where every pixel is matched.
ANCHOR_FLOOR = 0.05


def masked_mean(value: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean ``(B,)`` of ``value (B, C, H, W)`` by ``weight (B, 1, H, W)`` >= 0; 0 where all are 0."""
    weight = weight.to(value.dtype)
    total = (value.mean(1, keepdim=True) * weight).flatten(1).sum(1)
    return total / weight.flatten(1).sum(1).clamp_min(1e-6)


def photometric_map(left_01: Tensor, warped_01: Tensor, eta: float) -> Tensor:
    """Per-pixel ``eta (1 - SSIM) / 2 + (1 - eta) L1`` of two images ``(B, 3, H, W)``, in [0, 1] as they are.

    Source: Eq. 14 (eq:geo-loss). The paper gives no window; 3x3 follows the works it cites.
    """
    return (
        eta * ((1.0 - ssim(left_01, warped_01)) / 2.0).clamp(0.0, 1.0)
        + (1.0 - eta) * (left_01 - warped_01).abs()
    )


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity of every pixel, in a Gaussian window of 3x3 pixels, reflected at the border.

    As ``kornia.metrics.ssim(a, b, 3)``, which makes its window of a list at every call, and so waits for the
    device. Source: Wang et al. 2004, "Image quality assessment", Eq. 13.
    """
    moments = F.pad(torch.cat([a, b, a * a, b * b, a * b], 1), (1, 1, 1, 1), mode="reflect")
    moments = TAP_BESIDE * (moments[..., :-2] + moments[..., 2:]) + TAP_CENTRE * moments[..., 1:-1]
    moments = TAP_BESIDE * (moments[..., :-2, :] + moments[..., 2:, :]) + TAP_CENTRE * moments[..., 1:-1, :]
    mean_a, mean_b, square_a, square_b, product = moments.chunk(5, 1)
    means, squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
    covariance, variances = product - means, square_a + square_b - squares
    return (2.0 * means + C1) * (2.0 * covariance + C2) / ((squares + C1) * (variances + C2) + 1e-12)


def _moments(image: Tensor, weight: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation per sample and channel, ``(B, C, 1, 1)``, by weights of a ``total``."""
    mean = (image * weight).sum((-2, -1), keepdim=True) / total
    square = ((image - mean) ** 2 * weight).sum((-2, -1), keepdim=True) / total
    return mean, (square + BLANK_SPREAD**2).sqrt()


def match_exposure(warped_01: Tensor, left_01: Tensor, visible: Tensor) -> Tensor:
    """Bring warped right images to the left one's gain and bias per channel, and to its slow shading.

    In closed form: gain and bias make mean and spread over the ``visible`` pixels agree. A least-squares fit
    pixel by pixel would take every wrong depth for a lower gain. What remains of the difference in a coarse
    grid of cells is added as a smooth field. Images are ``(B, C, H, W)`` in [0, 1]; differentiable. Beyond
    the paper, which names illumination as a limit.
    """
    weight = visible.to(left_01.dtype)
    total = weight.sum((-2, -1), keepdim=True).clamp_min(1.0)
    mean_left, spread_left = _moments(left_01, weight, total)
    mean_right, spread_right = _moments(warped_01, weight, total)
    gain = (spread_left / spread_right).clamp(*GAINS)
    matched = mean_left + gain * (warped_01 - mean_right)
    share = F.adaptive_avg_pool2d(weight, CELLS)
    field = F.adaptive_avg_pool2d((left_01 - matched) * weight, CELLS) / (share + CELL_PRIOR)
    return matched + F.interpolate(field, left_01.shape[-2:], mode="bilinear", align_corners=False)


def photometric(left_01: Tensor, warped_01: Tensor, visible: Tensor, config: GuidanceConfig) -> Tensor:
    """Mean photometric error over the visible pixels, averaged over an image pyramid, ``(B,)`` in [0, 1].

    ``left_01 (B, 3, H, W)``, ``warped_01 (B, V, 3, H, W)`` every right image seen from the left, ``visible
    (B, V, 1, H, W)`` bool. Each pixel takes the least error of the views that see it, so a
    view in which it is occluded does not count (Godard et al. 2019, "Digging into self-supervised monocular
    depth estimation", Eq. 4). Coarser levels widen the basin of attraction.

    Source: Eq. 14 (eq:geo-loss). Deviation: the mask (the paper's mean over all pixels rewards depths that
        push pixels out of the right image) and the pyramid.
    """
    views = warped_01.shape[1]
    left = left_01.repeat_interleave(views, 0)  # (B V, 3, H, W), one entry per view
    warped, mask = warped_01.flatten(0, 1), visible.flatten(0, 1).to(left.dtype)
    if config.exposure:
        warped = match_exposure(warped, left, mask)
    total, levels = left.new_zeros(()), 0
    for level in range(config.pyramid_levels):
        if level:
            if min(left.shape[-2:]) < 2 * MIN_SIDE:
                break
            # Masked averaging: a coarse pixel is the mean of its visible fine ones.
            seen = F.avg_pool2d(mask, 2)
            left = F.avg_pool2d(left * mask, 2) / seen.clamp_min(1e-6)
            warped = F.avg_pool2d(warped * mask, 2) / seen.clamp_min(1e-6)
            mask = (seen > 0.5).to(left.dtype)
        total = total + masked_mean(*_best_explained(photometric_map(left, warped, config.eta), mask, views))
        levels += 1
    return total / levels


def _best_explained(error: Tensor, mask: Tensor, views: int) -> tuple[Tensor, Tensor]:
    """Least error over the views that see a pixel, and whether any does, ``(B, 1, H, W)`` each."""
    error = error.mean(1, keepdim=True).unflatten(0, (-1, views))
    mask = mask.unflatten(0, (-1, views))
    return torch.where(mask > 0, error, torch.full_like(error, UNSEEN)).amin(1), mask.amax(1)


class Given(NamedTuple):
    """What the loss of a relative map depends on beside the map and the views."""

    affine: AffineState  # carries the graph
    affine_start: AffineState  # the search's result
    z0: Tensor  # (B, C, h, w) the clean latent that the map was decoded from, carries the graph
    anchor: Tensor  # (B, C, h, w) the network's clean latent of this step, moved by its corrections
    matches: Matches | None = None  # without reflections
    points: Matches | None = None  # depths that the user knows
    hidden: Tensor | None = None  # (B, V, 1, H, W) bool, pixels not to be compared


class Compared(NamedTuple):
    """One metric estimate on the loss grid, and what the terms compare it with."""

    depth_m: Tensor  # (B, 1, H, W) metres, carries the graph
    left_01: Tensor  # (B, 3, H, W)
    warped_01: Tensor  # (B, V, 3, H, W) every right image seen from the left through ``depth_m``
    visible: Tensor  # (B, V, 1, H, W) bool: in view of that camera, and not known to be hidden from it
    affine: AffineState  # carries the graph
    affine_start: AffineState  # the search's result
    z0: Tensor  # (B, C, h, w) current clean latent, carries the graph
    anchor: Tensor  # (B, C, h, w) the network's clean latent of this step, moved by its corrections
    matches: Matches | None  # without reflections
    points: Matches | None = None  # depths that the user knows
    config: GuidanceConfig = DEFAULT


class Term(NamedTuple):
    """A function from ``Compared`` to ``(B,)``, and the input that it needs; without that it is left out.

    ``needs`` is ``"views"``, ``"matches"``, ``"points"``, or empty if every call has the input.
    """

    function: Callable[[Compared], Tensor]
    needs: str = ""


def cauchy(e: Tensor) -> Tensor:
    """``w^2 / 2 log(1 + (e / w)^2)``: ``e^2 / 2`` near 0, its gradient falls as 1 / e beyond ``w``."""
    return 0.5 * TERM_CAUCHY**2 * ((e / TERM_CAUCHY) ** 2).log1p()


def _relative_error(depth_m: Tensor, target: Matches) -> Tensor:
    """Error in inverse depth, in units of the target's step."""
    return (1.0 / depth_m - target.inverse_depth) / target.plane_step.view(-1, 1, 1, 1)


def matches_term(compared: Compared) -> Tensor:
    """Robust distance from the matches in inverse depth, in planes of the sweep: far and near weigh alike."""
    target = compared.matches
    assert target is not None  # Term.needs
    return masked_mean(cauchy(_relative_error(compared.depth_m, target)), target.confidence)


def points_term(compared: Compared) -> Tensor:
    """Error at depths that the user knows (lidar, structure from motion, a tape).

    ``points_loss="robust"`` is the Cauchy loss of the matches: a wrong point does not win against the rest.
    ``"l1l2"``, mean absolute plus squared error in metres, is Marigold-DC's (Viola et al. 2024, Eq. 4).
    """
    target = compared.points
    assert target is not None  # Term.needs
    if compared.config.points_loss == "robust":
        e = _relative_error(compared.depth_m, target)
        return masked_mean(cauchy(F.hardshrink(e, ROUNDING)), target.confidence)
    given = target.confidence > 0
    e = (compared.depth_m - 1.0 / target.inverse_depth.where(given, target.inverse_depth.new_ones(()))).abs()
    return masked_mean(e + e * e, given)


def prior_pull_term(compared: Compared) -> Tensor:
    """``||s_hat - s*||^2 + ||t_hat - t*||^2``, to be weighted by gamma.

    Source: Eq. 17, with ``pull_to="zero"``. Deviation: by default s*, t* are the search's result: a pull of
        the raw values towards 0 makes softplus(0) = 0.693 of both: far / near = 2 for every scene.
    """
    s, t = compared.affine.s_hat, compared.affine.t_hat
    if compared.config.pull_to == "start":
        s = s - compared.affine_start.s_hat
        t = t - compared.affine_start.t_hat
    return s * s + t * t


def anchor_term(compared: Compared) -> Tensor:
    """Mean squared distance of the clean latent from its anchor, weighted down where there are matches.

    With several inner updates it keeps unmatched regions near the prior: the proximal form of one diffusion
    posterior step (S3.2 takes a single gradient step instead).
    """
    square = (compared.z0 - compared.anchor).pow(2).mean(1, keepdim=True)  # (B, 1, h, w)
    if compared.matches is not None:
        matched = F.interpolate(compared.matches.confidence, square.shape[-2:], mode="area")
        square = square * (1.0 - matched).clamp_min(ANCHOR_FLOOR)
    return square.flatten(1).mean(1)


TERMS: dict[str, Term] = {
    "photometric": Term(lambda c: photometric(c.left_01, c.warped_01, c.visible, c.config), "views"),
    "matches": Term(matches_term, "matches"),
    "points": Term(points_term, "points"),
    "prior_pull": Term(prior_pull_term),
    "anchor": Term(anchor_term),
}


class Loss(NamedTuple):
    """One evaluation: ``total (B,)`` with its graph, the unweighted ``terms``, the share in view."""

    total: Tensor
    terms: dict[str, Tensor]
    visible_fraction: Tensor


class Objective:
    """The weighted sum of guidance terms for one chunk of samples, whose ``views`` have a batch axis.

    Below ``min_visible`` a sample's photometric term is off: a depth that pushes the scene out of the right
    image leaves nothing to compare and would win.
    """

    def __init__(self, views: PosedViews, metric: MetricMap, config: GuidanceConfig) -> None:
        self.views, self.metric, self.config = views, metric, config

    @cached_property
    def _rays(self) -> list[PlaneRays]:
        """Of every right view; only a loss of photographs needs them."""
        v = self.views
        return [rays_of(v.left_01, v.K_left, K, T) for _, K, T in v.views]

    def metric_depth(self, x: Tensor, affine: AffineState) -> Tensor:
        """``x (B, 1, h, w)`` resized to the loss grid, then Eq. 16: ``(B, 1, H, W)`` metres."""
        x = self.metric.confine(x)
        if x.shape[-2:] != self.views.size:
            x = F.interpolate(x, self.views.size, mode="bilinear", align_corners=False)
        return self.metric(x, affine)

    def __call__(self, x: Tensor, given: Given) -> Loss:
        """Loss of one estimate; differentiable in ``x``, ``given.z0`` and ``given.affine``.

        ``x (B, 1, h, w)`` is the unclipped relative map without padding, decoded from ``given.z0``.
        """
        needed = {"": True, "views": self.views.views, "matches": given.matches, "points": given.points}
        active = {name: w for name, w in self.config.weights.items() if w and needed[TERMS[name].needs]}
        depth_m = self.metric_depth(x, given.affine)
        warps = any(TERMS[name].needs == "views" for name in active)
        with torch.set_grad_enabled(torch.is_grad_enabled() and warps):
            warped_01, in_view = self._warp(depth_m)
        visible = in_view if given.hidden is None else in_view & ~given.hidden
        compared = Compared(
            depth_m,
            self.views.left_01,
            warped_01,
            visible,
            affine=given.affine,
            affine_start=given.affine_start,
            z0=given.z0,
            anchor=given.anchor,
            matches=given.matches,
            points=given.points,
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
        depth_m, K_left = self.metric_depth(x, affine), self.views.K_left
        hidden = [
            hidden_in_right(depth_m, K_left, K, T, image_size(image), rays=rays)
            for (image, K, T), rays in zip(self.views.views, self._rays, strict=True)
        ]
        return torch.stack(hidden, 1)

    def _warp(self, depth_m: Tensor) -> tuple[Tensor, Tensor]:
        """Every further image seen from the left ``(B, V, 3, H, W)``, and where its camera has it in view."""
        v = self.views
        warps = [
            warp_right_to_left(image, depth_m, v.K_left, K, T, rays=rays)
            for (image, K, T), rays in zip(v.views, self._rays, strict=True)
        ]
        if not warps:
            nothing = v.left_01[:, None][:, :0]
            return nothing, nothing[:, :, :1].bool()
        return torch.stack([w.image for w in warps], 1), torch.stack([w.visible for w in warps], 1)
