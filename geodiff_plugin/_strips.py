"""Large maps worked on strip by strip, so that what is made on the way fits the memory."""

from __future__ import annotations

from collections.abc import Iterator

#: Pixels of a strip: a map of float64 of so many is 8 MB.
STRIP_PIXELS = 1 << 20


def row_strips(height: int, width: int) -> Iterator[slice]:
    """Slices of at most ``STRIP_PIXELS`` pixels, or one row, that cover all rows: arrays stay small."""
    rows = max(1, STRIP_PIXELS // max(1, width))
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))
