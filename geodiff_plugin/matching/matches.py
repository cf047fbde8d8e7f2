"""``Matches``: inverse depth and confidence per pixel, from matches between views or from known points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin._internal.kernels import launch_bound
from geodiff_plugin.cameras import Camera
from geodiff_plugin.geometry import NEAREST_M, project, stacked

#: Minimum confidence of reliable matches: more likely right than wrong.
RELIABLE = 0.5
#: Unit of errors at points, as a fraction of their median inverse depth.
UNIT = 0.01


@dataclass(frozen=True)
class Matches:
    """Matches between views, or known points, on one grid of the left view, for one image or a chunk.

    ``inverse_depth`` and ``confidence`` are ``(1, H, W)`` for one image, or ``(B, 1, H, W)``. Confidence is
    in [0, 1], but above 1 at known points added by ``with_points``.
    """

    inverse_depth: Tensor  # float32, 1/m; defined everywhere, meaningful where ``confidence > 0``
    confidence: Tensor  # 0 where there is no match or point
    plane_step: Tensor  # () or (B,) 1/m, unit of errors: one plane, or ``UNIT`` of the points' median
    deviation: Tensor | None = None  # like ``confidence``, in plane steps; ``None`` means 1 everywhere
    repeated: Tensor | None = None  # like ``confidence``, how surely a pattern repeats; ``None``: nowhere
    period: Tensor | None = None  # like ``confidence``, 1/m from one match on a repeated pattern to the next
    _above: dict[float, Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)

    @classmethod
    def stack(cls, images: Sequence[Self | None]) -> Self | None:
        """Stack the matches of several images on grids of one size; ``None`` if any image has none."""
        given = [matches for matches in images if matches is not None]
        if len(given) < len(images):
            return None
        names = ("inverse_depth", "confidence", "plane_step")
        inverse_depth, confidence, step = (stacked([getattr(m, name) for m in given]) for name in names)
        deviations = [matches.deviation for matches in given]
        known = [each for each in deviations if each is not None]
        deviation = stacked(known) if len(known) == len(given) else None
        patterns = (_stacked_if_any(given, name) for name in ("repeated", "period"))
        return cls(inverse_depth, confidence, step, deviation, *patterns)

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the grid."""
        return self.confidence.shape[-2], self.confidence.shape[-1]

    def within(self, valid: Tensor) -> Self:
        """Set confidence to 0 outside ``valid (1, h, w)`` or ``(B, 1, h, w)`` bool, on any grid."""
        inside = F.interpolate(valid.view(-1, 1, *valid.shape[-2:]).float(), self.size, mode="nearest-exact")
        return replace(self, confidence=self.confidence * inside.view_as(self.confidence))

    def above(self, confidence: float) -> Tensor:
        """Return the flat indices ``(P,)`` of an image's pixels above a confidence, in order; cached."""
        if confidence not in self._above:
            read_above((self, confidence))
        return self._above[confidence]


def _stacked_if_any(images: Sequence[Matches], name: str) -> Tensor | None:
    """Stack a map of several images, 0 for those without; ``None`` if none has it."""
    maps = [getattr(matches, name) for matches in images]
    if all(each is None for each in maps):
        return None
    zeros = torch.zeros_like(images[0].confidence)
    return stacked([zeros if each is None else each for each in maps])


def read_above(*wanted: tuple[Matches, float]) -> None:
    """Fill the caches of ``Matches.above`` for grids of one size, synchronizing with the device once."""
    masks = torch.stack([matches.confidence.flatten() > confidence for matches, confidence in wanted])
    found = _indices(masks) if launch_bound(masks) else [mask.nonzero()[:, 0] for mask in masks]
    for (matches, confidence), indices in zip(wanted, found, strict=True):
        matches._above[confidence] = indices


def _indices(masks: Tensor) -> list[Tensor]:
    """Compute ``mask.nonzero()[:, 0]`` of every mask of ``(K, N)``; only the counts synchronize."""
    count = masks.cumsum(1)
    place = torch.where(masks, count, 0)  # unset pixels go to position 0, which is cut off
    indices = count.new_empty(len(masks), masks.shape[1] + 1)
    indices.scatter_(1, place, torch.arange(masks.shape[1], device=masks.device).expand_as(place))
    return [row[1 : 1 + number] for row, number in zip(indices, count[:, -1].tolist(), strict=True)]


class HalfOcclusions(NamedTuple):
    """Half-occlusions: strips of an image that the right view cannot see, ``(1, 1, h, w)`` each."""

    inside: Tensor  # bool
    inverse_depth: Tensor  # 1/m of the farther surface, which continues in them


class _PixelDepths(NamedTuple):
    """Known depths at pixels of the left image."""

    uv: Tensor  # (N, 2) pixels
    z: Tensor  # (N,) metres
    confidence: Tensor | None  # (N,) in (0, 1]; ``None`` means 1


def _pixel_depths(points: Tensor, camera: Camera, size: tuple[int, int]) -> _PixelDepths:
    """Locate known depths, in either form of ``points_to_matches``, in the left image."""
    if points.ndim == 2 and points.shape[1] in (3, 4):
        uv, z = project(points[:, :3], camera)
        return _PixelDepths(uv, z, points[:, 3] if points.shape[1] == 4 else None)
    if tuple(points.shape[:2]) != size:
        hint = "A sparse depth map must be aligned with the left image; otherwise pass points (N, 3)."
        got = f"{points.shape[1]}x{points.shape[0]}"
        bad_value("points", f"a map of the left image's {size[1]}x{size[0]} pixels", got, hint)
    depth_m = points if points.ndim == 2 else points[..., 0]
    rows, columns = (depth_m > 0).nonzero(as_tuple=True)
    confidence = points[rows, columns, 1] if points.ndim == 3 else None
    return _PixelDepths(torch.stack([columns, rows], dim=1).float(), depth_m[rows, columns], confidence)


def points_to_matches(points: Tensor, left: Camera, size_grid: tuple[int, int]) -> tuple[Matches, int]:
    """Rasterize known depths on a grid ``(h, w)`` of the left view; also returns the number excluded.

    ``points`` are ``(N, 3)`` metres in the left camera's frame, or ``(N, 4)`` with their confidence in (0,
    1]; or a map ``(H, W)`` of the left image's size, 0 where unknown, or ``(H, W, 2)`` with its confidence.
    The nearest of several points in a pixel wins. ``InputError`` if none remains, or for a map of another
    size.
    """
    assert left.size is not None
    size = left.size[::-1]
    uv, z, weight = _pixel_depths(points, left, size)
    # A pixel extends half a pixel beyond its centre.
    inside = ((uv >= -0.5) & (uv < uv.new_tensor([size[1], size[0]]) - 0.5)).all(dim=1) & (z > NEAREST_M)
    excluded = int((~inside).sum())
    if excluded == len(z):
        bad_value(
            "points",
            "at least one in front of the left camera and inside its image",
            f"{excluded} of {len(z)} behind it or outside",
            "Points are in metres in the left camera's frame: x right, y down, z forward. Transform points "
            "from any other frame first.",
        )
    height, width = size_grid
    scale = uv.new_tensor([width / size[1], height / size[0]])
    cell = ((uv[inside] + 0.5) * scale).floor().long()
    at = cell[:, 1].clamp(0, height - 1) * width + cell[:, 0].clamp(0, width - 1)
    nearest = z.new_zeros(height * width).scatter_reduce_(0, at, 1.0 / z[inside], "amax")
    inverse_depth = nearest.view(1, height, width)
    unit = UNIT * nearest[nearest > 0].median()
    confidence = (inverse_depth > 0).float()
    if weight is not None:
        weight = torch.where(1.0 / z[inside] == nearest[at], weight[inside], 0.0)
        confidence = torch.zeros_like(nearest).scatter_reduce_(0, at, weight, "amax").view(1, height, width)
    return Matches(inverse_depth, confidence, unit), excluded


def with_points(matches: Matches | None, points: Matches) -> Matches:
    """Replace matches, or ``None``, by known points where there are any: the target of match fitting.

    A point's confidence is the number of pixels that it represents, so that few points decide as much as
    many, and a point contradicted by a poor prior is not treated as an outlier, unlike a match. A match is
    kept if it is more confident than the point.
    """
    given = points.confidence > 0
    fraction = given.float().mean((-2, -1), keepdim=True)
    confidence = points.confidence / fraction.clamp_min(1.0 / given[0].numel())
    if matches is None:
        return replace(points, confidence=confidence)
    given &= (points.confidence >= 1.0) | (points.confidence >= matches.confidence)
    return replace(
        matches,
        inverse_depth=torch.where(given, points.inverse_depth, matches.inverse_depth),
        confidence=torch.where(given, confidence, matches.confidence),
        deviation=None if matches.deviation is None else torch.where(given, 1.0, matches.deviation),
    )
