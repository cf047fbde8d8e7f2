"""Poses as given -> poses that fit the images, or the same ones bit for bit where they fit already.

Data flow: images, K's, T's -> matches -> residual; where it is large, refined poses and straightened images.
Paper: none; it takes exact poses for granted (S3.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin.pose.mistakes import find_mistake, implausible_unit, pose_change
from geodiff_plugin.pose.scale import MOST_SCALE_SPREAD, refined_scale
from geodiff_plugin.pose.settle import (
    FEWEST,
    FREE_PX,
    SCALE_PX,
    is_rig,
    median_residuals,
    nearby_poses,
    settle_poses,
    undecided,
)
from geodiff_plugin.pose.solve import Prior, solve_poses
from geodiff_plugin.pose.straighten import Displacement, fit_displacement, straightened
from geodiff_plugin.pose.tracks import Tracks, merge_tracks, project_tracks, solve_inverse_depth
from geodiff_plugin.pose.views import FirstDepth, dense_tracks, grey_views, sparse_tracks
from geodiff_plugin.types import CameraView, PoseReport

__all__ = ["FITS_PX", "POSED_FITS_PX", "WARNS_PX", "RefinedViews", "polished", "refine_views", "untouched"]

#: A pose whose matches lie nearer than this to their epipolar lines, in the median, is left as it is: that of
#: a rectified rig, whose lenses leave as much, and any other, of which a shift may hide most of a wrong turn.
FITS_PX, POSED_FITS_PX = 0.45, 0.3
#: Above this, as given, the user is told.
WARNS_PX = 1.0
# Robust scales of an estimated pose after the first, pixels. Nothing but the matches holds it, and what most
# of them agree on to a tenth of a pixel is nearer the truth than what all of them are least far from.
_NARROWER_PX = (0.3, 0.15, 0.08)
# A refinement must gain this share of the residual, and may turn and shift a camera so far.
_LEAST_GAIN, _MOST_TURN_DEG, _MOST_SHIFT = 0.1, 8.0, 0.8

_CAUSES = (
    "Likely causes: poses of a tracker, of SLAM or of a rig that has drifted; things that moved between the "
    "photographs; a rolling shutter; lens distortion that was not taken out; K of another size; "
    "another order of the views, or world-to-camera poses for camera-to-world ones."
)


@dataclass(frozen=True, eq=False)
class RefinedViews:
    """What everything downstream works with.

    Attributes:
        rights: the right views as they were given, or with refined poses and straightened images.
        report: what was found.
    """

    rights: tuple[CameraView, ...]
    report: PoseReport


def untouched(rights: Sequence[CameraView], status: str = "given") -> RefinedViews:
    """The views as they were given, and a report that says why."""
    poses = _as_E(_poses(rights))
    return RefinedViews(tuple(rights), PoseReport(status, poses, poses))


def refine_views(
    left_01: Tensor,
    rights: Sequence[CameraView],
    K_left: Tensor,
    first_depth: FirstDepth,
    unit: str | None = "m",
    measured: bool = False,
) -> RefinedViews:
    """Check the poses against the images, and refine them together where they do not fit.

    Args:
        left_01: ``(3, H, W)`` float32 in [0, 1].
        rights: as they were given, one or several.
        K_left: ``(3, 3)`` pixels of ``left_01``.
        first_depth: a rough depth by poses that fit roughly; asked only where refinement is due.
        unit: of the poses' lengths; those in metres are asked about where they seem to be in millimetres.
        measured: whether the lengths of the baselines are measured. Refined poses then keep them, as those of
            a rectified rig do; otherwise they are weighed against the scene's depth under the given poses.

    Returns:
        ``RefinedViews``; its ``rights`` are the very ones that were given where the poses fit, where there
        are too few matches, where a mistake explains the misfit, or where no better pose is near.
    """
    views, given = grey_views(left_01, rights, K_left), _poses(rights)
    sparse = sparse_tracks(views)
    counts = sparse.seen.sum(1)
    if counts.max(initial=0) < FEWEST:
        return untouched(rights, "not checked")
    before, poses = median_residuals(sparse, given), _as_E(given)
    found = PoseReport("fits", poses, poses, _numbers(before), _numbers(before), _numbers(counts))
    rig = is_rig(sparse, given)
    fits_px = FITS_PX if rig else POSED_FITS_PX
    misfit = bool((before > fits_px).any())
    near = nearby_poses(sparse, given, before) if misfit else given
    units = _units(sparse, given) if unit == "m" else ()
    mistakes = _mistakes(sparse, given, near)
    if mistakes:
        return RefinedViews(tuple(rights), found.changed(status="mistaken", warnings=mistakes))
    if not misfit:
        return RefinedViews(tuple(rights), found.changed(warnings=units))
    depth_m = _on_grid(first_depth(_applied(rights, near)), views.left.shape)
    tracks = merge_tracks([sparse, dense_tracks(views, depth_m, near)])
    before = median_residuals(tracks, given)
    Ts, free = settle_poses(tracks, given, near, before, rig)
    after = median_residuals(tracks, Ts)
    found = found.changed(
        residual_px_given=_numbers(before),
        residual_px=_numbers(before),
        matches=_numbers(tracks.seen.sum(1)),
    )
    if not np.nanmean(after) < (1.0 - _LEAST_GAIN) * np.nanmean(before):
        warnings = _unimproved(before) + undecided(tracks, Ts, free) + units
        return RefinedViews(tuple(rights), found.changed(status="kept", warnings=warnings))
    turned_deg, shifts = pose_change(given, Ts)
    far = ~((turned_deg < _MOST_TURN_DEG) & (shifts < _MOST_SHIFT))
    if far.any():
        warnings = _too_far(before, after, far, turned_deg, shifts) + units
        return RefinedViews(tuple(rights), found.changed(status="kept", warnings=warnings))
    doubts, spread = undecided(tracks, Ts, free), None
    if not (rig or measured):
        Ts, spread, uncertain = _rescaled(tracks, given, Ts, before)
        doubts += uncertain
    bends = [
        None if not before[v] > fits_px else fit_displacement(tracks.view(v), T, views.rights[v].shape)
        for v, T in enumerate(Ts)
    ]
    found = found.changed(
        status="refined",
        warnings=_improved(before, after) + doubts + units,
        scale_spread=spread,
        E=_as_E(Ts),
        residual_px=_numbers(_straight_medians(tracks, Ts, bends)),
        straightened_px=tuple(0.0 if bend is None else bend.rms_px for bend in bends),
    )
    return RefinedViews(_applied(rights, Ts, bends), found)


def polished(
    left_01: Tensor, rights: Sequence[CameraView], K_left: Tensor, first_depth: FirstDepth, sparse: Tracks
) -> tuple[np.ndarray, Tracks]:
    """Estimated poses fitted once more to all matches, every view's to all that it shares with others.

    Args:
        left_01: ``(3, H, W)`` float32 in [0, 1].
        rights: with poses that the sparse tracks gave.
        K_left: ``(3, 3)`` pixels of ``left_01``.
        first_depth: as for ``refine_views``.
        sparse: the inliers of the estimation.

    Returns:
        ``(V, 4, 4)``, ``T_right_from_left``, the lengths of the baselines as they were but for their ratios;
        and all matches.
    """
    views, Ts = grey_views(left_01, rights, K_left), _poses(rights)
    tracks = merge_tracks([sparse, dense_tracks(views, _on_grid(first_depth(rights), views.left.shape), Ts)])
    free = Prior(
        np.full(len(Ts), FREE_PX),
        turned_rad=np.radians(3.0),
        shifted_share=0.3,
        longer_share=0.02 if len(Ts) == 1 else 0.2,
    )
    solved = Ts
    for scale_px in (SCALE_PX, *_NARROWER_PX):
        solved = solve_poses(tracks, Ts, free, start=solved, scale_px=scale_px)
    length = np.linalg.norm(Ts[0, :3, 3]) / np.linalg.norm(solved[0, :3, 3])
    solved[:, :3, 3] *= length
    return solved, tracks


def _rescaled(
    tracks: Tracks, given: np.ndarray, Ts: np.ndarray, before: np.ndarray
) -> tuple[np.ndarray, float, tuple[str, ...]]:
    """Refined poses of a tracker at the scale that baselines and scene agree on, its spread, and a warning."""
    refined, shifts = solve_inverse_depth(tracks, Ts), []
    for v, (K, T) in enumerate(zip(tracks.K_rights, Ts, strict=True)):
        rays, w = tracks.rays[tracks.seen[v]], refined[tracks.seen[v]]
        moved = project_tracks(rays, w, K, T).px - project_tracks(rays, np.zeros_like(w), K, T).px
        shifts.append(np.linalg.norm(moved, axis=1))
    misfit = float(np.nanmean(before) / max(np.median(np.concatenate(shifts)), 1e-6))
    factor, spread = refined_scale(refined, solve_inverse_depth(tracks, given), misfit)
    if not np.isfinite(factor):
        return Ts, float("inf"), ()
    Ts = Ts.copy()
    Ts[:, :3, 3] *= factor
    if spread <= MOST_SCALE_SPREAD:
        return Ts, spread, ()
    return (
        Ts,
        spread,
        (
            f"The scale of the refined pose is uncertain by {100 * spread:.0f} % (one standard deviation): "
            "the given baseline and the depth of the scene under the given pose disagree. If the distance "
            "between the cameras is measured, say so (measured_baseline=True, --baseline); otherwise give "
            "known points, or views from further apart.",
        ),
    )


def _mistakes(tracks: Tracks, given: np.ndarray, near: np.ndarray) -> tuple[str, ...]:
    """Sentences on the mistakes that explain the poses as given."""
    views = [(tracks.view(v), *poses) for v, poses in enumerate(zip(given, near, strict=True))]
    found = [find_mistake(own, T, T_near) for own, T, T_near in views if len(own) >= FEWEST]
    return tuple(dict.fromkeys(sentence for sentence in found if sentence))


def _units(tracks: Tracks, given: np.ndarray) -> tuple[str, ...]:
    """Questions about the unit of the translations, which no residual answers."""
    views = [(tracks.view(v), T) for v, T in enumerate(given)]
    found = [implausible_unit(own, T) for own, T in views if len(own) >= FEWEST]
    return tuple(dict.fromkeys(sentence for sentence in found if sentence))


def _on_grid(depth_m: Tensor, size: tuple[int, int]) -> Tensor:
    depth_m = depth_m.detach().cpu().float()
    return torch.nn.functional.interpolate(depth_m, size, mode="bilinear", align_corners=False)


def _poses(rights: Sequence[CameraView]) -> np.ndarray:
    return np.stack([T.detach().cpu().double().numpy() for _, _, T in rights])


def _as_E(Ts: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.linalg.inv(T) for T in Ts)


def _numbers(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


def _straight_medians(tracks: Tracks, Ts: np.ndarray, bends: Sequence[Displacement | None]) -> np.ndarray:
    right_px = np.stack(
        [px if bend is None else px + bend.at(px) for px, bend in zip(tracks.right_px, bends, strict=True)]
    )
    moved = Tracks(tracks.left_px, right_px, tracks.seen, tracks.K_left, tracks.K_rights)
    return median_residuals(moved, Ts)


def _applied(
    rights: Sequence[CameraView], Ts: np.ndarray, bends: Sequence[Displacement | None] | None = None
) -> tuple[CameraView, ...]:
    bends = bends or [None] * len(rights)
    return tuple(
        CameraView(image if bend is None else straightened(image, bend), K, given.new_tensor(T))
        for (image, K, given), T, bend in zip(rights, Ts, bends, strict=True)
    )


def _given(before: np.ndarray, v: int) -> str:
    return "The pose as given" if len(before) == 1 else f"The pose of right view {v + 1} as given"


def _improved(before: np.ndarray, after: np.ndarray) -> tuple[str, ...]:
    worst = int(np.argmax(np.nan_to_num(before)))
    if not before[worst] > WARNS_PX:
        return ()
    return (
        f"{_given(before, worst)} leaves matches {before[worst]:.1f} px off their epipolar lines in the "
        f"median, a refined one {after[worst]:.1f} px. {_CAUSES}",
    )


def _unimproved(before: np.ndarray) -> tuple[str, ...]:
    worst = int(np.argmax(np.nan_to_num(before)))
    if not before[worst] > WARNS_PX:
        return ()
    return (
        f"{_given(before, worst)} leaves matches {before[worst]:.1f} px off their epipolar lines in the "
        f"median, and no pose near it leaves clearly less. {_CAUSES}",
    )


def _too_far(
    before: np.ndarray, after: np.ndarray, far: np.ndarray, turned_deg: np.ndarray, shifts: np.ndarray
) -> tuple[str, ...]:
    if not np.nanmax(before) > WARNS_PX:
        return ()
    v = int(np.lexsort((np.nan_to_num(before), far & ~np.isnan(before)))[-1])  # of those too far, the worst
    return (
        f"{_given(before, v)} leaves matches {before[v]:.1f} px off their epipolar lines in the median. "
        f"A pose {turned_deg[v]:.0f} degrees and {100 * shifts[v]:.0f} % of the baseline away "
        f"fits to {after[v]:.1f} px, but is too far from the given one and was not used. {_CAUSES}",
    )
