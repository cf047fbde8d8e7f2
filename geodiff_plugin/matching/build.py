"""From two or more views to a cost volume that spans the scene, and its matches (S7.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from kornia.geometry.linalg import inverse_transformation
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.geometry import as_fine_as, image_size, resize_image
from geodiff_plugin.matching.census import grey
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.planes import even_planes, parallax_of
from geodiff_plugin.matching.sweep import CostVolume, sweep_planes
from geodiff_plugin.types import CameraView

# With fewer planes, a parabola through three neighbouring costs fits nothing.
_FEWEST_PLANES = 24
#: How far the median pixel moves from one plane to the next, px: below a pixel, for positions between planes.
PLANE_STEP_PX = 0.75
# Pixels of the coarse sweep that finds how near the planes must reach.
PILOT_PIXELS = 20_000
# Upper bound on its planes.
PILOT_PLANES = 160
# The shift of the median pixel from one of its planes to the next, px.
PILOT_STEP_PX = 1.0
# The coarse sweep reaches to the depth that shifts by this, in image widths, in the view that moves least: a
# near surface leaves the view that moves most while others still show it.
PILOT_SHIFT = 0.4
# It reaches at most this many times nearer than that depth for the view that moves most.
MOST_NEARER = 3.0
# Matches of the coarse sweep count above this confidence.
PILOT_CONFIDENCE = 0.8
# The quantile of their inverse depth that is taken as nearest: a few matches are wrong.
PILOT_QUANTILE = 0.995
# If fewer pixels than this share have such a match, the planes reach as near as the coarse sweep did.
PILOT_LEAST_SHARE = 0.03
# The planes reach this factor nearer than the nearest match.
HEADROOM = 1.25
# They reach to this shift at least, in image widths.
LEAST_SHIFT = 0.03
# The inverse pose is preferred if it matches this many times as much of the image as the given one.
_CLEARLY = 1.25
# Pixels of the sweeps that compare the two poses.
_INVERSE_PIXELS = 15_000
# If the given pose matches this share of the image, the inverse pose is not tried.
_ENOUGH_MATCHED = 0.4


def to_grid(
    left_01: Tensor, rights: Sequence[CameraView], K_left: Tensor, pixels: int
) -> tuple[Tensor, tuple[CameraView, ...], Tensor]:
    """The left view ``(C, H, W)`` with at most ``pixels``, right views as fine, and K of the left one."""
    height, width = image_size(left_01)
    factor = min(1.0, (pixels / (height * width)) ** 0.5)
    size = max(1, round(height * factor)), max(1, round(width * factor))
    left, K = resize_image(left_01, K_left, size)
    small = tuple(CameraView(*as_fine_as(image, K_r, K), T) for image, K_r, T in rights)
    return left, small, K


def _on_cpu(matrix: Tensor) -> Tensor:
    """Cameras and planes stay on the CPU, where every decision about them is taken."""
    return matrix.detach().to("cpu", torch.float32)


def _grey_views(views: Sequence[CameraView]) -> tuple[CameraView, ...]:
    return tuple(CameraView(grey(image), _on_cpu(K), _on_cpu(T)) for image, K, T in views)


@torch.no_grad()
def pilot_volume(
    left_01: Tensor, rights: Sequence[CameraView], K_left: Tensor, pixels: int = PILOT_PIXELS
) -> CostVolume:
    """A coarse sweep of all depths from infinity to a shift of 40 % of the width.

    Its grid has at most ``pixels`` pixels. Other arguments and errors as for ``build_cost_volume``.
    """
    left, small, K = to_grid(grey(left_01), _grey_views(rights), _on_cpu(K_left), pixels)
    views = parallax_of(small, K, image_size(left))
    nearest = [view.inverse_depth_at(PILOT_SHIFT * left.shape[-1]) for view in views]
    limit = min(max(nearest), MOST_NEARER * min(nearest))
    planes = even_planes(views, (0.0, limit), PILOT_STEP_PX, _FEWEST_PLANES, PILOT_PLANES)
    return sweep_planes(left, small, K, planes, views)


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
    left_01: Tensor,
    rights: Sequence[CameraView],
    K_left: Tensor,
    *,
    depth_range: tuple[float, float] | None = None,
    config: GuidanceConfig = DEFAULT,
) -> CostVolume:
    """Sweep planes through the left view ``(3, H, W)``, or grey, and compare it with right views of any size.

    The planes span ``depth_range``, metres; by default they reach from infinity to somewhat nearer than
    anything that a coarse sweep is certain of. ``config`` bounds their number and the pixels of the grid.
    ``InputError`` for a range that is not ascending, views that do not overlap, or two cameras at one place.
    """
    if depth_range is not None and not 0 < depth_range[0] < depth_range[1]:
        bad_value("depth_range", "(near, far) in metres with 0 < near < far", depth_range)
    left, small, K = to_grid(grey(left_01), _grey_views(rights), _on_cpu(K_left), config.sweep_pixels)
    if depth_range is None:
        span = 0.0, _nearest_inverse_depth(pilot_volume(left, small, K))
    else:
        span = 1.0 / depth_range[1], 1.0 / depth_range[0]
    views = parallax_of(small, K, image_size(left))
    planes = even_planes(views, span, PLANE_STEP_PX, _FEWEST_PLANES, config.planes)
    return sweep_planes(left, small, K, planes, views)


@torch.no_grad()
def inverse_pose_preferred(
    left_01: Tensor, rights: Sequence[CameraView], K_left: Tensor, matches: Matches | None = None
) -> bool:
    """Whether the inverse pose matches clearly more of the image than the given one.

    It does if the images were swapped, or if E is world-to-camera. Two coarse sweeps decide, or none if the
    ``matches`` under the given pose leave no doubt. Other arguments as for ``build_cost_volume``.
    """
    if matches is not None and float(matches.confidence.mean()) > _ENOUGH_MATCHED:
        return False

    def confidence(views: Sequence[CameraView]) -> float:
        return float(match_volume(pilot_volume(left_01, views, K_left, _INVERSE_PIXELS)).confidence.mean())

    given = confidence(rights)
    try:
        turned = confidence(
            [CameraView(image, K_right, inverse_transformation(T)) for image, K_right, T in rights]
        )
    except ValueError:  # under the inverse pose the views do not overlap, so it is not the true one
        turned = 0.0
    return turned > _CLEARLY * given
