"""Bars at opposite sides of both pictures, and what only looks like them."""

import numpy as np
import pytest

from geodiff_plugin.pose.bars import EVEN, bar_share

HEIGHT, WIDTH = 120, 200


def picture(seed: int, columns: tuple[int, int] = (0, 0), rows: tuple[int, int] = (0, 0), value: int = 0):
    """Noise with bars of so many columns at the left and the right, and rows at the top and the bottom."""
    grey = np.random.default_rng(seed).integers(60, 200, (HEIGHT, WIDTH)).astype(np.uint8)
    grey[:, : columns[0]], grey[: rows[0]] = value, value
    grey[:, WIDTH - columns[1] :], grey[HEIGHT - rows[1] :] = value, value
    return grey


@pytest.mark.parametrize("value", [0, 128])
@pytest.mark.parametrize(
    ("bars", "share"),
    [
        ({"columns": (20, 20)}, 0.1),
        ({"rows": (12, 12)}, 0.1),
        ({"columns": (20, 21)}, 0.105),
        ({"columns": (20, 24)}, 0.0),  # a rectified picture ends where it ends
        ({"columns": (20, 0)}, 0.0),  # padded
        ({"columns": (3, 3)}, 0.0),
        ({"columns": (4, 4)}, 0.02),
        ({"columns": (90, 90)}, 0.45),
        ({"columns": (95, 95)}, 0.0),
        ({}, 0.0),
    ],
)
def test_bars_are_as_wide_at_both_sides(bars, share, value):
    assert bar_share([picture(0, **bars, value=value), picture(1, **bars, value=value)]) == share


def test_both_pictures_have_them_evenly():
    bars = {"columns": (20, 20)}
    noisy = picture(1, **bars)
    assert bar_share([picture(0, **bars), picture(1)]) == 0.0
    assert bar_share([picture(0, **bars), picture(1, columns=(30, 30))]) == 0.0
    noisy[5, 3] = EVEN
    assert bar_share([picture(0, **bars), noisy]) == 0.1
    noisy[5, 3] = EVEN + 1
    assert bar_share([picture(0, **bars), noisy]) == 0.0
    bent = picture(0, **bars)
    bent[: HEIGHT // 2, 14:20] = 90
    assert bar_share([bent, bent]) == 0.0
    assert bar_share([np.zeros((HEIGHT, WIDTH), np.uint8)] * 2) == 0.0
