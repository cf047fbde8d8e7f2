"""Whether pictures are rectified or as they were taken, where their calibration describes both.

OpenCV's samples, ROS and ORB-SLAM write the cameras as they stand and what rectification makes of them into
one file, and nothing says which pictures a user has. Matches of the pictures lie on the epipolar lines of one
of the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from geodiff_plugin._checks import warn
from geodiff_plugin.formats.lenses import undistorted_pixels
from geodiff_plugin.messages import Message
from geodiff_plugin.types import Rig

#: Longest side of the pictures in which matches are sought.
LONGEST_SIDE = 1280
#: Features of each picture, at most.
MOST_FEATURES = 3000
#: The best match of a feature is nearer than the second by this factor (Lowe's ratio).
DISTINCT = 0.75
#: With fewer matches pictures are taken to be rectified.
LEAST_MATCHES = 40
#: Wrong matches lie anywhere: the better half of all is looked at, by its middle.
QUANTILE = 0.25
#: The pictures are as taken where that leaves matches within so many pixels of their lines,
MOST_RESIDUAL_PX = 1.5
#: and what rectification makes of the cameras leaves them further off by this factor.
FURTHER_OFF = 3.0


def fitting_rig(rig: Rig, images_01: Sequence[np.ndarray]) -> Rig:
    """The rig, or ``rig.as_taken`` where the first two of ``images_01 (H, W, 3)`` fit that better."""
    if rig.as_taken is None or len(images_01) < 2:
        return rig
    left, right = _matches(images_01[0], images_01[1])
    if len(left) < LEAST_MATCHES:
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
    """Pixels ``(N, 2)`` of features of both pictures that are each other's nearest."""
    sift = cv2.SIFT.create(MOST_FEATURES)
    found = []
    for image_01 in (left_01, right_01):
        factor = min(1.0, LONGEST_SIDE / max(image_01.shape[:2]))
        grey = cv2.cvtColor((image_01 * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        features, of_each = sift.detectAndCompute(small, np.empty(0))
        points = cv2.KeyPoint.convert(features)
        found.append(((np.reshape(points, (-1, 2)) + 0.5) / factor - 0.5, of_each))
    (left, of_left), (right, of_right) = found
    if len(left) < 2 or len(right) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher().knnMatch(of_left, of_right, k=2)
    best = [first for first, second in pairs if first.distance < DISTINCT * second.distance]
    rows = np.array([(match.queryIdx, match.trainIdx) for match in best], int).reshape(-1, 2)
    return left[rows[:, 0]], right[rows[:, 1]]


def off_lines_px(rig: Rig, left: np.ndarray, right: np.ndarray) -> float:
    """How far the better half of matches ``(N, 2)`` lies off its epipolar lines, by its middle (Sampson)."""
    rays = []
    for pixels, K, lens in zip((left, right), (rig.K_left, rig.K_right), rig.distortion, strict=True):
        straight = pixels if lens is None else undistorted_pixels(pixels, K, lens)
        homogeneous = np.column_stack([straight, np.ones(len(straight))])
        rays.append(homogeneous)
    T = rig.T_right_from_left
    x, y, z = T[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ T[:3, :3]
    F = np.linalg.inv(rig.K_right).T @ essential @ np.linalg.inv(rig.K_left)
    lines_right, lines_left = rays[0] @ F.T, rays[1] @ F
    slope = (lines_right[:, :2] ** 2).sum(1) + (lines_left[:, :2] ** 2).sum(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.abs((rays[1] * lines_right).sum(1)) / np.sqrt(slope)
    return float(np.quantile(np.nan_to_num(off, nan=np.inf), QUANTILE))
