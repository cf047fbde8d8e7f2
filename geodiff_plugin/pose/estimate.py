"""Estimates poses of images with PoseLib (Larsson), and their scale from a known length."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from geodiff_plugin._internal.checks import InputError, bad_value, check_number
from geodiff_plugin._internal.statistics import SD_PER_MAD
from geodiff_plugin.cameras import Camera
from geodiff_plugin.findings import Finding
from geodiff_plugin.pose.fit import FITS_PX
from geodiff_plugin.pose.solve import FREE_PX, SCALE_PX, PosePrior, solve_poses
from geodiff_plugin.pose.tracks import (
    GreyImage,
    Tracks,
    dense_tracks,
    merge_tracks,
    project_tracks,
    residuals_px,
    solve_inverse_depth,
    sparse_tracks,
)

#: Maximum distance of an inlier from its epipolar line, or from its position under a simpler motion, pixels.
INLIER_PX = 2.0
#: Minimum number of inliers of a pose.
MIN_INLIERS = 30
#: Minimum fraction of inliers among the matches.
MIN_INLIER_FRACTION = 0.3
#: The same for matches of XFeat, which may answer wrongly where SIFT finds nothing. In 30 of 32 real pairs,
#: half of them dark, it has 99 or more inliers, which are .53 or more of its matches.
MIN_LEARNED_INLIERS = 60
MIN_LEARNED_FRACTION = 0.45
#: Median angle between the two rays of a point below which an error is raised, degrees.
NO_PARALLAX_DEG = 0.3
#: Median angle below which depth is inaccurate, degrees.
LITTLE_PARALLAX_DEG = 0.6
#: Fraction of the inliers that a simpler motion must explain to be preferred.
MIN_SIMPLER_FRACTION = 0.9
#: Distance of matches from their epipolar lines that noise does not explain, pixels.
LARGE_RESIDUAL_PX = 6.0
#: Minimum fraction of all matches for a second motion in the scene.
SECOND_MOTION_FRACTION = 0.1
#: Minimum fraction of the first motion's outliers that a second motion must explain.
SECOND_OF_REST = 0.5
#: Ratio of the second to the first motion's matches above which either may be the camera's.
MAX_SECOND_RATIO = 0.45
# Robust scales of the final fits, pixels: only matches determine an estimated pose.
_FINAL_SCALES_PX = (0.3, 0.15, 0.08)
# Standard deviations of estimated poses before the final fit: of their rotations, and of the camera centres
# relative to the baseline.
_ROTATION_RAD = np.radians(3.0)
_SHIFT_FRACTION = 0.3
# Standard deviation of the log length of several baselines; a single one has no length of its own and is
# fixed.
_LENGTH_FRACTION = 0.2
_SINGLE_LENGTH_FRACTION = 0.02
# Maximum distance of the matches that determine a pixel's depth, pixels of their grid.
_NEAR_PX = 40.0
NO_UNIT = Finding(
    "scale.none",
    "No length is known, so the result has no unit: all depths are in baselines of the first two cameras. "
    "Pass the baseline, a known length in the left image, or known points.",
)


LEARNED = Finding(
    "estimate.learned",
    "No pose could be estimated from SIFT features, so the poses were estimated from matches of a learned "
    "feature matcher (XFeat). They may be wrong without any other symptom. Check the result, or take "
    "brighter, sharper images.",
)
#: Matches sparse features of the left image in the right ones.
Matcher = Callable[[Sequence[GreyImage]], Tracks]


@dataclass(frozen=True, eq=False)
class EstimatedPose:
    """Relative pose of two images."""

    T: np.ndarray  # (4, 4) T_right_from_left with a baseline of length 1
    inliers: np.ndarray  # (N,) bool, tracks consistent with the pose
    parallax_deg: float  # median angle between the two rays of an inlier
    residual_px: float  # median distance of the inliers from their epipolar lines
    rectified: bool  # whether matches are on the same rows
    findings: tuple[Finding, ...]


def _parallax_deg(tracks: Tracks, R: np.ndarray) -> np.ndarray:
    """Compute the angles ``(N,)``, degrees, between both rays of a view's tracks, for its ``R (3, 3)``."""
    left = tracks.rays @ R.T
    right = tracks.right_rays(0)
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(left, right), axis=1), (left * right).sum(1)))


@dataclass(frozen=True)
class Inliers:
    """Minimum number of matches consistent with a pose, and their minimum fraction of all matches."""

    count: int = MIN_INLIERS
    fraction: float = MIN_INLIER_FRACTION


OF_SIFT = Inliers()
OF_XFEAT = Inliers(MIN_LEARNED_INLIERS, MIN_LEARNED_FRACTION)


def estimate_pose(tracks: Tracks, name: str = "the two images", needed: Inliers = OF_SIFT) -> EstimatedPose:
    """Estimate rotation and baseline direction of one right view from tracks with outliers."""
    if len(tracks) < needed.count:
        hint = (
            "Check that they show the same place, are sharp and well lit, and that none is mirrored "
            "(a selfie). Half of the content of one should be visible in the other."
        )
        expected = f"similar enough for at least {needed.count} matches"
        bad_value(name, expected, f"{len(tracks)}", hint, code="estimate.few-matches")
    T = _five_points(tracks)
    sideways = _rectified(tracks, residuals_px(tracks, T[None])[0] < INLIER_PX)
    T = T if sideways is None else sideways
    residual = residuals_px(tracks, T[None])[0]
    inverse_depth = solve_inverse_depth(tracks, T[None])
    near = residual < INLIER_PX
    inliers = near & (inverse_depth > 0)
    count, fraction = int(inliers.sum()), float(inliers.mean())
    if count < needed.count or fraction < needed.fraction:
        got = f"{count} of {len(tracks)} matches consistent with one pose"
        hint = "Check that they show the same place at the same time, unmirrored and unedited, and check K."
        expected = "of one static scene, seen by two cameras"
        bad_value(name, expected, got, hint, code="estimate.no-motion")
    parallax = float(np.median(_parallax_deg(tracks, T[:3, :3])[inliers]))
    _check_parallax(tracks, near, parallax, name)
    findings = _second_motion(tracks, T, inliers, name)
    if parallax < LITTLE_PARALLAX_DEG:
        sentence = (
            f"The median parallax between {name} is only {parallax:.2f} degrees, so depth is inaccurate. "
            "Move the camera further sideways."
        )
        findings.append(Finding("estimate.parallax", sentence))
    left, right = (px[near].astype(np.float32) for px in (tracks.left_px, tracks.right_px[0]))
    on_plane = cv2.findHomography(left, right, cv2.RANSAC, INLIER_PX)[1]
    if on_plane is not None and on_plane.mean() > MIN_SIMPLER_FRACTION:
        sentence = (
            f"Nearly all matches of {name} are on one plane, so several poses fit them about as well. "
            "Take images with objects at different depths, or pass the pose."
        )
        findings.append(Finding("estimate.plane", sentence))
    residual_px = float(np.median(residual[inliers]))
    return EstimatedPose(T, inliers, parallax, residual_px, sideways is not None, tuple(findings))


def estimate_poses(
    views: Sequence[GreyImage], matcher: Matcher | None = None
) -> tuple[Tracks, list[EstimatedPose]]:
    """Estimate the poses of two or more images, with a first baseline of 1; returns inliers and poses.

    ``matcher`` is used if no pose can be estimated from SIFT features.
    """
    try:
        return _poses_of_tracks(sparse_tracks(views), OF_SIFT)
    except InputError:
        if matcher is None:
            raise
    tracks, (first, *others) = _poses_of_tracks(matcher(views), OF_XFEAT)
    return tracks, [replace(first, findings=(*first.findings, LEARNED)), *others]


def _poses_of_tracks(tracks: Tracks, needed: Inliers) -> tuple[Tracks, list[EstimatedPose]]:
    """Estimate the poses of all right images; returns inliers and poses."""
    poses = []
    count = len(tracks.seen)
    for v in range(count):
        name = "the two images" if count == 1 else f"the left and right image {v + 1}"
        poses.append(estimate_pose(tracks.view(v), name, needed))
    seen = tracks.seen.copy()
    for v, pose in enumerate(poses):
        seen[v, tracks.seen[v]] = pose.inliers
    tracks = replace(tracks, seen=seen)
    return tracks, [poses[0], *(_same_unit(tracks, poses, v) for v in range(1, len(poses)))]


def _same_unit(tracks: Tracks, poses: Sequence[EstimatedPose], v: int) -> EstimatedPose:
    """Scale the baseline of pose ``v`` to units of the first one, using points that both see."""
    both = tracks.kept(tracks.seen[0] & tracks.seen[v])
    if len(both) < 15:
        got = f"{len(both)} of them also in view {v + 1}"
        bad_value("images", "with points visible in all of them", got)
    first, other = (solve_inverse_depth(both.alone(i), poses[i].T[None]) for i in (0, v))
    T = poses[v].T.copy()
    T[:3, 3] *= np.median(other / np.maximum(first, 1e-9))
    return replace(poses[v], T=T)


def _five_points(tracks: Tracks) -> np.ndarray:
    """Return the ``T_right_from_left`` that explains the most tracks, with a baseline of length 1."""
    try:
        poselib = importlib.import_module("poselib")
    except ImportError:
        hint = "Run pip install 'geodiff-plugin[pose]', or pip install poselib."
        bad_value("PoseLib", "installed, to estimate poses", "no module poselib", hint)
    pixels, cameras = [], []
    for px, K in ((tracks.left_px, tracks.K_left), (tracks.right_px[0], tracks.K_rights[0])):
        width, height = (max(1, int(2 * c + 1)) for c in K[:2, 2])
        params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        cameras.append({"model": "PINHOLE", "width": width, "height": height, "params": params})
        # The same rays in a camera without skew, which PoseLib's models do not support.
        pixels.append(np.c_[px[:, 0] - K[0, 1] * (px[:, 1] - K[1, 2]) / K[1, 1], px[:, 1]])
    options = {"max_epipolar_error": INLIER_PX / 2, "seed": 0, "min_iterations": 1000}
    pose, _ = poselib.estimate_relative_pose(*pixels, *cameras, options, {})
    T = np.eye(4)
    T[:3] = pose.Rt
    T[:3, 3] /= max(float(np.linalg.norm(T[:3, 3])), 1e-12)
    return T


def _consistent(tracks: Tracks, T: np.ndarray) -> np.ndarray:
    """Return which matches fit a pose ``T (4, 4)`` with a point in front of the cameras, ``(N,)`` bool."""
    poses = T[None]
    return (residuals_px(tracks, poses)[0] < INLIER_PX) & (solve_inverse_depth(tracks, poses) > 0)


def _second_motion(tracks: Tracks, T: np.ndarray, inliers: np.ndarray, name: str) -> list[Finding]:
    """Detect a moving part of the scene, whose matches fit a second pose; reports it or raises an error.

    Wrong matches fit no pose. Motion along epipolar lines cannot be detected in two images; such objects get
    wrong depths.
    """
    rest = tracks.kept(residuals_px(tracks, T[None])[0] > LARGE_RESIDUAL_PX)
    if len(rest) < MIN_INLIERS:
        return []
    count = int(_consistent(rest, _five_points(rest)).sum())
    enough = max(MIN_INLIERS, SECOND_MOTION_FRACTION * len(tracks), SECOND_OF_REST * len(rest))
    if count < enough:
        return []
    hint = (
        "Something moved between the images, or a pattern repeats. Take both at the same time, or of a "
        "static scene."
    )
    if count > MAX_SECOND_RATIO * inliers.sum():
        got = f"two motions, with {int(inliers.sum())} and {count} of {len(tracks)} matches"
        bad_value(name, "of one static scene", got, hint, code="estimate.two-motions")
    sentence = (
        f"{100 * count / len(tracks):.0f} % of the matches of {name} follow a second motion: their depths "
        f"are wrong, and the pose may be wrong as well. {hint}"
    )
    return [Finding("estimate.second-motion", sentence)]


def _rectified(tracks: Tracks, near: np.ndarray) -> np.ndarray | None:
    """Return the pose of a rectified pair if it explains the inliers of an unconstrained pose as well."""
    inliers = tracks.kept(near)
    for way in (-1.0, 1.0):
        T = np.eye(4)
        T[0, 3] = way
        fits = len(inliers) >= MIN_INLIERS and np.median(residuals_px(inliers, T[None])) < FITS_PX
        if fits and (solve_inverse_depth(inliers, T[None]) > 0).mean() > MIN_SIMPLER_FRACTION:
            return T
    return None


def _check_parallax(tracks: Tracks, near: np.ndarray, parallax: float, name: str) -> None:
    """Raise an error for a purely rotating camera: then every baseline direction explains the matches."""
    fraction = float((_rotation_residuals(tracks)[near] < INLIER_PX).mean())
    if fraction > MIN_SIMPLER_FRACTION or parallax < NO_PARALLAX_DEG:
        got = f"a purely rotating camera ({fraction:.0%} of matches fit one, parallax {parallax:.2f} degrees)"
        hint = "Without sideways motion two images contain no depth."
        bad_value(name, "taken from two positions", got, hint, code="estimate.rotation")


def _rotation_residuals(tracks: Tracks) -> np.ndarray:
    """Compute the distances ``(N,)``, pixels, of tracks from their positions under a fitted rotation."""
    left, right = (
        rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (tracks.rays, tracks.right_rays(0))
    )
    weights, off = np.ones(len(left)), np.zeros(len(left))
    for _ in range(10):
        R = Rotation.align_vectors(right, left, weights=weights)[0].as_matrix()
        p = left @ (tracks.K_rights[0] @ R).T
        off = np.linalg.norm(p[:, :2] / np.maximum(p[:, 2:], 1e-6) - tracks.right_px[0], axis=1)
        weights = 1.0 / (1.0 + (off / INLIER_PX) ** 2)
    return off


def polished(
    views: Sequence[GreyImage], Ts: np.ndarray, depth_m: Tensor, sparse: Tracks
) -> tuple[np.ndarray, Tracks]:
    """Refit estimated poses ``(V, 4, 4)`` of the ``sparse`` inliers to all matches of all views.

    ``depth_m`` is as in ``dense_tracks``. Returns poses, with the first baseline unchanged, and all matches.
    """
    Ts = Ts.astype(np.float32).astype(np.float64)  # the precision that the depth was computed with
    tracks = merge_tracks([sparse, dense_tracks(views, depth_m, Ts)])
    length_fraction = _SINGLE_LENGTH_FRACTION if len(Ts) == 1 else _LENGTH_FRACTION
    free = PosePrior(np.full(len(Ts), FREE_PX), _ROTATION_RAD, _SHIFT_FRACTION, length_fraction)
    solved = Ts
    for scale_px in (SCALE_PX, *_FINAL_SCALES_PX):
        solved = solve_poses(tracks, Ts, free, start=solved, scale_px=scale_px)
    length = np.linalg.norm(Ts[0, :3, 3]) / np.linalg.norm(solved[0, :3, 3])
    solved[:, :3, 3] *= length
    return solved, tracks


@dataclass(frozen=True)
class Scale:
    """Metres per unit of an estimated pose."""

    source: str  # "baseline", "known length", "points" or "none"
    factor: float  # 1 without a source
    spread: float | None = None  # relative standard error from the matches, None if unknown
    findings: tuple[Finding, ...] = ()

    @property
    def unit(self) -> str | None:
        """Unit ``"m"``, or ``None`` if there is none."""
        return None if self.source == "none" else "m"


def _point_at(
    pixel: np.ndarray, factor: float, tracks: Tracks, inverse_depth: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the point ``(3,)`` at a left pixel, in units, and the relative spread of its depth."""
    px = (pixel + 0.5) * factor - 0.5
    away = np.linalg.norm(tracks.left_px - px, axis=1)
    near = np.argsort(away)[:8]
    near = near[away[near] < _NEAR_PX]
    if len(near) < 3:
        hint = "Choose end points on textured surfaces visible in both images."
        got = f"({pixel[0]:.0f}, {pixel[1]:.0f}) with {len(near)} nearby"
        expected = "end points close to matched points"
        bad_value("known length", expected, got, hint, code="known-length.ends")
    w = inverse_depth[near]
    middle = float(np.median(w))
    spread = SD_PER_MAD * float(np.median(np.abs(w / middle - 1)))
    ray = Camera(tracks.K_left).rays(px)
    return ray / middle, spread


def find_scale(
    tracks: Tracks,
    Ts: np.ndarray,
    factor: float,
    baseline_m: float | None,
    known_length: tuple[float, float, float, float, float] | None,
    points: np.ndarray | None,
) -> Scale:
    """Compute metres per unit ``s`` from the given length; arguments as in ``from_unposed_images``.

    A measured baseline ``b`` gives ``s = b / |t|``, with ``t`` the first right camera's. A known length ``l``
    between two scene points ``X`` gives ``s = l / |X_1 - X_2|``. Known points of depth ``z_i`` metres give
    ``s = argmin_s sum_i |z_i / d_i - s|``, with ``d_i`` the depth, in units, of the match nearest to each.

    ``Ts (V, 4, 4)`` are ``T_right_from_left`` in units; ``factor`` is pixels of the tracks' grid per pixel of
    the left image; ``points`` ``(N, 3)`` are metres in the left frame.
    """
    given = [name for name, v in (("baseline", baseline_m), ("known length", known_length)) if v is not None]
    if len(given) > 1:
        bad_value(
            "scale", "specified once", " and ".join(given), "Remove one; points may be passed in addition."
        )
    if baseline_m is not None:
        return Scale("baseline", baseline_m / float(np.linalg.norm(Ts[0, :3, 3])))
    fits = (np.nan_to_num(residuals_px(tracks, Ts), nan=0.0) < 1.5).all(0)
    tracks = tracks.kept(fits)
    inverse_depth = solve_inverse_depth(tracks, Ts)
    tracks = tracks.kept(inverse_depth > 0)
    inverse_depth = inverse_depth[inverse_depth > 0]
    if known_length is not None:
        *ends, metres = known_length
        check_number(metres, "known length", 1e-6, 1e6)
        pixels = np.array(ends).reshape(2, 2)
        (first, s1), (second, s2) = (_point_at(each, factor, tracks, inverse_depth) for each in pixels)
        length = float(np.linalg.norm(first - second))
        if length < 1e-9:
            got = "the same point twice"
            bad_value("known length", "between two points", got, code="known-length.one-point")
        return Scale("known length", metres / length, float(np.hypot(s1, s2)))
    if points is not None:
        return _by_points(tracks, inverse_depth, points)
    return Scale("none", 1.0, None, (NO_UNIT,))


def _by_points(tracks: Tracks, inverse_depth: np.ndarray, points: np.ndarray) -> Scale:
    ahead = points[points[:, 2] > 0]
    px = project_tracks(ahead, np.zeros(len(ahead)), tracks.K_left, np.eye(4)).px
    away, nearest = cKDTree(tracks.left_px).query(px)
    close = away < _NEAR_PX / 4
    if close.sum() < 5:
        bad_value("points", "at least 5 of them close to matched points", f"{int(close.sum())}")
    ratios = ahead[close, 2] * inverse_depth[nearest[close]]
    factor = float(np.median(ratios))
    spread = SD_PER_MAD * float(np.median(np.abs(ratios / factor - 1))) / np.sqrt(close.sum())
    return Scale("points", factor, spread)
