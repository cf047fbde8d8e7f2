"""How firmly poses as given hold against matches that want others.

Data flow: tracks, poses as given, poses nearby -> poses that are used, and those that fit best.
Paper: none; it takes exact poses for granted (S3.3).
"""

from __future__ import annotations

import numpy as np
import torch

from geodiff_plugin.geometry.cameras import is_rectified
from geodiff_plugin.pose.noise import split_residuals
from geodiff_plugin.pose.solve import Prior, solve_poses
from geodiff_plugin.pose.tracks import Tracks, residuals_px, solve_inverse_depth

__all__ = [
    "FEWEST",
    "FREE_PX",
    "SCALE_PX",
    "is_rig",
    "median_residuals",
    "nearby_poses",
    "settle_poses",
    "undecided",
]

#: Fewer matches than this say nothing about a pose.
FEWEST = 40
# How far a refined pose may move the points, along their lines as well: the residual that it explains, times
# a share. The share is 1 where that residual is so many times the cameras' other faults (a rolling shutter,
# lenses, K), which are what the residuals of neighbours have in common. It grows with the fourth power:
# below, a free pose would hide those faults; above, the given pose was wrong.
_FAULTS, _MOVED_SHARE = 5.6, (0.2, 40.0)
_FLOOR_PX, _LEAST_FAULT_PX = 0.05, 0.03
# A rectified pair has a share and a narrow prior of its own: its cameras are bolted together, turn by tenths
# of a degree and hardly shift, and a pan that fits the rows better is more often a fault of the lenses.
_RIG_MOVED_SHARE, _RIG_TURNED_RAD, _RIG_SHIFTED_SHARE = 0.4, np.radians(0.3), 0.01
# Robust scale of the first fit, whose noise is not known yet, pixels of the right view. That of the next one
# is so many times the residual that the first one leaves, but not below a tenth of a pixel; and its residuals
# count half, because blocks of the image do not show all that neighbours have in common.
SCALE_PX, _SCALE_BY, _LEAST_SCALE_PX, _COUNTS = 0.7, 2.0, 0.1, 0.5
# Where the given pose was wrong, little but the matches holds the new one, and what most of them agree on is
# nearer the truth than what all of them are least far from: narrower fits follow.
_NARROWER_BY = (1.0, 0.5)
# A prior as wide as this leaves a pose free, but for the length of its baseline.
FREE_PX = 1e3
# The user is warned if the pose that fits best changes log depth by more than this, in the median.
_MOST_SPREAD = 0.13


def median_residuals(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Median distance from the epipolar lines, ``(V,)`` pixels, NaN for a view with too few matches."""
    own = [tracks.view(v) for v in range(len(Ts))]
    return np.array(
        [
            np.median(residuals_px(one, T[None])) if len(one) >= FEWEST else np.nan
            for one, T in zip(own, Ts, strict=True)
        ]
    )


def is_rig(tracks: Tracks, given: np.ndarray) -> bool:
    """Whether all poses as given ``(V, 4, 4)`` are those of a rectified rig."""
    cameras = (torch.as_tensor(m, device="cpu") for m in (tracks.K_left, tracks.K_rights, given))
    return bool(is_rectified(*cameras).all())


def nearby_poses(sparse: Tracks, given: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Poses that fit the sparse matches, found from far away first: then no match is an outlier yet.

    Args:
        sparse: matches of V right views, outliers among them.
        given: ``(V, 4, 4)``, ``T_right_from_left`` as given.
        before: ``(V,)`` pixels, ``median_residuals`` of those.

    Returns:
        ``(V, 4, 4)``.
    """
    before = np.nan_to_num(before, nan=1.0)
    prior, Ts = Prior(1.5 * before + _FLOOR_PX), given
    for scale in (max(float(before.max()), 1.0), 1.0):
        Ts = solve_poses(sparse, given, prior, start=Ts, scale_px=scale)
    return Ts


def settle_poses(
    tracks: Tracks, given: np.ndarray, near: np.ndarray, before: np.ndarray, rig: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Poses that fit all matches, held as firmly as the given ones turn out to deserve.

    Args:
        tracks: all matches of V right views.
        given: ``(V, 4, 4)``, ``T_right_from_left`` as given.
        near: likewise, poses that fit roughly.
        before: ``(V,)`` pixels, ``median_residuals`` of the poses as given.
        rig: whether these are those of a rectified rig, see ``is_rig``.

    Returns:
        ``(V, 4, 4)``: free where they explain nearly all of the residual, near the given ones where the
        cameras have faults that no pose explains, and where they are those of a rectified rig. And
        ``(V, 4, 4)``: those that fit best, but for the lengths of the baselines.
    """
    free = Prior(np.full(len(given), FREE_PX), longer_share=0.02)
    fitted = solve_poses(tracks, given, free, start=near, scale_px=SCALE_PX)
    left = np.maximum(median_residuals(tracks, fitted), _FLOOR_PX)
    explained = np.sqrt(np.clip(before**2 - left**2, 0.0, None))
    views = [tracks.view(v) for v in range(len(given))]
    parts = [split_residuals(one, T) if len(one) else None for one, T in zip(views, fitted, strict=True)]
    faults = np.array([np.nan if part is None else part.common_px for part in parts])
    times = explained / (_FAULTS * np.maximum(faults, _LEAST_FAULT_PX))
    share = np.full_like(times, _RIG_MOVED_SHARE) if rig else np.clip(times**4, *_MOVED_SHARE)
    moved = np.maximum(np.nan_to_num(share * explained), _FLOOR_PX)
    shares = [part.independent_share for part in parts if part is not None]
    held = Prior(moved, _RIG_TURNED_RAD, _RIG_SHIFTED_SHARE) if rig else Prior(moved)
    wrong = not rig and bool((times > 1.0).any())
    settled = fitted
    for by in (_SCALE_BY, *(_NARROWER_BY if wrong else ())):
        settled = solve_poses(
            tracks,
            given,
            held,
            start=settled,
            scale_px=max(by * float(np.nanmean(left)), _LEAST_SCALE_PX),
            trust=_COUNTS * float(np.mean(shares)),
        )
    return settled, fitted


def undecided(tracks: Tracks, Ts: np.ndarray, free: np.ndarray) -> tuple[str, ...]:
    """A sentence where the matches leave the pose, and with it the depth, open."""
    used, other = (solve_inverse_depth(tracks, poses) for poses in (Ts, free))
    ahead = (used > 0) & (other > 0)
    spread = float(np.median(np.abs(np.log(used[ahead] / other[ahead])))) if ahead.any() else 0.0
    if spread < _MOST_SPREAD:
        return ()
    return (
        "The matches do not settle the pose: another one fits them as well, and its depths differ by "
        f"{100 * np.expm1(spread):.0f} % in the median. Give a more exact pose, or views from further apart.",
    )
