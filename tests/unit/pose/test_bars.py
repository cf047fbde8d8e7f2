"""Bars of one level at opposite sides of images of different sizes."""

import numpy as np
import pytest

from geodiff_plugin.pose.bars import bar_share


def image(size, bars, axis, levels=(0, 0), seed=0):
    """Noise with bars of so many lines before and after it, each of a level."""
    grey = np.random.default_rng(seed).integers(60, 200, size).astype(np.uint8)
    lines = np.moveaxis(grey, axis, 0)
    lines[: bars[0]], lines[len(lines) - bars[1] :] = levels
    return grey


@pytest.mark.parametrize("axis", [0, 1])
def test_bars_of_images_of_several_sizes_and_levels_have_one_relative_width(axis):
    sizes = ((200, 400), (300, 200))
    widths = [round(0.1 * size[axis]) for size in sizes]
    levels = ((0, 250), (128, 255))  # each bar has a level of its own
    images = [image(size, (w, w), axis, of) for size, w, of in zip(sizes, widths, levels, strict=True)]
    assert bar_share(images) == pytest.approx(0.1)
    images[1] = image(sizes[1], (widths[1], widths[1]), 1 - axis, levels[1])
    assert bar_share(images) == 0.0


@pytest.mark.parametrize("off", [4, -4, 5, -5])
@pytest.mark.parametrize("side", [0, -1])
def test_a_bar_is_even_within_four_levels_of_its_corner(off, side):
    grey = image((200, 100), (20, 20), 0, (128, 128))
    grey[side, 37] = 128 + off
    assert bar_share([grey, grey]) == (0.1 if abs(off) == 4 else 0.0)
    dark = image((200, 100), (20, 20), 0, (250, 3))
    dark[3, 7], dark[-4, 5] = 254, 0
    assert bar_share([dark]) == 0.1


@pytest.mark.parametrize(
    ("bars", "share"), [((20, 21), 0.105), ((21, 20), 0.105), ((20, 22), 0.0), ((4, 4), 0.02), ((3, 4), 0.0)]
)
def test_bars_may_differ_by_half_a_per_cent_of_the_side(bars, share):
    assert bar_share([image((200, 100), bars, 0), image((200, 100), bars, 0, seed=1)]) == share
