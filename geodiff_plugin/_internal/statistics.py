"""Compute the statistically significant part of an estimate, and define constants of robust statistics."""

from __future__ import annotations

import math

#: Number of standard errors that are subtracted from an estimate.
UNCERTAIN = 4.0
#: Standard deviation of normally distributed values per median absolute deviation.
SD_PER_MAD = 1.4826
#: Maximum number of values sorted for a quantile. ``torch.quantile`` accepts up to 16 million.
MAX_SORTED = 1 << 22
#: Maximum relative standard deviation of a trusted scale from a refined pose, a solved capture or a known
#: length.
MAX_SCALE_SPREAD = 0.1


def certain_part(value: float, error: float) -> float:
    """Shrink an estimate towards 0 by ``UNCERTAIN`` standard errors, at most to 0."""
    return math.copysign(max(abs(value) - UNCERTAIN * error, 0.0), value)
