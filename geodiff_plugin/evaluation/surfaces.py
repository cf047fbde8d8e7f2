"""How well a map keeps the qualities of a good prior: sharp depth edges and smooth surfaces.

Data flow: depth in metres + dense truth -> error near truth edges, error of slope away from them.
Paper: none; its tables average over all pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

__all__ = ["DenseTruth"]

#: Step in log depth between neighbours that makes an edge; how near an edge counts, and how far off a surface
#: begins, in pixels.
EDGE_STEP, NEAR_EDGE, OFF_EDGE = 0.08, 3, 5


@dataclass(frozen=True)
class DenseTruth:
    """Truth that is known nearly everywhere.

    Attributes:
        depth_m: ``(H, W)`` metres.
        valid: ``(H, W)`` bool, where it is known.
    """

    depth_m: np.ndarray
    valid: np.ndarray

    @cached_property
    def _log(self) -> np.ndarray:
        return np.log(np.where(self.valid, self.depth_m, 1.0))

    @cached_property
    def _edge(self) -> np.ndarray:
        """Pixels whose 3x3 neighbourhood is known and has a step in it."""
        high = ndimage.maximum_filter(np.where(self.valid, self._log, np.inf), 3)
        low = ndimage.minimum_filter(np.where(self.valid, self._log, -np.inf), 3)
        return np.isfinite(high) & np.isfinite(low) & (high - low > EDGE_STEP)

    def edge_error(self, depth_m: np.ndarray) -> float:
        """Mean relative error within 3 px of the truth's edges; NaN without an edge."""
        near = ndimage.binary_dilation(self._edge, iterations=NEAR_EDGE) & self.valid
        if not near.any():
            return float("nan")
        return float((np.abs(depth_m - self.depth_m)[near] / self.depth_m[near]).mean())

    def surface_error(self, depth_m: np.ndarray) -> float:
        """Mean absolute error of the slope of log depth, per mille a pixel, more than 5 px from any edge."""
        off = self.valid & ~ndimage.binary_dilation(self._edge, iterations=OFF_EDGE)
        difference = np.log(np.maximum(depth_m, 1e-6)) - self._log
        whole = off[1:, 1:] & off[:-1, 1:] & off[1:, :-1]
        if not whole.any():
            return float("nan")
        slopes = [np.abs(np.diff(difference, axis=axis)) for axis in (0, 1)]
        return float(500.0 * (slopes[0][:, 1:] + slopes[1][1:])[whole].mean())
