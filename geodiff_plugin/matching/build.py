"""From two or more views to a cost volume that spans the scene, and its matches (S7.3)."""

from __future__ import annotations

import numpy as np
import torch
from kornia.geometry.linalg import inverse_transformation
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.geometry import as_fine_as, resize_image, size_within
from geodiff_plugin.matching.census import grey
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.planes import even_planes, parallax_of
from geodiff_plugin.matching.sweep import CostVolume, sweep_planes
from geodiff_plugin.types import CameraView, PosedViews

#: With fewer planes, a parabola through three neighbouring costs fits nothing.
_FEWEST_PLANES = 24
#: How far the median pixel moves from one plane to the next, px: below a pixel, for positions between planes.
PLANE_STEP_PX = 0.75
#: Pixels of the coarse sweep that finds how near the planes must reach.
PILOT_PIXELS = 20_000
#: Upper bound on its planes.
PILOT_PLANES = 160
#: The shift of the median pixel from one of its planes to the next, px.
PILOT_STEP_PX = 1.0
#: The coarse sweep reaches to the depth that shifts by this, in image widths, in the view that moves least: a
#: near surface leaves the view that moves most while others still show it.
PILOT_SHIFT = 0.4
#: It reaches at most this many times nearer than that depth for the view that moves most.
MOST_NEARER = 3.0
#: Matches of the coarse sweep count above this confidence.
PILOT_CONFIDENCE = 0.8
#: The quantile of their inverse depth that is taken as nearest: a few matches are wrong.
PILOT_QUANTILE = 0.995
#: If fewer pixels than this share have such a match, the planes reach as near as the coarse sweep did.
PILOT_LEAST_SHARE = 0.03
#: The planes reach this factor nearer than the nearest match.
HEADROOM = 1.25
#: They reach to this shift at least, in image widths.
LEAST_SHIFT = 0.03
#: The inverse pose is preferred if it matches this many times as much of the image as the given one.
_CLEARLY = 1.25
#: Pixels of the sweeps that compare the two poses.
_INVERSE_PIXELS = 15_000
#: If the given pose matches this share of the image, the inverse pose is not tried.
_ENOUGH_MATCHED = 0.4


def to_grid(posed: PosedViews, pixels: int) -> PosedViews:
    """The views with a left image of at most ``pixels``, and right ones as fine as that."""
    left, K = resize_image(posed.left_01, posed.K_left, size_within(posed.size, pixels))
    rights = tuple(CameraView(*as_fine_as(image, K_r, K), T) for image, K_r, T in posed.views)
    return PosedViews(left, rights, K)


def _on_cpu(matrix: Tensor) -> Tensor:
    """Cameras and planes stay on the CPU, where every decision about them is taken."""
    return matrix.detach().to("cpu", torch.float32)


def _in_grey(posed: PosedViews) -> PosedViews:
    """The views with grey images and cameras in float32."""
    rights = tuple(CameraView(grey(image), _on_cpu(K), _on_cpu(T)) for image, K, T in posed.views)
    return PosedViews(grey(posed.left_01), rights, _on_cpu(posed.K_left))


@torch.no_grad()
def pilot_volume(posed: PosedViews, pixels: int = PILOT_PIXELS) -> CostVolume:
    """A coarse sweep of all depths from infinity to a shift of 40 % of the width.

    Its grid has at most ``pixels`` pixels. Other arguments and errors as for ``build_cost_volume``.
    """
    grid = to_grid(_in_grey(posed), pixels)
    parallax = parallax_of(grid)
    nearest = [of_view.inverse_depth_at(PILOT_SHIFT * grid.size[1]) for of_view in parallax]
    limit = min(max(nearest), MOST_NEARER * min(nearest))
    planes = even_planes(parallax, (0.0, limit), PILOT_STEP_PX, _FEWEST_PLANES, PILOT_PLANES)
    return sweep_planes(grid, planes, parallax)


def _nearest_inverse_depth(pilot: CostVolume) -> float:
    """The inverse depth at which the planes end, somewhat nearer than the matches of a coarse sweep."""
    matches = match_volume(pilot)
    # The one time that a sweep waits for the device: the host decides how near the planes reach. To read such
    # small maps takes less time than to launch what a quantile is made of.
    confidence, inverse_depth = torch.cat([matches.confidence, matches.inverse_depth]).cpu().numpy()
    reliable = confidence > PILOT_CONFIDENCE
    limit = float(pilot.inverse_depth[-1])
    if reliable.mean() < PILOT_LEAST_SHARE:  # then the planes must span everything
        return limit
    nearest = float(np.quantile(inverse_depth[reliable], np.float32(PILOT_QUANTILE)))
    least = min(view.inverse_depth_at(LEAST_SHIFT * pilot.size[1]) for view in pilot.parallax)
    return min(max(HEADROOM * nearest, least), limit)


@torch.no_grad()
def build_cost_volume(
    posed: PosedViews, *, depth_range: tuple[float, float] | None = None, config: GuidanceConfig = DEFAULT
) -> CostVolume:
    """Sweep planes through the left view, in colour or grey, and compare it with right views of any size.

    The planes span ``depth_range``, metres; by default they reach from infinity to somewhat nearer than
    anything that a coarse sweep is certain of. ``config`` bounds their number and the pixels of the grid.
    ``InputError`` for a range that is not ascending, views that do not overlap, or two cameras at one place.
    """
    if depth_range is not None and not 0 < depth_range[0] < depth_range[1]:
        bad_value("depth_range", "(near, far) in metres with 0 < near < far", depth_range)
    grid = to_grid(_in_grey(posed), config.sweep_pixels)
    if depth_range is None:
        span = 0.0, _nearest_inverse_depth(pilot_volume(grid))
    else:
        span = 1.0 / depth_range[1], 1.0 / depth_range[0]
    parallax = parallax_of(grid)
    planes = even_planes(parallax, span, PLANE_STEP_PX, _FEWEST_PLANES, config.planes)
    return sweep_planes(grid, planes, parallax)


@torch.no_grad()
def inverse_pose_preferred(posed: PosedViews, matches: Matches | None = None) -> bool:
    """Whether the inverse pose matches clearly more of the image than the given one.

    It does if the images were swapped, or if E is world-to-camera. Two coarse sweeps decide, or none if the
    ``matches`` under the given pose leave no doubt. Errors as for ``build_cost_volume``.
    """
    if matches is not None and float(matches.confidence.mean()) > _ENOUGH_MATCHED:
        return False

    def confidence(of_pose: PosedViews) -> float:
        return float(match_volume(pilot_volume(of_pose, _INVERSE_PIXELS)).confidence.mean())

    given = confidence(posed)
    turned_back = (CameraView(image, K, inverse_transformation(T)) for image, K, T in posed.views)
    try:
        turned = confidence(posed._replace(views=tuple(turned_back)))
    except ValueError:  # under the inverse pose the views do not overlap, so it is not the true one
        turned = 0.0
    return turned > _CLEARLY * given
