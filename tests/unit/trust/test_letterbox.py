"""Bars of one level at opposite sides of images of different sizes."""

import numpy as np
import pytest

from geodiff_plugin.trust import ImagesStage
from geodiff_plugin.trust.letterbox import Letterbox, LetterboxWidth, letterbox_fraction
from tests.unit.trust.sheets import good, judged


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
    assert letterbox_fraction(images) == pytest.approx(0.1)
    images[1] = image(sizes[1], (widths[1], widths[1]), 1 - axis, levels[1])
    assert letterbox_fraction(images) == 0.0


@pytest.mark.parametrize("off", [4, -4, 5, -5])
@pytest.mark.parametrize("side", [0, -1])
def test_a_bar_is_even_within_four_levels_of_its_corner(off, side):
    grey = image((200, 100), (20, 20), 0, (128, 128))
    grey[side, 37] = 128 + off
    assert letterbox_fraction([grey, grey]) == (0.1 if abs(off) == 4 else 0.0)
    dark = image((200, 100), (20, 20), 0, (250, 3))
    dark[3, 7], dark[-4, 5] = 254, 0
    assert letterbox_fraction([dark]) == 0.1


@pytest.mark.parametrize(
    ("bars", "fraction"),
    [
        ((20, 21), 0.105),
        ((21, 20), 0.105),
        ((20, 22), 0.0),  # as at the border of a rectified image
        ((20, 0), 0.0),  # padding
        ((4, 4), 0.02),
        ((3, 4), 0.0),
        ((90, 90), 0.45),
        ((91, 91), 0.0),
        ((0, 0), 0.0),
    ],
)
@pytest.mark.parametrize("axis", [0, 1])
def test_bars_are_as_wide_at_both_sides_up_to_half_a_per_cent(axis, bars, fraction):
    images = [image((200, 200), bars, axis, seed=seed) for seed in (0, 1)]
    assert letterbox_fraction(images) == fraction


def test_all_images_have_letterbox_bars_of_one_width():
    barred, wider = (image((100, 200), (width, width), 1) for width in (20, 30))
    assert letterbox_fraction([barred, image((100, 200), (20, 20), 1, seed=1)]) == 0.1
    for other in (wider, image((100, 200), (0, 0), 1)):
        assert letterbox_fraction([barred, other]) == letterbox_fraction([other, barred]) == 0.0


def test_a_curved_border_and_a_blank_image_are_not_letterboxed():
    bent = image((100, 200), (20, 20), 1)
    bent[:50, 14:20] = 90
    assert letterbox_fraction([bent, bent]) == 0.0
    assert letterbox_fraction([np.zeros((100, 200), np.uint8)] * 2) == 0.0


def test_the_finding_states_the_width_of_the_bars():
    assert "each black bar covers 7 % of the image" in judged(good(LetterboxWidth(0.0678)), "views.letterbox")
    greys = [image((200, 100), (20, 20), 0), image((200, 100), (20, 20), 0)]
    assert Letterbox.of_images(ImagesStage(greys, [200, 200])) == LetterboxWidth(0.1)
    assert Letterbox.of_images(ImagesStage([greys[0], image((200, 100), (0, 0), 0)], [200, 200])) is None


def test_bars_that_are_not_valid_are_found_by_their_mask():
    """Their content was replaced; a round image in a frame has no bars."""
    rows, columns = np.mgrid[:200, :100]
    images = [image((200, 100), (0, 0), 0, seed=seed) for seed in (0, 1)]
    bars, circle = abs(rows - 99.5) < 80, (rows - 100) ** 2 + (columns - 50) ** 2 < 40**2
    assert Letterbox.of_images(ImagesStage(images, [200, 200], [bars, bars])) == LetterboxWidth(0.1)
    assert Letterbox.of_images(ImagesStage(images, [200, 200], [bars, None])) is None
    assert Letterbox.of_images(ImagesStage(images, [200, 200], [circle, circle])) is None
