"""What of an estimate is certain."""

from __future__ import annotations

import math

#: So many standard errors of an estimate are not counted.
UNCERTAIN = 4.0


def certain_part(value: float, error: float) -> float:
    """The estimate moved towards 0 by ``UNCERTAIN`` of its standard errors, 0 where these reach further."""
    return math.copysign(max(abs(value) - UNCERTAIN * error, 0.0), value)
