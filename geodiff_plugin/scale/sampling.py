"""Limits the number of pixels, matches and points used by the scale search and fit."""

from __future__ import annotations

from torch import Tensor

from geodiff_plugin.matching import CostVolume

#: Maximum number of points in the search by points, which bounds its time.
BASIN_SAMPLES = 1500
#: Maximum number of matches in the fit, which bounds its time.
FIT_SAMPLES = 8000
#: Maximum number of groups of similar value that represent the pixels in the volume search.
GROUPS = 512
#: Minimum fraction of pixels that must stay in view, for a rectified pair.
IN_VIEW_RECTIFIED = 0.6
#: Minimum fraction of pixels that must stay in view, for a posed pair; some pairs share only .3 of the pixels
#: at the true depth.
IN_VIEW_POSED = 0.25


def basin_stride(at: Tensor) -> int:
    """Return the stride of the points ``at (P,)`` that take part in the search for a basin."""
    return max(1, -(-len(at) // BASIN_SAMPLES))


def sampling_stride(at: Tensor) -> int:
    """Return the stride of the matches ``at (P,)`` that are fitted to."""
    return max(1, len(at) // FIT_SAMPLES)


def group_size(pixels: int) -> int:
    """Return the number of pixels per group."""
    return -(-pixels // GROUPS)


def min_in_view(volume: CostVolume) -> float:
    """Return the minimum fraction of pixels that must stay in view."""
    return IN_VIEW_RECTIFIED if volume.rectified else IN_VIEW_POSED
