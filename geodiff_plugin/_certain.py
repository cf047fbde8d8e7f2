"""Robust statistics: which part of an estimate is certain, and the spread that a median stands for."""

from __future__ import annotations

import math

#: So many standard errors of an estimate are not counted.
UNCERTAIN = 4.0
#: Standard deviation of normally distributed values per median absolute deviation.
SD_PER_MAD = 1.4826


def certain_part(value: float, error: float) -> float:
    """The estimate moved towards 0 by ``UNCERTAIN`` of its standard errors, 0 where these reach further."""
    return math.copysign(max(abs(value) - UNCERTAIN * error, 0.0), value)
