"""Photometric error between the left image and the right ones seen through the estimate.

Data flow: ``Estimate`` -> ``(B,)`` in [0, 1].
Paper: S4.2, Eq. 14 (eq:geo-loss).
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.terms.base import Estimate, masked_mean
from geodiff_plugin.algorithm.terms.exposure import match_exposure
from geodiff_plugin.config import DEFAULT

__all__ = ["photometric", "photometric_map", "ssim"]

#: A pyramid level with a shorter side than this says nothing that its parent does not.
MIN_SIDE = 24
#: SSIM's two constants for images in [0, 1], and the 3 taps of its Gaussian window of 1.5 pixels.
C1, C2, LEAST = 0.01**2, 0.03**2, 1e-12
BESIDE = math.exp(-0.5 / 1.5**2)
BESIDE, CENTRE = BESIDE / (1.0 + 2.0 * BESIDE), 1.0 / (1.0 + 2.0 * BESIDE)
#: More than any error of a view that sees the pixel.
UNSEEN = 2.0


def photometric_map(left_01: Tensor, warped_01: Tensor, eta: float) -> Tensor:
    """Per-pixel ``eta (1 - SSIM) / 2 + (1 - eta) L1``.

    Args:
        left_01: ``(B, 3, H, W)`` in [0, 1].
        warped_01: ``(B, 3, H, W)`` in [0, 1].
        eta: weight of SSIM, [0, 1].

    Returns:
        ``(B, 3, H, W)`` in [0, 1].

    Source: Eq. 14 (eq:geo-loss). The paper gives no window; 3x3 follows the works it cites.
    """
    return (
        eta * ((1.0 - ssim(left_01, warped_01)) / 2.0).clamp(0.0, 1.0)
        + (1.0 - eta) * (left_01 - warped_01).abs()
    )


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity of every pixel, in a Gaussian window of 3x3 pixels, reflected at the border.

    Args:
        a: ``(B, C, H, W)`` in [0, 1].
        b: the same.

    Returns:
        ``(B, C, H, W)`` in [-1, 1]; as ``kornia.metrics.ssim(a, b, 3)``, which makes its window of a list at
        every call, and so waits for the device.

    Source: Wang et al. 2004, "Image quality assessment", Eq. 13.
    """
    moments = F.pad(torch.cat([a, b, a * a, b * b, a * b], 1), (1, 1, 1, 1), mode="reflect")
    moments = BESIDE * (moments[..., :-2] + moments[..., 2:]) + CENTRE * moments[..., 1:-1]
    moments = BESIDE * (moments[..., :-2, :] + moments[..., 2:, :]) + CENTRE * moments[..., 1:-1, :]
    mean_a, mean_b, square_a, square_b, product = moments.chunk(5, 1)
    means, squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
    covariance, variances = product - means, square_a + square_b - squares
    return (2.0 * means + C1) * (2.0 * covariance + C2) / ((squares + C1) * (variances + C2) + LEAST)


def photometric(
    estimate: Estimate,
    *,
    eta: float = DEFAULT.eta,
    pyramid_levels: int = DEFAULT.pyramid_levels,
    exposure: bool = DEFAULT.exposure,
) -> Tensor:
    """Mean photometric error over the visible pixels, averaged over an image pyramid.

    With several right views each pixel takes the one that explains it best among those that see it: a view
    in which something hides the pixel then does not count.

    Args:
        estimate: needs ``left_01``, ``warped_01`` and ``visible``.
        eta: weight of SSIM against L1.
        pyramid_levels: 1 is the paper's; coarser levels widen the basin of attraction.
        exposure: compare in the left image's exposure (``exposure.match_exposure``).

    Returns:
        ``(B,)`` float; differentiable in the depth through ``warped_01`` (bilinear, so the gradient is
        zero where the right image is constant and jumps where a sample crosses a pixel centre).

    Source: Eq. 14 (eq:geo-loss). Deviation: masked to visible pixels (the paper's mean over all
    pixels rewards depths that push pixels out of the right image), and the pyramid. Minimum over views:
    Godard et al. 2019, "Digging into self-supervised monocular depth estimation", Eq. 4.
    """
    views = estimate.warped_01.shape[1]
    left = estimate.left_01.repeat_interleave(views, 0)  # (B V, 3, H, W), a view's pixels by themselves
    warped = estimate.warped_01.flatten(0, 1)
    mask = estimate.visible.flatten(0, 1).to(left.dtype)
    if exposure:
        warped = match_exposure(warped, left, mask)
    total, levels = left.new_zeros(()), 0
    for level in range(pyramid_levels):
        if level:
            if min(left.shape[-2:]) < 2 * MIN_SIDE:
                break
            # Masked averaging: a coarse pixel is the mean of its visible fine ones.
            seen = F.avg_pool2d(mask, 2)
            left = F.avg_pool2d(left * mask, 2) / seen.clamp_min(1e-6)
            warped = F.avg_pool2d(warped * mask, 2) / seen.clamp_min(1e-6)
            mask = (seen > 0.5).to(left.dtype)
        total = total + masked_mean(*_best_explained(photometric_map(left, warped, eta), mask, views))
        levels += 1
    return total / levels


def _best_explained(error: Tensor, mask: Tensor, views: int) -> tuple[Tensor, Tensor]:
    """Least error over the views that see a pixel, and whether any does, ``(B, 1, H, W)`` each."""
    error = error.mean(1, keepdim=True).unflatten(0, (-1, views))
    mask = mask.unflatten(0, (-1, views))
    return torch.where(mask > 0, error, torch.full_like(error, UNSEEN)).amin(1), mask.amax(1)
