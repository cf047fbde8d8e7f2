"""Reproject the maps of one camera into another one by z-buffered forward warping of its surfaces."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

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


class _Samples(NamedTuple):
    """Samples of a surface, projected into the other camera."""

    px: np.ndarray  # (n, 2) in the other camera
    z: np.ndarray  # (n,) depth in the other camera
    source: np.ndarray  # (n,) flat index of the nearest pixel of the first camera


def maps_in_camera(
    depth: np.ndarray, sigma: np.ndarray | None, camera: Camera, other: PosedCamera
) -> tuple[np.ndarray, np.ndarray | None]:
    """Compute a depth map and its standard deviation as another camera sees them, in the same unit.

    Every cell of four pixels of ``depth (H, W)`` on one surface (``JUMP``) is filled, so that a camera with a
    higher resolution has no holes. If several surfaces project to a pixel, the nearest one wins. Regions that
    are occluded in the first camera, outside its image, or unknown have no depth.

    An error of the depth ``z`` moves a point along its ray ``r``, with ``r_z = 1``. Its depth along the other
    camera's z axis ``e`` therefore changes by ``e . r`` times the error, about 1 for nearly parallel cameras,
    and so does its standard deviation. This is the uncertainty of the point; it does not include that the
    point also moves to another pixel of the other camera.

    Args:
        depth: ``(H, W)`` along z of the first camera; 0 or not finite where unknown.
        sigma: ``(H, W)`` standard deviation of ``depth``; NaN where unknown, ``None`` if there is none.
        camera: the first camera.
        other: the other camera, with its size and its pose in the first camera's frame.

    Returns:
        Depth ``(h, w)`` float32 along z of the other camera, 0 for no depth, and its standard deviation
        ``(h, w)`` float32 at the winning points, NaN where it is unknown or there is no depth.
    """
    width, height = other.size
    inverse = _inverse(depth)
    nearest, source = (each.reshape(height, width) for each in _z_buffer(inverse, camera, other))
    depth_seen = np.empty((height, width), np.float32)
    for rows in row_strips(height, width):
        depth_seen[rows] = _at_centres(nearest[rows], rows.start, inverse, camera, other)
    if sigma is None:
        return depth_seen, None
    sigma_seen = np.empty((height, width), np.float32)
    for rows in row_strips(height, width):
        sigma_seen[rows] = _sigma_along_z(sigma, source[rows], camera, other)
    return depth_seen, sigma_seen


def _z_buffer(inverse: np.ndarray, camera: Camera, other: PosedCamera) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest depth ``(h * w,)`` in the pixels of the other camera, and its source.

    The depth is infinite and the source -1 in pixels without a sample.
    """
    width, height = other.size
    nearest = np.full(width * height, np.inf)
    source = np.full(width * height, -1)
    for rows in row_strips(*inverse.shape):
        for samples in _samples(inverse, rows, camera, other):
            inside = other.contains(samples.px)
            column, row = (np.rint(at[inside]).astype(np.int64) for at in samples.px.T)
            cells, z = row * width + column, samples.z[inside]
            before = nearest[cells]
            keep_nearest(torch.from_numpy(nearest), torch.from_numpy(cells), torch.from_numpy(z))
            wins = np.flatnonzero((z < before) & (z == nearest[cells]))[::-1]
            source[cells[wins]] = samples.source[inside][wins]  # the first of equal depths, written last
    return nearest, source


def _sigma_along_z(sigma: np.ndarray, source: np.ndarray, camera: Camera, other: PosedCamera) -> np.ndarray:
    """Return the standard deviations of depth along the other camera's z for a strip of ``source (r, w)``."""
    known = source >= 0
    row, column = np.divmod(source[known], sigma.shape[1])
    along_z = np.abs(camera.rays(joined(column, row)) @ other.E[:3, 2])
    found = np.full(source.shape, np.nan)
    found[known] = sigma[row, column] * along_z
    return found


def _inverse(depth: np.ndarray) -> np.ndarray:
    """Compute ``1 / depth`` float64, which is linear in the pixel for a plane; 0 for unknown depth."""
    known = np.isfinite(depth) & (depth > 0)
    return np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0)


def _is_surface(*corners: np.ndarray) -> np.ndarray:
    """Whether the inverse depths of four corners are known and belong to one surface."""
    largest, smallest = np.maximum.reduce(corners), np.minimum.reduce(corners)
    return (smallest > 0) & (largest <= (1.0 + JUMP) * smallest)


def _samples(inverse: np.ndarray, rows: slice, camera: Camera, other: PosedCamera) -> Iterator[_Samples]:
    """Yield samples of a strip of the surface.

    The first samples are the known pixels. The others subdivide each cell of four pixels on one surface,
    whose inverse depth is interpolated bilinearly.
    """
    strip = inverse[rows.start : rows.stop + 1]  # includes the row below, which the last cells need
    own = strip[: rows.stop - rows.start]
    width = inverse.shape[1]
    y, x = np.nonzero(own > 0)
    pixel = (y + rows.start) * width + x
    yield _Samples(*_seen(joined(x, y + rows.start), own[y, x], camera, other), pixel)
    corners_of_cells = strip[:-1, :-1], strip[:-1, 1:], strip[1:, :-1], strip[1:, 1:]
    y, x = np.nonzero(_is_surface(*corners_of_cells))
    if not len(y):
        return
    px, pixel = joined(x, y + rows.start), (y + rows.start) * width + x
    corners = [part[y, x] for part in corners_of_cells]
    count = _samples_per_side(px, corners, camera, other)
    for down in range(count):
        for right in range(count):
            if down or right:  # (0, 0) is the pixel itself
                s, t = right / count, down / count
                weights = ((1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t)
                seen = _seen(px + (s, t), np.tensordot(weights, corners, 1), camera, other)
                yield _Samples(*seen, pixel + round(t) * width + round(s))


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
