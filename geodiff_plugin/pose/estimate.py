"""Estimate poses of photographs by PoseLib (Larsson), and their scale from a known length."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from geodiff_plugin._certain import SD_PER_MAD
from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin.messages import Message
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

#: An inlier lies nearer than this to its epipolar line, or to its position under a simpler motion.
INLIER_PX = 2.0
#: Fewer inliers make no pose.
FEWEST_INLIERS = 30
#: A smaller share of inliers among the matches makes none.
LEAST_SHARE = 0.3
#: Median angle between the two rays of a point below which depth is refused.
NO_PARALLAX_DEG = 0.3
#: The angle below which it is inaccurate.
LITTLE_PARALLAX_DEG = 0.6
#: A pair is rectified if its rows agree this well without any rotation.
RECTIFIED_PX = 0.45
#: A simpler motion that explains this share of the inliers is preferred.
SIMPLER = 0.9
#: Matches this far from their lines are not explained by noise.
APART_PX = 6.0
#: A second motion that explains this share of all matches may be one of the scene.
SECOND_SHARE = 0.1
#: It is one if it also explains this share of the matches that the first motion leaves.
SECOND_OF_REST = 0.5
#: Above this share of the first motion's matches, either motion may be the camera's.
RIVAL = 0.45
# Robust scales of the last fits, pixels: only matches determine an estimated pose.
_NARROWER_PX = (0.3, 0.15, 0.08)
# Standard deviations of estimated poses before that fit: of their rotations, and of the cameras' centres as a
# share of the baseline.
_TURNED_RAD = np.radians(3.0)
_SHIFTED = 0.3
# Of the lengths of several baselines; a single one has no length of its own, and is held.
_LONGER = 0.2
_ONE_LONGER = 0.02
# The depth of a pixel is that of the matches this near, pixels of their grid.
_NEAR_PX = 40.0
NO_UNIT = Message(
    "scale.none",
    "No length is known, so the result has no unit: all depths are in baselines of the first two cameras. "
    "Give their distance (baseline), a known length in the left photograph, or known points.",
)


@dataclass(frozen=True, eq=False)
class EstimatedPose:
    """A relative pose of two photographs."""

    T: np.ndarray  # (4, 4) T_right_from_left with a baseline of length 1
    inliers: np.ndarray  # (N,) bool, the tracks that it explains
    parallax_deg: float  # median angle between the two rays of an inlier
    residual_px: float  # median distance of the inliers from their epipolar lines
    rectified: bool  # all rows agree
    warnings: tuple[Message, ...]


def _right_rays(tracks: Tracks) -> np.ndarray:
    pixels = np.c_[tracks.right_px[0], np.ones(len(tracks))]
    return np.linalg.solve(tracks.K_rights[0], pixels.T).T


def _parallax_deg(tracks: Tracks, R: np.ndarray) -> np.ndarray:
    """Angle ``(N,)`` degrees between the two rays of every track of a view, by ``R (3, 3)`` of its pose."""
    left, right = tracks.rays @ R.T, _right_rays(tracks)
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(left, right), axis=1), (left * right).sum(1)))


def estimate_pose(tracks: Tracks, name: str = "the two photographs") -> EstimatedPose:
    """Rotation and direction of the baseline of one right view, from tracks with outliers."""
    if len(tracks) < FEWEST_INLIERS:
        cure = (
            "Are they of the same place, sharp and well lit, none of them a mirror image (a selfie)? Half of "
            "what one shows should be in the other."
        )
        bad_value(name, f"alike enough for at least {FEWEST_INLIERS} matches", f"{len(tracks)}", cure)
    T = _five_points(tracks)
    sideways = _rectified(tracks, residuals_px(tracks, T[None])[0] < INLIER_PX)
    T = T if sideways is None else sideways
    residual = residuals_px(tracks, T[None])[0]
    inverse_depth = solve_inverse_depth(tracks, T[None])
    near = residual < INLIER_PX
    inliers = near & (inverse_depth > 0)
    count, share = int(inliers.sum()), float(inliers.mean())
    if count < FEWEST_INLIERS or share < LEAST_SHARE:
        got = f"{count} matches of {len(tracks)} that one pose explains"
        cure = "Are they of the same place, taken at the same time, neither mirrored nor edited? Is K right?"
        bad_value(name, "of one scene that stands still, seen by two cameras", got, cure)
    parallax = float(np.median(_parallax_deg(tracks, T[:3, :3])[inliers]))
    _check_parallax(tracks, near, parallax, name)
    warnings = _of_second_motion(tracks, T, inliers, name)
    if parallax < LITTLE_PARALLAX_DEG:
        sentence = (
            f"The parallax between {name} is {parallax:.2f} degrees in the median: depth rests on little. "
            "Move the camera further sideways."
        )
        warnings.append(Message("estimate.parallax", sentence))
    left, right = (px[near].astype(np.float32) for px in (tracks.left_px, tracks.right_px[0]))
    on_plane = cv2.findHomography(left, right, cv2.RANSAC, INLIER_PX)[1]
    if on_plane is not None and on_plane.mean() > SIMPLER:
        sentence = (
            f"Nearly all matches of {name} lie on one plane: several poses explain them about as well. "
            "Take photographs with things at different depths, or give the pose."
        )
        warnings.append(Message("estimate.plane", sentence))
    residual_px = float(np.median(residual[inliers]))
    return EstimatedPose(T, inliers, parallax, residual_px, sideways is not None, tuple(warnings))


def estimate_poses(views: Sequence[GreyImage]) -> tuple[Tracks, list[EstimatedPose]]:
    """The inliers of the right views of two photographs or more, and their poses; the first baseline is 1."""
    tracks, poses = sparse_tracks(views), []
    for v in range(len(views) - 1):
        name = "the two photographs" if len(views) == 2 else f"the left and right photograph {v + 1}"
        poses.append(estimate_pose(tracks.view(v), name))
    seen = tracks.seen.copy()
    for v, pose in enumerate(poses):
        seen[v, tracks.seen[v]] = pose.inliers
    tracks = replace(tracks, seen=seen)
    return tracks, [poses[0], *(_same_unit(tracks, poses, v) for v in range(1, len(poses)))]


def _same_unit(tracks: Tracks, poses: Sequence[EstimatedPose], v: int) -> EstimatedPose:
    """Pose ``v`` with its baseline in units of the first one, by the points that both see."""
    both = tracks.kept(tracks.seen[0] & tracks.seen[v])
    if len(both) < 15:
        got = f"{len(both)} of them in view {v + 1} too"
        bad_value("photographs", "with points that all of them show", got)
    first, other = (solve_inverse_depth(both.alone(i), poses[i].T[None]) for i in (0, v))
    T = poses[v].T.copy()
    T[:3, 3] *= np.median(other / np.maximum(first, 1e-9))
    return replace(poses[v], T=T)


def _five_points(tracks: Tracks) -> np.ndarray:
    """``T_right_from_left`` that explains the most tracks, its baseline of length 1."""
    try:
        poselib = importlib.import_module("poselib")
    except ImportError:
        cure = "pip install 'geodiff-plugin[pose]', or pip install poselib."
        bad_value("PoseLib", "installed, to estimate poses", "no module poselib", cure)
    pixels, cameras = [], []
    for px, K in ((tracks.left_px, tracks.K_left), (tracks.right_px[0], tracks.K_rights[0])):
        width, height = (max(1, int(2 * c + 1)) for c in K[:2, 2])
        params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        cameras.append({"model": "PINHOLE", "width": width, "height": height, "params": params})
        # The same rays in a camera without skew: PoseLib's models have none.
        pixels.append(np.c_[px[:, 0] - K[0, 1] * (px[:, 1] - K[1, 2]) / K[1, 1], px[:, 1]])
    options = {"max_epipolar_error": INLIER_PX / 2, "seed": 0, "min_iterations": 1000}
    pose, _ = poselib.estimate_relative_pose(*pixels, *cameras, options, {})
    T = np.eye(4)
    T[:3] = pose.Rt
    T[:3, 3] /= max(float(np.linalg.norm(T[:3, 3])), 1e-12)
    return T


def _of_second_motion(tracks: Tracks, T: np.ndarray, inliers: np.ndarray, name: str) -> list[Message]:
    """Refuse, or report, a part of the scene that moved: a second pose explains its matches.

    Wrong matches are explained by no pose. What moves along its epipolar lines cannot be seen in two
    photographs; it then lies at a wrong depth.
    """
    rest = tracks.kept(residuals_px(tracks, T[None])[0] > APART_PX)
    if len(rest) < FEWEST_INLIERS:
        return []
    second = _five_points(rest)
    fit = (residuals_px(rest, second[None])[0] < INLIER_PX) & (solve_inverse_depth(rest, second[None]) > 0)
    count = int(fit.sum())
    if count < max(FEWEST_INLIERS, SECOND_SHARE * len(tracks), SECOND_OF_REST * len(rest)):
        return []
    cure = (
        "Something moved between the photographs, or a pattern repeats. Take both at one moment, or of a "
        "scene that stands still."
    )
    if count > RIVAL * inliers.sum():
        got = f"two motions, of {int(inliers.sum())} and {count} of its {len(tracks)} matches"
        bad_value(name, "of one scene that stands still", got, cure)
    sentence = (
        f"{100 * count / len(tracks):.0f} % of the matches of {name} follow a motion of their own: they lie "
        f"at wrong depths, and the pose may be wrong as well. {cure}"
    )
    return [Message("estimate.second-motion", sentence)]


def _rectified(tracks: Tracks, near: np.ndarray) -> np.ndarray | None:
    """The pose of a rectified pair, where that explains the inliers of a free one as well."""
    inliers = tracks.kept(near)
    for way in (-1.0, 1.0):
        T = np.eye(4)
        T[0, 3] = way
        fits = len(inliers) >= FEWEST_INLIERS and np.median(residuals_px(inliers, T[None])) < RECTIFIED_PX
        if fits and (solve_inverse_depth(inliers, T[None]) > 0).mean() > SIMPLER:
            return T
    return None


def _check_parallax(tracks: Tracks, near: np.ndarray, parallax: float, name: str) -> None:
    """Refuse a camera that only turned: then every direction of a baseline explains the matches."""
    share = float((_rotation_residuals(tracks)[near] < INLIER_PX).mean())
    if share > SIMPLER or parallax < NO_PARALLAX_DEG:
        got = f"a camera that only turned ({share:.0%} of matches say so, parallax {parallax:.2f} degrees)"
        cure = "Without a step to the side two photographs carry no depth."
        bad_value(name, "taken from two places", got, cure)


def _rotation_residuals(tracks: Tracks) -> np.ndarray:
    """Distance ``(N,)`` px from where a rotation alone, fitted robustly, puts the tracks."""
    left, right = (
        rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (tracks.rays, _right_rays(tracks))
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
    """Estimated poses ``(V, 4, 4)`` of the ``sparse`` inliers, fitted once more to all matches of all views.

    ``depth_m`` is as for ``dense_tracks``. Returns poses, the first baseline unchanged, and all matches.
    """
    Ts = Ts.astype(np.float32).astype(np.float64)  # the precision that the depth was made with
    tracks = merge_tracks([sparse, dense_tracks(views, depth_m, Ts)])
    longer = _ONE_LONGER if len(Ts) == 1 else _LONGER
    free = PosePrior(np.full(len(Ts), FREE_PX), _TURNED_RAD, _SHIFTED, longer)
    solved = Ts
    for scale_px in (SCALE_PX, *_NARROWER_PX):
        solved = solve_poses(tracks, Ts, free, start=solved, scale_px=scale_px)
    length = np.linalg.norm(Ts[0, :3, 3]) / np.linalg.norm(solved[0, :3, 3])
    solved[:, :3, 3] *= length
    return solved, tracks


@dataclass(frozen=True)
class Scale:
    """Metres per unit of an estimated pose."""

    source: str  # "baseline", "known length", "points" or "none"
    factor: float  # 1 without a source
    spread: float | None = None  # relative standard error as the matches show, None where they cannot
    warnings: tuple[Message, ...] = ()

    @property
    def unit(self) -> str | None:
        """``"m"``, or ``None`` where there is no unit."""
        return None if self.source == "none" else "m"


def _point_at(
    pixel: np.ndarray, factor: float, tracks: Tracks, inverse_depth: np.ndarray
) -> tuple[np.ndarray, float]:
    """The point ``(3,)`` of a pixel of the left photograph in units, and the relative spread of its depth."""
    px = (pixel + 0.5) * factor - 0.5
    away = np.linalg.norm(tracks.left_px - px, axis=1)
    near = np.argsort(away)[:8]
    near = near[away[near] < _NEAR_PX]
    if len(near) < 3:
        cure = "Choose ends on something with texture that both photographs show."
        got = f"({pixel[0]:.0f}, {pixel[1]:.0f}) with {len(near)} nearby"
        bad_value("known length", "near matched points", got, cure)
    w = inverse_depth[near]
    middle = float(np.median(w))
    spread = SD_PER_MAD * float(np.median(np.abs(w / middle - 1)))
    ray = np.linalg.solve(tracks.K_left, (*px, 1.0))
    return ray / middle, spread


def find_scale(
    tracks: Tracks,
    Ts: np.ndarray,
    factor: float,
    baseline_m: float | None,
    known_length: tuple[float, float, float, float, float] | None,
    points: np.ndarray | None,
) -> Scale:
    """Metres per unit ``s``, from whichever length is given; arguments as ``from_photographs``.

    A measured baseline ``b`` gives ``s = b / |t|``, with ``t`` that of the first right camera; a known length
    ``l`` between two points ``X`` of the scene ``s = l / |X_1 - X_2|``; known points of depth ``z_i`` metres
    ``s = argmin_s sum_i |z_i / d_i - s|``, with ``d_i`` units the depth of the match nearest to each.

    ``Ts (V, 4, 4)`` are ``T_right_from_left`` in units; ``factor`` is pixels of the tracks' grid a pixel of
    the left photograph; ``points`` ``(N, 3)`` metres in the left frame.
    """
    given = [name for name, v in (("baseline", baseline_m), ("known length", known_length)) if v is not None]
    if len(given) > 1:
        bad_value("scale", "given once", " and ".join(given), "Drop one; points may be given beside.")
    if baseline_m is not None:
        return Scale("baseline", baseline_m / float(np.linalg.norm(Ts[0, :3, 3])))
    fits = (np.nan_to_num(residuals_px(tracks, Ts), nan=0.0) < 1.5).all(0)
    tracks = tracks.kept(fits)
    inverse_depth = solve_inverse_depth(tracks, Ts)
    tracks, inverse_depth = tracks.kept(inverse_depth > 0), inverse_depth[inverse_depth > 0]
    if known_length is not None:
        *ends, metres = known_length
        check_number(metres, "known length", 1e-6, 1e6)
        pixels = np.array(ends).reshape(2, 2)
        (first, s1), (second, s2) = (_point_at(each, factor, tracks, inverse_depth) for each in pixels)
        length = float(np.linalg.norm(first - second))
        if length < 1e-9:
            bad_value("known length", "between two places", "the same place twice")
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
        bad_value("points", "with at least 5 near matched points", f"{int(close.sum())}")
    ratios = ahead[close, 2] * inverse_depth[nearest[close]]
    factor = float(np.median(ratios))
    spread = SD_PER_MAD * float(np.median(np.abs(ratios / factor - 1))) / np.sqrt(close.sum())
    return Scale("points", factor, spread)
