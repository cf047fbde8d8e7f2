"""Strips of rows cover every row once, and none is larger than it may be."""

import pytest

from geodiff_plugin import _strips
from geodiff_plugin._strips import row_strips


@pytest.mark.parametrize(
    ("height", "width", "pixels", "rows"),
    [
        (10, 7, 21, 3),
        (9, 7, 21, 3),
        (10, 7, 20, 2),
        (4, 50, 21, 1),
        (5, 1, 100, 5),
        (0, 7, 21, 3),
        (3, 0, 2, 2),
    ],
)
def test_strips_cover_all_rows_in_order_with_as_many_pixels_as_they_may_have(
    monkeypatch, height, width, pixels, rows
):
    monkeypatch.setattr(_strips, "STRIP_PIXELS", pixels)
    strips = list(row_strips(height, width))
    assert [row for strip in strips for row in range(height)[strip]] == list(range(height))
    assert all(strip.stop - strip.start == rows for strip in strips[:-1])
    assert all(0 < strip.stop - strip.start <= rows and strip.stop <= height for strip in strips)


def test_a_strip_of_doubles_has_8_megabytes():
    first = next(iter(row_strips(10**6, 1024)))
    assert (first.stop - first.start) * 1024 * 8 == 8 * 1024**2
