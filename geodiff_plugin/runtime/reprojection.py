"""Photometric error and visibility of a depth map in the right views, at the output's resolution.

Data flow: depth in metres, right views -> where any of them sees the pixel, photometric error.
Paper: Eq. 14's re-rendered left image, as a per-pixel report.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from geodiff_plugin.algorithm.evidence import as_fine_as
from geodiff_plugin.algorithm.terms.exposure import match_exposure
from geodiff_plugin.formats.depth import row_strips
from geodiff_plugin.geometry.warping import warp_right_to_left
from geodiff_plugin.types import CameraView

__all__ = ["reprojection"]


def reprojection(
    views: Sequence[CameraView], depth_m: Tensor, left_01: Tensor, K_left: Tensor
) -> tuple[Tensor, Tensor]:
    """Where any right view sees the pixel, and the least mean absolute error to the re-rendered left image.

    The error is that of the view that explains the pixel best, compared in the left image's exposure.

    Args:
        views: the right views of one image, native.
        depth_m: ``(1, 1, H, W)`` metres.
        left_01: ``(1, 3, H, W)`` in [0, 1].
        K_left: ``(1, 3, 3)`` pixels of that grid.

    Returns:
        ``(1, 1, H, W)`` bool and float in [0, 1], 0 where no view sees the pixel.
    """
    best, visible = torch.full_like(depth_m, torch.inf), torch.zeros_like(depth_m, dtype=torch.bool)
    for image, K_right, T in views:
        image, K_right = as_fine_as(image, K_right, K_left[0])
        warped, seen = _warped(image[None], depth_m, K_left, K_right[None], T[None])
        error = torch.zeros_like(depth_m)
        for channel in range(left_01.shape[1]):  # one by one: at this size a copy of all three counts
            own = slice(channel, channel + 1)
            matched = match_exposure(warped[:, own], left_01[:, own], seen)
            error += matched.sub_(left_01[:, own]).abs_()
        error /= left_01.shape[1]
        best = torch.where(seen, torch.minimum(best, error), best)
        visible |= seen
    return visible, best.where(visible, torch.zeros_like(best))


def _warped(
    right_01: Tensor, depth_m: Tensor, K_left: Tensor, K_right: Tensor, T_right_from_left: Tensor
) -> tuple[Tensor, Tensor]:
    """The right image on the left grid and where it is visible, a strip of rows at a time.

    Rays and places to sample at take ten times the memory of the image that comes of them.
    """
    height, width = depth_m.shape[-2:]
    warped = right_01.new_empty((1, right_01.shape[1], height, width))
    visible = torch.empty_like(depth_m, dtype=torch.bool)
    for rows in row_strips(height, width):
        K_strip = K_left.clone()
        K_strip[:, 1, 2] -= rows.start
        part = warp_right_to_left(right_01, depth_m[:, :, rows], K_strip, K_right, T_right_from_left)
        warped[:, :, rows], visible[:, :, rows] = part.image, part.visible
    return warped, visible
