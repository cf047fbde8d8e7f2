"""Distortion left in both pictures of a pair, by how residuals grow with the distance from the centre."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from geodiff_plugin.pose.tracks import FEWEST, Tracks, across_lines, blocks, residuals_px

#: Matches further off their epipolar lines than this are wrong, pixels.
MOST_OFF_PX = 12.0
#: Steps of the fit, each of which weighs the matches anew.
STEPS = 6
#: Step of the numerical derivative by k1.
STEP_K1 = 0.01
#: No lens of a camera with a rectilinear picture has more.
MOST_K1 = 0.6
#: So many standard errors of an estimate are not counted.
UNCERTAIN = 4.0


def _without(px: np.ndarray, K: np.ndarray, k1: float) -> np.ndarray:
    """Pixels ``(N, 2)`` of a picture from which a distortion ``k1`` is removed."""
    return cv2.undistortPoints(px[:, None], K, np.array([k1, 0.0, 0.0, 0.0]), P=K)[:, 0]


def _residuals(tracks: Tracks, T: np.ndarray, k1: float) -> np.ndarray:
    """Signed distances ``(N,)`` from the epipolar lines without a distortion of both pictures, pixels."""
    left_px = _without(tracks.left_px, tracks.K_left, k1)
    right_px = _without(tracks.right_px[0], tracks.K_rights[0], k1)
    return across_lines(replace(tracks, left_px=left_px, right_px=right_px[None]), T)[0]


def remaining_distortion(tracks: Tracks, T: np.ndarray) -> float:
    """The radial coefficient k1, of OpenCV's model, that both pictures still have for certain.

    It minimises ``sum_i rho(e_i(k1) + c)``, with ``e_i`` the signed distance of match i from its epipolar
    line when ``k1`` is removed from both pictures, ``c`` a shift across the lines, and Cauchy's ``rho``;
    the estimate is moved towards 0 by ``UNCERTAIN`` standard errors. The standard error is the larger of two:
    as if matches erred independently, and as the sums over blocks of the left image show, since neighbours
    err alike.

    Args:
        tracks: of one right view.
        T: ``(4, 4)`` ``T_right_from_left``.

    Returns:
        ``k1``; 0 where nothing is certain, NaN for too few matches.
    """
    tracks = tracks.kept(residuals_px(tracks, T[None])[0] < MOST_OFF_PX)
    if len(tracks) < FEWEST:
        return float("nan")
    k1 = 0.0
    for _ in range(STEPS):
        off = _residuals(tracks, T, k1)
        ahead, behind = (_residuals(tracks, T, k1 + way * STEP_K1) for way in (1, -1))
        A = np.c_[(ahead - behind) / (2 * STEP_K1), np.ones(len(tracks))]
        scale = max(1.4826 * float(np.median(np.abs(off - np.median(off)))), 0.1)
        weight = 1.0 / (1.0 + ((off - np.median(off)) / (2.0 * scale)) ** 2)
        H = (A * weight[:, None]).T @ A + 1e-9 * np.eye(2)
        step = np.linalg.solve(H, (A * weight[:, None]).T @ off)
        k1 = float(np.clip(k1 - step[0], -MOST_K1, MOST_K1))
    inverse, pulls = np.linalg.inv(H), A * (weight * (off - A @ step))[:, None]
    error = max(scale * float(np.sqrt(inverse[0, 0])), _error_by_blocks(inverse, pulls, blocks(tracks)))
    return float(np.sign(k1)) * max(abs(k1) - UNCERTAIN * error, 0.0)


def _error_by_blocks(inverse: np.ndarray, pulls: np.ndarray, block: np.ndarray) -> float:
    """Standard error of the first unknown where the matches of a block ``(N,)`` may err alike.

    From the inverse ``(2, 2)`` of the normal equations' matrix, and what every match adds to their right
    side at the minimum, ``pulls (N, 2)``.
    """
    of_blocks = np.stack([np.bincount(block, pull) for pull in pulls.T], axis=1)
    return float(np.sqrt((inverse @ of_blocks.T @ of_blocks @ inverse)[0, 0]))
