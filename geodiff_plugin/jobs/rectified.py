"""Detects whether images are rectified or raw if their calibration describes both.

OpenCV's samples, ROS and ORB-SLAM write the cameras before and after rectification into one file, which does
not state which images it belongs to. Matches between the images lie on the epipolar lines of one of the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from geodiff_plugin._internal.checks import warn
from geodiff_plugin.cameras import Camera, resized_px
from geodiff_plugin.findings import Finding
from geodiff_plugin.pose.tracks import MIN_MATCHES, Tracks, epipolar, reduced_grey, sparse_tracks
from geodiff_plugin.types import Rig

#: Quantile of the residuals for the comparison: the median of the better half, because outliers are
#: arbitrary.
QUANTILE = 0.25
#: Maximum residual in pixels for raw images.
MAX_RESIDUAL_PX = 2.0
#: Images are raw if the residual of the rectified cameras is larger by this factor.
MIN_RATIO = 3.0


def select_rig(rig: Rig, images_01: Sequence[np.ndarray]) -> Rig:
    """Return the rig, or ``rig.as_taken`` if it fits the first two of ``images_01 (H, W, 3)`` better."""
    if rig.as_taken is None or len(images_01) < 2:
        return rig
    left, right = _matches(rig, images_01)
    if len(left) < MIN_MATCHES:
        return rig
    rectified_px, taken_px = (off_lines_px(each, left, right) for each in (rig, rig.as_taken))
    if taken_px > MAX_RESIDUAL_PX or rectified_px < MIN_RATIO * taken_px:
        return rig
    sentence = (
        f"{rig.source} describes raw and rectified images. These images are raw: matches lie "
        f"{taken_px:.1f} px off their epipolar lines, {rectified_px:.1f} px if they were rectified."
    )
    warn(Finding("calibration.unrectified", sentence))
    return replace(rig.as_taken, source=rig.source)


def _matches(rig: Rig, images_01: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the pixels ``(N, 2)`` of matches in both images ``(H, W, 3)``."""
    pair = images_01[:2]
    views = [
        reduced_grey(torch.from_numpy(image).permute(2, 0, 1), Camera(camera.K))
        for image, camera in zip(pair, (rig.left, rig.right), strict=True)
    ]
    tracks = sparse_tracks(views)
    return [
        resized_px(px, view.grey.shape[::-1], image.shape[1::-1])
        for px, view, image in zip((tracks.left_px, tracks.right_px[0]), views, pair, strict=True)
    ]


def off_lines_px(rig: Rig, left: np.ndarray, right: np.ndarray) -> float:
    """Return the distance of matches ``(N, 2)`` from their epipolar lines in pixels, at ``QUANTILE``."""
    left, right = rig.left.undistorted_px(left), rig.right.undistorted_px(right)
    tracks = Tracks(left, right[None], np.ones((1, len(left)), bool), rig.K_left, rig.K_right[None])
    with np.errstate(invalid="ignore"):  # a lens may not see a pixel
        off_px = np.abs(epipolar(tracks, rig.T_right_from_left).off_px)
    return float(np.quantile(np.nan_to_num(off_px, nan=np.inf), QUANTILE))
