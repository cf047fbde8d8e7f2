"""Depth of one camera as another one sees it: a forward warp of its surfaces with a z-buffer."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from geodiff_plugin._camera_checks import check_intrinsics, check_pose
from geodiff_plugin._checks import bad_type, check_size
from geodiff_plugin._strips import row_strips

#: Four pixels lie on one surface unless their depth grows by more than this share of the nearest: twice what
#: a surface seen at 87 degrees from its normal changes from pixel to pixel, as a cell has a diagonal.
JUMP = 0.08
#: Samples of a cell along one side, at most: of a camera that sees the surface eight times as finely.
MOST_SAMPLES = 8
#: Distance of samples in pixels of the other camera below which no pixel between them stays empty.
SPACING_PX = 0.7
#: Nearer than this, in lengths of the depth, a point is behind the camera.
NEAREST = 1e-6
#: Steps along a pixel's ray to the surface.
STEPS = 3
#: They may lead this far from the sample that the pixel got, as a share of its depth.
FARTHEST_STEP = 0.05


class PosedCamera(NamedTuple):
    """A camera beside the left one, which has the depth."""

    K: np.ndarray  # (3, 3) pixels, the first pixel's centre at (0, 0)
    E: np.ndarray  # (4, 4) its pose in the left camera's frame, in OpenCV's axes
    size: tuple[int, int]  # (width, height) of its image

    @classmethod
    def checked(cls, K: Any, E: Any, size: Any, of: str = "into") -> PosedCamera:
        """The camera of arguments that a user gave; ``InputError`` names them after ``of``."""
        if size is None:
            bad_type(f"{of}: size", "a pair (width, height)", size)
        width_height = check_size(size, f"{of}: size")
        assert width_height is not None
        pose = "E is the 4x4 pose of that camera in the left camera's frame, [[R, t], [0, 1]]."
        return cls(check_intrinsics(K, f"{of}: K"), check_pose(E, f"{of}: E", pose), width_height)


def depth_in_camera(depth: np.ndarray, K: np.ndarray, camera: PosedCamera) -> np.ndarray:
    """Depth ``(h, w)`` float32 along z of another camera, in the same unit; 0 where there is none.

    Every cell of four pixels of ``depth (H, W)`` that lie on one surface (``JUMP``) is one, so that a finer
    camera sees no holes in it; of several surfaces behind a pixel the nearest counts. What the first camera
    does not see, behind an edge or outside of its image, has no depth: 0. So has what is unknown to it.
    """
    width, height = camera.size
    nearest = np.full(width * height, np.inf)
    inverse = _inverse(depth)
    for rows in row_strips(*depth.shape):
        for u, v, z in _samples(inverse, rows, K, camera):
            inside = (z > NEAREST) & (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
            at = np.rint(v[inside]).astype(np.int64) * width + np.rint(u[inside]).astype(np.int64)
            np.minimum.at(nearest, at, z[inside])
    seen = nearest.reshape(height, width)
    result = np.zeros((height, width), np.float32)
    for rows in row_strips(height, width):
        result[rows] = _at_centres(seen[rows], rows.start, inverse, K, camera)
    return result


class _Seen(NamedTuple):
    """Samples of a surface as the other camera sees them, ``(n,)`` each."""

    u: np.ndarray  # columns, pixels
    v: np.ndarray  # rows
    z: np.ndarray  # depths, in the unit of the first camera's


def _inverse(depth: np.ndarray) -> np.ndarray:
    """``1 / depth`` float64, of which a plane is a linear function of the pixel; 0 where unknown."""
    known = np.isfinite(depth) & (depth > 0)
    return np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0)


def _is_surface(*corners: np.ndarray) -> np.ndarray:
    """Whether the inverse depths of four corners are known, and of one surface."""
    most, least = np.maximum.reduce(corners), np.minimum.reduce(corners)
    return (least > 0) & (most <= (1.0 + JUMP) * least)


def _samples(inverse: np.ndarray, rows: slice, K: np.ndarray, camera: PosedCamera) -> Iterator[_Seen]:
    """Every known pixel of a strip, and places within its cells, as the other camera sees them."""
    strip = inverse[rows.start : rows.stop + 1]  # with the row below, which its last cells need
    own = strip[: rows.stop - rows.start]
    y, x = np.nonzero(own > 0)
    yield _seen(x, y + rows.start, own[y, x], K, camera)
    a, b, c, d = strip[:-1, :-1], strip[:-1, 1:], strip[1:, :-1], strip[1:, 1:]
    y, x = np.nonzero(_is_surface(a, b, c, d))
    if not len(y):
        return
    corners = [part[y, x] for part in (a, b, c, d)]
    count = _samples_a_side(x, y + rows.start, corners, K, camera)
    for down in range(count):
        for right in range(count):
            if down or right:
                s, t = right / count, down / count
                weights = ((1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t)
                between = np.tensordot(weights, corners, 1)
                yield _seen(x + s, y + rows.start + t, between, K, camera)


def _samples_a_side(
    x: np.ndarray, y: np.ndarray, corners: list[np.ndarray], K: np.ndarray, camera: PosedCamera
) -> int:
    """So many samples along a side of a cell that no pixel of the other camera between them stays empty."""
    u, v, z = _seen(x, y, corners[0], K, camera)
    farthest = 0.0
    for corner, (dx, dy) in zip(corners[1:], ((1, 0), (0, 1), (1, 1)), strict=True):
        other_u, other_v, other_z = _seen(x + dx, y + dy, corner, K, camera)
        ahead = (z > NEAREST) & (other_z > NEAREST)
        apart = np.maximum(np.abs(other_u - u), np.abs(other_v - v))[ahead]
        farthest = max(farthest, float(np.quantile(apart, 0.999)) if len(apart) else 0.0)
    return int(np.clip(np.ceil(farthest / SPACING_PX), 1, MOST_SAMPLES))


def _seen(x: np.ndarray, y: np.ndarray, inverse: np.ndarray, K: np.ndarray, camera: PosedCamera) -> _Seen:
    """Pixels ``(n,)`` of the first camera in the other one, by their inverse depth."""
    rays = np.linalg.inv(K) @ np.stack([x, y, np.ones(len(x))])
    points = camera.E[:3, :3].T @ (rays / inverse - camera.E[:3, 3:])
    z = points[2]
    u, v, _ = camera.K @ (points / np.where(z > NEAREST, z, 1.0))
    return _Seen(u, v, z)


def _at_centres(
    seen: np.ndarray, top: int, inverse: np.ndarray, K: np.ndarray, camera: PosedCamera
) -> np.ndarray:
    """A strip of the z-buffer with each depth moved from its sample to the centre of the pixel.

    Along the pixel's ray to where it meets the surface, by Newton's steps with the surface's slope left out.
    """
    found = np.where(np.isfinite(seen), seen, 0.0)
    v, u = np.nonzero(found)
    z = first = best = found[v, u]
    least = np.full(len(z), np.inf)
    rays = camera.E[:3, :3] @ np.linalg.inv(camera.K) @ np.stack([u, v + top, np.ones(len(u))])
    for _ in range(STEPS + 1):
        off = _above_surface(rays * z + camera.E[:3, 3:], inverse, K)
        better = np.abs(off) < least
        best, least = np.where(better, z, best), np.where(better, np.abs(off), least)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = off / rays[2]
        z = np.where(np.isfinite(step) & (np.abs(z + step - first) <= FARTHEST_STEP * first), z + step, z)
    found[v, u] = best
    return found


def _above_surface(points: np.ndarray, inverse: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Depth of the surface less that of points ``(3, n)`` of the first camera; infinity where it has none."""
    height, width = inverse.shape
    z = points[2]
    ahead = z > NEAREST
    x, y, _ = K @ (points / np.where(ahead, z, 1.0))
    inside = ahead & (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    column, row = (np.where(inside, value, 0).astype(np.int64) for value in (x, y))
    column, row = np.minimum(column, max(width - 2, 0)), np.minimum(row, max(height - 2, 0))
    below, right = np.minimum(row + 1, height - 1), np.minimum(column + 1, width - 1)
    corners = inverse[row, column], inverse[row, right], inverse[below, column], inverse[below, right]
    s, t = x - column, y - row
    between = (1 - t) * ((1 - s) * corners[0] + s * corners[1]) + t * ((1 - s) * corners[2] + s * corners[3])
    good = inside & _is_surface(*corners)
    return np.where(good, 1.0 / np.where(good, between, 1.0) - z, np.inf)
