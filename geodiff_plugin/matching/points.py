"""Known depths in the form of matches: lidar, structure from motion, any sparse depth.

Data flow: ``(N, 3)`` points or an ``(H, W)`` map in metres, K -> ``Matches`` on any grid of the left view.
Paper: none; what Marigold-DC (Viola et al. 2024) completes.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin.geometry import NEAREST_M, project
from geodiff_plugin.matching.matches import Matches

__all__ = ["UNIT", "points_to_matches", "with_points"]

#: The unit in which errors at points are measured, as a share of their median inverse depth.
UNIT = 0.01


def points_to_matches(
    points: torch.Tensor,
    K_left: torch.Tensor,
    size: tuple[int, int],
    size_grid: tuple[int, int],
) -> tuple[Matches, int]:
    """Put known depths on a grid of the left view; where several fall on one pixel, the nearest wins.

    Args:
        points: ``(N, 3)`` float32, metres, in the left camera's frame (x right, y down, z forward); or a map
            ``(H, W)`` of ``size``, metres, 0 where unknown.
        K_left: ``(3, 3)`` pixels of the left image.
        size: ``(H, W)`` of the left image.
        size_grid: ``(h, w)`` of the grid.

    Returns:
        ``Matches`` of the grid, with confidence 1 where a depth is known and 0 elsewhere, and how many of the
        points are left out: behind the camera, or outside the image.

    Raises:
        ValueError: no point is left, or a map is not of the image's size.
    """
    if points.shape[1] == 3:
        uv, z = project(points[None, None], K_left[None])
        uv, z = uv[0, 0], z[0, 0]
    else:
        if tuple(points.shape) != size:
            cure = "A sparse depth map belongs to the left image, pixel by pixel; else give points (N, 3)."
            got = f"{points.shape[1]}x{points.shape[0]}"
            bad_value("points", f"a map of the left image's {size[1]}x{size[0]} pixels", got, cure)
        rows, columns = (points > 0).nonzero(as_tuple=True)
        uv, z = torch.stack([columns, rows], dim=1).float(), points[rows, columns]
    # A pixel reaches half a pixel beyond its centre.
    inside = ((uv >= -0.5) & (uv < uv.new_tensor([size[1], size[0]]) - 0.5)).all(dim=1) & (z > NEAREST_M)
    left_out = int((~inside).sum())
    if left_out == len(z):
        bad_value(
            "points",
            "in front of the left camera and inside its image, at least one of them",
            f"{left_out} of {len(z)} behind it or outside",
            "They are metres in the left camera's frame: x right, y down, z forward. Is a pose missing?",
        )
    height, width = size_grid
    scale = uv.new_tensor([width / size[1], height / size[0]])
    cell = ((uv[inside] + 0.5) * scale).floor().long()
    at = cell[:, 1].clamp(0, height - 1) * width + cell[:, 0].clamp(0, width - 1)
    nearest = z.new_zeros(height * width).scatter_reduce_(0, at, 1.0 / z[inside], "amax")
    inverse_depth = nearest.view(1, height, width)
    unit = UNIT * nearest[nearest > 0].median()
    return Matches(inverse_depth, (inverse_depth > 0).float(), unit), left_out


def with_points(matches: Matches | None, points: Matches) -> Matches:
    """Matches with known points in their place: what the refinement follows.

    Args:
        matches: of one image, or of a chunk of samples; ``None`` where there are none.
        points: of the same, on the same grid.

    Returns:
        As ``matches`` (or ``points``, without), but that the confidence of a point is the number of pixels
        that it stands for: few points then decide as much as many, and one that a poor prior contradicts is
        not taken for an outlier, as a match would be.
    """
    given = points.confidence > 0
    share = given.float().mean((-2, -1), keepdim=True)
    confidence = points.confidence / share.clamp_min(1.0 / given[0].numel())
    if matches is None:
        return replace(points, confidence=confidence)
    return replace(
        matches,
        inverse_depth=torch.where(given, points.inverse_depth, matches.inverse_depth),
        confidence=torch.where(given, confidence, matches.confidence),
    )
