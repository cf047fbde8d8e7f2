"""Bars of one colour at opposite sides of all pictures, as where they were fitted into another format."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Values of a bar differ by this at most, grey levels: compressed black is not quite even.
EVEN = 4
#: Narrower bars are edges of a sensor or of a rectified picture, as a share of the side.
NARROWEST = 0.02
#: Wider ones leave no picture between them.
WIDEST = 0.45
#: Opposite bars, and those of the other pictures, are as wide, up to this share of the side.
AS_WIDE = 0.005


def _bar(value: int, least: np.ndarray, most: np.ndarray) -> float:
    """Share of the lines, from the first on, that have a value all along.

    ``least`` and ``most (N,)`` are the extremes of every line.
    """
    even = (most.astype(np.int16) - value <= EVEN) & (value - least.astype(np.int16) <= EVEN)
    return float(np.argmin(even)) / len(even) if not even.all() else 1.0


def bar_share(greys: Sequence[np.ndarray]) -> float:
    """Width of the bars at either side of all pictures ``(H, W)`` uint8, as a share of that side; 0 for none.

    Both sides of all pictures have bars that are as wide. The border of a rectified picture is bent, or
    wider at one side.
    """
    for turned in (False, True):
        shares = []
        for grey in greys:
            lines = grey if turned else grey.T
            least, most = lines.min(1), lines.max(1)
            shares.append(_bar(int(lines[0, 0]), least, most))
            shares.append(_bar(int(lines[-1, 0]), least[::-1], most[::-1]))
        if NARROWEST <= min(shares) <= max(shares) <= min(WIDEST, min(shares) + AS_WIDE):
            return max(shares)
    return 0.0
