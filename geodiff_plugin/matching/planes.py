"""Chooses the planes of a sweep from how far pixels shift in a right view as their depth changes.

Cameras are few numbers, so this module uses NumPy on the CPU in float64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.cameras import Camera, PosedViews, View, rays_of_pixels
from geodiff_plugin.geometry import NEAREST_M

#: Minimum number of pixels that represent the grid, enough for medians.
SAMPLES = 1024
#: Minimum shift that can be measured, pixels.
MIN_SHIFT_PX = 0.3
#: Decimal exponent of an inverse depth in 1/m at which nothing shifts.
NEVER_SHIFTED = -8
#: Decimal exponent of an inverse depth in 1/m at which all shifts are maximal.
FULLY_SHIFTED = 5
#: Number of steps between the two exponents, of 0.05 % each, to which inverse depths are rounded up. Rounding
#: errors of cameras then do not change the planes.
STEPS = 1 << 16


class Parallax:
    """Shift of left pixels in one right view, relative to their position at infinity."""

    def __init__(self, left: Camera, right: View, name: str) -> None:
        """Create the shifts for the left grid of a camera's size; errors mention ``name``."""
        assert left.size is not None
        matrices = left.K, right.camera.K, right.T_right_from_left
        K, K_r, T = (each.astype(np.float64) for each in matrices)
        width, height = left.size
        row, column = np.divmod(np.arange(0, width * height, max(1, width * height // SAMPLES)), width)
        x, y = rays_of_pixels(K, column, row)
        infinity = K_r @ T[:3, :3] @ np.stack([x, y, np.ones_like(x)])
        infinity = infinity[:, infinity[2] > NEAREST_M]
        centre = K_r @ T[:3, 3:]  # projection of the left camera, towards which pixels move
        # On a plane of inverse depth w the shift is w * way / (far + w * ahead).
        self._far = infinity[2]
        self._ahead = float(centre[2, 0])
        self._distance = np.hypot(*(centre[:2] - infinity[:2] / infinity[2] * self._ahead))
        self._name = name

    def median_shift(self, inverse_depth: float) -> float:
        """Return the median shift in pixels from infinity to a plane, 1/m.

        A rotation shifts all depths alike and does not count. Infinite if the plane is behind the right
        camera. ``InputError`` if no pixel's point at infinity is in front of that camera.
        """
        if not self._far.size:
            expected, got = "a pose under which the views overlap", "a right camera facing the opposite way"
            hint = "Check radians or degrees, the order of a quaternion (scipy: x, y, z, w) and the axes."
            bad_value(self._name, expected, got, hint)
        z = self._far + inverse_depth * self._ahead
        in_front = z > NEAREST_M
        shift = np.where(in_front, inverse_depth * self._distance / np.where(in_front, z, 1.0), np.inf)
        middle = (len(shift) - 1) // 2
        return float(np.partition(shift, middle)[middle])

    def inverse_depth_at(self, shift_px: float) -> float:
        """Return the inverse depth, 1/m within 0.05 %, at which ``median_shift`` equals ``shift_px`` > 0.

        If one camera is behind the other, pixels can only move to the epipole, so ``shift_px`` is limited to
        half of that distance. ``InputError`` if both cameras are at the same position.
        """
        most = self.median_shift(10.0**FULLY_SHIFTED)
        if most < MIN_SHIFT_PX:
            bad_value(self._name, "a pose with a baseline", "both cameras at the same position")
        shift_px = min(shift_px, 0.5 * most)
        slope = self._distance - shift_px * self._ahead
        reached = np.full_like(slope, np.inf)  # for every pixel; never reached with slope <= 0
        np.divide(shift_px * self._far, slope, out=reached, where=slope > 0)
        if self._ahead < 0:  # or the plane is behind the right camera before
            reached = np.minimum(reached, (self._far - NEAREST_M) / -self._ahead)
        middle = len(reached) // 2  # the same median as in ``median_shift``
        exponent = math.log10(float(np.partition(reached, middle)[middle]))
        span = FULLY_SHIFTED - NEVER_SHIFTED
        step = max(1, math.ceil((exponent - NEVER_SHIFTED) / span * STEPS))
        return 10.0 ** (NEVER_SHIFTED + span * step / STEPS)


def parallax_of(posed: PosedViews) -> tuple[Parallax, ...]:
    """Compute the ``Parallax`` of every right view on the left image's grid."""
    count = len(posed.rights)
    names = ["E"] if count == 1 else [f"E of right view {v}" for v in range(1, count + 1)]
    named = zip(posed.rights, names, strict=True)
    return tuple(Parallax(posed.left.camera, view, name) for view, name in named)


def even_planes(
    views: Sequence[Parallax], span: tuple[float, float], step_px: float, least: int, most: int
) -> Tensor:
    """Return inverse depths ``(D,)`` float32 over ``span``, one per ``step_px`` of median shift.

    Their number is between ``least`` and ``most``.
    """
    first, last = span
    total_shift = max(view.median_shift(last) - view.median_shift(first) for view in views)
    wanted = (
        round(total_shift / step_px) + 1 if np.isfinite(total_shift) else most
    )  # not finite behind a camera
    steps = torch.linspace(0.0, 1.0, min(max(wanted, least), most), dtype=torch.float32, device="cpu")
    return first + (last - first) * steps
