"""How the poses of right views as given fit the matches of their pictures' features.

Features of pictures of half the size take a quarter of the time. They are fewer and less exact, so they can
show that a pose fits, and never that it does not. The check of a rectified pair often needs no others.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from geodiff_plugin.geometry import is_rectified
from geodiff_plugin.pose.bars import bar_share
from geodiff_plugin.pose.tearing import find_tear
from geodiff_plugin.pose.tracks import FEWEST, GreyImage, Tracks, grey_views, median_residuals, sparse_tracks
from geodiff_plugin.types import CameraView, PosedViews, Tear

#: Largest median distance of matches from their epipolar lines at which the pose of a rectified rig fits: its
#: lenses alone err this much.
FITS_PX = 0.45
#: The same of any other pose, where a shift hides most of a wrong rotation.
POSED_FITS_PX = 0.3
#: Scale of the pictures in which features show most poses that fit at once.
SMALLER = 0.5
#: There a pose surely fits up to this share of the limit. Of 151 real pairs, each under its own pose and 119
#: others, none passed that misses the limit at full size.
SURELY = 0.85


class PictureSigns(NamedTuple):
    """What pictures show without any match."""

    tear: Tear | None  # where one of them is torn
    bars: float  # width of bars at opposite sides of all of them, as a share of that side


@dataclass(frozen=True, eq=False)
class PosedGreys:
    """Grey views at about as many pixels per radian, and the poses of the V right ones."""

    views: Sequence[GreyImage]  # left one first
    given: np.ndarray  # (V, 4, 4) T_right_from_left
    heights: Sequence[int]  # of the pictures that the views were made of

    @functools.cached_property
    def rig(self) -> bool:
        """Whether all poses are those of a rectified rig."""
        K_left, *K_rights = (torch.from_numpy(K) for _, K in self.views)
        return bool(is_rectified(K_left, torch.stack(K_rights), torch.from_numpy(self.given)).all())

    @functools.cached_property
    def signs(self) -> PictureSigns:
        """What the pictures show alone."""
        greys = [grey for grey, _ in self.views]
        return PictureSigns(find_tear(greys, self.heights), bar_share(greys))


def posed_greys(posed: PosedViews) -> PosedGreys:
    """The views as their features are matched."""
    heights = [image.shape[-2] for image in (posed.left_01, *(view.image_01 for view in posed.views))]
    return PosedGreys(grey_views(posed), poses_of(posed.views), heights)


def poses_of(rights: Sequence[CameraView]) -> np.ndarray:
    """``T_right_from_left (V, 4, 4)`` of right views, float64."""
    return np.stack([T.numpy(force=True).astype(np.float64) for _, _, T in rights])


@dataclass(frozen=True, eq=False)
class PoseFit:
    """How the given poses of V right views fit the matches of their pictures."""

    greys: PosedGreys
    tracks: Tracks  # by SIFT
    residual_px: np.ndarray  # (V,) median distance of matches from their epipolar lines, NaN where too few
    is_small: bool = False  # whether the features are those of small pictures
    surely: bool = False  # whether small pictures show that all poses fit

    @property
    def rig(self) -> bool:
        """Whether all poses are those of a rectified rig."""
        return self.greys.rig

    @property
    def is_known(self) -> bool:
        """Whether there are enough matches."""
        return bool(self.tracks.seen.sum(1).max(initial=0) >= FEWEST)

    @property
    def limit_px(self) -> float:
        """Residual up to which a pose fits."""
        return FITS_PX if self.rig else POSED_FITS_PX

    @property
    def fits(self) -> bool:
        """Whether enough matches show that no view misses by more: such views stay as they are."""
        return self.surely or (self.is_known and not (self.residual_px > self.limit_px).any())

    def of_whole_pictures(self) -> PoseFit:
        """The same by the features of the pictures themselves; what was sure stays so."""
        return replace(_fit_at(self.greys, 1.0), surely=self.surely)


def _fit_at(greys: PosedGreys, scale: float) -> PoseFit:
    """How the poses fit features of pictures of a scale."""
    tracks = sparse_tracks(greys.views, scale)
    return PoseFit(greys, tracks, median_residuals(tracks, greys.given), is_small=scale < 1.0)


def fit_of_small(greys: PosedGreys) -> PoseFit:
    """How the poses fit features of small pictures.

    These are fewer, and their residuals larger: where they do not show that all poses ``surely`` fit, they
    say nothing. Where they do, they say it before the features of the pictures themselves are matched.
    """
    fit = _fit_at(greys, SMALLER)
    return replace(fit, surely=bool((fit.residual_px <= SURELY * fit.limit_px).all()))  # not where it is NaN


def measure_fit(greys: PosedGreys, small: Callable[[], PoseFit] | None = None) -> PoseFit:
    """Match the pictures, and measure how far the matches are from their epipolar lines.

    Of a rectified pair whose pose surely fits, the answer is that of small pictures. ``small`` gives the
    answer of ``fit_of_small`` where another thread works it out.
    """
    small = small or functools.cache(functools.partial(fit_of_small, greys))
    if greys.rig and len(greys.given) == 1 and (of_small := small()).surely:
        return of_small
    fit = _fit_at(greys, 1.0)
    return fit if fit.fits else replace(fit, surely=small().surely)
