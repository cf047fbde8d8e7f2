"""Check for lens distortion in both images of a pair, from residuals that grow away from the centre."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.statistics import SD_PER_MAD, certain_part
from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.pose.tracks import MIN_MATCHES, TINY, Tracks, blocks, epipolar
from geodiff_plugin.trust.check import Check, FactSheet, MatchError
from geodiff_plugin.trust.stages import TracksStage

DISTORTED = FindingKind(
    "views.distorted",
    REASON,
    "The images have residual lens distortion",
    cause="The images are raw but the calibration has no distortion coefficients, or they are rectified but "
    "the calibration still has coefficients.",
    hint="Use rectified images, or raw images with a calibration that has the distortion coefficients.",
)
RESIDUAL_TREND = FindingKind(
    "views.residual-trend",
    REASON,
    "Epipolar residuals vary systematically across the image",
    cause="E has a wrong rotation, a rolling shutter sheared the right image, or lens distortion was not "
    "removed. All of these explain the matches equally well.",
    hint="Check the rotation of E, and that the images are rectified with this calibration.",
)

#: Maximum epipolar distance of a match that is used, pixels.
MAX_OFF_PX = 12.0
#: Number of iterations of the reweighted least-squares fit.
STEPS = 6
#: Step of the numerical derivative with respect to k1.
STEP_K1 = 0.01
#: Step of the numerical derivative with respect to a rotation, radians.
STEP_ROTATION = 1e-4
#: Maximum magnitude of k1 of a lens with a rectilinear image.
MAX_K1 = 0.6
#: Number of fixed-point iterations that undistort a ray, the same as in OpenCV.
UNDISTORT_STEPS = 5
#: Number of standard errors between the estimate of k1 and its upper bound.
BOUND_ERRORS = 2.0


@dataclass(frozen=True)
class ResidualDistortion:
    """The residual radial coefficient k1 (OpenCV's model) in both images of the first pair."""

    k1: float  # the statistically significant part; 0 if there is none
    unexplained_k1: float  # the part that neither a rotation nor a shear of the right image explains
    k1_bound: float  # upper bound of the magnitude of k1


class Distortion(Check[ResidualDistortion]):
    """Detects images that were not undistorted, or were undistorted twice.

    If a rotation of the right camera or a shear of its image explains the same residuals, the finding is
    ``views.residual-trend`` instead of ``views.distorted``.
    """

    kinds = (DISTORTED, RESIDUAL_TREND)
    #: The significant part of k1 is up to .07 in correct pairs. With an uncorrected distortion of .25 it is
    #: .12 to .46, except in two pairs with few matches.
    MAX_K1 = 0.11
    #: Correct pairs can show up to this much, which does not lower the confidence.
    USUAL_K1 = 0.08
    #: Few matches exclude distortion if the bound on k1 is below this. Of 236 rigs, correct or wrong in one
    #: of six ways, 149 passed; these showed at most .05 at full size.
    MAX_RULED_OUT = USUAL_K1

    @classmethod
    def of_tracks(cls, stage: TracksStage) -> ResidualDistortion | None:
        return residual_distortion(stage.tracks.view(0), stage.given[0])

    @classmethod
    def rules_out(cls, fact: ResidualDistortion | None) -> bool:
        return fact is not None and fact.k1_bound <= cls.MAX_RULED_OUT

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact and abs(fact.k1) > cls.MAX_K1:
            is_distorted = abs(fact.unexplained_k1) > cls.MAX_K1
            yield _distorted(fact.k1) if is_distorted else _residual_trend(fact.k1)

    @classmethod
    def match_error(cls, facts: FactSheet) -> MatchError:
        fact = facts[cls]
        return MatchError(distortion=0.0 if fact is None else max(0.0, abs(fact.k1) - cls.USUAL_K1))


def _distorted(k1: float) -> Finding:
    hint = "Rectify the images, or pass the distortion coefficients."
    if k1 > 0:  # a telephoto lens, or a wide-angle lens whose distortion was removed twice
        hint = "The images may be undistorted twice; check whether they are rectified already."
    return Finding(
        DISTORTED,
        f"Residual lens distortion of k1 = {k1:+.2f} in both images makes depth wrong away from the centre. "
        f"{hint}",
    )


def _residual_trend(k1: float) -> Finding:
    return Finding(
        RESIDUAL_TREND,
        f"Epipolar residuals vary across the image (as for k1 = {k1:+.2f}), so depth is distorted. Check E "
        "and rectification.",
    )


class _Pair(NamedTuple):
    """Matches as distorted rays with z = 1, and the linear map from left rays to epipolar lines.

    The undistorted left ray ``x`` and right ray ``y`` meet if ``y . m = 0`` with ``m = R x x t``.
    """

    distorted: np.ndarray  # (2, 2 N) x and y of the left rays, then of the right rays
    lines: np.ndarray  # (5, 3), times x: m, then the normal of the epipolar line in pixels


def _pair(tracks: Tracks, T: np.ndarray) -> _Pair:
    tx, ty, tz = T[:3, 3]
    m = np.array([[0.0, tz, -ty], [-tz, 0.0, tx], [ty, -tx, 0.0]]) @ T[:3, :3]
    normals = np.linalg.inv(tracks.K_rights[0])[:, :2].T @ m
    distorted = np.concatenate([tracks.rays, tracks.right_rays(0)])[:, :2].T
    return _Pair(np.ascontiguousarray(distorted), np.concatenate([m, normals]))


def undistorted_rays(distorted: np.ndarray, k1s: np.ndarray) -> np.ndarray:
    """Remove radial distortions ``k1s (M,)`` from rays ``(2, N)``; returns rays ``(M, N, 2)``.

    The results are the fixed points of ``x = distorted / (1 + k1 |x|^2)``, found by the iteration of
    ``cv2.undistortPoints``. OpenCV's function is several times slower, because it evaluates all 14
    coefficients of its model ray by ray. A ray that an iteration would mirror is returned unchanged.
    """
    k1, (x, y) = k1s[:, None], distorted
    mirrored = np.zeros((len(k1s), distorted.shape[1]), bool)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # only mirrored rays overflow
        for _ in range(UNDISTORT_STEPS):
            factor = 1.0 / (1.0 + k1 * (x * x + y * y))
            mirrored |= factor < 0.0
            x, y = distorted[0] * factor, distorted[1] * factor
    return np.stack([np.where(mirrored, distorted[0], x), np.where(mirrored, distorted[1], y)], axis=-1)


def _residuals(pair: _Pair, k1s: np.ndarray) -> np.ndarray:
    """Compute signed epipolar distances ``(len(k1s), N)`` in pixels after removing each distortion."""
    left, right = np.split(undistorted_rays(pair.distorted, k1s), 2, axis=1)
    of_left = left @ pair.lines[:, :2].T + pair.lines[:, 2]
    mx, my, mz, nx, ny = np.moveaxis(of_left, -1, 0)  # (len(k1s), N) each
    off = mx * right[..., 0] + my * right[..., 1] + mz
    return off / np.maximum(np.hypot(nx, ny), TINY)


def residual_distortion(tracks: Tracks, T: np.ndarray) -> ResidualDistortion | None:
    """Estimate the distortion from matches of one right view under ``T (4, 4)``, ``T_right_from_left``."""
    tracks = tracks.kept(np.abs(epipolar(tracks, T).off_px) < MAX_OFF_PX)
    if len(tracks) < MIN_MATCHES:
        return None
    estimate, error = _fit_k1(tracks, T, np.zeros((len(tracks), 0)))
    k1 = certain_part(estimate, error)
    bound = abs(estimate) + BOUND_ERRORS * error
    if k1 == 0.0:
        return ResidualDistortion(0.0, 0.0, bound)
    sheared = (tracks.right_px[0] - tracks.K_rights[0][:2, 2]) / tracks.K_rights[0][0, 0]
    explanations = _by_rotation(tracks, T), sheared
    others = [certain_part(*_fit_k1(tracks, T, explained)) for explained in explanations]
    unexplained = min((k1, *others), key=abs) if all(other * k1 > 0 for other in others) else 0.0
    return ResidualDistortion(k1, unexplained, bound)


def _by_rotation(tracks: Tracks, T: np.ndarray) -> np.ndarray:
    """Compute the derivatives ``(N, 3)`` of the residuals by rotations about the right camera's axes."""
    columns = []
    for axis in np.eye(3):
        rotation = np.eye(4)
        rotation[:3, :3] = Rotation.from_rotvec(STEP_ROTATION * axis).as_matrix()
        forward, backward = (epipolar(tracks, each @ T).off_px for each in (rotation, rotation.T))
        columns.append((forward - backward) / (2 * STEP_ROTATION))
    return np.stack(columns, axis=1)


def _fit_k1(tracks: Tracks, T: np.ndarray, explained: np.ndarray) -> tuple[float, float]:
    """Fit k1 jointly with other explanations of the residuals, columns ``(N, M)``.

    Minimises ``sum_i rho(e_i(k1) + c + b . a_i)``. ``e_i`` is the signed epipolar distance of match i after
    ``k1`` is removed from both images, ``c`` an offset perpendicular to the lines, ``a_i`` the match's row of
    the other explanations, and ``rho`` the Cauchy loss.

    Returns:
        k1 and its standard error, which is the larger of two estimates: one for independent errors of the
        matches, and one from sums over blocks of the left image, because errors of neighbours are correlated.
    """
    pair = _pair(tracks, T)
    k1 = 0.0
    others = np.zeros(explained.shape[1])
    # The columns are the derivatives of the residuals by k1, by the offset and by the other explanations.
    A = np.concatenate([np.ones((len(tracks), 2)), explained], axis=1)
    for _ in range(STEPS):
        off, forward, backward = _residuals(pair, np.array([k1, k1 + STEP_K1, k1 - STEP_K1]))
        A[:, 0] = (forward - backward) / (2 * STEP_K1)
        centred = off - explained @ others
        centred = centred - np.median(centred)
        scale = max(SD_PER_MAD * float(np.median(np.abs(centred))), 0.1)
        weight = 1.0 / (1.0 + (centred / (2.0 * scale)) ** 2)
        weighted = A * weight[:, None]
        H = weighted.T @ A + 1e-9 * np.eye(A.shape[1])
        step = np.linalg.solve(H, weighted.T @ off)
        k1 = float(np.clip(k1 - step[0], -MAX_K1, MAX_K1))
        others = step[2:]
    inverse = np.linalg.inv(H)
    gradients = A * (weight * (off - A @ step))[:, None]
    error = max(scale * float(np.sqrt(inverse[0, 0])), _error_by_blocks(inverse, gradients, blocks(tracks)))
    return k1, error


def _error_by_blocks(inverse: np.ndarray, gradients: np.ndarray, block: np.ndarray) -> float:
    """Compute the standard error of the first unknown for errors that are correlated within a block.

    ``inverse (M, M)`` is the inverse of the normal matrix. ``gradients (N, M)`` holds the contribution of
    every match to the right-hand side at the minimum. ``block (N,)`` is the block index of every match.
    """
    of_blocks = np.stack([np.bincount(block, gradient) for gradient in gradients.T], axis=1)
    return float(np.sqrt((inverse @ of_blocks.T @ of_blocks @ inverse)[0, 0]))
