"""Take the difference in exposure and colour between two cameras out of a photometric comparison.

Data flow: right image seen from the left, left image, visible mask -> right image in the left one's exposure.
Paper: none; it names illumination as a limit (Limitations), and its loss takes both images as they are.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.guidance.presets import DEFAULT

__all__ = ["match_exposure"]

#: Added to a spread, so that a blank image divides nothing by zero.
LEAST_SPREAD = 1e-3


def _moments(image: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation per sample and channel, ``(B, C, 1, 1)`` each."""
    total = weight.sum((-2, -1), keepdim=True).clamp_min(1.0)
    mean = (image * weight).sum((-2, -1), keepdim=True) / total
    square = ((image - mean) ** 2 * weight).sum((-2, -1), keepdim=True) / total
    return mean, (square + LEAST_SPREAD**2).sqrt()


def match_exposure(
    warped_01: Tensor,
    left_01: Tensor,
    visible: Tensor,
    *,
    gain_range: tuple[float, float] = DEFAULT.terms.exposure_gain,
    cells: tuple[int, int] = (DEFAULT.terms.exposure_rows, DEFAULT.terms.exposure_columns),
    prior: float = DEFAULT.terms.exposure_prior,
) -> Tensor:
    """Bring the warped right image to the left one's gain and bias per channel, and to its slow shading.

    In closed form: gain and bias make mean and spread over the visible pixels agree. A least-squares fit
    pixel by pixel would take every wrong depth for a lower gain. What remains of the difference in a coarse
    grid of cells is added as a smooth field.

    Args:
        warped_01: ``(B, 3, H, W)`` in [0, 1].
        left_01: ``(B, 3, H, W)`` in [0, 1].
        visible: ``(B, 1, H, W)`` bool or float, what is compared.
        gain_range: least and greatest gain.
        cells: rows and columns of the slow field.
        prior: share of a cell in view that counts as much as what is known of the whole image.

    Returns:
        ``(B, 3, H, W)``, about [0, 1]; differentiable in ``warped_01``.
    """
    weight = visible.to(left_01.dtype)
    mean_left, spread_left = _moments(left_01, weight)
    mean_right, spread_right = _moments(warped_01, weight)
    gain = (spread_left / spread_right).clamp(*gain_range)
    matched = mean_left + gain * (warped_01 - mean_right)
    share = F.adaptive_avg_pool2d(weight, cells)
    field = F.adaptive_avg_pool2d((left_01 - matched) * weight, cells) / (share + prior)
    return matched + F.interpolate(field, left_01.shape[-2:], mode="bilinear", align_corners=False)
