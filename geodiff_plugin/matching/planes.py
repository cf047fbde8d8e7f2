"""Which planes a sweep needs: how far pixels move in a right view as their depth changes.

Cameras are few numbers, so all of this is NumPy on the CPU in float64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.geometry import NEAREST_M
from geodiff_plugin.types import PosedViews

#: Pixels of the grid that stand for all of it, at least: enough for medians.
SAMPLES = 1024
#: A smaller shift cannot be measured, pixels.
LEAST_SHIFT_PX = 0.3
#: Decimal exponent of an inverse depth in 1/m at which nothing shifts.
NEVER_SHIFTED = -8
#: Decimal exponent of one at which all shifts are largest.
FULLY_SHIFTED = 5
#: Inverse depths are rounded up to one of so many steps of the exponent between the two, of 0.05 %: rounding
#: errors of cameras then move no plane.
STEPS = 1 << 16


def _matrix(matrix: Tensor) -> np.ndarray:
    return matrix.numpy(force=True).astype(np.float64)


class Parallax:
    """How far left pixels lie, in one right view, from where they would be at infinity."""

    def __init__(
        self, K_left: Tensor, K_right: Tensor, T_right_from_left: Tensor, size: tuple[int, int], name: str
    ) -> None:
        """Of the left grid ``size (H, W)``; ``K (3, 3)``, ``T (4, 4)`` on any device; errors say ``name``."""
        K, K_r, T = (_matrix(each) for each in (K_left, K_right, T_right_from_left))
        pixels = size[0] * size[1]
        row, column = np.divmod(np.arange(0, pixels, max(1, pixels // SAMPLES)), size[1])
        y = (row - K[1, 2]) / K[1, 1]
        x = (column - K[0, 2]) / K[0, 0] - K[0, 1] / K[0, 0] * y
        infinity = K_r @ T[:3, :3] @ np.stack([x, y, np.ones_like(x)])
        infinity = infinity[:, infinity[2] > NEAREST_M]
        centre = K_r @ T[:3, 3:]  # of the left camera: a pixel goes from the one to the other
        # On a plane of inverse depth w it has moved by w * way / (far + w * ahead).
        self._far, self._ahead = infinity[2], float(centre[2, 0])
        self._way = np.hypot(*(centre[:2] - infinity[:2] / infinity[2] * self._ahead))
        self._name = name

    def median_shift(self, inverse_depth: float) -> float:
        """Pixels by which the median pixel moves from infinity to a plane, 1/m.

        A rotation, which moves all depths alike, does not count. Infinite where the plane passes behind the
        right camera. ``InputError`` where no pixel's point at infinity is in front of that camera.
        """
        if not self._far.size:
            expected, got = "a pose under which the views overlap", "a right camera that looks the other way"
            cure = "Check radians and degrees, the order of a quaternion (scipy: x, y, z, w) and the axes."
            bad_value(self._name, expected, got, cure)
        z = self._far + inverse_depth * self._ahead
        in_front = z > NEAREST_M
        shift = np.where(in_front, inverse_depth * self._way / np.where(in_front, z, 1.0), np.inf)
        middle = (len(shift) - 1) // 2
        return float(np.partition(shift, middle)[middle])

    def inverse_depth_at(self, shift_px: float) -> float:
        """The inverse depth, 1/m within 0.05 %, at which ``median_shift`` reaches ``shift_px`` > 0.

        If one camera stands behind the other, pixels move to the epipole at most, so ``shift_px`` is bounded
        by half of that way. ``InputError`` where both cameras stand at one place.
        """
        most = self.median_shift(10.0**FULLY_SHIFTED)
        if most < LEAST_SHIFT_PX:
            bad_value(self._name, "a pose with a baseline", "both cameras at one place")
        shift_px = min(shift_px, 0.5 * most)
        slope = self._way - shift_px * self._ahead
        reached = np.full_like(slope, np.inf)  # by every pixel; with slope <= 0 never
        np.divide(shift_px * self._far, slope, out=reached, where=slope > 0)
        if self._ahead < 0:  # or it passes behind the right camera before
            reached = np.minimum(reached, (self._far - NEAREST_M) / -self._ahead)
        middle = len(reached) // 2  # half of them have moved as far, the median as ``median_shift`` has it
        exponent = math.log10(float(np.partition(reached, middle)[middle]))
        span = FULLY_SHIFTED - NEVER_SHIFTED
        step = max(1, math.ceil((exponent - NEVER_SHIFTED) / span * STEPS))
        return 10.0 ** (NEVER_SHIFTED + span * step / STEPS)


def parallax_of(posed: PosedViews) -> tuple[Parallax, ...]:
    """The ``Parallax`` of every right view on the left image's grid."""
    count = len(posed.views)
    names = ["E"] if count == 1 else [f"E of right view {v}" for v in range(1, count + 1)]
    return tuple(
        Parallax(posed.K_left, K, T, posed.size, name)
        for (_, K, T), name in zip(posed.views, names, strict=True)
    )


def even_planes(
    views: Sequence[Parallax], span: tuple[float, float], step_px: float, least: int, most: int
) -> Tensor:
    """Inverse depths ``(D,)`` float32 over ``span``; from one to the next the median pixel moves by a step.

    There are ``least`` to ``most`` of them.
    """
    first, last = span
    moved = max(view.median_shift(last) - view.median_shift(first) for view in views)
    wanted = round(moved / step_px) + 1 if np.isfinite(moved) else most  # not finite behind a camera
    steps = torch.linspace(0.0, 1.0, min(max(wanted, least), most), dtype=torch.float32, device="cpu")
    return first + (last - first) * steps
