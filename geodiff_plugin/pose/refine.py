"""Checks given poses against the images, and refines them where they do not fit.

A pose that fits is used bit for bit. Errors that no pose explains (rolling shutter, lens distortion, K) are
removed from the right image afterwards, by a smooth displacement across the epipolar lines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._checks import InputError
from geodiff_plugin.messages import Message, distinct
from geodiff_plugin.pose.fit import FITS_PX, PoseFit, poses_of
from geodiff_plugin.pose.lens import Remaining, remaining_distortion
from geodiff_plugin.pose.mistakes import exchangeable, find_mistake, pose_change
from geodiff_plugin.pose.moving import moved_share
from geodiff_plugin.pose.solve import nearby_poses, regularised_poses
from geodiff_plugin.pose.tracks import (
    FEWEST,
    Behind,
    Tracks,
    behind_infinity,
    coarse_depth,
    dense_tracks,
    epipolar,
    median_residuals,
    merge_tracks,
    project_tracks,
    solve_inverse_depth,
)
from geodiff_plugin.types import CameraView, PosedViews, PoseReport

#: The user is warned if the given pose has a larger residual than this.
WARNS_PX = 1.0
# A refinement must remove this share of the residual.
_LEAST_GAIN = 0.1
# It may turn a camera by this much at most, degrees.
_MOST_TURN_DEG = 8.0
# It may shift a camera by this share of the baseline at most.
_MOST_SHIFT = 0.8
#: Relative standard deviation, under the poses of a tracker, of the distance between two cameras; measured on
#: 85 pairs of two trackers.
LENGTH_SPREAD = 0.15
#: The same of the scene's median depth, measured on the same pairs. A pose that is used as it was given has
#: this uncertainty of its scale unless its length was measured: a pair does not show lengths.
DEPTH_SPREAD = 0.05
#: A pose is undetermined if the one that fits best changes log depth by more than this in the median. That
#: was up to .148 for right pairs, and .17 to .64 where the yaw of E was off by a degree.
MOST_DEPTH_SPREAD = 0.16
#: Features of small pictures are enough only if at most this share of them lies behind infinity, half of the
#: share from which confidence falls.
LITTLE_BEHIND = 0.02
#: They are enough only if the size of k1 is probably at most this, as right pairs show up to this much. Of
#: 236 rigs, right or wrong in one of six ways, 149 passed, whose features at full size showed .05 at most.
LITTLE_DISTORTION = 0.08
#: They are enough only if at most this share of them lies in parts that moved, half of the share that is not
#: trusted.
LITTLE_MOVED = 0.075
#: They are enough only if at most this share of them fits as well with near and far exchanged, half of the
#: share from which the order of the pictures is in doubt.
LITTLE_EXCHANGED = 0.15
# Straightening: residual above which a match counts for less, pixels.
_BENT_PX = 0.5
# Pull of its 20 coefficients towards 0, in matches.
_RIDGE = 3.0
# Fewest matches that it is fitted to.
_FEWEST_BENT = 80
# Side of the blocks for cross-validation, as a share of the image's longer side.
_BLOCK = 1.0 / 6.0
# Share by which the residual of left-out matches must fall.
_LEAST_BENT_GAIN = 0.05

_CAUSES = (
    "Likely causes: poses of a tracker, of SLAM or of a rig that has drifted; things that moved between the "
    "photographs; a rolling shutter; lens distortion that was not taken out; K of another size; "
    "another order of the views, or world-to-camera poses for camera-to-world ones."
)

_DRIFT = (
    "Likely cause: a rig that has drifted since it was calibrated. Calibrate it anew, or keep its "
    "calibration (pose='given', --knob pose=given)."
)


class CheckedViews(NamedTuple):
    """The right views with the poses and images that everything after the check uses, and its report."""

    views: tuple[CameraView, ...]
    report: PoseReport


def report_as_given(rights: Sequence[CameraView], status: str = "given") -> PoseReport:
    """The report of poses that are used as they were given, with nothing that was measured."""
    poses = _as_E(poses_of(rights))
    return PoseReport(status, poses, poses)


@dataclass(frozen=True, eq=False)
class _Misfit:
    """Right views whose poses do not fit, and what is known of them."""

    rights: tuple[CameraView, ...]
    sizes: Sequence[tuple[int, int]]  # (H, W) of the right images that the tracks are of
    tracks: Tracks
    given: np.ndarray  # (V, 4, 4) T_right_from_left
    near: np.ndarray  # (V, 4, 4) poses near the given ones that fit roughly
    fits_px: float  # residual below which a pose fits
    rig: bool  # a rectified one
    measured: bool  # whether the lengths of the baselines are


def refine_views(posed: PosedViews, fit: PoseFit, measured: bool = False) -> CheckedViews:
    """Check the poses of a known fit against the images, and refine them where they do not fit.

    ``measured`` baselines keep their lengths, as those of a rectified rig do; others are weighed against the
    depth of the scene. The given views are returned if they fit, if there are too few matches, if a mistake
    explains the misfit, or if no better pose is near. A rectified rig is refined only if the dense matches
    miss it as well. Where few features match, optical flow is asked. If features of small pictures show that
    the pose of a rig fits, but not that nothing else is wrong, those at full size are matched.
    """
    if not (fit.is_known or fit.surely):
        return _checked_by_flow(posed, fit, measured)
    rights, sparse, given, before = posed.views, fit.tracks, fit.greys.given, fit.residual_px
    near = given if fit.fits else nearby_poses(sparse, given, before)
    signs = _signs_of(fit, near)
    if fit.is_small and not signs.are_usual:
        return refine_views(posed, fit.of_whole_pictures(), measured)
    report = _with_signs(_with_residuals(_as_given(posed, fit, measured), sparse, before), signs, fit)
    if signs.mistakes:
        return CheckedViews(rights, replace(report, status="mistaken", warnings=signs.mistakes))
    if fit.fits:
        return CheckedViews(rights, report)
    depth_m = coarse_depth(posed._replace(views=_applied(rights, near)), fit.greys.views[0][0].shape)
    tracks = merge_tracks([sparse, dense_tracks(fit.greys.views, depth_m, near)])
    if fit.rig:
        by_all = median_residuals(tracks, given)
        if not (by_all > fit.limit_px).any():
            # The few sparse matches missed by chance: a calibration is not changed for what all do not show.
            return CheckedViews(rights, _with_residuals(report, tracks, by_all))
    sizes = [(grey.shape[0], grey.shape[1]) for grey, _ in fit.greys.views[1:]]
    return _refined(_Misfit(rights, sizes, tracks, given, near, fit.limit_px, fit.rig, measured), report)


def _with_residuals(report: PoseReport, tracks: Tracks, residual_px: np.ndarray) -> PoseReport:
    """The report with the residuals ``(V,)`` of these tracks under the given poses, which are in use."""
    residuals, matches = tuple(residual_px.tolist()), tuple(map(float, tracks.seen.sum(1)))
    return replace(report, residual_px_given=residuals, residual_px=residuals, matches=matches)


def _as_given(posed: PosedViews, fit: PoseFit, measured: bool) -> PoseReport:
    """The report of poses in use as they were given: a pair does not show lengths that nobody measured."""
    spread = None if fit.rig or measured else DEPTH_SPREAD
    return replace(report_as_given(posed.views, "fits"), scale_spread=spread)


def _checked_by_flow(posed: PosedViews, fit: PoseFit, measured: bool) -> CheckedViews:
    """The views whose features hardly match, with poses checked, and refined, by optical flow as well.

    Flow starts from what the poses predict, and stays there on blank walls. So a pose that it does not fit is
    wrong, but one that is refined by it is not certain. A calibration is not changed for that little.
    """
    rights, given, sparse = posed.views, fit.greys.given, fit.tracks
    left, *greys = [grey for grey, _ in fit.greys.views]
    tracks = sparse
    with suppress(InputError):  # views without overlap, which matching is the one to refuse
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
    views, report = _refined(misfit, report)
    return CheckedViews(views, replace(report, warnings=(*report.warnings, _by_flow_alone(sparse, before))))


class _Signs(NamedTuple):
    """What matches say against the poses as given, and against the pictures."""

    moved: float  # ``moved_share`` of the worst view
    behind: Behind
    distortion: Remaining  # of the first view
    exchangeable: float
    mistakes: tuple[Message, ...]

    @property
    def are_usual(self) -> bool:
        """Whether the few matches of one small pair exclude every other fault; an unknown sign does not."""
        return not self.mistakes and (
            self.behind.share <= LITTLE_BEHIND
            and self.distortion.at_most <= LITTLE_DISTORTION
            and self.moved <= LITTLE_MOVED
            and self.exchangeable <= LITTLE_EXCHANGED
        )


def _signs_of(fit: PoseFit, near: np.ndarray) -> _Signs:
    """The signs of a fit; ``near (V, 4, 4)`` are poses near the given ones that fit best."""
    tracks, given = fit.tracks, fit.greys.given
    moved = (moved_share(tracks.view(v), T) for v, T in enumerate(given))
    return _Signs(
        max((share for share in moved if not math.isnan(share)), default=math.nan),
        behind_infinity(tracks, given),
        remaining_distortion(tracks.view(0), given[0]),
        exchangeable(tracks, given, near, [grey.shape for grey, _ in fit.greys.views]),
        _messages(tracks, find_mistake, given, near),
    )


def _with_signs(report: PoseReport, signs: _Signs, fit: PoseFit) -> PoseReport:
    """The report with what the matches of a fit say, and what its pictures show alone."""
    return replace(
        report,
        moved=signs.moved,
        behind_infinity=signs.behind.share,
        behind_px=signs.behind.px,
        distortion=signs.distortion.k1,
        distortion_alone=signs.distortion.alone,
        exchangeable=signs.exchangeable,
        tear=fit.greys.signs.tear,
        bars=fit.greys.signs.bars,
    )


def _refined(misfit: _Misfit, report: PoseReport) -> CheckedViews:
    """The views with poses that fit better, and images without the residuals that no pose explains.

    The given views where no pose near them is better, or the better one is too far away.
    """
    rights, tracks, given = misfit.rights, misfit.tracks, misfit.given
    before = median_residuals(tracks, given)
    Ts, free = regularised_poses(tracks, given, misfit.near, before, misfit.rig)
    after = median_residuals(tracks, Ts)
    worst = int(np.argmax(np.nan_to_num(before)))
    apart = 0.0 if misfit.rig else depths_apart(tracks, Ts, free)  # a calibration determines the pose
    doubts = _undetermined(apart)
    report = replace(_with_residuals(report, tracks, before), depth_spread=apart)
    if not np.nanmean(after) < (1.0 - _LEAST_GAIN) * np.nanmean(before):
        warnings = _kept_misfit(before, worst) + doubts
        return CheckedViews(rights, replace(report, status="kept", warnings=warnings))
    turned_deg, shifts = pose_change(given, Ts)
    far = ~((turned_deg < _MOST_TURN_DEG) & (shifts < _MOST_SHIFT))
    if far.any():
        v = int(np.lexsort((np.nan_to_num(before), far & ~np.isnan(before)))[-1])  # the worst of the far ones
        warnings = _too_far(before, after, v, turned_deg[v], shifts[v])
        return CheckedViews(rights, replace(report, status="kept", warnings=warnings))
    keeps_length = misfit.rig or misfit.measured
    Ts, spread = (Ts, None) if keeps_length else _rescaled(tracks, given, Ts, before)
    warnings = _refined_misfit(before, after, worst, misfit.rig) + doubts
    report = replace(report, status="refined", warnings=warnings, scale_spread=spread)
    return _straightened_views(misfit, report, before, Ts)


def _straightened_views(
    misfit: _Misfit, report: PoseReport, before: np.ndarray, Ts: np.ndarray
) -> CheckedViews:
    """The views with refined poses ``Ts``, and images without the residuals that these do not explain.

    ``before (V,)`` are the residuals under the poses as given: a view that fitted keeps its image.
    """
    tracks = misfit.tracks
    bends = [
        fit_displacement(tracks.view(v), T, size) if before[v] > misfit.fits_px else None
        for v, (T, size) in enumerate(zip(Ts, misfit.sizes, strict=True))
    ]
    pairs = zip(tracks.right_px, bends, strict=True)
    straight = np.stack([px if bend is None else px + bend.at(px) for px, bend in pairs])
    behind = behind_infinity(tracks, Ts)
    report = replace(
        report,
        behind_infinity=behind.share,
        behind_px=behind.px,
        E=_as_E(Ts),
        residual_px=tuple(median_residuals(replace(tracks, right_px=straight), Ts).tolist()),
        straightened_px=tuple(0.0 if bend is None else bend.rms_px for bend in bends),
    )
    return CheckedViews(_applied(misfit.rights, Ts, bends), report)


def refined_scale(refined: np.ndarray, given: np.ndarray, misfit: float) -> tuple[float, float]:
    """Factor on refined translations, and its relative standard deviation; NaN if no point is in front.

    Two given lengths fix the scale: that of the baseline, and the depth of the scene, since a tracker's
    errors of rotation and shift compensate. The result is their mean, weighted by uncertainty. ``refined``
    and ``given (N,)`` are inverse depths under the refined poses, with the given lengths, and under the given
    poses. ``misfit`` is the median distance of matches from their epipolar lines over their median parallax:
    as much error is expected along the lines, where it changes depth. The more the ratio of both depths
    differs from place to place, the less its median says about the scale.
    """
    ahead = (refined > 0) & (given > 0)
    if not ahead.any():
        return float("nan"), float("nan")
    ratios = np.log(refined[ahead] / given[ahead])
    by_depth = float(np.median(ratios))
    uneven = float(np.median(np.abs(ratios - by_depth)))
    of_length, of_depth = LENGTH_SPREAD**2, DEPTH_SPREAD**2 + misfit**2 + uneven**2
    weight = of_length / (of_length + of_depth)
    # The variance of the weighted mean, and what the two lengths disagree by.
    variance = weight * of_depth + weight * (1.0 - weight) * by_depth**2
    return float(np.exp(weight * by_depth)), float(np.sqrt(variance))


def _rescaled(
    tracks: Tracks, given: np.ndarray, Ts: np.ndarray, before: np.ndarray
) -> tuple[np.ndarray, float]:
    """Refined poses of a tracker, scaled by both baselines and scene, and the spread of the scale."""
    refined, shifts = solve_inverse_depth(tracks, Ts), []
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
    """A cubic displacement of a right image."""

    coefficients: np.ndarray  # (10, 2) pixels
    size: tuple[int, int]  # (H, W) of the image
    most_px: float  # no pixel moves further
    rms_px: float  # of the matches

    def at(self, px: np.ndarray) -> np.ndarray:
        """The displacement ``(N, 2)`` of pixels ``(N, 2)``."""
        moved = _cubic(px, self.size) @ self.coefficients
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        return moved * np.minimum(1.0, self.most_px / np.maximum(length, 1e-9))


def _cubic(px: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """``(N, 10)``: all products of x and y up to the third degree, over [-1, 1] of the longer side."""
    half = max(size) / 2.0
    x, y = (px[:, 0] - (size[1] - 1) / 2) / half, (px[:, 1] - (size[0] - 1) / 2) / half
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)


def _fit_cubic(basis: np.ndarray, normals: np.ndarray, off: np.ndarray) -> np.ndarray:
    rows = (basis[:, :, None] * normals[:, None]).reshape(len(basis), -1)
    solution = np.zeros(rows.shape[1])
    for _ in range(15):
        weights = 1.0 / (1.0 + ((rows @ solution - off) / _BENT_PX) ** 2)
        weighted = rows * weights[:, None]
        solution = np.linalg.solve(weighted.T @ rows + _RIDGE * np.eye(rows.shape[1]), weighted.T @ off)
    return solution.reshape(10, 2)


def fit_displacement(tracks: Tracks, T: np.ndarray, size: tuple[int, int]) -> Displacement | None:
    """The displacement that brings matches of one right view of ``size`` ``(H, W)`` to their epipolar lines.

    ``None`` where there are few matches, nothing smooth is left, or left-out matches do not agree. Only for a
    refined pose ``T (4, 4)``: a residual that depends on depth is a pose's.
    """
    if len(tracks) < _FEWEST_BENT:
        return None
    off, normals, _ = epipolar(tracks, T)
    basis = _cubic(tracks.right_px[0], size)
    block = (tracks.left_px // (_BLOCK * max(size))).sum(1) % 2 == 0
    predicted = np.empty(len(off))
    for part in (block, ~block):
        if part.sum() < _FEWEST_BENT // 4:
            return None
        fit = _fit_cubic(basis[part], normals[part], off[part])
        predicted[~part] = ((basis[~part] @ fit) * normals[~part]).sum(1)
    if np.median(np.abs(off - predicted)) > (1.0 - _LEAST_BENT_GAIN) * np.median(np.abs(off)):
        return None
    coefficients = _fit_cubic(basis, normals, off)
    lengths = np.linalg.norm(basis @ coefficients, axis=1)
    most_px, rms_px = float(np.quantile(lengths, 0.98)), float(np.sqrt((lengths**2).mean()))
    return Displacement(coefficients, size, most_px, rms_px)


def straightened(image_01: Tensor, displacement: Displacement) -> Tensor:
    """The right image ``(C, H, W)`` warped by a displacement, which is scaled to its size.

    Its edge is repeated where nothing is seen; not differentiable.
    """
    height, width = image_01.shape[-2:]
    scale = np.array([displacement.size[1] / width, displacement.size[0] / height])
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2).astype(np.float64)
    moved = displacement.at((grid + 0.5) * scale - 0.5) / scale
    source = (grid - moved).reshape(height, width, 2).astype(np.float32)
    pixels = image_01.detach().cpu().float().permute(1, 2, 0).contiguous().numpy()
    bent = cv2.remap(pixels, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    bent = bent.reshape(height, width, -1).clip(0.0, 1.0)
    return torch.from_numpy(np.ascontiguousarray(bent.transpose(2, 0, 1))).to(image_01)


def _as_E(Ts: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.linalg.inv(T) for T in Ts)


def _applied(
    rights: Sequence[CameraView], Ts: np.ndarray, bends: Sequence[Displacement | None] | None = None
) -> tuple[CameraView, ...]:
    bends = bends or [None] * len(rights)
    return tuple(
        CameraView(image if bend is None else straightened(image, bend), K, given.new_tensor(T))
        for (image, K, given), T, bend in zip(rights, Ts, bends, strict=True)
    )


def _messages(
    tracks: Tracks, check: Callable[..., Message | None], *poses: np.ndarray
) -> tuple[Message, ...]:
    """What ``check`` says of every view that has matches, each message once."""
    views = [(tracks.view(v), *of_view) for v, of_view in enumerate(zip(*poses, strict=True))]
    found = [check(*view) for view in views if len(view[0]) >= FEWEST]
    return distinct(message for message in found if message is not None)


def depths_apart(tracks: Tracks, Ts: np.ndarray, free: np.ndarray) -> float:
    """Median difference in log depth of the matches under poses ``Ts`` and ``free``, ``(V, 4, 4)`` each."""
    used, other = (solve_inverse_depth(tracks, poses) for poses in (Ts, free))
    ahead = (used > 0) & (other > 0)
    return float(np.median(np.abs(np.log(used[ahead] / other[ahead])))) if ahead.any() else 0.0


def _undetermined(apart: float) -> tuple[Message, ...]:
    """A message where the matches do not determine the pose, and with it the depth."""
    if apart <= MOST_DEPTH_SPREAD:
        return ()
    sentence = (
        "The matches do not determine the pose: another one fits them as well, and its depths differ by "
        f"{100 * np.expm1(apart):.0f} % in the median. Give a more exact pose, or views from further apart."
    )
    return (Message("pose.undetermined", sentence),)


def _by_flow_alone(sparse: Tracks, before: np.ndarray) -> Message:
    """A message about poses that optical flow misses by ``before (V,)`` where few features match."""
    found = sparse.seen.sum(1).max(initial=0)
    sentence = (
        f"The pose could hardly be checked: {found} features match where {FEWEST} are needed. Together "
        f"with matches of optical flow they lie {np.nanmax(before):.1f} px off their epipolar lines in the "
        "median. Give a more exact pose, or views that show more texture or overlap more."
    )
    return Message("pose.few-matches", sentence)


def _misses(before: np.ndarray, v: int, least_px: float = WARNS_PX) -> str | None:
    """How far view ``v``'s pose as given misses the matches; ``None`` if no view is worth a warning."""
    if not np.nanmax(before) > least_px:
        return None
    pose = "The pose as given" if len(before) == 1 else f"The pose of right view {v + 1} as given"
    return f"{pose} leaves matches {before[v]:.1f} px off their epipolar lines in the median"


def _kept_misfit(before: np.ndarray, v: int) -> tuple[Message, ...]:
    misses = _misses(before, v)
    if misses is None:
        return ()
    return (Message("pose.kept", f"{misses}, and no pose near it leaves clearly less. {_CAUSES}"),)


def _refined_misfit(before: np.ndarray, after: np.ndarray, v: int, rig: bool) -> tuple[Message, ...]:
    """A rig whose calibration is changed is always told so, since it stands for being exact."""
    misses = _misses(before, v, FITS_PX if rig else WARNS_PX)
    if misses is None:
        return ()
    causes = _CAUSES if np.nanmax(before) > WARNS_PX else _DRIFT
    return (Message("pose.refined", f"{misses}, a refined one {after[v]:.1f} px. {causes}"),)


def _too_far(
    before: np.ndarray, after: np.ndarray, v: int, turned_deg: float, shift: float
) -> tuple[Message, ...]:
    misses = _misses(before, v)
    if misses is None:
        return ()
    rest = (
        f"A pose {turned_deg:.0f} degrees and {100 * shift:.0f} % of the baseline away fits to "
        f"{after[v]:.1f} px, but is too far from the given one and was not used."
    )
    return (Message("pose.too-far", f"{misses}. {rest} {_CAUSES}"),)
