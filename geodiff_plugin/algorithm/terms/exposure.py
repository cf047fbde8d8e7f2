"""Take the difference in exposure and colour between two cameras out of a photometric comparison.

Data flow: right image seen from the left, left image, visible mask -> right image in the left one's exposure.
Paper: none; it names illumination as a limit (Limitations), and its loss takes both images as they are.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

__all__ = ["match_exposure"]

#: Gains beyond these say that two photographs do not show the same scene.
GAIN_RANGE = (0.2, 5.0)
#: Rows and columns of cells of the slow field: vignetting, sun from one side; and the share of a cell in view
#: that counts as much as what is known of the whole image.
CELLS, PRIOR = (4, 5), 0.2
#: Added to a spread, so that a blank image divides nothing by zero.
LEAST_SPREAD = 1e-3


def _moments(image: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation per sample and channel, ``(B, C, 1, 1)`` each."""
    total = weight.sum((-2, -1), keepdim=True).clamp_min(1.0)
    mean = (image * weight).sum((-2, -1), keepdim=True) / total
    square = ((image - mean) ** 2 * weight).sum((-2, -1), keepdim=True) / total
    return mean, (square + LEAST_SPREAD**2).sqrt()


def match_exposure(warped_01: Tensor, left_01: Tensor, visible: Tensor) -> Tensor:
    """Bring the warped right image to the left one's gain and bias per channel, and to its slow shading.

    In closed form: gain and bias make mean and spread over the visible pixels agree. A least-squares fit
    pixel by pixel would take every wrong depth for a lower gain. What remains of the difference in a coarse
    grid of cells is added as a smooth field.

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
    gain = (spread_left / spread_right).clamp(*GAIN_RANGE)
    matched = mean_left + gain * (warped_01 - mean_right)
    share = F.adaptive_avg_pool2d(weight, CELLS)
    field = F.adaptive_avg_pool2d((left_01 - matched) * weight, CELLS) / (share + PRIOR)
    return matched + F.interpolate(field, left_01.shape[-2:], mode="bilinear", align_corners=False)
