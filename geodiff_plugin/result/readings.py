"""What a depth map says at a pixel, and between two: points, distances, and how far they may be off."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from geodiff_plugin._certain import SD_PER_MAD
from geodiff_plugin._checks import bad_value

#: ``confidence`` is the probability that a depth is within this share of the truth.
CONFIDENT_WITHIN = 0.1
#: A lower confidence says no more about the spread than this one does.
LEAST_CONFIDENCE = 0.05
#: Nor does a higher one than this.
MOST_CONFIDENCE = 0.999


@dataclass(frozen=True)
class Reading:
    """What the depth map says at one pixel ``(x, y)``."""

    pixel: tuple[int, int]
    point_m: np.ndarray  # (3,) in the left camera's frame
    spread: float | None  # standard deviation of the depth as a share of it, if anything tells
    confidence: float | None  # in [0, 1]

    @property
    def depth_m(self) -> float:
        """z, metres."""
        return float(self.point_m[2])

    @property
    def spread_m(self) -> float | None:
        """Standard deviation of the depth in metres."""
        return None if self.spread is None else self.spread * self.depth_m


def _spread(confidence: float | None, uncertainty_m: float | None, depth_m: float) -> float | None:
    """The larger of what the confidence and the spread of the members say, as a share of the depth."""
    spreads = []
    if confidence is not None:
        bounded = min(max(confidence, LEAST_CONFIDENCE), MOST_CONFIDENCE)
        # A normal error that is within 10 % with this probability has this standard deviation.
        spreads.append(CONFIDENT_WITHIN / NormalDist().inv_cdf((1 + bounded) / 2))
    if uncertainty_m is not None:
        spreads.append(SD_PER_MAD * uncertainty_m / depth_m)
    return max(spreads, default=None)


def read_pixel(
    depth_m: np.ndarray,
    K: np.ndarray,
    pixel: tuple[int, int],
    confidence: np.ndarray | None = None,
    uncertainty_m: np.ndarray | None = None,
) -> Reading:
    """The point (Eq. 9) that a pixel ``(x, y)`` shows; ``ValueError`` outside the map, and without depth.

    ``depth_m`` and ``uncertainty_m``, the median absolute deviation of the members, are ``(H, W)`` metres,
    ``confidence`` is ``(H, W)`` in [0, 1], ``K`` ``(3, 3)`` in pixels of these maps.
    """
    x, y = (int(v) for v in pixel)
    height, width = depth_m.shape
    if not (0 <= x < width and 0 <= y < height):
        bad_value("pixel", f"inside the map of {width}x{height}", (x, y))
    z = float(depth_m[y, x])
    if not (np.isfinite(z) and z > 0):
        bad_value("pixel", "one with a depth", (x, y))
    sure, off_m = (None if map is None else float(map[y, x]) for map in (confidence, uncertainty_m))
    return Reading((x, y), z * (np.linalg.inv(K) @ (x, y, 1.0)), _spread(sure, off_m, z), sure)


def distance_m(a: Reading, b: Reading) -> tuple[float, float | None]:
    """How far two points are from each other, and the standard deviation of that if known, in metres.

    An error of depth moves a point along its own ray; the errors of the two points are taken as independent.
    """
    between = b.point_m - a.point_m
    length = float(np.linalg.norm(between))
    if a.spread is None or b.spread is None:
        return length, None
    if length == 0:
        return 0.0, float(np.hypot(a.spread, b.spread) * np.linalg.norm(a.point_m))
    of_a, of_b = between @ a.point_m * a.spread, between @ b.point_m * b.spread
    return length, float(np.hypot(of_a, of_b) / length)


def metres(value: float, spread: float | None = None, unit: str | None = "m") -> str:
    """``2.31 m`` or ``2.31 ± 0.07 m``; to the millimetre where the spread is below half a centimetre.

    Lengths without a unit are "units of the poses".
    """
    decimals = 3 if spread is not None and spread < 0.005 else 2
    shown = f"{value:.{decimals}f}{'' if spread is None else f' ± {spread:.{decimals}f}'}"
    return f"{shown} {unit or 'units of the poses'}"
