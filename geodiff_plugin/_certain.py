"""Robust statistics: which part of an estimate is certain, and the spread that a median stands for."""

from __future__ import annotations

import math

#: So many standard errors of an estimate are not counted.
UNCERTAIN = 4.0
#: Standard deviation of normally distributed values per median absolute deviation.
SD_PER_MAD = 1.4826
#: A scale whose relative standard deviation is larger is not trusted, whether it comes from a refined pose,
#: from a solved capture or from a known length.
MAX_SCALE_SPREAD = 0.1


def certain_part(value: float, error: float) -> float:
    """The estimate moved towards 0 by ``UNCERTAIN`` of its standard errors, 0 where these reach further."""
    return math.copysign(max(abs(value) - UNCERTAIN * error, 0.0), value)
