"""Computes the geometric standard error of matched depths, and the confidence left by the checks' facts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._internal.strips import row_strips
from geodiff_plugin.cameras import Camera, View, rays_of_pixels
from geodiff_plugin.geometry import image_size
from geodiff_plugin.result.confidence import RIGHT_WITHIN
from geodiff_plugin.trust import NO_ERROR, MatchError

#: Standard deviation of a good match, pixels of the left image.
MATCH_NOISE_PX = 0.25


def expected_error(
    depth_m: np.ndarray,
    K_left: np.ndarray,
    poses: Sequence[np.ndarray],
    scale_rel_std: float = 0.0,
    extra: MatchError = NO_ERROR,
) -> np.ndarray:
    """Compute the geometric standard error of a matched depth, ``(H, W)`` metres: ``z^2 sigma_d / (f b)``.

    For a general pose it is ``(z - t_z)^2 sigma_d / |f (t_xy - r_xy t_z)|``, with the pixel's ray ``r`` and
    the right camera's centre ``t``; the minimum over ``poses (4, 4)``. Rotations do not change it.
    ``sigma_d`` is the noise of a match and the ``extra`` error in pixels. Relative errors are added: the
    larger of ``scale_rel_std``, of the poses' length, and of ``extra``; and the fraction ``k1 (|r_xy|^2
    + 2 r_b^2)`` by which a distortion of both images changes the shift between the views, with ``r_b`` the
    component of ``r_xy`` along the epipolar line.
    """
    height, width = depth_m.shape
    error_m = np.empty((height, width))
    noise_px = math.hypot(MATCH_NOISE_PX, extra.px)
    for rows in row_strips(height, width):
        ray_x, ray_y = rays_of_pixels(K_left, np.arange(width), np.arange(rows.start, rows.stop)[:, None])
        z_m = depth_m[rows]
        best = np.full((rows.stop - rows.start, width), np.inf)
        for E in poses:
            shift_x, shift_y = E[0, 3] - ray_x * E[2, 3], E[1, 3] - ray_y * E[2, 3]
            px_m = np.hypot(K_left[0, 0] * shift_x, K_left[1, 1] * shift_y)
            with np.errstate(divide="ignore"):
                error = (z_m - E[2, 3]) ** 2 * noise_px / px_m
            if extra.distortion:
                along = (ray_x * shift_x + ray_y * shift_y) ** 2 / (shift_x**2 + shift_y**2 + 1e-12)
                error = np.hypot(error, extra.distortion * (ray_x**2 + ray_y**2 + 2.0 * along) * z_m)
            best = np.minimum(best, error)
        error_m[rows] = np.hypot(best, max(scale_rel_std, extra.relative) * z_m)
    return error_m


def remaining_confidence(depth_m: Tensor, camera: Camera, views: Sequence[View], extra: MatchError) -> Tensor:
    """Compute the factor ``(1, 1, H, W)`` in [0, 1] by which an ``extra`` error reduces confidence.

    A depth that is correct by its own evidence has the error of its match. The ``extra`` error is independent
    and adds to it. The sum of normal errors is normal, and one with relative standard deviation ``s`` is
    below ``RIGHT_WITHIN`` with probability ``erf(RIGHT_WITHIN / (sqrt(2) s))``. The factor is this
    probability with the ``extra`` error divided by the one without it.
    """
    z_m = depth_m[0, 0].numpy(force=True)
    K = camera.K.astype(np.float64)
    poses = [np.linalg.inv(view.T_right_from_left.astype(np.float64)) for view in views]
    without, with_extra = (
        torch.from_numpy(z_m / expected_error(z_m, K, poses, extra=each)) for each in (NO_ERROR, extra)
    )
    within = RIGHT_WITHIN / math.sqrt(2.0)
    fraction = torch.erf(within * with_extra) / torch.erf(within * without)
    return fraction.view(1, 1, *image_size(depth_m)).to(depth_m)
