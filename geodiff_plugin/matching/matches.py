"""``Matches``: inverse depth and confidence per pixel, of matches between views or of known points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin._kernels import launch_bound, use_kernel
from geodiff_plugin.geometry import NEAREST_M, project, stacked

#: The unit in which errors at points are measured, as a share of their median inverse depth.
UNIT = 0.01
#: Reflections. Half the side of the window over which matches must agree, in image sides; with a smaller one,
#: gaps that the prior misses would be taken for reflections.
REGION = 0.08
#: How far behind the prior a reflection lies, in spreads of the matches around the prior's log depth. A prior
#: that misses a whole wall would have it rejected at fewer spreads.
SPREADS = 3.0
#: How far it lies behind at least, in log depth.
LEAST_DISTANCE = 0.2
#: A match's weight falls to 0 between that distance and this multiple of it.
MULTIPLE = 1.6
#: Matches above this confidence make the spread.
SPREAD_CONFIDENCE = 0.3
#: The spread is measured at this quantile of the distances: the median would miss that nearly half of the
#: scene is on a wrong surface.
SPREAD_SHARE = 0.6
#: The same quantile of the size of a normal variable, by which it is divided.
NORMAL_QUANTILE = 0.8416
#: About so many distances are sorted: torch's quantile takes no more than 16 million.
MOST_SORTED = 1 << 22
#: Larger differences in log depth count as this one.
LARGEST = 1.5


@dataclass(frozen=True)
class Matches:
    """Matches between the views, or known points, on one grid of the left view; of one image or of a chunk.

    ``inverse_depth`` and ``confidence`` are ``(1, H, W)`` of one image, or ``(B, 1, H, W)``. Confidence lies
    in [0, 1], but above 1 at the known points of ``with_points``.
    """

    inverse_depth: Tensor  # float32, 1/m; defined everywhere, to be read where ``confidence > 0``
    confidence: Tensor  # 0 where nothing is matched or known
    plane_step: Tensor  # () or (B,) 1/m, the unit of errors: a plane, or ``UNIT`` of the points' median
    deviation: Tensor | None = None  # like ``confidence``, in plane steps; ``None`` is 1 everywhere
    _above: dict[float, Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)

    @classmethod
    def stack(cls, images: Sequence[Self | None]) -> Self | None:
        """Matches of several images on grids of one size as a chunk; ``None`` if some image has none."""
        given = [matches for matches in images if matches is not None]
        if len(given) < len(images):
            return None
        names = ("inverse_depth", "confidence", "plane_step")
        inverse_depth, confidence, step = (stacked([getattr(m, name) for m in given]) for name in names)
        deviations = [matches.deviation for matches in given]
        known = [each for each in deviations if each is not None]
        deviation = stacked(known) if len(known) == len(given) else None
        return cls(inverse_depth, confidence, step, deviation)

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the grid."""
        return self.confidence.shape[-2], self.confidence.shape[-1]

    def within(self, valid: Tensor) -> Self:
        """The same with confidence 0 outside of ``valid (1, h, w)`` or ``(B, 1, h, w)`` bool, on any grid."""
        inside = F.interpolate(valid.view(-1, 1, *valid.shape[-2:]).float(), self.size, mode="nearest-exact")
        return replace(self, confidence=self.confidence * inside.view_as(self.confidence))

    def above(self, confidence: float) -> Tensor:
        """Flat indices ``(P,)`` of one image's pixels above a confidence, in order; cached."""
        if confidence not in self._above:
            read_above((self, confidence))
        return self._above[confidence]


def read_above(*wanted: tuple[Matches, float]) -> None:
    """Fill the caches of ``Matches.above``, for matches on grids of one size; a device is waited for once."""
    masks = torch.stack([matches.confidence.flatten() > confidence for matches, confidence in wanted])
    found = _indices(masks) if launch_bound(masks) else [mask.nonzero()[:, 0] for mask in masks]
    for (matches, confidence), indices in zip(wanted, found, strict=True):
        matches._above[confidence] = indices


def _indices(masks: Tensor) -> list[Tensor]:
    """As ``mask.nonzero()[:, 0]`` of every mask of ``(K, N)``; only their numbers are waited for."""
    count = masks.cumsum(1)
    place = torch.where(masks, count, 0)  # what is not there goes to place 0, which is cut off
    indices = count.new_empty(len(masks), masks.shape[1] + 1)
    indices.scatter_(1, place, torch.arange(masks.shape[1], device=masks.device).expand_as(place))
    return [row[1 : 1 + number] for row, number in zip(indices, count[:, -1].tolist(), strict=True)]


class _PixelDepths(NamedTuple):
    """Known depths at places of the left image."""

    uv: Tensor  # (N, 2) pixels
    z: Tensor  # (N,) metres
    confidence: Tensor | None  # (N,) in (0, 1]; ``None`` for 1


def _pixel_depths(points: Tensor, K_left: Tensor, size: tuple[int, int]) -> _PixelDepths:
    """Where known depths, in either form of ``points_to_matches``, lie in the left image."""
    if points.ndim == 2 and points.shape[1] in (3, 4):
        uv, z = project(points[None, None, :, :3], K_left[None])
        return _PixelDepths(uv[0, 0], z[0, 0], points[:, 3] if points.shape[1] == 4 else None)
    if tuple(points.shape[:2]) != size:
        cure = "A sparse depth map belongs to the left image, pixel by pixel; else give points (N, 3)."
        got = f"{points.shape[1]}x{points.shape[0]}"
        bad_value("points", f"a map of the left image's {size[1]}x{size[0]} pixels", got, cure)
    depth_m = points if points.ndim == 2 else points[..., 0]
    rows, columns = (depth_m > 0).nonzero(as_tuple=True)
    confidence = points[rows, columns, 1] if points.ndim == 3 else None
    return _PixelDepths(torch.stack([columns, rows], dim=1).float(), depth_m[rows, columns], confidence)


def points_to_matches(
    points: Tensor, K_left: Tensor, size: tuple[int, int], size_grid: tuple[int, int]
) -> tuple[Matches, int]:
    """Known depths on a grid ``(h, w)`` of the left view, and how many of them are left out.

    ``points`` are ``(N, 3)`` metres in the left camera's frame, or ``(N, 4)`` with their confidence in (0,
    1]; or a map ``(H, W)`` of the image's ``size``, 0 where unknown, or ``(H, W, 2)`` with its confidence.
    Of several points in a pixel the nearest wins. ``InputError`` if none is left, or for a map of other size.
    """
    uv, z, weight = _pixel_depths(points, K_left, size)
    # A pixel reaches half a pixel beyond its centre.
    inside = ((uv >= -0.5) & (uv < uv.new_tensor([size[1], size[0]]) - 0.5)).all(dim=1) & (z > NEAREST_M)
    left_out = int((~inside).sum())
    if left_out == len(z):
        bad_value(
            "points",
            "in front of the left camera and inside its image, at least one of them",
            f"{left_out} of {len(z)} behind it or outside",
            "They are metres in the left camera's frame: x right, y down, z forward. Bring points of another "
            "frame into it first.",
        )
    height, width = size_grid
    scale = uv.new_tensor([width / size[1], height / size[0]])
    cell = ((uv[inside] + 0.5) * scale).floor().long()
    at = cell[:, 1].clamp(0, height - 1) * width + cell[:, 0].clamp(0, width - 1)
    nearest = z.new_zeros(height * width).scatter_reduce_(0, at, 1.0 / z[inside], "amax")
    inverse_depth = nearest.view(1, height, width)
    unit, confidence = UNIT * nearest[nearest > 0].median(), (inverse_depth > 0).float()
    if weight is not None:
        weight = torch.where(1.0 / z[inside] == nearest[at], weight[inside], 0.0)
        confidence = torch.zeros_like(nearest).scatter_reduce_(0, at, weight, "amax").view(1, height, width)
    return Matches(inverse_depth, confidence, unit), left_out


def with_points(matches: Matches | None, points: Matches) -> Matches:
    """Matches, or ``None``, replaced by known points where there are any: the target of the refinement.

    The confidence of a point is the number of pixels that it stands for: few points then decide as much as
    many, and one that a poor prior contradicts is not taken for an outlier, as a match would be. A match
    stays where it is more confident than a point.
    """
    given = points.confidence > 0
    share = given.float().mean((-2, -1), keepdim=True)
    confidence = points.confidence / share.clamp_min(1.0 / given[0].numel())
    if matches is None:
        return replace(points, confidence=confidence)
    given &= (points.confidence >= 1.0) | (points.confidence >= matches.confidence)
    return replace(
        matches,
        inverse_depth=torch.where(given, points.inverse_depth, matches.inverse_depth),
        confidence=torch.where(given, confidence, matches.confidence),
        deviation=None if matches.deviation is None else torch.where(given, 1.0, matches.deviation),
    )


@torch.no_grad()
def reject_reflections(matches: Matches, depth_m: Tensor) -> Tensor:
    """The share ``(B, 1, H, W)`` that remains of each match, given the prior's first depth at its scale.

    One-sided: a reflection and what is seen through glass lie behind the surface, never before it. A prior
    that is right to 5 % can tell a reflection; a prior that errs by 30 % cannot.
    """
    radius = max(1, round(REGION * max(depth_m.shape[-2:])))
    if use_kernel(depth_m) and depth_m.numel() < MOST_SORTED:
        from geodiff_plugin.matching import reflection_kernels as kernels

        return kernels.reject_reflections(matches, depth_m, radius)
    weight = matches.confidence.float()
    behind = -(matches.inverse_depth * depth_m).clamp_min(1e-6).log().clamp(-LARGEST, LARGEST)
    counted = torch.where(weight > SPREAD_CONFIDENCE, behind, torch.full_like(behind, torch.nan)).flatten(1)
    middle = counted.nanmedian(1, keepdim=True).values
    apart = (counted - middle).abs()[:, :: 1 + counted.numel() // MOST_SORTED]
    spread = apart.nanquantile(SPREAD_SHARE, 1) / NORMAL_QUANTILE
    least = (SPREADS * spread.nan_to_num(LARGEST)).clamp_min(LEAST_DISTANCE)[:, None, None, None]
    behind_in_region, in_region = _window_sum(torch.cat([behind * weight, weight], 1), radius).chunk(2, 1)
    region = behind_in_region / in_region.clamp_min(1.0)
    rejected = ((torch.minimum(region, behind) / least - 1.0) / (MULTIPLE - 1.0)).clamp(0.0, 1.0)
    return (1.0 - rejected).contiguous()  # the sums lie column by column, which everything after would copy


def _window_sum(x: Tensor, radius: int) -> Tensor:
    for _ in range(2):  # along rows, then along columns
        until = F.pad(F.pad(x.cumsum(-1), (0, radius, 0, 0), mode="replicate"), (radius + 1, 0))
        x = (until[..., 2 * radius + 1 :] - until[..., : -2 * radius - 1]).mT
    return x
