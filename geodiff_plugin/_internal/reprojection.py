"""Reproject the depth of one camera into another one by z-buffered forward warping of its surfaces."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from geodiff_plugin._internal.strips import row_strips
from geodiff_plugin.cameras import NEAREST, Camera, PosedCamera, joined, keep_nearest

#: Relative change of depth between adjacent pixels of the steepest surface. At a focal length of 500 px the
#: surface is seen at 87 degrees from its normal.
STEEPEST_STEP = 0.04
#: Maximum relative range of depth of four pixels on one surface, twice the step because a cell has a
#: diagonal.
JUMP = 2 * STEEPEST_STEP
#: Maximum number of samples per side of a cell, for a target camera with eight times the resolution.
MAX_SAMPLES = 8
#: Maximum distance of samples in pixels of the target camera that leaves no pixel empty.
SPACING_PX = 0.7
#: Number of iterations that intersect a pixel's ray with the surface.
STEPS = 3
#: Maximum distance of the intersection from the sample of the pixel, as a fraction of its depth.
MAX_STEP_FRACTION = 0.05


def depth_in_camera(depth: np.ndarray, camera: Camera, other: PosedCamera) -> np.ndarray:
    """Compute the depth ``(h, w)`` float32 along z of another camera, in the same unit; 0 for no depth.

    Every cell of four pixels of ``depth (H, W)`` on one surface (``JUMP``) is filled, so that a camera with a
    higher resolution has no holes. If several surfaces project to a pixel, the nearest one wins. Regions that
    are occluded in the first camera, outside its image, or unknown have no depth.
    """
    width, height = other.size
    nearest = np.full(width * height, np.inf)
    inverse = _inverse(depth)
    for rows in row_strips(*depth.shape):
        for px, z in _samples(inverse, rows, camera, other):
            inside = other.contains(px)
            column, row = (np.rint(at[inside]).astype(np.int64) for at in px.T)
            cells = torch.from_numpy(row * width + column)
            z_inside = torch.from_numpy(z[inside])
            keep_nearest(torch.from_numpy(nearest), cells, z_inside)
    seen = nearest.reshape(height, width)
    result = np.zeros((height, width), np.float32)
    for rows in row_strips(height, width):
        result[rows] = _at_centres(seen[rows], rows.start, inverse, camera, other)
    return result


def _inverse(depth: np.ndarray) -> np.ndarray:
    """Compute ``1 / depth`` float64, which is linear in the pixel for a plane; 0 for unknown depth."""
    known = np.isfinite(depth) & (depth > 0)
    return np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0)


def _is_surface(*corners: np.ndarray) -> np.ndarray:
    """Whether the inverse depths of four corners are known and belong to one surface."""
    largest, smallest = np.maximum.reduce(corners), np.minimum.reduce(corners)
    return (smallest > 0) & (largest <= (1.0 + JUMP) * smallest)


def _samples(
    inverse: np.ndarray, rows: slice, camera: Camera, other: PosedCamera
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pixels ``(n, 2)`` and depths ``(n,)`` in the other camera of samples of a strip of the surface.

    The first samples are the known pixels. The others subdivide each cell of four pixels on one surface,
    whose inverse depth is interpolated bilinearly.
    """
    strip = inverse[rows.start : rows.stop + 1]  # includes the row below, which the last cells need
    own = strip[: rows.stop - rows.start]
    y, x = np.nonzero(own > 0)
    yield _seen(joined(x, y + rows.start), own[y, x], camera, other)
    corners_of_cells = strip[:-1, :-1], strip[:-1, 1:], strip[1:, :-1], strip[1:, 1:]
    y, x = np.nonzero(_is_surface(*corners_of_cells))
    if not len(y):
        return
    px = joined(x, y + rows.start)
    corners = [part[y, x] for part in corners_of_cells]
    count = _samples_per_side(px, corners, camera, other)
    for down in range(count):
        for right in range(count):
            if down or right:  # (0, 0) is the pixel itself
                s, t = right / count, down / count
                weights = ((1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t)
                yield _seen(px + (s, t), np.tensordot(weights, corners, 1), camera, other)


def _samples_per_side(px: np.ndarray, corners: list[np.ndarray], camera: Camera, other: PosedCamera) -> int:
    """Return the number of samples per side of a cell that leaves no pixel of the other camera empty."""
    first, z = _seen(px, corners[0], camera, other)
    farthest = 0.0
    for corner, step in zip(corners[1:], ((1, 0), (0, 1), (1, 1)), strict=True):
        second, other_z = _seen(px + step, corner, camera, other)
        distance = np.abs(second - first).max(1)[(z > NEAREST) & (other_z > NEAREST)]
        farthest = max(farthest, float(np.quantile(distance, 0.999)) if len(distance) else 0.0)
    return int(np.clip(np.ceil(farthest / SPACING_PX), 1, MAX_SAMPLES))


def _seen(
    px: np.ndarray, inverse: np.ndarray, camera: Camera, other: PosedCamera
) -> tuple[np.ndarray, np.ndarray]:
    """Project pixels with inverse depths into the other camera; returns pixels ``(n, 2)``, depth ``(n,)``."""
    return other.project(other.from_world(camera.rays(px) / inverse[:, None]))


def _at_centres(
    seen: np.ndarray, top: int, inverse: np.ndarray, camera: Camera, other: PosedCamera
) -> np.ndarray:
    """Move each depth of a strip of the z-buffer from its sample to the centre of the pixel.

    The function intersects the pixel's ray with the surface by Newton iterations that ignore the slope of the
    surface.
    """
    found = np.where(np.isfinite(seen), seen, 0.0)
    v, u = np.nonzero(found)
    z = first = best = found[v, u]
    smallest = np.full(len(z), np.inf)
    rays = other.rays(joined(u, v + top)) @ other.E[:3, :3].T
    for _ in range(STEPS + 1):
        off = _above_surface(rays * z[:, None] + other.E[:3, 3], inverse, camera)
        better = np.abs(off) < smallest
        best = np.where(better, z, best)
        smallest = np.where(better, np.abs(off), smallest)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = off / rays[:, 2]
        z = np.where(np.isfinite(step) & (np.abs(z + step - first) <= MAX_STEP_FRACTION * first), z + step, z)
    found[v, u] = best
    return found


def _above_surface(points: np.ndarray, inverse: np.ndarray, camera: Camera) -> np.ndarray:
    """Subtract the depth of points ``(n, 3)`` from the first camera's surface; infinity without surface."""
    height, width = inverse.shape
    px, z = camera.project(points)
    x, y = px.T
    inside = (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    column, row = (np.where(inside, value, 0).astype(np.int64) for value in (x, y))
    column, row = np.minimum(column, max(width - 2, 0)), np.minimum(row, max(height - 2, 0))
    below, right = np.minimum(row + 1, height - 1), np.minimum(column + 1, width - 1)
    corners = inverse[row, column], inverse[row, right], inverse[below, column], inverse[below, right]
    s, t = x - column, y - row
    between = (1 - t) * ((1 - s) * corners[0] + s * corners[1]) + t * ((1 - s) * corners[2] + s * corners[3])
    good = inside & _is_surface(*corners)
    return np.where(good, 1.0 / np.where(good, between, 1.0) - z, np.inf)
