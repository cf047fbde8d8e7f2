"""Iterates over large maps in strips of rows, so that temporary arrays stay small.

Data flow: height and width -> slices of rows.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Iterator

__all__ = ["STRIP_PIXELS", "row_strips"]

#: Pixels of a strip: a map of float64 of so many is 8 MB.
STRIP_PIXELS = 1 << 20


def row_strips(height: int, width: int) -> Iterator[slice]:
    """Slices that cover all rows in order, each of at most ``STRIP_PIXELS`` pixels or of one row."""
    rows = max(1, STRIP_PIXELS // max(1, width))
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))
