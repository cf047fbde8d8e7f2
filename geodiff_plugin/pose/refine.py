"""Checks given poses against the images and refines them if they do not fit.

A pose that fits is used bit for bit. Errors that no pose explains (rolling shutter, lens distortion, K) are
then removed from the right image by a smooth displacement across the epipolar lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import ALL_VALID, PosedViews, View, resized_px
from geodiff_plugin.pose.fit import PoseFit, pose_change, poses_of
from geodiff_plugin.pose.solve import nearby_poses, regularized_poses
from geodiff_plugin.pose.tracks import (
    Tracks,
    coarse_depth,
    dense_tracks,
    epipolar,
    median_residuals,
    merge_tracks,
    project_tracks,
    solve_inverse_depth,
)
from geodiff_plugin.types import PoseReport, RejectedPose

# Minimum relative reduction of the residual by a refinement.
_MIN_GAIN = 0.1
# Maximum rotation of a camera by a refinement, degrees.
_MAX_ROTATION_DEG = 8.0
# Maximum shift of a camera by a refinement, relative to the baseline.
_MAX_SHIFT = 0.8
#: Relative standard deviation of the distance between two cameras under the poses of a tracker, measured on
#: 85 pairs of two trackers.
LENGTH_SPREAD = 0.15
#: Relative standard deviation of the scene's median depth on the same pairs. A pose used as given has this
#: uncertainty of scale unless its length was measured, since a pair does not show lengths.
DEPTH_SPREAD = 0.05
# Image warp: residual at which a match has half the weight, pixels.
_WARP_SCALE_PX = 0.5
# Image warp: ridge regularization of its 20 coefficients, in matches.
_RIDGE = 3.0
# Image warp: minimum number of matches for the fit.
_MIN_WARP_MATCHES = 80
# Image warp: side of the cross-validation blocks, relative to the image's longer side.
_BLOCK = 1.0 / 6.0
# Image warp: minimum relative reduction of the residual of held-out matches.
_MIN_WARP_GAIN = 0.05


class CheckedViews(NamedTuple):
    """Right views with the poses and images used after the check, and its report."""

    views: tuple[View, ...]
    report: PoseReport
    tracks: Tracks | None = None  # tracks that refined the poses; None if they are used as given
    warps: tuple[Displacement | None, ...] = ()  # of the images; empty if they are unchanged


def report_as_given(rights: Sequence[View], status: str = "given") -> PoseReport:
    """Return the report of poses that are used as given, without measurements."""
    poses = _as_E(poses_of(rights))
    return PoseReport(status, poses, poses)


@dataclass(frozen=True, eq=False)
class _Misfit:
    """Right views whose poses do not fit, with their tracks and limits."""

    rights: tuple[View, ...]
    sizes: Sequence[tuple[int, int]]  # (H, W) of the right images of the tracks
    tracks: Tracks
    given: np.ndarray  # (V, 4, 4) T_right_from_left
    near: np.ndarray  # (V, 4, 4) poses near the given ones that fit approximately
    fits_px: float  # maximum residual of a pose that fits
    rig: bool  # whether it is a rectified rig
    measured: bool  # whether the baseline lengths are measured


def nearby_of(fit: PoseFit) -> np.ndarray:
    """Return the best-fitting poses ``(V, 4, 4)`` near the given ones; the given ones if they fit."""
    given = fit.greys.given
    return given if fit.fits else nearby_poses(fit.tracks, given, fit.residual_px)


def refine_views(
    posed: PosedViews, fit: PoseFit, near: np.ndarray, measured: bool, mistaken: bool = False
) -> CheckedViews:
    """Refine the poses of a known fit if they do not fit the images.

    ``near (V, 4, 4)`` are the poses of ``nearby_of``. ``measured`` baselines keep their lengths, as for a
    rectified rig; others are weighed against the depth of the scene. The given views are returned if
    they fit, if a common error explains the misfit (``mistaken``), or if no nearby pose is better. A
    rectified rig is refined only if the dense matches do not fit it either.
    """
    rights = posed.rights
    sparse = fit.tracks
    given = fit.greys.given
    before = fit.residual_px
    report = _with_residuals(_as_given(posed, fit, measured), sparse, before)
    if mistaken:
        return CheckedViews(rights, replace(report, status="mistaken"))
    if fit.fits:
        return CheckedViews(rights, report)
    depth_m = coarse_depth(posed._replace(rights=with_poses(rights, near)), fit.greys.views[0].grey.shape)
    tracks = merge_tracks([sparse, dense_tracks(fit.greys.views, depth_m, near)])
    if fit.rig:
        by_all = median_residuals(tracks, given)
        if not (by_all > fit.limit_px).any():
            # The sparse matches misfit by chance; a calibration is not changed unless all matches disagree
            # with it.
            return CheckedViews(rights, _with_residuals(report, tracks, by_all))
    sizes = [(view.grey.shape[0], view.grey.shape[1]) for view in fit.greys.views[1:]]
    return _refined(_Misfit(rights, sizes, tracks, given, near, fit.limit_px, fit.rig, measured), report)


def _with_residuals(report: PoseReport, tracks: Tracks, residual_px: np.ndarray) -> PoseReport:
    """Add the residuals ``(V,)`` of tracks under the given poses, which are in use, to the report."""
    residuals = tuple(residual_px.tolist())
    matches = tuple(map(float, tracks.seen.sum(1)))
    return replace(report, residual_px_given=residuals, residual_px=residuals, matches=matches)


def _as_given(posed: PosedViews, fit: PoseFit, measured: bool) -> PoseReport:
    """Return the report of poses used as given; lengths that were not measured are uncertain."""
    spread = None if fit.rig or measured else DEPTH_SPREAD
    return replace(report_as_given(posed.rights, "fits"), scale_rel_std=spread, rig=fit.rig)


def refine_by_flow(posed: PosedViews, fit: PoseFit, measured: bool) -> CheckedViews:
    """Check and refine poses with optical flow as well, for views with few feature matches.

    Flow starts from the prediction of the poses and stays there on textureless surfaces. A pose that it does
    not fit is therefore wrong, but a pose refined by it is not certain. This evidence is too weak to change a
    calibration.
    """
    rights = posed.rights
    given = fit.greys.given
    sparse = fit.tracks
    left, *greys = [view.grey for view in fit.greys.views]
    tracks = sparse
    with suppress(InputError):  # views without overlap; matching raises their error
        depth_m = coarse_depth(posed, (left.shape[0], left.shape[1]))
        tracks = merge_tracks([sparse, dense_tracks(fit.greys.views, depth_m, given)])
    before = median_residuals(tracks, given)
    report = _with_residuals(_as_given(posed, fit, measured), tracks, before)
    misses = bool((before > fit.limit_px).any())
    if np.isnan(before).all() or (misses and fit.rig):
        return CheckedViews(rights, replace(report, status="not checked"))
    if not misses:
        return CheckedViews(rights, report)
    sizes = [(image.shape[0], image.shape[1]) for image in greys]
    misfit = _Misfit(rights, sizes, tracks, given, given, fit.limit_px, rig=False, measured=measured)
    features = int(sparse.seen.sum(1).max(initial=0))
    return _refined(misfit, replace(report, features=features))


def _refined(misfit: _Misfit, report: PoseReport) -> CheckedViews:
    """Return views with better-fitting poses, and images without the residuals that no pose explains.

    Returns the given views if no nearby pose is better, or if the better one is too far away.
    """
    rights, tracks, given = misfit.rights, misfit.tracks, misfit.given
    before = median_residuals(tracks, given)
    Ts, free = regularized_poses(tracks, given, misfit.near, before, misfit.rig)
    after = median_residuals(tracks, Ts)
    depth_change = (
        0.0 if misfit.rig else depth_difference(tracks, Ts, free)
    )  # a calibration determines the pose
    report = replace(_with_residuals(report, tracks, before), status="kept", depth_spread=depth_change)
    if not np.nanmean(after) < (1.0 - _MIN_GAIN) * np.nanmean(before):
        return CheckedViews(rights, report)
    rejected = _rejected(given, Ts, before, after)
    if rejected is not None:
        return CheckedViews(rights, replace(report, rejected=rejected))
    keeps_length = misfit.rig or misfit.measured
    Ts, spread = (Ts, None) if keeps_length else _rescaled(tracks, given, Ts, before)
    return _warped_views(misfit, replace(report, status="refined", scale_rel_std=spread), before, Ts)


def _rejected(
    given: np.ndarray, Ts: np.ndarray, before: np.ndarray, after: np.ndarray
) -> RejectedPose | None:
    """Return the worst refined pose that is too far from the given one, by the residuals ``before (V,)``."""
    turned_deg, shifts = pose_change(given, Ts)
    far = ~((turned_deg < _MAX_ROTATION_DEG) & (shifts < _MAX_SHIFT))
    if not far.any():
        return None
    v = int(np.lexsort((np.nan_to_num(before), far & ~np.isnan(before)))[-1])
    return RejectedPose(v, float(turned_deg[v]), float(shifts[v]), float(after[v]))


def _warped_views(misfit: _Misfit, report: PoseReport, before: np.ndarray, Ts: np.ndarray) -> CheckedViews:
    """Return the views with refined poses ``Ts``, and images without the residuals that these do not explain.

    ``before (V,)`` are the residuals under the given poses: a view that already fitted keeps its image.
    """
    tracks = misfit.tracks
    warps = [
        fit_displacement(tracks.view(v), T, size) if before[v] > misfit.fits_px else None
        for v, (T, size) in enumerate(zip(Ts, misfit.sizes, strict=True))
    ]
    pairs = zip(tracks.right_px, warps, strict=True)
    corrected_px = np.stack([px if warp is None else px + warp.at(px) for px, warp in pairs])
    report = replace(
        report,
        E=_as_E(Ts),
        residual_px=tuple(median_residuals(replace(tracks, right_px=corrected_px), Ts).tolist()),
        warp_rms_px=tuple(0.0 if warp is None else warp.rms_px for warp in warps),
    )
    return CheckedViews(with_poses(misfit.rights, Ts, warps), report, tracks, tuple(warps))


def refined_scale(refined: np.ndarray, given: np.ndarray, misfit: float) -> tuple[float, float]:
    """Return the factor on refined translations and its relative standard deviation, or NaN.

    Two given lengths determine the scale: the baseline and the scene depth, since a tracker's errors of
    rotation and shift compensate each other. The result is their mean, weighted by uncertainty. ``refined``
    and ``given (N,)`` are inverse depths under the refined poses, with the given lengths, and under the given
    poses. ``misfit`` is the ratio of the median distance of matches from their epipolar lines to their median
    parallax: errors of this size are expected along the lines too, where they change depth. The more the
    ratio of both depths varies over the image, the less its median determines the scale. Both are NaN if no
    point is in front of the cameras.
    """
    ahead = (refined > 0) & (given > 0)
    if not ahead.any():
        return float("nan"), float("nan")
    ratios = np.log(refined[ahead] / given[ahead])
    by_depth = float(np.median(ratios))
    uneven = float(np.median(np.abs(ratios - by_depth)))
    of_length = LENGTH_SPREAD**2
    of_depth = DEPTH_SPREAD**2 + misfit**2 + uneven**2
    weight = of_length / (of_length + of_depth)
    # Variance of the weighted mean, plus the disagreement of the two lengths.
    variance = weight * of_depth + weight * (1.0 - weight) * by_depth**2
    return float(np.exp(weight * by_depth)), float(np.sqrt(variance))


def _rescaled(
    tracks: Tracks, given: np.ndarray, Ts: np.ndarray, before: np.ndarray
) -> tuple[np.ndarray, float]:
    """Scale a tracker's refined poses by baselines and scene depth; also returns the spread of the scale."""
    refined = solve_inverse_depth(tracks, Ts)
    shifts = []
    depths = refined, np.zeros_like(refined)
    for seen, K, T in zip(tracks.seen, tracks.K_rights, Ts, strict=True):
        here, far = (project_tracks(tracks.rays[seen], w[seen], K, T).px for w in depths)
        shifts.append(np.linalg.norm(here - far, axis=1))
    misfit = float(np.nanmean(before) / max(np.median(np.concatenate(shifts)), 1e-6))
    factor, spread = refined_scale(refined, solve_inverse_depth(tracks, given), misfit)
    scaled = Ts.copy()
    scaled[:, :3, 3] *= factor
    return (scaled, spread) if np.isfinite(factor) else (Ts, float("inf"))


@dataclass(frozen=True, eq=False)
class Displacement:
    """Cubic displacement field of a right image."""

    coefficients: np.ndarray  # (10, 2) pixels
    size: tuple[int, int]  # (H, W) of the image
    max_px: float  # maximum displacement of a pixel
    rms_px: float  # RMS over the matches

    def at(self, px: np.ndarray) -> np.ndarray:
        """Compute the displacement ``(N, 2)`` of pixels ``(N, 2)``."""
        displaced = _cubic(px, self.size) @ self.coefficients
        length = np.linalg.norm(displaced, axis=1, keepdims=True)
        return displaced * np.minimum(1.0, self.max_px / np.maximum(length, 1e-9))


def _cubic(px: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Compute all monomials of x and y up to degree three, ``(N, 10)``, on [-1, 1] of the longer side."""
    half = max(size) / 2.0
    x, y = (px[:, 0] - (size[1] - 1) / 2) / half, (px[:, 1] - (size[0] - 1) / 2) / half
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)


def _fit_cubic(basis: np.ndarray, normals: np.ndarray, off: np.ndarray) -> np.ndarray:
    rows = (basis[:, :, None] * normals[:, None]).reshape(len(basis), -1)
    solution = np.zeros(rows.shape[1])
    for _ in range(15):
        weights = 1.0 / (1.0 + ((rows @ solution - off) / _WARP_SCALE_PX) ** 2)
        weighted = rows * weights[:, None]
        solution = np.linalg.solve(weighted.T @ rows + _RIDGE * np.eye(rows.shape[1]), weighted.T @ off)
    return solution.reshape(10, 2)


def fit_displacement(tracks: Tracks, T: np.ndarray, size: tuple[int, int]) -> Displacement | None:
    """Fit the displacement of one right view's matches, of ``size`` ``(H, W)``, to their epipolar lines.

    ``None`` with few matches, without a smooth residual, or if held-out matches disagree. Only for a refined
    pose ``T (4, 4)``: a residual that depends on depth indicates a wrong pose.
    """
    if len(tracks) < _MIN_WARP_MATCHES:
        return None
    off, normals, _ = epipolar(tracks, T)
    basis = _cubic(tracks.right_px[0], size)
    block = (tracks.left_px // (_BLOCK * max(size))).sum(1) % 2 == 0
    predicted = np.empty(len(off))
    for part in (block, ~block):
        if part.sum() < _MIN_WARP_MATCHES // 4:
            return None
        fit = _fit_cubic(basis[part], normals[part], off[part])
        predicted[~part] = ((basis[~part] @ fit) * normals[~part]).sum(1)
    if np.median(np.abs(off - predicted)) > (1.0 - _MIN_WARP_GAIN) * np.median(np.abs(off)):
        return None
    coefficients = _fit_cubic(basis, normals, off)
    lengths = np.linalg.norm(basis @ coefficients, axis=1)
    max_px = float(np.quantile(lengths, 0.98))
    rms_px = float(np.sqrt((lengths**2).mean()))
    return Displacement(coefficients, size, max_px, rms_px)


def warp_image(image_01: Tensor, displacement: Displacement) -> Tensor:
    """Warp a right image ``(C, H, W)`` by a displacement, scaled to its size.

    Its border is replicated outside; not differentiable.
    """
    height, width = image_01.shape[-2:]
    scale = np.array([displacement.size[1] / width, displacement.size[0] / height])
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2).astype(np.float64)
    displaced = displacement.at(resized_px(grid, (width, height), displacement.size[::-1])) / scale
    source = (grid - displaced).reshape(height, width, 2).astype(np.float32)
    pixels = image_01.detach().cpu().float().permute(1, 2, 0).contiguous().numpy()
    warped = cv2.remap(pixels, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    warped = warped.reshape(height, width, -1).clip(0.0, 1.0)
    return torch.from_numpy(np.ascontiguousarray(warped.transpose(2, 0, 1))).to(image_01)


def _warp_mask(valid: Tensor | None, displacement: Displacement) -> Tensor | None:
    """Warp the valid pixels ``(H, W)`` of an image by a displacement."""
    return None if valid is None else warp_image(valid[None].float(), displacement)[0] > ALL_VALID


def _as_E(Ts: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.linalg.inv(T) for T in Ts)


def with_poses(
    rights: Sequence[View], Ts: np.ndarray, warps: Sequence[Displacement | None] = ()
) -> tuple[View, ...]:
    """Return right views with poses ``Ts (V, 4, 4)`` (right from left), and images with the given warps."""
    warps = warps or [None] * len(rights)
    return tuple(
        view._replace(
            image_01=view.image_01 if warp is None else warp_image(view.image_01, warp),
            valid=view.valid if warp is None else _warp_mask(view.valid, warp),
            T_right_from_left=T.astype(view.T_right_from_left.dtype),
        )
        for view, T, warp in zip(rights, Ts, warps, strict=True)
    )


def depth_difference(tracks: Tracks, Ts: np.ndarray, free: np.ndarray) -> float:
    """Compute the median difference in log depth between poses ``Ts`` and ``free``, ``(V, 4, 4)`` each."""
    used, other = (solve_inverse_depth(tracks, poses) for poses in (Ts, free))
    ahead = (used > 0) & (other > 0)
    return float(np.median(np.abs(np.log(used[ahead] / other[ahead])))) if ahead.any() else 0.0
