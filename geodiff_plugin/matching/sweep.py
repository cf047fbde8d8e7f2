"""Plane sweep (S7.3): cost of each inverse depth at each pixel, for any pose and any number of views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F

from geodiff_plugin._checks import bad_value
from geodiff_plugin.geometry import NEAREST_M, PlaneRays, image_size, is_rectified, plane_rays
from geodiff_plugin.matching.aggregation import cells
from geodiff_plugin.matching.alignment import AlignedView, ComparedView, align_view
from geodiff_plugin.matching.census import COST_LEVELS, MARGIN_PX, census, grey_levels
from geodiff_plugin.types import CameraView

UNSEEN_LEVEL = 78
UNSEEN_COST = UNSEEN_LEVEL / COST_LEVELS
"""Cost of a plane on which no right view sees the pixel: that of unrelated texture, neither good nor bad."""

_LEAST_SHIFT_PX = 0.3


@dataclass(frozen=True)
class CostVolume:
    """Costs of fronto-parallel planes in the left view, uniform in inverse depth.

    Attributes:
        levels: ``(D, H, W)`` uint8, mean census difference to the right views that see the pixel, 0 to
            ``COST_LEVELS``; that of ``UNSEEN_COST`` where none does.
        in_view: ``(D, H, W)`` bool, at least one right view sees the pixel on this plane.
        inverse_depth: ``(D,)`` float32, 1/m, ascending and evenly spaced.
        K: ``(3, 3)`` pixels of this grid.
        left_01: ``(1, H, W)`` grey left image on this grid.
        rights: the right views at the resolution that was used, ``(1, Hr, Wr)`` grey, with their K and T.
        aligned: the same, turned parallel to the left view.
    """

    levels: torch.Tensor
    in_view: torch.Tensor
    inverse_depth: torch.Tensor
    K: torch.Tensor
    left_01: torch.Tensor
    rights: tuple[CameraView, ...]
    aligned: tuple[AlignedView, ...]

    @property
    def cost(self) -> torch.Tensor:
        """``(D, H, W)`` float32 in [0, 1], the costs of all cells: four times the volume's own memory."""
        return self.levels.float() / COST_LEVELS

    def at_pixels(self, index: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """``cost (D, P)`` in [0, 1] and ``in_view (D, P)`` bool of pixels ``(P,)``: ``row * W + column``."""
        row, column = index // self.size[1], index % self.size[1]
        return self.levels[:, row, column].float() / COST_LEVELS, self.in_view[:, row, column]

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the grid."""
        return self.levels.shape[1], self.levels.shape[2]

    @property
    def plane_step(self) -> torch.Tensor:
        """``()`` float32, 1/m between neighbouring planes."""
        return self.inverse_depth[1] - self.inverse_depth[0]

    @cached_property
    def rectified(self) -> bool:
        """Whether every right view is rectified with the left one."""
        return all(bool(is_rectified(self.K, K, T)) for _, K, T in self.rights)

    @cached_property
    def reach_m(self) -> tuple[float, float]:
        """Metres of the nearest plane, and of a shift of 0.3 px, beyond which views say nothing."""
        all_rays = [plane_rays(self.K[None], K[None], T[None], self.size) for _, K, T in self.rights]
        farthest = max(1.0 / float(inverse_depth_at_shift(rays, _LEAST_SHIFT_PX)) for rays in all_rays)
        return 1.0 / float(self.inverse_depth[-1]), farthest


def _plane_uv(rays: PlaneRays, inverse_depth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Right pixels ``(D, 2, N)`` of every left pixel on every plane, and ``(D, N)`` if it is in front."""
    p = rays.A + inverse_depth[:, None, None] * rays.b  # z * A + b, divided by z
    in_front = p[:, 2] > NEAREST_M
    return p[:, :2] / torch.where(in_front, p[:, 2], torch.ones_like(p[:, 2]))[:, None], in_front


def median_shift(rays: PlaneRays, inverse_depth: torch.Tensor, name: str = "E") -> torch.Tensor:
    """How far the median pixel lies, in the right view, from where it would be at infinity.

    ``(N,)`` pixels for ``inverse_depth (N,)`` 1/m, >= 0; infinite where the plane passes behind the right
    camera. Measured from infinity, so that a rotation, which moves all depths alike, does not count.

    Args:
        rays: ``plane_rays`` of any grid of left pixels, batch of 1.
        inverse_depth: of the planes.
        name: of the pose, for messages.

    Raises:
        InputError: no pixel's point at infinity is in front of the right camera.
    """
    stride = max(1, rays.A.shape[-1] // 1024)
    some = PlaneRays(rays.A[..., ::stride], rays.b)
    at_infinity, ahead = _plane_uv(some, rays.A.new_zeros(1))
    if not ahead.any():
        bad_value(name, "a pose under which the views overlap", "a right camera that looks the other way")
    uv, in_front = _plane_uv(some, inverse_depth)
    dx, dy = (uv - at_infinity).unbind(dim=1)
    shift = torch.hypot(dx, dy)  # a norm over a dimension of 2 takes most of a sweep's time
    shift = torch.where(in_front, shift, torch.full_like(shift, torch.inf))
    return shift[:, ahead[0]].median(dim=1).values


def inverse_depth_at_shift(rays: PlaneRays, shift_px: float, name: str = "E") -> torch.Tensor:
    """The inverse depth, ``()`` 1/m within 1 %, at which ``median_shift`` reaches ``shift_px`` > 0.

    A camera that stands behind the other one sees no pixel move further than to the epipole: there, at most
    the depth at which it has gone half of that way. Raises ``InputError`` if the views do not overlap, or
    both cameras stand at one place.
    """
    exponents = rays.A.new_tensor([-8.0, 5.0])
    most = float(median_shift(rays, 10.0 ** exponents[1:], name))
    if most < _LEAST_SHIFT_PX:
        bad_value(name, "a pose with a baseline", "both cameras at one place")
    shift_px = min(shift_px, 0.5 * most)
    for _ in range(16):  # the shift grows with inverse depth, so bisection of 13 decades reaches 0.05 %
        middle = exponents.mean()
        reached = median_shift(rays, 10.0 ** middle[None])[0] >= shift_px
        exponents = torch.where(
            reached, torch.stack([exponents[0], middle]), torch.stack([middle, exponents[1]])
        )
    return 10.0 ** exponents[1]


@torch.no_grad()
def sweep_planes(
    left_01: torch.Tensor, rights: Sequence[CameraView], K_left: torch.Tensor, inverse_depth: torch.Tensor
) -> CostVolume:
    """Compare the left view with the right views on every plane, at the resolution as given.

    Planes go one by one, so memory is that of the result, two bytes a cell, and of what describes the right
    views. Not differentiable.

    Args:
        left_01: ``(1, H, W)`` float32 grey in [0, 1].
        rights: one or several, grey, of about as many pixels per radian as the left view. Costs are averaged
            over the views that see a pixel.
        K_left: ``(3, 3)`` pixels of ``left_01``.
        inverse_depth: ``(D,)`` 1/m, ascending, evenly spaced, D >= 2.
    """
    size = image_size(left_01)
    aligned = tuple(align_view(right, K_left, size, inverse_depth) for right in rights)
    left = census(grey_levels(F.pad(left_01[None], (MARGIN_PX,) * 4, mode="replicate")[0, 0]))
    compared = [ComparedView(left, view) for view in aligned]
    levels = cells(len(inverse_depth), size, torch.uint8, left.device)
    in_view = left.new_empty(levels.shape, dtype=torch.bool)
    unseen = levels.new_full((), UNSEEN_LEVEL)
    for plane in range(len(inverse_depth)):
        costs, seen = [view.cost(plane) for view in compared], [view.seen(plane) for view in compared]
        cost, in_view[plane] = (costs[0], seen[0]) if len(costs) == 1 else _mean(costs, seen)
        levels[plane] = torch.where(in_view[plane], cost, unseen)
    return CostVolume(levels, in_view, inverse_depth, K_left, left_01, tuple(rights), aligned)


def _mean(costs: list[torch.Tensor], seen: list[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean cost over the views that see a pixel, uint8, and whether any does."""
    total, count = (torch.zeros_like(costs[0], dtype=torch.float32) for _ in range(2))
    for cost, of_view in zip(costs, seen, strict=True):
        total += cost * of_view
        count += of_view
    return (total / count.clamp_min(1.0)).round().to(torch.uint8), count > 0
