"""Photometric error between the left image and the right ones seen through an estimate.

Source: S4.2, Eq. 14 (eq:geo-loss). Deviations: only visible pixels count, differences in exposure are taken
out, and the error is averaged over an image pyramid.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.config import GuidanceConfig

#: A pyramid level with a shorter side than this says nothing that its parent does not.
MIN_SIDE = 24
#: SSIM's two constants for images in [0, 1], and the 3 taps of its Gaussian window of 1.5 pixels.
C1, C2, LEAST = 0.01**2, 0.03**2, 1e-12
BESIDE = math.exp(-0.5 / 1.5**2)
BESIDE, CENTRE = BESIDE / (1.0 + 2.0 * BESIDE), 1.0 / (1.0 + 2.0 * BESIDE)
#: More than any error of a view that sees the pixel.
UNSEEN = 2.0
#: Added to a spread, so that a blank image divides nothing by zero.
LEAST_SPREAD = 1e-3
#: Gains beyond these say that two photographs do not show the same scene.
GAINS = (0.2, 5.0)
#: Rows and columns of the field of slow shading: vignetting, sun from one side; and the share of a cell in
#: view that counts as much as the mean of the whole image.
CELLS, CELL_PRIOR = (4, 5), 0.2


def masked_mean(value: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean ``(B,)`` of ``value (B, C, H, W)`` by ``weight (B, 1, H, W)``, bool or float >= 0.

    It is 0, without a gradient, for a sample whose weights are all zero. Whoever must not go on without a
    valid pixel checks the visible fraction first.
    """
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

    Both images are ``(B, C, H, W)`` in [0, 1], the result is in [-1, 1]; as ``kornia.metrics.ssim(a, b, 3)``,
    which makes its window of a list at every call, and so waits for the device.

    Source: Wang et al. 2004, "Image quality assessment", Eq. 13.
    """
    moments = F.pad(torch.cat([a, b, a * a, b * b, a * b], 1), (1, 1, 1, 1), mode="reflect")
    moments = BESIDE * (moments[..., :-2] + moments[..., 2:]) + CENTRE * moments[..., 1:-1]
    moments = BESIDE * (moments[..., :-2, :] + moments[..., 2:, :]) + CENTRE * moments[..., 1:-1, :]
    mean_a, mean_b, square_a, square_b, product = moments.chunk(5, 1)
    means, squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
    covariance, variances = product - means, square_a + square_b - squares
    return (2.0 * means + C1) * (2.0 * covariance + C2) / ((squares + C1) * (variances + C2) + LEAST)


def _moments(image: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation per sample and channel, ``(B, C, 1, 1)`` each."""
    total = weight.sum((-2, -1), keepdim=True).clamp_min(1.0)
    mean = (image * weight).sum((-2, -1), keepdim=True) / total
    square = ((image - mean) ** 2 * weight).sum((-2, -1), keepdim=True) / total
    return mean, (square + LEAST_SPREAD**2).sqrt()


def match_exposure(warped_01: Tensor, left_01: Tensor, visible: Tensor) -> Tensor:
    """Bring warped right images to the left one's gain and bias per channel, and to its slow shading.

    In closed form: gain and bias make mean and spread over the visible pixels agree. A least-squares fit
    pixel by pixel would take every wrong depth for a lower gain. What remains of the difference in a coarse
    grid of cells is added as a smooth field. Beyond the paper, which names illumination as a limit.

    Args:
        warped_01: ``(B, 3, H, W)`` in [0, 1].
        left_01: ``(B, 3, H, W)`` in [0, 1].
        visible: ``(B, 1, H, W)`` bool or float, what is compared.

    Returns:
        ``(B, 3, H, W)``, about [0, 1]; differentiable in ``warped_01``.
    """
    weight = visible.to(left_01.dtype)
    mean_left, spread_left = _moments(left_01, weight)
    mean_right, spread_right = _moments(warped_01, weight)
    gain = (spread_left / spread_right).clamp(*GAINS)
    matched = mean_left + gain * (warped_01 - mean_right)
    share = F.adaptive_avg_pool2d(weight, CELLS)
    field = F.adaptive_avg_pool2d((left_01 - matched) * weight, CELLS) / (share + CELL_PRIOR)
    return matched + F.interpolate(field, left_01.shape[-2:], mode="bilinear", align_corners=False)


def photometric(left_01: Tensor, warped_01: Tensor, visible: Tensor, config: GuidanceConfig) -> Tensor:
    """Mean photometric error over the visible pixels, averaged over an image pyramid.

    With several right views each pixel takes the one that explains it best among those that see it: a view
    in which something hides the pixel then does not count.

    Args:
        left_01: ``(B, 3, H, W)`` in [0, 1].
        warped_01: ``(B, V, 3, H, W)`` every right image seen from the left.
        visible: ``(B, V, 1, H, W)`` bool, what is compared.
        config: ``eta``, ``pyramid_levels`` (1 is the paper's; coarser levels widen the basin of attraction)
            and ``exposure``.

    Returns:
        ``(B,)`` float in [0, 1]; differentiable in the depth through ``warped_01`` (bilinear, so the gradient
        is zero where the right image is constant and jumps where a sample crosses a pixel centre).

    Source: Eq. 14 (eq:geo-loss). Deviation: the mask (the paper's mean over all pixels rewards depths that
    push pixels out of the right image) and the pyramid. Minimum over views: Godard et al. 2019, "Digging into
    self-supervised monocular depth estimation", Eq. 4.
    """
    views = warped_01.shape[1]
    left = left_01.repeat_interleave(views, 0)  # (B V, 3, H, W), a view's pixels by themselves
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
