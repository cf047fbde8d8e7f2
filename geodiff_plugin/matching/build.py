"""Builds the cost volume of a scene and its matches from two or more views (S7.3)."""

from __future__ import annotations

import numpy as np
import torch

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.cameras import PosedViews, View, size_within
from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.matching.census import grey
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.planes import even_planes, parallax_of
from geodiff_plugin.matching.sweep import sweep_planes
from geodiff_plugin.matching.volume import CostVolume

#: Minimum number of planes for subplane positions by a parabola through three costs.
_MIN_PLANES = 24
#: Shift of the median pixel between consecutive planes, pixels: less than 1 for subplane positions.
PLANE_STEP_PX = 0.75
#: Maximum number of pixels of the coarse sweep that finds the nearest plane.
COARSE_PIXELS = 20_000
#: Maximum number of planes of the coarse sweep.
COARSE_PLANES = 160
#: Shift of the median pixel between consecutive planes of the coarse sweep, pixels.
COARSE_STEP_PX = 1.0
#: Largest shift of the coarse sweep, in image widths, in the view with the smallest shifts: a near surface
#: leaves the view with the largest shifts while others still show it.
COARSE_SHIFT = 0.4
#: Maximum factor between that nearest depth and the one for the view with the largest shifts.
MAX_NEARER_FACTOR = 3.0
#: Minimum confidence of coarse matches.
COARSE_CONFIDENCE = 0.8
#: Quantile of coarse matches' inverse depth that is used as the nearest: a few matches are wrong.
COARSE_QUANTILE = 0.995
#: Minimum fraction of pixels with a coarse match; with fewer, the planes cover the whole coarse sweep.
COARSE_MIN_FRACTION = 0.03
#: Factor between the nearest match's depth and the nearest plane's.
HEADROOM = 1.25
#: Minimum shift of the nearest plane, in image widths.
MIN_SHIFT = 0.03
#: The inverse pose is preferred if it matches this many times as many pixels as the given one.
_MIN_GAIN = 1.25
#: Maximum number of pixels of the sweeps that compare both poses.
_INVERSE_PIXELS = 15_000
#: Matched fraction of the image above which the inverse pose is not tried.
_ENOUGH_MATCHED = 0.4


def to_grid(posed: PosedViews, pixels: int) -> PosedViews:
    """Resize the left image to at most ``pixels``, and the right ones to the same resolution."""
    left = posed.left.resized(size_within(posed.size, pixels))
    return PosedViews(left, tuple(view.as_fine_as(left.camera) for view in posed.rights))


def _in_grey(posed: PosedViews) -> PosedViews:
    """Convert the images of the views to grey."""
    left, *rights = (view._replace(image_01=grey(view.image_01)) for view in (posed.left, *posed.rights))
    return PosedViews(left, tuple(rights))


@torch.no_grad()
def coarse_volume(posed: PosedViews, pixels: int = COARSE_PIXELS) -> CostVolume:
    """Sweep all depths from infinity to a shift of 40 % of the width, coarsely.

    The grid has at most ``pixels`` pixels. Other arguments and errors as in ``build_cost_volume``.
    """
    grid = to_grid(_in_grey(posed), pixels)
    parallax = parallax_of(grid)
    nearest = [of_view.inverse_depth_at(COARSE_SHIFT * grid.size[1]) for of_view in parallax]
    limit = min(max(nearest), MAX_NEARER_FACTOR * min(nearest))
    planes = even_planes(parallax, (0.0, limit), COARSE_STEP_PX, _MIN_PLANES, COARSE_PLANES)
    return sweep_planes(grid, planes, parallax)


def _nearest_inverse_depth(coarse: CostVolume) -> float:
    """Return the inverse depth of the nearest plane, somewhat nearer than the matches of a coarse sweep."""
    matches = match_volume(coarse)
    # The only synchronization of a sweep: the host chooses the nearest plane. Reading such small maps takes
    # less time than launching the kernels of a quantile.
    confidence, inverse_depth = torch.cat([matches.confidence, matches.inverse_depth]).cpu().numpy()
    reliable = confidence > COARSE_CONFIDENCE
    limit = float(coarse.inverse_depth[-1])
    if reliable.mean() < COARSE_MIN_FRACTION:  # too few matches, so the planes must cover everything
        return limit
    nearest = float(np.quantile(inverse_depth[reliable], np.float32(COARSE_QUANTILE)))
    least = min(view.inverse_depth_at(MIN_SHIFT * coarse.size[1]) for view in coarse.parallax)
    return min(max(HEADROOM * nearest, least), limit)


@torch.no_grad()
def build_cost_volume(
    posed: PosedViews, *, depth_range: tuple[float, float] | None = None, config: GuidanceConfig = DEFAULT
) -> CostVolume:
    """Sweep planes through the left view and compare it with the right views, colour or grey, of any size.

    The planes span ``depth_range``, metres; by default they span from infinity to somewhat nearer than the
    nearest confident match of a coarse sweep. ``config`` bounds the number of planes and of pixels.
    ``InputError`` for a range that is not ascending, views that do not overlap, or two cameras at the same
    position.
    """
    if depth_range is not None and not 0 < depth_range[0] < depth_range[1]:
        bad_value("depth_range", "(near, far) in metres with 0 < near < far", depth_range)
    grid = to_grid(_in_grey(posed), config.sweep_pixels)
    if depth_range is None:
        span = 0.0, _nearest_inverse_depth(coarse_volume(grid))
    else:
        span = 1.0 / depth_range[1], 1.0 / depth_range[0]
    parallax = parallax_of(grid)
    planes = even_planes(parallax, span, PLANE_STEP_PX, _MIN_PLANES, config.planes)
    return sweep_planes(grid, planes, parallax)


@torch.no_grad()
def inverse_pose_preferred(posed: PosedViews, matches: Matches | None = None) -> bool:
    """Return whether the inverse pose matches clearly more of the image than the given one.

    This is the case if the images were swapped or E is world-to-camera. Two coarse sweeps decide, or none if
    the ``matches`` under the given pose are conclusive. Errors as in ``build_cost_volume``.
    """
    if matches is not None and float(matches.confidence.mean()) > _ENOUGH_MATCHED:
        return False

    def confidence(of_pose: PosedViews) -> float:
        return float(match_volume(coarse_volume(of_pose, _INVERSE_PIXELS)).confidence.mean())

    def inverted(view: View) -> View:
        return view._replace(T_right_from_left=np.linalg.inv(view.T_right_from_left))

    given = confidence(posed)
    try:
        inverse = confidence(posed._replace(rights=tuple(map(inverted, posed.rights))))
    except ValueError:  # views that do not overlap under the inverse pose rule it out
        inverse = 0.0
    return inverse > _MIN_GAIN * given
