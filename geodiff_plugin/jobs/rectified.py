"""Whether pictures are rectified or as they were taken, where their calibration describes both.

OpenCV's samples, ROS and ORB-SLAM write the cameras as they stand and what rectification makes of them into
one file, and nothing says which pictures a user has. Matches of the pictures lie on the epipolar lines of one
of the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from geodiff_plugin._checks import warn
from geodiff_plugin.formats.lenses import undistorted_pixels
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.tracks import (
    FEWEST,
    LONG_SIDE,
    Tracks,
    epipolar,
    grey_image,
    rays_through,
    sparse_tracks,
)
from geodiff_plugin.types import Rig

#: Wrong matches lie anywhere, so the better half of all is looked at, by its middle.
QUANTILE = 0.25
#: The pictures may be as taken where the cameras as they stand leave matches within so many pixels of their
#: epipolar lines.
MOST_RESIDUAL_PX = 2.0
#: Then they are as taken if the rectified cameras leave the matches farther off by this factor.
FURTHER_OFF = 3.0


def fitting_rig(rig: Rig, images_01: Sequence[np.ndarray]) -> Rig:
    """The rig, or ``rig.as_taken`` where the first two of ``images_01 (H, W, 3)`` fit that better."""
    if rig.as_taken is None or len(images_01) < 2:
        return rig
    left, right = _matches(images_01[0], images_01[1])
    if len(left) < FEWEST:
        return rig
    rectified_px, taken_px = (off_lines_px(each, left, right) for each in (rig, rig.as_taken))
    if taken_px > MOST_RESIDUAL_PX or rectified_px < FURTHER_OFF * taken_px:
        return rig
    sentence = (
        f"{rig.source} describes the pictures as they were taken and rectified ones, and these are as taken: "
        f"matches lie {taken_px:.1f} px off their lines, {rectified_px:.1f} px if they were rectified."
    )
    warn(Message("calibration.as-taken", sentence))
    return replace(rig.as_taken, source=rig.source)


def _matches(left_01: np.ndarray, right_01: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels ``(N, 2)`` of both pictures in which they match."""
    views = []
    for image_01 in (left_01, right_01):
        image = torch.from_numpy(image_01).permute(2, 0, 1)
        views.append(grey_image(image, torch.eye(3), min(1.0, LONG_SIDE / max(image_01.shape[:2]))))
    tracks = sparse_tracks(views)
    # With K = 1 the rays of the reduced images are pixels of the images themselves.
    left = rays_through(tracks.left_px, tracks.K_left)
    right = rays_through(tracks.right_px[0], tracks.K_rights[0])
    return left[:, :2], right[:, :2]


def off_lines_px(rig: Rig, left: np.ndarray, right: np.ndarray) -> float:
    """How far the better half of matches ``(N, 2)`` lies off its epipolar lines, pixels, by its middle."""
    Ks = rig.K_left, rig.K_right
    straight = [
        pixels if lens is None else undistorted_pixels(pixels, K, lens)
        for pixels, K, lens in zip((left, right), Ks, rig.distortion, strict=True)
    ]
    tracks = Tracks(
        straight[0], straight[1][None], np.ones((1, len(left)), bool), rig.K_left, rig.K_right[None]
    )
    with np.errstate(invalid="ignore"):  # a lens may not see a pixel
        off_px = np.abs(epipolar(tracks, rig.T_right_from_left).off_px)
    return float(np.quantile(np.nan_to_num(off_px, nan=np.inf), QUANTILE))
