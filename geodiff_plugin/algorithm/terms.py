"""Loss of a relative map: guidance terms, their table, and their weighted sum.

``photometric`` and ``affine_reg`` are Eq. 14 (eq:geo-loss) and Eq. 17 on the metric depth of Eq. 16. The
other terms go beyond the paper, as do the mask, exposure matching and pyramid of the photometric term. A new
term is a function and one line in ``TERMS``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.cameras import ALL_VALID, PosedViews, valid_pixels
from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.geometry import (
    PlaneRays,
    image_size,
    occluded_in_right,
    plane_rays,
    stacked,
    warp_right_to_left,
)
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.affine import AffineState
from geodiff_plugin.scale.space import MetricMap

#: Minimum shorter side of a pyramid level.
MIN_SIDE = 24
#: SSIM's stabilizing constant of the means, for images in [0, 1], from the original paper.
C1 = 0.01**2
#: SSIM's stabilizing constant of the variances.
C2 = 0.03**2
# Outer taps of SSIM's 3-tap Gaussian window with sigma 1.5 pixels, before normalization.
_TAP = math.exp(-0.5 / 1.5**2)
#: Outer taps of SSIM's window.
TAP_NEIGHBOUR = _TAP / (1.0 + 2.0 * _TAP)
#: Middle tap of SSIM's window.
TAP_CENTRE = 1.0 / (1.0 + 2.0 * _TAP)
#: Photometric error of a view in which the pixel is not visible; larger than any other error.
UNSEEN = 2.0
#: Added to a standard deviation, so that a blank image causes no division by zero.
BLANK_SPREAD = 1e-3
#: Bounds of the exposure gain; outside them two images do not show the same scene.
GAINS = (0.2, 5.0)
#: Rows and columns of the smooth shading field (vignetting, sun from one side).
CELLS = (4, 5)
#: Visible fraction of a cell at which its mean has half the weight: the mean of a few pixels is not shading.
CELL_PRIOR = 0.2
#: Largest error at points, as a fraction of the unit, that is attributed to float32 rounding and has no
#: gradient. An optimizer that normalizes gradients would otherwise follow its sign.
ROUNDING = 1e-3
#: Residual of matches, in planes, and of points, in their unit, above which their gradient falls. A wrong
#: match must not win against its neighbours, but a surface that the prior misplaces must still be corrected.
TERM_CAUCHY = 5.0
#: Fraction of the anchor term that remains where every pixel is matched.
ANCHOR_FLOOR = 0.05


def masked_mean(value: Tensor, weight: Tensor) -> Tensor:
    """Average ``value (B, C, H, W)`` with weights ``(B, 1, H, W)`` >= 0 to ``(B,)``; 0 if all are 0."""
    weight = weight.to(value.dtype)
    total = (value.mean(1, keepdim=True) * weight).flatten(1).sum(1)
    return total / weight.flatten(1).sum(1).clamp_min(1e-6)


def photometric_map(left_01: Tensor, warped_01: Tensor, eta: float) -> Tensor:
    """Compute ``eta (1 - SSIM) / 2 + (1 - eta) L1`` per pixel of two images ``(B, 3, H, W)`` in [0, 1].

    Source: Eq. 14 (eq:geo-loss). The paper gives no window size; 3x3 follows the works it cites.
    """
    return (
        eta * ((1.0 - ssim(left_01, warped_01)) / 2.0).clamp(0.0, 1.0)
        + (1.0 - eta) * (left_01 - warped_01).abs()
    )


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Compute the structural similarity of every pixel, with a 3x3 Gaussian window and reflected borders.

    Equals ``kornia.metrics.ssim(a, b, 3)``, which builds its window from a list at every call and therefore
    synchronizes with the device. Source: Wang et al. 2004, "Image quality assessment", Eq. 13.
    """
    moments = F.pad(torch.cat([a, b, a * a, b * b, a * b], 1), (1, 1, 1, 1), mode="reflect")
    moments = TAP_NEIGHBOUR * (moments[..., :-2] + moments[..., 2:]) + TAP_CENTRE * moments[..., 1:-1]
    moments = (
        TAP_NEIGHBOUR * (moments[..., :-2, :] + moments[..., 2:, :]) + TAP_CENTRE * moments[..., 1:-1, :]
    )
    mean_a, mean_b, square_a, square_b, product = moments.chunk(5, 1)
    means = mean_a * mean_b
    squares = mean_a * mean_a + mean_b * mean_b
    covariance = product - means
    variances = square_a + square_b - squares
    return (2.0 * means + C1) * (2.0 * covariance + C2) / ((squares + C1) * (variances + C2) + 1e-12)


def _moments(image: Tensor, weight: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    """Compute weighted mean and standard deviation per sample and channel, ``(B, C, 1, 1)``."""
    mean = (image * weight).sum((-2, -1), keepdim=True) / total
    square = ((image - mean) ** 2 * weight).sum((-2, -1), keepdim=True) / total
    return mean, (square + BLANK_SPREAD**2).sqrt()


def match_exposure(warped_01: Tensor, left_01: Tensor, visible: Tensor) -> Tensor:
    """Adjust warped right images to the left one's gain and bias per channel and to its slow shading.

    In closed form: gain and bias make mean and standard deviation over the ``visible`` pixels agree. A
    per-pixel least-squares fit would explain every wrong depth by a lower gain. The remaining difference in
    a coarse grid of cells is added as a smooth field. Images are ``(B, C, H, W)`` in [0, 1]. Differentiable.
    Beyond the paper, which names illumination as a limitation.
    """
    weight = visible.to(left_01.dtype)
    total = weight.sum((-2, -1), keepdim=True).clamp_min(1.0)
    mean_left, spread_left = _moments(left_01, weight, total)
    mean_right, spread_right = _moments(warped_01, weight, total)
    gain = (spread_left / spread_right).clamp(*GAINS)
    matched = mean_left + gain * (warped_01 - mean_right)
    fraction = F.adaptive_avg_pool2d(weight, CELLS)
    field = F.adaptive_avg_pool2d((left_01 - matched) * weight, CELLS) / (fraction + CELL_PRIOR)
    return matched + F.interpolate(field, left_01.shape[-2:], mode="bilinear", align_corners=False)


def photometric(left_01: Tensor, warped_01: Tensor, visible: Tensor, config: GuidanceConfig) -> Tensor:
    """Average the photometric error over visible pixels and an image pyramid, ``(B,)`` in [0, 1].

    ``left_01 (B, 3, H, W)``; ``warped_01 (B, V, 3, H, W)``, every right image warped to the left view;
    ``visible (B, V, 1, H, W)`` bool. Each pixel takes the minimum error of the views that see it, so a view
    in which it is occluded does not count (Godard et al. 2019, "Digging into self-supervised monocular depth
    estimation", Eq. 4). Coarser levels widen the basin of attraction.

    Source: Eq. 14 (eq:geo-loss). Deviation: the mask (the paper's mean over all pixels rewards depths that
        project pixels outside the right image) and the pyramid.
    """
    views = warped_01.shape[1]
    left = left_01.repeat_interleave(views, 0)  # (B V, 3, H, W), one entry per view
    warped = warped_01.flatten(0, 1)
    mask = visible.flatten(0, 1).to(left.dtype)
    if config.exposure:
        warped = match_exposure(warped, left, mask)
    total = left.new_zeros(())
    levels = 0
    for level in range(config.pyramid_levels):
        if level:
            if min(left.shape[-2:]) < 2 * MIN_SIDE:
                break
            # Masked averaging: a coarse pixel is the mean of its visible fine pixels.
            seen = F.avg_pool2d(mask, 2)
            left = F.avg_pool2d(left * mask, 2) / seen.clamp_min(1e-6)
            warped = F.avg_pool2d(warped * mask, 2) / seen.clamp_min(1e-6)
            mask = (seen > 0.5).to(left.dtype)
        total = total + masked_mean(
            *_best_explained(photometric_map(left, warped, config.ssim_weight), mask, views)
        )
        levels += 1
    return total / levels


def _best_explained(error: Tensor, mask: Tensor, views: int) -> tuple[Tensor, Tensor]:
    """Return the minimum error over views that see a pixel, and whether any does, ``(B, 1, H, W)`` each."""
    error = error.mean(1, keepdim=True).unflatten(0, (-1, views))
    mask = mask.unflatten(0, (-1, views))
    return torch.where(mask > 0, error, torch.full_like(error, UNSEEN)).amin(1), mask.amax(1)


class Given(NamedTuple):
    """Inputs of the loss of a relative map, in addition to the map and the views."""

    affine: AffineState  # carries the graph
    affine_start: AffineState  # search result
    z0: Tensor  # (B, C, h, w) clean latent that the map was decoded from, carries the graph
    anchor: Tensor  # (B, C, h, w) the network's clean latent of this step plus its match fits
    matches: Matches | None = None  # without reflections
    points: Matches | None = None  # user-given depths
    occluded: Tensor | None = None  # (B, V, 1, H, W) bool, pixels excluded from the comparison


class Compared(NamedTuple):
    """One metric estimate on the loss grid, and the data that terms compare it with."""

    depth_m: Tensor  # (B, 1, H, W) metres, carries the graph
    left_01: Tensor  # (B, 3, H, W)
    warped_01: Tensor  # (B, V, 3, H, W) every right image warped to the left view by ``depth_m``
    visible: Tensor  # (B, V, 1, H, W) bool: in the camera's view and not known to be occluded
    affine: AffineState  # carries the graph
    affine_start: AffineState  # search result
    z0: Tensor  # (B, C, h, w) current clean latent, carries the graph
    anchor: Tensor  # (B, C, h, w) the network's clean latent of this step plus its match fits
    matches: Matches | None  # without reflections
    points: Matches | None = None  # user-given depths
    config: GuidanceConfig = DEFAULT


class Term(NamedTuple):
    """A function from ``Compared`` to ``(B,)``, and the input that it needs; skipped without that input.

    ``needs`` is ``"views"``, ``"matches"``, ``"points"``, or empty for no special input.
    """

    function: Callable[[Compared], Tensor]
    needs: str = ""


def cauchy(e: Tensor) -> Tensor:
    """Compute ``w^2 / 2 log(1 + (e / w)^2)``: ``e^2 / 2`` near 0, gradient falling as 1 / e beyond ``w``."""
    return 0.5 * TERM_CAUCHY**2 * ((e / TERM_CAUCHY) ** 2).log1p()


def _relative_error(depth_m: Tensor, target: Matches) -> Tensor:
    """Compute the error in inverse depth, in units of the target's plane step."""
    return (1.0 / depth_m - target.inverse_depth) / target.plane_step.view(-1, 1, 1, 1)


def matches_term(compared: Compared) -> Tensor:
    """Compute the robust inverse-depth error at matches in sweep planes, so all distances weigh alike."""
    target = compared.matches
    assert target is not None  # Term.needs
    return masked_mean(cauchy(_relative_error(compared.depth_m, target)), target.confidence)


def points_term(compared: Compared) -> Tensor:
    """Compute the error at user-given depths (lidar, structure from motion, tape measure).

    ``points_loss="robust"`` is the Cauchy loss of the matches, which limits the influence of wrong points.
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


def affine_reg_term(compared: Compared) -> Tensor:
    """Compute ``||s_hat - s*||^2 + ||t_hat - t*||^2``, to be weighted by gamma.

    Source: Eq. 17, with ``affine_reg_target="zero"``. Deviation: by default s*, t* are the search result.
        Regularizing the raw values towards 0 makes both softplus(0) = 0.693, so far / near = 2 for every
        scene.
    """
    s, t = compared.affine.s_hat, compared.affine.t_hat
    if compared.config.affine_reg_target == "search":
        s = s - compared.affine_start.s_hat
        t = t - compared.affine_start.t_hat
    return s * s + t * t


def anchor_term(compared: Compared) -> Tensor:
    """Compute the mean squared distance of the clean latent from its anchor, with less weight at matches.

    With several updates per step it keeps unmatched regions near the prior: the proximal form of one
    diffusion posterior step (S3.2 takes a single gradient step instead).
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
    "affine_reg": Term(affine_reg_term),
    "anchor": Term(anchor_term),
}


class Loss(NamedTuple):
    """One evaluation: ``total (B,)`` with its graph, the unweighted ``terms``, and the fraction in view."""

    total: Tensor
    terms: dict[str, Tensor]
    visible_fraction: Tensor


class Objective:
    """The weighted sum of guidance terms for one chunk of samples.

    ``views`` has the views of every sample, equal in number and size (``chunk_views``). Below ``min_visible``
    a sample's photometric term is disabled: a depth that projects the scene outside the right image would
    leave nothing to compare and win.
    """

    def __init__(self, views: Sequence[PosedViews], metric: MetricMap, config: GuidanceConfig) -> None:
        self.metric, self.config = metric, config
        self._left_views = [each.left for each in views]
        self._lefts = [view.camera for view in self._left_views]
        self._rights = list(zip(*(each.rights for each in views), strict=True))  # by view, then by sample
        self.left_01 = stacked([each.left.image_01 for each in views])  # (B, 3, H, W)
        self.size = image_size(self.left_01)
        self.rights_01 = [stacked([view.image_01 for view in each]) for each in self._rights]

    @cached_property
    def _rays(self) -> list[PlaneRays]:
        """Rays of every right view, needed only by a photometric loss."""
        return [
            plane_rays(
                self.left_01,
                self._lefts,
                [view.camera for view in of_samples],
                [view.T_right_from_left for view in of_samples],
            )
            for of_samples in self._rights
        ]

    def metric_depth(self, x: Tensor, affine: AffineState) -> Tensor:
        """Resize ``x (B, 1, h, w)`` to the loss grid and apply Eq. 16: ``(B, 1, H, W)`` metres."""
        x = self.metric.confine(x)
        if x.shape[-2:] != self.size:
            x = F.interpolate(x, self.size, mode="bilinear", align_corners=False)
        return self.metric(x, affine)

    def __call__(self, x: Tensor, given: Given) -> Loss:
        """Compute the loss of one estimate; differentiable in ``x``, ``given.z0`` and ``given.affine``.

        ``x (B, 1, h, w)`` is the unclipped relative map without padding, decoded from ``given.z0``.
        """
        needed = {"": True, "views": self.rights_01, "matches": given.matches, "points": given.points}
        active = {name: w for name, w in self.config.weights.items() if w and needed[TERMS[name].needs]}
        depth_m = self.metric_depth(x, given.affine)
        warps = any(TERMS[name].needs == "views" for name in active)
        with torch.set_grad_enabled(torch.is_grad_enabled() and warps):
            warped_01, in_view = self._warp(depth_m)
        visible = in_view if given.occluded is None else in_view & ~given.occluded
        compared = Compared(
            depth_m,
            self.left_01,
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
        if (left := self._valid[0]) is not None:
            visible_fraction = visible_fraction / left.float().flatten(1).mean(1).clamp_min(1e-6)
        total = torch.zeros_like(visible_fraction)
        values = {}
        for name, weight in active.items():
            value = TERMS[name].function(compared)
            if TERMS[name].needs == "views":
                value = value * (visible_fraction >= self.config.min_visible)
            values[name] = value
            total = total + weight * value
        return Loss(total, values, visible_fraction)

    def occluded(self, x: Tensor, affine: AffineState) -> Tensor:
        """Return ``(B, V, 1, H, W)`` bool: pixels that the estimate itself occludes in each right view."""
        depth_m = self.metric_depth(x, affine)
        each = zip(self.rights_01, self._rays, strict=True)
        return torch.stack([occluded_in_right(depth_m, rays, image_size(image)) for image, rays in each], 1)

    def _warp(self, depth_m: Tensor) -> tuple[Tensor, Tensor]:
        """Warp every right image to the left view, ``(B, V, 3, H, W)``, and return where it is in view."""
        if not self.rights_01:
            nothing = self.left_01[:, None][:, :0]
            return nothing, nothing[:, :, :1].bool()
        each = zip(self.rights_01, self._rays, strict=True)
        warps = [warp_right_to_left(image, depth_m, rays) for image, rays in each]
        visible = torch.stack([w.visible for w in warps], 1)
        left, rights = self._valid
        for v, (valid, rays) in enumerate(zip(rights, self._rays, strict=True)):
            if valid is not None:
                visible[:, v] &= warp_right_to_left(valid, depth_m, rays).image > ALL_VALID
        if left is not None:
            visible = visible & left[:, None]
        return torch.stack([w.image for w in warps], 1), visible

    @cached_property
    def _valid(self) -> tuple[Tensor | None, list[Tensor | None]]:
        """Valid pixels ``(B, 1, H, W)`` of the left images, bool, and of each right view, float; or None."""
        left, *rights = (valid_pixels(of_samples) for of_samples in (self._left_views, *self._rights))
        return left, [None if valid is None else valid.to(self.left_01.dtype) for valid in rights]
