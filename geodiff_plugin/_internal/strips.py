"""Split large maps into strips, so that temporary arrays fit into memory."""

from __future__ import annotations

from collections.abc import Iterator

#: Number of pixels per strip, 8 MB as float64.
STRIP_PIXELS = 1 << 20


def row_strips(height: int, width: int) -> Iterator[slice]:
    """Yield slices that cover all rows, each with at most ``STRIP_PIXELS`` pixels or one row."""
    rows = max(1, STRIP_PIXELS // max(1, width))
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))
