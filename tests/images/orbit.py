"""A depth map as a surface, drawn from a camera that moves around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

#: Points a pixel of the depth map, along each side: fewer leave gaps where the camera looks along a surface.
FINER = 2
#: Pixels around a point that it covers.
SPLAT = ((0, 0), (0, 1), (1, 0), (1, 1))
BACKGROUND = (24, 26, 33)
#: A gap of one pixel is closed where so many of its eight neighbours are covered.
CLOSED_FROM = 5


@dataclass(frozen=True)
class Surface:
    """Points ``(N, 3)``, metres in the camera's frame, with colours ``(N, 3)`` uint8."""

    points_m: np.ndarray
    colours: np.ndarray

    @property
    def pivot_m(self) -> np.ndarray:
        """``(3,)``: what a camera turns around, the median point, which no far wall pulls away."""
        return np.median(self.points_m, axis=0)


def surface_of(depth_m: np.ndarray, image: np.ndarray, K: np.ndarray, solid: np.ndarray) -> Surface:
    """Points of the ``solid`` pixels of a map ``(H, W)`` in the colours of ``image``, ``FINER`` a side."""
    height, width = depth_m.shape
    y, x = np.mgrid[0 : height - 1 : 1 / FINER, 0 : width - 1 : 1 / FINER]
    i, j = y.astype(int), x.astype(int)
    inside = solid[i, j] & solid[i + 1, j] & solid[i, j + 1] & solid[i + 1, j + 1]
    y, x, i, j = (values[inside] for values in (y, x, i, j))
    v, u = y - i, x - j
    inverse, colours = 1.0 / depth_m, image.astype(np.float64)
    corners = (
        (i, j, (1 - v) * (1 - u)),
        (i, j + 1, (1 - v) * u),
        (i + 1, j, v * (1 - u)),
        (i + 1, j + 1, v * u),
    )
    z = 1.0 / sum(weight * inverse[a, b] for a, b, weight in corners)
    colour = sum(weight[:, None] * colours[a, b] for a, b, weight in corners)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K).T
    return Surface(rays * z[:, None], np.clip(colour, 0, 255).astype(np.uint8))


def look_from(
    surface: Surface, K: np.ndarray, size: tuple[int, int], yaw: float, pitch: float, back: float
) -> np.ndarray:
    """``(H, W, 3)`` uint8: the surface as a camera sees it that has turned around the pivot.

    ``yaw`` and ``pitch`` are degrees; ``back`` is how far it has stepped back, a fraction of the distance to
    the pivot. ``size`` is (H, W) and ``K`` its camera matrix.
    """
    height, width = size
    pivot = surface.pivot_m
    turn = Rotation.from_euler("yx", (yaw, pitch), degrees=True).as_matrix()
    points = (surface.points_m - pivot) @ turn.T + pivot + (0, 0, back * pivot[2])
    ahead = points[:, 2] > 0.05
    points, colours = points[ahead], surface.colours[ahead]
    order = np.argsort(-points[:, 2])  # far first, so that near ones are written last
    points, colours = points[order], colours[order]
    projected = points @ K.T
    column, row = (np.rint(projected[:, k] / projected[:, 2]).astype(int) for k in (0, 1))
    rgb = np.full((height, width, 3), BACKGROUND, np.uint8)
    covered = np.zeros((height, width), bool)
    rows = np.stack([row + dy for dy, _ in SPLAT], axis=1).ravel()
    columns = np.stack([column + dx for _, dx in SPLAT], axis=1).ravel()
    seen = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    rgb[rows[seen], columns[seen]] = np.repeat(colours, len(SPLAT), axis=0)[seen]
    covered[rows[seen], columns[seen]] = True
    return _closed(rgb, covered)


def _closed(rgb: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """The image with gaps of one pixel in the mean colour of what surrounds them."""
    ones = np.ones((3, 3))
    around = ndimage.convolve(covered.astype(float), ones, mode="constant")
    sums = [
        ndimage.convolve(np.where(covered, channel, 0.0), ones, mode="constant")
        for channel in np.moveaxis(rgb, -1, 0)
    ]
    gap = ~covered & (around >= CLOSED_FROM)
    rgb[gap] = (np.stack(sums, axis=-1) / np.maximum(around, 1)[..., None])[gap]
    return rgb
