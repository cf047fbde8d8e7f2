"""Coloured point clouds from depth, without flying points between two surfaces.

Data flow: depth in metres, image, K -> binary PLY in the left camera's frame.
Paper: Eq. 9 (unprojection).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from geodiff_plugin._camera_checks import check_intrinsics
from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.atomic import atomic_path
from geodiff_plugin.formats.strips import row_strips

__all__ = ["Cloud", "flying_points", "make_cloud", "write_ply"]

#: Depth change from one pixel to the next, as a share of the nearer depth. At a focal length of 500 px it is
#: a surface seen at 87 degrees from its normal: hardly a surface that one camera can see.
RELATIVE_STEP = 0.04
#: A corner of a flat surface has three neighbours on it, a one-pixel ramp along an edge has two.
FEWEST_NEIGHBOURS = 3
VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])


def flying_points(
    depth_m: np.ndarray,
    valid: np.ndarray | None = None,
    *,
    relative_step: float = RELATIVE_STEP,
    reach: int = 1,
) -> np.ndarray:
    """Points that hang in the air between a near and a far surface.

    A pixel flies when fewer than three of its eight neighbours have its depth, within ``relative_step`` of
    the nearer of the two. Both sides of a clean edge stay. Things one pixel wide and surfaces seen at a
    grazing angle (a road near the horizon) go too. A map that was enlarged has wider ramps: give the
    enlargement as ``reach``.

    Args:
        depth_m: ``(H, W)`` metres.
        valid: ``(H, W)`` boolean; pixels that are not valid or not above 0 support no neighbour.
        relative_step: allowed depth change between neighbours, > 0.
        reach: distance of the eight neighbours in pixels, >= 1.

    Returns:
        ``(H, W)`` boolean, True where a valid pixel flies.
    """
    depth_m = np.asarray(depth_m, dtype=np.float32)
    use = np.isfinite(depth_m) & (depth_m > 0)
    use = use if valid is None else use & np.asarray(valid, dtype=bool)
    height, width = depth_m.shape
    # NaN compares false with everything, so what is unknown or outside the image supports nobody.
    padded = np.pad(np.where(use, depth_m, np.nan), reach, constant_values=np.nan)
    flying, shifts = np.empty(depth_m.shape, dtype=bool), (0, reach, 2 * reach)
    for rows in row_strips(height, width):
        count = rows.stop - rows.start
        strip = padded[rows.start : rows.stop + 2 * reach]
        centre = strip[reach : reach + count, reach : reach + width]
        support = np.zeros(centre.shape, dtype=np.int8)
        for dy, dx in ((dy, dx) for dy in shifts for dx in shifts if (dy, dx) != (reach, reach)):
            neighbour = strip[dy : dy + count, dx : dx + width]
            support += np.abs(centre - neighbour) <= relative_step * np.minimum(centre, neighbour)
        flying[rows] = use[rows] & (support < FEWEST_NEIGHBOURS)
    return flying


@dataclass(frozen=True)
class Cloud:
    """Coloured points in the left camera's frame.

    Attributes:
        points_m: ``(N, 3)`` float64 metres; x right, y down, z forward.
        colours: ``(N, 3)`` uint8 RGB.
    """

    points_m: np.ndarray
    colours: np.ndarray

    def thinned(self, most: int) -> Cloud:
        """At most ``most`` of the points, evenly over their order, which is that of the pixels."""
        if len(self.points_m) <= most:
            return self
        kept = np.linspace(0, len(self.points_m) - 1, most).astype(int)
        return Cloud(self.points_m[kept], self.colours[kept])


def make_cloud(
    depth_m: np.ndarray, image_01: np.ndarray, K: np.ndarray, valid: np.ndarray | None = None
) -> Cloud:
    """The points of a depth map.

    Args:
        depth_m: ``(H, W)`` metres, z of the left camera.
        image_01: ``(H, W, 3)`` in [0, 1], the colours.
        K: ``(3, 3)`` pixels of this grid.
        valid: ``(H, W)`` boolean; only these become points (``valid & ~flying_points(depth_m)``).

    Returns:
        One point a pixel, row by row; pixels that are not finite or not above 0 never are.

    Raises:
        ValueError: shapes that do not fit, or a K that is none.

    Convention:
        A pixel on the principal point at 2 m is (0, 0, 2).
    """
    parts = list(_cloud_strips(depth_m, image_01, K, valid))
    return Cloud(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("points_m", "colours"))
    )


def _cloud_strips(
    depth_m: np.ndarray, image_01: np.ndarray, K: np.ndarray, valid: np.ndarray | None
) -> Iterator[Cloud]:
    """The points of ``make_cloud``, a strip of rows after the other."""
    depth_m, image_01 = np.asarray(depth_m), np.asarray(image_01)
    if depth_m.ndim != 2 or image_01.shape != (*depth_m.shape, 3):
        bad_value("image_01", "(H, W, 3) over a depth of (H, W)", f"{image_01.shape} over {depth_m.shape}")
    unproject = np.linalg.inv(check_intrinsics(K)).T
    for rows in row_strips(*depth_m.shape):
        z = depth_m[rows].astype(np.float64)
        use = np.isfinite(z) & (z > 0)
        use = use if valid is None else use & np.asarray(valid[rows], dtype=bool)
        v, u = np.nonzero(use)
        points = np.stack([u, v + rows.start, np.ones_like(u)], axis=-1) @ unproject * z[use][:, None]
        yield Cloud(points, np.rint(np.clip(image_01[rows][use], 0.0, 1.0) * 255.0).astype(np.uint8))


def write_ply(
    path: str | os.PathLike[str],
    depth_m: np.ndarray,
    image_01: np.ndarray,
    K: np.ndarray,
    valid: np.ndarray | None = None,
    unit: str | None = "m",
) -> int:
    """Write a coloured point cloud as binary little-endian PLY, whole or not at all.

    Args:
        path: the file.
        depth_m: ``(H, W)`` metres, z of the left camera.
        image_01: ``(H, W, 3)`` in [0, 1], the colours.
        K: ``(3, 3)`` pixels of this grid.
        valid: ``(H, W)`` boolean; only these become points (``valid & ~flying_points(depth_m)``).
        unit: ``"m"``, or ``None`` for a depth without one; a comment of the file says which.

    Returns:
        How many points were written.

    Raises:
        ValueError: as in ``make_cloud``.
        OSError: the folder does not exist or is not writable.

    Convention:
        x right, y down, z forward, metres: a pixel on the principal point at 2 m is (0, 0, 2).
    """
    depth_m = np.asarray(depth_m)
    use = np.isfinite(depth_m) & (depth_m > 0)
    count = int(np.count_nonzero(use if valid is None else use & np.asarray(valid, dtype=bool)))
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(_ply_head(count, unit))
        for cloud in _cloud_strips(depth_m, image_01, K, valid):
            file.write(_vertices(cloud).tobytes())
    return count


def _vertices(cloud: Cloud) -> np.ndarray:
    """``(N,)`` of ``VERTEX``."""
    vertices = np.empty(len(cloud.points_m), dtype=VERTEX)
    for column, name in enumerate(("x", "y", "z")):
        vertices[name] = cloud.points_m[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        vertices[name] = cloud.colours[:, column]
    return vertices


def _ply_head(count: int, unit: str | None) -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment camera frame: x right, y down, z forward, {'metres' if unit else 'no unit'}",
        f"element vertex {count}",
        *(f"property float {name}" for name in ("x", "y", "z")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")
