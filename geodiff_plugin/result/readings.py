"""Reads points and distances with their errors from depth maps, and reprojects maps into another camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin._internal.reprojection import maps_in_camera
from geodiff_plugin.cameras import Camera, PosedCamera
from geodiff_plugin.result.sigma import relative_sigma


@dataclass(frozen=True)
class Reading:
    """The depth map's value at one pixel ``(x, y)``."""

    pixel: tuple[int, int]
    point_m: np.ndarray  # (3,) in the left camera's frame
    spread: float | None  # standard deviation relative to the depth, if known
    confidence: float | None  # in [0, 1]

    @property
    def depth_m(self) -> float:
        """Depth z, metres."""
        return float(self.point_m[2])

    @property
    def spread_m(self) -> float | None:
        """Standard deviation of the depth in metres."""
        return None if self.spread is None else self.spread * self.depth_m


def read_pixel(
    depth_m: np.ndarray,
    K: np.ndarray,
    pixel: tuple[int, int],
    confidence: np.ndarray | None = None,
    sigma_m: np.ndarray | None = None,
) -> Reading:
    """Return the point (Eq. 9) at a pixel ``(x, y)``; ``ValueError`` outside the map or without depth.

    ``depth_m`` and ``sigma_m``, its standard deviation, are ``(H, W)`` metres; ``confidence`` is ``(H, W)``
    in [0, 1]; ``K`` is ``(3, 3)`` in pixels of these maps. Without ``sigma_m``, the standard deviation
    follows from the confidence alone.
    """
    x, y = (int(v) for v in pixel)
    height, width = depth_m.shape
    if not (0 <= x < width and 0 <= y < height):
        bad_value("pixel", f"inside the map of {width}x{height}", (x, y))
    z = float(depth_m[y, x])
    if not (np.isfinite(z) and z > 0):
        bad_value("pixel", "a pixel with a depth", (x, y))
    known, sigma = (None if each is None else float(each[y, x]) for each in (confidence, sigma_m))
    spread = None if sigma is None or not np.isfinite(sigma) else sigma / z
    if sigma_m is None and known is not None:
        spread = float(relative_sigma(np.array(known)))
    return Reading((x, y), z * Camera(K).rays(np.array([x, y])), spread, known)


def distance_m(a: Reading, b: Reading) -> tuple[float, float | None]:
    """Compute the distance between two points and, if known, its standard deviation, metres.

    A depth error moves a point along its ray. The errors of the two points are assumed independent.
    """
    between = b.point_m - a.point_m
    length = float(np.linalg.norm(between))
    if a.spread is None or b.spread is None:
        return length, None
    if length == 0:
        return 0.0, float(np.hypot(a.spread, b.spread) * np.linalg.norm(a.point_m))
    of_a, of_b = between @ a.point_m * a.spread, between @ b.point_m * b.spread
    return length, float(np.hypot(of_a, of_b) / length)


def beyond_limit(depth: np.ndarray, measurable: float | None) -> np.ndarray:
    """Return the mask ``(H, W)`` of depths that are too far to be measured, as in the sky.

    ``measurable`` is the farthest measurable depth, in the unit of ``depth``; ``None`` if unknown.
    """
    return np.isfinite(depth) & (depth > (math.inf if measurable is None else measurable))


def measured(depth: np.ndarray, valid: np.ndarray, measurable: float | None) -> np.ndarray:
    """Return a depth map ``(H, W)`` with 0 where it is not ``valid (H, W)`` or too far to be measured."""
    return np.where(valid & ~beyond_limit(depth, measurable), depth, 0.0)


def metres(value: float, spread: float | None = None, unit: str | None = "m") -> str:
    """Format a length as ``2.31 m`` or ``2.31 ± 0.07 m``, with 3 decimals for spreads below 5 mm.

    Lengths without a unit are in "units of the poses".
    """
    decimals = 3 if spread is not None and spread < 0.005 else 2
    shown = f"{value:.{decimals}f}{'' if spread is None else f' ± {spread:.{decimals}f}'}"
    return f"{shown} {unit or 'units of the poses'}"


class Reprojected(NamedTuple):
    """Maps of another camera, ``(N, height, width, 1)`` numpy or ``(N, 1, height, width)`` torch, float32."""

    depth: np.ndarray | torch.Tensor  # along z of that camera; 0 where it sees none
    sigma: np.ndarray | torch.Tensor | None  # standard deviation of the depth; NaN where unknown


def reproject(
    depth: np.ndarray | torch.Tensor,
    sigma: np.ndarray | torch.Tensor | None,
    K: np.ndarray | torch.Tensor,
    camera: PosedCamera,
) -> Reprojected:
    """Reproject depth maps and their standard deviations into another camera, in the same unit.

    Args:
        depth: ``(N, H, W, 1)`` numpy or ``(N, 1, H, W)`` torch, 0 where there is no depth.
        sigma: standard deviation of ``depth``, shaped like it; NaN where unknown, ``None`` if there is none.
        K: ``(N, 3, 3)`` intrinsics of the maps, pixels.
        camera: the other camera, with ``size (width, height)``.
    """

    def on_host(maps: np.ndarray | torch.Tensor) -> np.ndarray:
        return maps[..., 0] if isinstance(maps, np.ndarray) else maps[:, 0].numpy(force=True)

    def stacked(maps: Sequence[np.ndarray]) -> np.ndarray | torch.Tensor:
        every = np.stack(maps)
        if isinstance(depth, np.ndarray):
            return every[..., None]
        return torch.from_numpy(every[:, None]).to(depth.device)

    Ks = K if isinstance(K, np.ndarray) else K.numpy(force=True)
    sigmas = [None] * len(depth) if sigma is None else on_host(sigma)
    images = zip(on_host(depth), sigmas, map(Camera, Ks.astype(np.float64)), strict=True)
    seen = [maps_in_camera(*image, camera) for image in images]
    known = [each for _, each in seen if each is not None]
    return Reprojected(stacked([each for each, _ in seen]), stacked(known) if known else None)
