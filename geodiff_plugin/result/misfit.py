"""Errors that the matches of a run show: the standard error of its depth, and what they take from confidence.

A matched depth has the error of its match, by the geometry of the cameras. Where matches also miss cameras
that are given, by more than in any right pair, as much error is expected in the shifts between the views. A
pose whose length was not measured leaves an error that all depths share.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._strips import row_strips
from geodiff_plugin.geometry import image_size
from geodiff_plugin.result.confidence import RIGHT_WITHIN
from geodiff_plugin.result.indicators import pixels_of_matches
from geodiff_plugin.types import CameraView, Indicators

#: Standard deviation of a good match, pixels of the left image.
MATCH_NOISE_PX = 0.25
#: Residual of the matches across their epipolar lines that right pairs of a rectified rig have, pixels of
#: their grid: as much error as there is beyond it is expected along the lines, where it changes depth. Under
#: any other pose all of the residual is: the log loss of 90 pairs of three trackers is within .001 of its
#: least up to 1.25 of it, and that of rendered pairs falls as more of it counts.
USUAL_PX = 0.45
#: Root mean square displacement of right images that brings matches of right pairs to their lines, pixels.
USUAL_BEND_PX = 1.0
#: Share of the matches that lie behind infinity in right pairs: on blank walls, a few of few matches.
USUAL_BEHIND = 0.04
#: Radial coefficient k1 that right pairs seem to have.
USUAL_DISTORTION = 0.08
#: Shear of the right picture along its rows, in shares of its width, that right pairs seem to have.
USUAL_SHEAR = 0.001
#: Relative error that all depths share under a pose whose length was not measured, in stated spreads of its
#: scale. The log loss of 90 pairs of three trackers is within .002 of its least from .75 to .9, and
#: higher by .008 at .65.
SCALE_SHARE = 0.85
#: The same relative error in changes of log depth by another pose that fits as well: the pose in use lies
#: between that one and the given one. The loss of 77 pairs of trackers is within .001 of its least from .3 to
#: .5, and right pairs lose least of their confidence at .3.
SPREAD_SHARE = 0.3
#: What is beyond this change counts in full: right pairs have less.
USUAL_SPREAD = 0.15


class Misfit(NamedTuple):
    """Errors that matches show: those that right pairs do not have, and those of a pose that is not exact."""

    px: float = 0.0  # standard deviation of the shift between the views, pixels of the left image
    distortion: float = 0.0  # size of the radial coefficient k1 that both pictures still have
    relative: float = 0.0  # relative standard deviation of all depths together


NO_MISFIT = Misfit()


def misfit_of(found: Indicators, size: tuple[int, int]) -> Misfit:
    """The misfit of a run on a left image of ``size`` ``(H, W)``, by its indicators; 0 where unknown."""
    usual_px = USUAL_PX if found.rectified else 0.0
    across_px = math.hypot(
        _beyond(found.epipolar_px, usual_px), _beyond(found.straightened_px, USUAL_BEND_PX)
    )
    behind_px = found.behind_px if found.behind_infinity > USUAL_BEHIND else 0.0
    # Root mean square of a shift that grows from nothing at one edge of the picture.
    sheared_px = abs(found.shear) * size[1] / math.sqrt(3.0) if abs(found.shear) > USUAL_SHEAR else 0.0
    return Misfit(
        math.hypot(across_px * pixels_of_matches(size), behind_px, sheared_px),
        0.0 if math.isnan(found.distortion) else max(0.0, abs(found.distortion) - USUAL_DISTORTION),
        _relative_of_pose(found.scale_spread, found.depth_spread),
    )


def _relative_of_pose(scale_spread: float, depth_spread: float) -> float:
    """Relative standard deviation that a pose of uncertain length or shape gives all depths."""
    return math.hypot(
        SCALE_SHARE * _known(scale_spread),
        max(SPREAD_SHARE * _known(depth_spread), _beyond(depth_spread, USUAL_SPREAD)),
    )


def _beyond(deviation: float, usual: float) -> float:
    """Standard deviation that a usual one leaves of another; 0 where that is unknown."""
    return math.sqrt(max(0.0, _known(deviation) ** 2 - usual**2))


def _known(deviation: float) -> float:
    """A standard deviation, 0 where it is unknown."""
    return 0.0 if math.isnan(deviation) else deviation


def expected_error(
    depth_m: np.ndarray,
    K_left: np.ndarray,
    poses: Sequence[np.ndarray],
    scale_spread: float = 0.0,
    misfit: Misfit = NO_MISFIT,
) -> np.ndarray:
    """Standard error of a matched depth by geometry alone, ``(H, W)`` metres: ``z^2 sigma_d / (f b)``.

    For a general pose ``(z - t_z)^2 sigma_d / |f (t_xy - r_xy t_z)|``, with the pixel's ray ``r`` and the
    right camera's centre ``t``; the least over ``poses (4, 4)``. Rotations do not change it. ``sigma_d`` is
    the noise of a match and the ``misfit`` in pixels. Relative errors add to it: ``scale_spread``, that of
    the poses' length, or that of the misfit, if larger, and the share ``k1 (|r_xy|^2 + 2 r_b^2)`` by which a
    distortion of both pictures changes the shift between the views, ``r_b`` being the part of ``r_xy`` along
    the epipolar line.
    """
    height, width = depth_m.shape
    error_m = np.empty((height, width))
    noise_px = math.hypot(MATCH_NOISE_PX, misfit.px)
    ray_x = (np.arange(width) - K_left[0, 2]) / K_left[0, 0]
    for rows in row_strips(height, width):
        ray_y = (np.arange(rows.start, rows.stop)[:, None] - K_left[1, 2]) / K_left[1, 1]
        z_m = depth_m[rows]
        best = np.full((rows.stop - rows.start, width), np.inf)
        for E in poses:
            moved_x, moved_y = E[0, 3] - ray_x * E[2, 3], E[1, 3] - ray_y * E[2, 3]
            px_m = np.hypot(K_left[0, 0] * moved_x, K_left[1, 1] * moved_y)
            with np.errstate(divide="ignore"):
                error = (z_m - E[2, 3]) ** 2 * noise_px / px_m
            if misfit.distortion:
                along = (ray_x * moved_x + ray_y * moved_y) ** 2 / (moved_x**2 + moved_y**2 + 1e-12)
                error = np.hypot(error, misfit.distortion * (ray_x**2 + ray_y**2 + 2.0 * along) * z_m)
            best = np.minimum(best, error)
        error_m[rows] = np.hypot(best, max(scale_spread, misfit.relative) * z_m)
    return error_m


def share_left(depth_m: Tensor, K_left: Tensor, views: Sequence[CameraView], misfit: Misfit) -> Tensor:
    """What a misfit leaves of the confidence of a depth ``(1, 1, H, W)``, shaped alike, in [0, 1].

    A depth that is right by its own evidence has the error of its match. Those of the misfit are independent
    of it and add to it. The sum of normal errors is normal, and one of relative size ``s`` is below
    ``RIGHT_WITHIN`` with a probability of ``erf(RIGHT_WITHIN / (sqrt(2) s))``. The share is this probability
    with the misfit over the one without it.
    """
    z_m, K = depth_m[0, 0].numpy(force=True), K_left.double().numpy(force=True)
    poses = [np.linalg.inv(view.T_right_from_left.double().numpy(force=True)) for view in views]
    without, with_it = (
        torch.from_numpy(z_m / expected_error(z_m, K, poses, misfit=each)) for each in (NO_MISFIT, misfit)
    )
    within = RIGHT_WITHIN / math.sqrt(2.0)
    share = torch.erf(within * with_it) / torch.erf(within * without)
    return share.view(1, 1, *image_size(depth_m)).to(depth_m)
