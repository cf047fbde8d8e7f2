"""Poses as given -> poses that fit the images, or the same ones bit for bit where they fit already.

Data flow: images, K's, T's -> matches -> residual; above 0.45 px refined poses and straightened images.
Paper: none; it takes exact poses for granted (S3.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin.geometry.cameras import is_rectified
from geodiff_plugin.pose.mistakes import find_mistake, implausible_unit
from geodiff_plugin.pose.noise import independent_share
from geodiff_plugin.pose.solve import Prior, solve_poses
from geodiff_plugin.pose.straighten import Displacement, fit_displacement, straightened
from geodiff_plugin.pose.tracks import Tracks, merge_tracks, residuals_px
from geodiff_plugin.pose.views import FirstDepth, dense_tracks, grey_views, sparse_tracks
from geodiff_plugin.types import CameraView, PoseReport

__all__ = ["FITS_PX", "WARNS_PX", "RefinedViews", "polished", "refine_views", "settle_poses", "untouched"]

#: A pose whose matches lie nearer than this to their epipolar lines, in the median, is left as it is.
FITS_PX = 0.45
#: Above this, as given, the user is told.
WARNS_PX = 1.0
#: Fewer matches than this say nothing about a pose.
FEWEST = 40
# What a refined pose may move the points by, along their lines as well: a share of the residual that it
# explains, which grows with the square of how many times that is what it leaves. Where a pose explains nearly
# all, it was the pose that was wrong; where it leaves much, the cameras have other faults, which a free pose
# would hide. The cameras of a rectified pair are bolted together: they turn by tenths of a degree, hardly
# shift, and a pan that fits the rows better is more often a fault of the lenses; the least share is theirs.
_MOVED_BY, _MOVED_SHARE, _FLOOR_PX = 0.05, (0.4, 10.0), 0.05
_RIG_TURNED_RAD, _RIG_SHIFTED_SHARE = np.radians(0.3), 0.01
# Robust scale of a fit whose noise is not known yet, pixels of the right view; then so many times what the
# fit leaves, and what residuals that are independent count: half, for they are not quite.
_SCALE_PX, _SCALE_BY, _LEAST_SCALE_PX, _COUNTS = 0.7, 2.0, 0.1, 0.5
# What hardly holds a pose: the length of its baseline stays, all else is free.
_FREE_PX = 1e3
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
    left_01: Tensor, rights: Sequence[CameraView], K_left: Tensor, first_depth: FirstDepth
) -> RefinedViews:
    """Check the poses against the images, and refine them together where they do not fit.

    Args:
        left_01: ``(3, H, W)`` float32 in [0, 1].
        rights: as they were given, one or several.
        K_left: ``(3, 3)`` pixels of ``left_01``.
        first_depth: a rough depth by poses that fit roughly; asked only where refinement is due.

    Returns:
        ``RefinedViews``; its ``rights`` are the very ones that were given where the poses fit, where there
        are too few matches, where a mistake explains the misfit, or where no better pose is near.
    """
    views, given = grey_views(left_01, rights, K_left), _poses(rights)
    sparse = sparse_tracks(views)
    counts = sparse.seen.sum(1)
    if counts.max(initial=0) < FEWEST:
        return untouched(rights, "not checked")
    before, poses = _medians(sparse, given), _as_E(given)
    found = PoseReport("fits", poses, poses, _numbers(before), _numbers(before), _numbers(counts))
    misfit = bool((before > FITS_PX).any())
    near = _nearby(sparse, given, before) if misfit else given
    units = _units(sparse, given)
    mistakes = _mistakes(sparse, given, near)
    if mistakes:
        return RefinedViews(tuple(rights), found.changed(status="mistaken", warnings=mistakes))
    if not misfit:
        return RefinedViews(tuple(rights), found.changed(warnings=units))
    depth_m = _on_grid(first_depth(_applied(rights, near)), views.left.shape)
    tracks = merge_tracks([sparse, dense_tracks(views, depth_m, near)])
    Ts = settle_poses(tracks, given, near)
    before, after = _medians(tracks, given), _medians(tracks, Ts)
    warnings = _warnings(before, after) + units
    found = found.changed(
        residual_px_given=_numbers(before),
        residual_px=_numbers(before),
        matches=_numbers(tracks.seen.sum(1)),
        warnings=warnings,
    )
    if not _acceptable(given, Ts, before, after):
        return RefinedViews(tuple(rights), found.changed(status="kept"))
    bends = [
        None if not before[v] > FITS_PX else fit_displacement(tracks.view(v), T, views.rights[v].shape)
        for v, T in enumerate(Ts)
    ]
    found = found.changed(
        status="refined",
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
        np.full(len(Ts), _FREE_PX),
        turned_rad=np.radians(3.0),
        shifted_share=0.3,
        longer_share=0.02 if len(Ts) == 1 else 0.2,
    )
    solved = solve_poses(tracks, Ts, free, scale_px=_SCALE_PX)
    length = np.linalg.norm(Ts[0, :3, 3]) / np.linalg.norm(solved[0, :3, 3])
    solved[:, :3, 3] *= length
    return solved, tracks


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


def _nearby(sparse: Tracks, given: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Poses that fit the sparse matches, found from far away first: then no match is an outlier yet."""
    before = np.nan_to_num(before, nan=1.0)
    prior, Ts = Prior(1.5 * before + _FLOOR_PX), given
    for scale in (max(float(before.max()), 1.0), 1.0):
        Ts = solve_poses(sparse, given, prior, start=Ts, scale_px=scale)
    return Ts


def settle_poses(tracks: Tracks, given: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Poses that fit all matches, held as firmly as the given ones turn out to deserve.

    Args:
        tracks: all matches of V right views.
        given: ``(V, 4, 4)``, ``T_right_from_left`` as given.
        near: likewise, poses that fit roughly.

    Returns:
        ``(V, 4, 4)``: free where they explain nearly all of the residual, near the given ones where the
        cameras have faults that no pose explains, and where they are those of a rectified rig.
    """
    free = Prior(np.full(len(given), _FREE_PX), longer_share=0.02)
    fitted = solve_poses(tracks, given, free, start=near, scale_px=_SCALE_PX)
    left = np.maximum(_medians(tracks, fitted), _FLOOR_PX)
    explained = np.sqrt(np.clip(_medians(tracks, given) ** 2 - left**2, 0.0, None))
    rig = bool(is_rectified(*(torch.as_tensor(m) for m in (tracks.K_left, tracks.K_rights, given))).all())
    share = np.clip(0.0 if rig else _MOVED_BY * (explained / left) ** 2, *_MOVED_SHARE)
    moved = np.maximum(np.nan_to_num(share * explained), _FLOOR_PX)
    shares = [independent_share(tracks.view(v), T) for v, T in enumerate(fitted) if tracks.seen[v].any()]
    return solve_poses(
        tracks,
        given,
        Prior(moved, _RIG_TURNED_RAD, _RIG_SHIFTED_SHARE) if rig else Prior(moved),
        start=fitted,
        scale_px=max(_SCALE_BY * float(np.nanmean(left)), _LEAST_SCALE_PX),
        trust=_COUNTS * float(np.mean(shares)),
    )


def _on_grid(depth_m: Tensor, size: tuple[int, int]) -> Tensor:
    depth_m = depth_m.detach().cpu().float()
    return torch.nn.functional.interpolate(depth_m, size, mode="bilinear", align_corners=False)


def _poses(rights: Sequence[CameraView]) -> np.ndarray:
    return np.stack([T.detach().cpu().double().numpy() for _, _, T in rights])


def _as_E(Ts: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.linalg.inv(T) for T in Ts)


def _numbers(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


def _medians(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Median distance from the epipolar lines, ``(V,)`` pixels, NaN for a view with too few matches."""
    own = [tracks.view(v) for v in range(len(Ts))]
    return np.array(
        [
            np.median(residuals_px(one, T[None])) if len(one) >= FEWEST else np.nan
            for one, T in zip(own, Ts, strict=True)
        ]
    )


def _straight_medians(tracks: Tracks, Ts: np.ndarray, bends: Sequence[Displacement | None]) -> np.ndarray:
    right_px = np.stack(
        [px if bend is None else px + bend.at(px) for px, bend in zip(tracks.right_px, bends, strict=True)]
    )
    moved = Tracks(tracks.left_px, right_px, tracks.seen, tracks.K_left, tracks.K_rights)
    return _medians(moved, Ts)


def _acceptable(given: np.ndarray, Ts: np.ndarray, before: np.ndarray, after: np.ndarray) -> bool:
    """Whether the refined poses are near the given ones and clearly better, all views together."""
    change = Ts @ np.linalg.inv(given)
    turned = np.degrees(np.arccos(np.clip((np.trace(change[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    shifted = np.linalg.norm(change[:, :3, 3], axis=1) / np.linalg.norm(given[:, :3, 3], axis=1)
    near = (turned < _MOST_TURN_DEG).all() and (shifted < _MOST_SHIFT).all()
    return bool(near and np.nanmean(after) < (1.0 - _LEAST_GAIN) * np.nanmean(before))


def _applied(
    rights: Sequence[CameraView], Ts: np.ndarray, bends: Sequence[Displacement | None] | None = None
) -> tuple[CameraView, ...]:
    bends = bends or [None] * len(rights)
    return tuple(
        CameraView(image if bend is None else straightened(image, bend), K, torch.as_tensor(T).to(given))
        for (image, K, given), T, bend in zip(rights, Ts, bends, strict=True)
    )


def _warnings(before: np.ndarray, after: np.ndarray) -> tuple[str, ...]:
    worst = int(np.argmax(np.nan_to_num(before)))
    if not before[worst] > WARNS_PX:
        return ()
    which = "The pose as given" if len(before) == 1 else f"The pose of right view {worst + 1} as given"
    return (
        f"{which} leaves matches {before[worst]:.1f} px off their epipolar lines in the median, a refined "
        f"one {after[worst]:.1f} px. {_CAUSES}",
    )
