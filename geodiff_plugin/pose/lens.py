"""Distortion left in both pictures of a pair, by how residuals grow with the distance from the centre."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._certain import SD_PER_MAD, certain_part
from geodiff_plugin.pose.tracks import FEWEST, TINY, Tracks, blocks, epipolar

#: Matches further off their epipolar lines than this are wrong, pixels.
MOST_OFF_PX = 12.0
#: Steps of the fit, each of which weighs the matches anew.
STEPS = 6
#: Step of the numerical derivative by k1.
STEP_K1 = 0.01
#: The same by a turn, radians.
STEP_TURN = 1e-4
#: No lens of a camera with a rectilinear picture has more.
MOST_K1 = 0.6
#: Steps to the rays without a distortion, as many as OpenCV takes.
STEPS_OF_RAYS = 5
#: So many standard errors above its estimate lies the bound of a distortion's size.
BOUND_ERRORS = 2.0


class _Pair(NamedTuple):
    """Matches as rays with z = 1, bent as their pictures are, and what the true rays give.

    The true left ray ``x`` and right ray ``y`` meet where ``y . m = 0`` with ``m = R x x t``.
    """

    bent: np.ndarray  # (2, 2 N) x and y of the left rays, then of the right ones
    lines: np.ndarray  # (5, 3) times x: m, then the normal of the line in pixels


def _pair(tracks: Tracks, T: np.ndarray) -> _Pair:
    right = np.c_[tracks.right_px[0], np.ones(len(tracks))] @ np.linalg.inv(tracks.K_rights[0]).T
    tx, ty, tz = T[:3, 3]
    m = np.array([[0.0, tz, -ty], [-tz, 0.0, tx], [ty, -tx, 0.0]]) @ T[:3, :3]
    normals = np.linalg.inv(tracks.K_rights[0])[:, :2].T @ m
    bent = np.concatenate([tracks.rays, right])[:, :2].T
    return _Pair(np.ascontiguousarray(bent), np.concatenate([m, normals]))


def undistorted_rays(bent: np.ndarray, k1s: np.ndarray) -> np.ndarray:
    """Rays ``(M, N, 2)`` without the radial distortions ``k1s (M,)``, of bent ones ``(2, N)``, x and y.

    They are the fixed points of ``x = bent / (1 + k1 |x|^2)``, sought as ``cv2.undistortPoints`` does, which
    takes several times as long, because it evaluates all 14 coefficients of its model for one ray after the
    other. A ray that a step would mirror stays as it is.
    """
    k1, (x, y) = k1s[:, None], bent
    mirrored = np.zeros((len(k1s), bent.shape[1]), bool)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # only mirrored rays get that far
        for _ in range(STEPS_OF_RAYS):
            factor = 1.0 / (1.0 + k1 * (x * x + y * y))
            mirrored |= factor < 0.0
            x, y = bent[0] * factor, bent[1] * factor
    return np.stack([np.where(mirrored, bent[0], x), np.where(mirrored, bent[1], y)], axis=-1)


def _residuals(pair: _Pair, k1s: np.ndarray) -> np.ndarray:
    """Signed distances ``(len(k1s), N)`` from the epipolar lines without these distortions, pixels."""
    left, right = np.split(undistorted_rays(pair.bent, k1s), 2, axis=1)
    of_left = left @ pair.lines[:, :2].T + pair.lines[:, 2]
    mx, my, mz, nx, ny = np.moveaxis(of_left, -1, 0)  # (len(k1s), N) each
    off = mx * right[..., 0] + my * right[..., 1] + mz
    return off / np.maximum(np.hypot(nx, ny), TINY)


class Remaining(NamedTuple):
    """The radial coefficient k1, of OpenCV's model, that both pictures still have for certain.

    ``alone`` is what of it is certain too where the right camera may be turned, or its picture sheared or
    stretched: what they explain as well is not known to be a distortion. 0 where nothing is certain.
    ``at_most`` is an upper bound of k1's size. All three are NaN for too few matches.
    """

    k1: float
    alone: float
    at_most: float


def remaining_distortion(tracks: Tracks, T: np.ndarray) -> Remaining:
    """The distortion that matches of one right view show under ``T (4, 4)``, ``T_right_from_left``."""
    tracks = tracks.kept(np.abs(epipolar(tracks, T).off_px) < MOST_OFF_PX)
    if len(tracks) < FEWEST:
        return Remaining(math.nan, math.nan, math.nan)  # the one NaN, by which equal verdicts are equal
    estimate, error = _fit_k1(tracks, T, np.zeros((len(tracks), 0)))
    k1, at_most = certain_part(estimate, error), abs(estimate) + BOUND_ERRORS * error
    if k1 == 0.0:
        return Remaining(0.0, 0.0, at_most)
    sheared = (tracks.right_px[0] - tracks.K_rights[0][:2, 2]) / tracks.K_rights[0][0, 0]
    explanations = _by_rotation(tracks, T), sheared
    others = [certain_part(*_fit_k1(tracks, T, explained)) for explained in explanations]
    alone = min((k1, *others), key=abs) if all(other * k1 > 0 for other in others) else 0.0
    return Remaining(k1, alone, at_most)


def _by_rotation(tracks: Tracks, T: np.ndarray) -> np.ndarray:
    """Derivatives ``(N, 3)`` of the residuals by a turn of the right camera about each of its axes."""
    columns = []
    for axis in np.eye(3):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(STEP_TURN * axis).as_matrix()
        ahead, behind = (epipolar(tracks, each @ T).off_px for each in (turn, turn.T))
        columns.append((ahead - behind) / (2 * STEP_TURN))
    return np.stack(columns, axis=1)


def _fit_k1(tracks: Tracks, T: np.ndarray, explained: np.ndarray) -> tuple[float, float]:
    """k1 beside other explanations, columns ``(N, M)`` of the residuals, and its standard error.

    It minimises ``sum_i rho(e_i(k1) + c + b . a_i)``, with ``e_i`` the signed distance of match i from its
    epipolar line when ``k1`` is removed from both pictures, ``c`` a shift across the lines, ``a_i`` the
    match's row of the other explanations, and Cauchy's ``rho``. The standard error is the larger of two: as
    if matches erred independently, and as the sums over blocks of the left image show, since neighbours err
    alike.
    """
    pair, k1, others = _pair(tracks, T), 0.0, np.zeros(explained.shape[1])
    # Derivatives of the residuals by k1, by the shift and by the others.
    A = np.concatenate([np.ones((len(tracks), 2)), explained], axis=1)
    for _ in range(STEPS):
        off, ahead, behind = _residuals(pair, np.array([k1, k1 + STEP_K1, k1 - STEP_K1]))
        A[:, 0] = (ahead - behind) / (2 * STEP_K1)
        centred = off - explained @ others
        centred = centred - np.median(centred)
        scale = max(SD_PER_MAD * float(np.median(np.abs(centred))), 0.1)
        weight = 1.0 / (1.0 + (centred / (2.0 * scale)) ** 2)
        weighted = A * weight[:, None]
        H = weighted.T @ A + 1e-9 * np.eye(A.shape[1])
        step = np.linalg.solve(H, weighted.T @ off)
        k1, others = float(np.clip(k1 - step[0], -MOST_K1, MOST_K1)), step[2:]
    inverse, pulls = np.linalg.inv(H), A * (weight * (off - A @ step))[:, None]
    error = max(scale * float(np.sqrt(inverse[0, 0])), _error_by_blocks(inverse, pulls, blocks(tracks)))
    return k1, error


def _error_by_blocks(inverse: np.ndarray, pulls: np.ndarray, block: np.ndarray) -> float:
    """Standard error of the first unknown where the matches of a block ``(N,)`` may err alike.

    From the inverse ``(M, M)`` of the normal equations' matrix, and what every match adds to their right
    side at the minimum, ``pulls (N, M)``.
    """
    of_blocks = np.stack([np.bincount(block, pull) for pull in pulls.T], axis=1)
    return float(np.sqrt((inverse @ of_blocks.T @ of_blocks @ inverse)[0, 0]))
