"""Coloured point clouds from depth, without flying points between two surfaces.

Hop: depth in metres, image, K -> binary PLY in the left camera's frame.
Paper: Eq. 9 (unprojection).
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from geodiff_plugin._checks import bad_value, check_intrinsics
from geodiff_plugin.formats.atomic import atomic_path

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
    use = np.isfinite(depth_m) & (np.where(np.isfinite(depth_m), depth_m, 0) > 0)
    use = use if valid is None else use & np.asarray(valid, dtype=bool)
    height, width = depth_m.shape
    # NaN compares false with everything, so what is unknown or outside the image supports nobody.
    padded = np.pad(np.where(use, depth_m, np.nan), reach, constant_values=np.nan)
    centre = padded[reach : reach + height, reach : reach + width]
    support = np.zeros(depth_m.shape, dtype=np.int8)
    shifts = (0, reach, 2 * reach)
    for dy, dx in ((dy, dx) for dy in shifts for dx in shifts if (dy, dx) != (reach, reach)):
        neighbour = padded[dy : dy + height, dx : dx + width]
        support += np.abs(centre - neighbour) <= relative_step * np.minimum(centre, neighbour)
    return use & (support < FEWEST_NEIGHBOURS)


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
    depth_m = np.asarray(depth_m, dtype=np.float64)
    image_01 = np.asarray(image_01)
    if depth_m.ndim != 2 or image_01.shape != (*depth_m.shape, 3):
        bad_value("image_01", "(H, W, 3) over a depth of (H, W)", f"{image_01.shape} over {depth_m.shape}")
    K = check_intrinsics(K)
    use = np.isfinite(depth_m) & (np.where(np.isfinite(depth_m), depth_m, 0) > 0)
    use = use if valid is None else use & np.asarray(valid, dtype=bool)
    v, u = np.nonzero(use)
    points = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T * depth_m[use][:, None]
    return Cloud(points, np.rint(np.clip(image_01[use], 0.0, 1.0) * 255.0).astype(np.uint8))


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
        depth_m: as in ``make_cloud``.
        image_01: as in ``make_cloud``.
        K: as in ``make_cloud``.
        valid: as in ``make_cloud``.
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
    cloud = make_cloud(depth_m, image_01, K, valid)
    vertices = np.empty(len(cloud.points_m), dtype=VERTEX)
    for column, name in enumerate(("x", "y", "z")):
        vertices[name] = cloud.points_m[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        vertices[name] = cloud.colours[:, column]
    with atomic_path(path) as temporary:
        temporary.write_bytes(_ply_head(len(vertices), unit) + vertices.tobytes())
    return len(vertices)


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
