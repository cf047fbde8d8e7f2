"""Measures how well the given poses of right views fit the matches of image features.

Features of half-size images take a quarter of the time. They are fewer and less accurate, so they can show
that a pose fits, but never that it does not. The check of a rectified pair often needs no others.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from geodiff_plugin.cameras import PosedViews, View, is_rectified
from geodiff_plugin.pose.tracks import (
    MIN_MATCHES,
    GreyImage,
    Tracks,
    grey_views,
    median_residuals,
    sparse_tracks,
)

#: Maximum median distance of matches from their epipolar lines at which the pose of a rectified rig fits;
#: lens errors alone reach it.
FITS_PX = 0.45
#: The limit for any other pose, where a shift compensates most of a wrong rotation.
POSED_FITS_PX = 0.3
#: Scale of the images whose features quickly confirm most correct poses.
SMALL_SCALE = 0.5
#: Fraction of the limit up to which a pose certainly fits at that scale. Of 151 real pairs, each under its
#: own pose and 119 others, none passed that exceeds the limit at full size.
SURELY = 0.85


@dataclass(frozen=True, eq=False)
class PosedGreys:
    """Grey views with similar pixels per radian, and the poses of the V right ones."""

    views: Sequence[GreyImage]  # left one first
    given: np.ndarray  # (V, 4, 4) T_right_from_left
    heights: Sequence[int]  # heights of the original images

    @functools.cached_property
    def rig(self) -> bool:
        """Whether all poses belong to a rectified rig."""
        left, *rights = (view.camera for view in self.views)
        return all(is_rectified(left, right, T) for right, T in zip(rights, self.given, strict=True))


def posed_greys(posed: PosedViews) -> PosedGreys:
    """Prepare the views for feature matching."""
    heights = [view.size[0] for view in (posed.left, *posed.rights)]
    return PosedGreys(grey_views(posed), poses_of(posed.rights), heights)


def pose_change(given: np.ndarray, Ts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the change of poses ``Ts (V, 4, 4)`` from the given ones, ``(V,)`` degrees and baselines."""
    change = Ts @ np.linalg.inv(given)
    cosines = (np.trace(change[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    shifts = np.linalg.norm(change[:, :3, 3], axis=1) / np.linalg.norm(given[:, :3, 3], axis=1)
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))), shifts


def poses_of(rights: Sequence[View]) -> np.ndarray:
    """Return ``T_right_from_left (V, 4, 4)`` of right views, float64."""
    return np.stack([view.T_right_from_left.astype(np.float64) for view in rights])


@dataclass(frozen=True, eq=False)
class PoseFit:
    """Fit of the given poses of V right views to the matches of image features."""

    greys: PosedGreys
    tracks: Tracks  # SIFT matches
    residual_px: np.ndarray  # (V,) median distance of matches from their epipolar lines, NaN for too few
    is_small: bool = False  # whether the features are from downscaled images
    surely: bool = False  # whether downscaled images show that all poses fit

    @property
    def rig(self) -> bool:
        """Whether all poses belong to a rectified rig."""
        return self.greys.rig

    @property
    def is_known(self) -> bool:
        """Whether there are enough matches."""
        return bool(self.tracks.seen.sum(1).max(initial=0) >= MIN_MATCHES)

    @property
    def limit_px(self) -> float:
        """Maximum residual of a pose that fits."""
        return FITS_PX if self.rig else POSED_FITS_PX

    @property
    def fits(self) -> bool:
        """Whether enough matches show that no view exceeds the limit; such views are kept unchanged."""
        return self.surely or (self.is_known and not (self.residual_px > self.limit_px).any())

    def at_full_resolution(self) -> PoseFit:
        """Measure the fit with full-size features; a certain fit remains certain."""
        return replace(_fit_at(self.greys, 1.0), surely=self.surely)


def _fit_at(greys: PosedGreys, scale: float) -> PoseFit:
    """Measure the fit of the poses with features at an image scale."""
    tracks = sparse_tracks(greys.views, scale)
    return PoseFit(greys, tracks, median_residuals(tracks, greys.given), is_small=scale < 1.0)


def fit_of_small(greys: PosedGreys) -> PoseFit:
    """Measure the fit of the poses with features of downscaled images.

    There are fewer features, with larger residuals. They are inconclusive unless they show that all poses
    ``surely`` fit; then no full-size features need to be matched.
    """
    fit = _fit_at(greys, SMALL_SCALE)
    return replace(fit, surely=bool((fit.residual_px <= SURELY * fit.limit_px).all()))  # False if NaN


def measure_fit(greys: PosedGreys, small: Callable[[], PoseFit] | None = None) -> PoseFit:
    """Match image features and measure their distance from the epipolar lines.

    For a rectified pair whose pose surely fits, the result is the one of downscaled images. ``small`` returns
    the result of ``fit_of_small`` if another thread computes it.
    """
    small = small or functools.cache(functools.partial(fit_of_small, greys))
    if greys.rig and len(greys.given) == 1 and (of_small := small()).surely:
        return of_small
    fit = _fit_at(greys, 1.0)
    return fit if fit.fits else replace(fit, surely=small().surely)
