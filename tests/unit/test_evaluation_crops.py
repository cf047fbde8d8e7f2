"""Crops against index ranges worked out by hand from their definitions."""

import numpy as np
import pytest

from geodiff_plugin.evaluation.metrics import CROPS, crop_mask

#: (H, W) -> crop -> first and last row, first and last column.
RANGES = {
    (375, 1242): {
        "none": (0, 374, 0, 1241),
        "garg": (153, 370, 44, 1196),
        "eigen": (124, 341, 44, 1196),
        "benchmark": (23, 374, 13, 1228),
    },
    (352, 1216): {
        "none": (0, 351, 0, 1215),
        "garg": (143, 348, 43, 1171),
        "eigen": (117, 320, 43, 1171),
        "benchmark": (0, 351, 0, 1215),
    },
    (370, 1225): {
        "none": (0, 369, 0, 1224),
        "garg": (151, 365, 44, 1179),
        "eigen": (122, 336, 44, 1179),
        "benchmark": (18, 369, 4, 1219),  # an odd margin: the smaller half is on the left
    },
}


@pytest.mark.parametrize("size", RANGES)
@pytest.mark.parametrize("name", CROPS)
def test_crop_keeps_the_rows_and_columns_of_its_definition(size, name):
    mask = crop_mask(name, size)
    first_row, last_row, first_column, last_column = RANGES[size][name]
    rows, columns = np.arange(size[0])[:, None], np.arange(size[1])[None]
    expected = (rows >= first_row) & (rows <= last_row) & (columns >= first_column) & (columns <= last_column)
    np.testing.assert_array_equal(mask, expected)


def test_bad_crops_are_named():
    with pytest.raises(ValueError, match="crop must be one of"):
        crop_mask("middle", (375, 1242))
    with pytest.raises(
        ValueError, match=r"crop must be 'benchmark' for images of at least 1216 x 352; got 640 x 480"
    ):
        crop_mask("benchmark", (480, 640))
