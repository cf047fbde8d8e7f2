"""Rotation and direction of the baseline of two photographs, by PoseLib (Larsson), or why there is none."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.pose.matches import GreyViews, Matcher
from geodiff_plugin.pose.tracks import Tracks, residuals_px, solve_inverse_depth

#: An inlier lies nearer to its epipolar line, or to its place under a simpler motion, than this.
INLIER_PX = 2.0
#: Fewer inliers, or a smaller share of the matches, make no pose.
FEWEST_INLIERS, LEAST_SHARE = 30, 0.3
#: Median angle between the two rays of a point below which no depth is to be had, and below which little.
NO_PARALLAX_DEG, LITTLE_PARALLAX_DEG = 0.3, 0.6
#: Rows that agree this well, without any turn, are those of a rectified pair.
RECTIFIED_PX = 0.45
#: A simpler motion that explains this share of the inliers is the motion.
SIMPLER = 0.9
#: Matches this far from their lines are no noise of the pose; a second motion that explains this share
#: of all matches, and of those, is one of the scene. Above the last, as a share of the first motion's
#: matches, nobody can tell which of the two the camera made.
APART_PX, SECOND_SHARE, SECOND_OF_REST, RIVAL = 6.0, 0.1, 0.5, 0.45


@dataclass(frozen=True, eq=False)
class EstimatedPose:
    """A relative pose of two photographs.

    Attributes:
        T: ``(4, 4)``, ``T_right_from_left`` with a baseline of length 1.
        inliers: ``(N,)`` bool, the tracks that it explains.
        parallax_deg: median angle between the two rays of an inlier.
        residual_px: median distance of the inliers from their epipolar lines.
        rectified: whether all rows agree, which those of two photographs by hand do not by chance.
        warnings: sentences for the user.
    """

    T: np.ndarray
    inliers: np.ndarray
    parallax_deg: float
    residual_px: float
    rectified: bool
    warnings: tuple[str, ...]


def _right_rays(tracks: Tracks) -> np.ndarray:
    pixels = np.c_[tracks.right_px[0], np.ones(len(tracks))]
    return np.linalg.solve(tracks.K_rights[0], pixels.T).T


def _parallax_deg(tracks: Tracks, R: np.ndarray) -> np.ndarray:
    """Angle ``(N,)`` degrees between the two rays of every track of a view, by ``R (3, 3)`` of its pose."""
    left, right = tracks.rays @ R.T, _right_rays(tracks)
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(left, right), axis=1), (left * right).sum(1)))


def estimate_pose(tracks: Tracks, name: str = "the two photographs") -> EstimatedPose:
    """Rotation and direction of the baseline of one right view, of tracks with outliers.

    Raises:
        InputError: PoseLib is not installed; no pose is to be had: too few matches or inliers, a pure
            rotation, too little parallax, two motions.
    """
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
        warnings.append(
            f"The parallax between {name} is {parallax:.2f} degrees in the median: depth rests on little. "
            "Move the camera further sideways."
        )
    left, right = (px[near].astype(np.float32) for px in (tracks.left_px, tracks.right_px[0]))
    on_plane = cv2.findHomography(left, right, cv2.RANSAC, INLIER_PX)[1]
    if on_plane is not None and on_plane.mean() > SIMPLER:
        warnings.append(
            f"Nearly all matches of {name} lie on one plane: several poses explain them about as well. "
            "Take photographs with things at different depths, or give the pose."
        )
    residual_px = float(np.median(residual[inliers]))
    return EstimatedPose(T, inliers, parallax, residual_px, sideways is not None, tuple(warnings))


def estimate_poses(views: GreyViews, matcher: Matcher) -> tuple[Tracks, list[EstimatedPose]]:
    """Poses of the right views of two photographs or more, matched anew.

    Returns:
        The inliers of all views, and the pose of each; the first baseline has length 1.

    Raises:
        InputError: as ``estimate_pose``; or views that share too few points with the first one.
    """
    tracks, poses = matcher(views), []
    for v in range(len(views.rights)):
        name = "the two photographs" if len(views.rights) == 1 else f"the left and right photograph {v + 1}"
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


def _of_second_motion(tracks: Tracks, T: np.ndarray, inliers: np.ndarray, name: str) -> list[str]:
    """Refuse, or report, a part of the scene that moved on its own: a second pose explains its matches.

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
    return [
        f"{100 * count / len(tracks):.0f} % of the matches of {name} follow a motion of their own: they lie "
        f"at wrong depths, and the pose may be wrong as well. {cure}"
    ]


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
        got = (
            f"a camera that only turned ({share:.0%} of the matches say so, parallax {parallax:.2f} degrees)"
        )
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
