"""Pictures: colours, legend, contact sheet."""

import matplotlib
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.plotting import colour_depth, depth_figure, depth_range, grid, ticks


def test_near_is_yellow_far_is_blue_unknown_is_grey():
    depth = np.array([[1.0, 2.0, 4.0, np.inf], [np.nan, 0.0, -1.0, -np.inf]])
    picture = colour_depth(depth, near=1, far=4)
    assert picture.dtype == np.uint8 and picture.shape == (2, 4, 3)
    expected = matplotlib.colormaps["plasma"]([1.0, 0.5, 0.0])[:, :3] * 255
    np.testing.assert_allclose(picture[0, :3], expected, atol=1)
    assert (np.concatenate([picture[0, 3:], picture[1]]) == 128).all()
    lightness = colour_depth(np.geomspace(1, 9, 100)[None], near=1, far=9)[0] @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(lightness) <= 1).all() and lightness[0] - lightness[-1] > 180


def test_percentiles_ignore_invalid_and_outliers():
    depth = np.linspace(2.0, 3.0, 1000).reshape(10, 100)
    depth[0, 0], depth[0, 1] = 1e6, np.inf
    near, far = depth_range(depth)
    assert 2.0 < near < 2.05 and 2.95 < far < 3.05
    assert depth_range(depth, near=1.0) == (1.0, far)


RISING = np.linspace(2.0, 3.0, 100).reshape(10, 10)


@pytest.mark.parametrize(
    ("depth", "ends"),
    [
        (np.full((4, 4), 2.0), {}),
        (np.full((4, 4), np.nan), {}),
        (np.zeros((4, 4)), {}),
        (RISING, {"near": 10.0}),
        (RISING, {"far": 0.5}),
    ],
)
def test_flat_and_empty_maps_and_ends_beyond_the_data_have_a_range(depth, ends):
    near, far = depth_range(depth, **ends)
    assert 0 < near < far and colour_depth(depth, **ends).shape == (*depth.shape, 3)
    assert depth_figure(depth, **ends).height >= 256


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: depth_range(np.ones((3, 4)), near=0), "near"),
        (lambda: depth_range(np.ones((3, 4)), far=float("inf")), "far"),
        (lambda: depth_range(np.ones((3, 4)), near=3, far=2), "near < far"),
        (lambda: colour_depth(np.ones((2, 3, 4))), "depth_m"),
        (lambda: grid([], []), "one or more, each with a title; got 0"),
        (lambda: grid([np.zeros((2, 2))], ["a", "b"]), "each with a title; got 1, 2 titles"),
        (lambda: grid([np.zeros((2, 2, 4))], ["a"]), "images"),
    ],
)
def test_what_is_no_picture_or_range_is_named(call, match):
    with pytest.raises(ValueError, match=match):
        call()


@pytest.mark.parametrize("near", [0.001, 0.3, 2.0, 47.0])
@pytest.mark.parametrize("ratio", [1.001, 1.1, 1.9, 5.0, 30.0, 1e4])
def test_ticks_are_few_rising_inside_and_round(near, ratio):
    values = ticks(near, near * ratio)
    assert 2 <= len(values) <= 8
    assert near * (1 - 1e-6) <= values[0] and values[-1] <= near * ratio * (1 + 1e-6)
    assert (np.diff(values) > 0).all()
    assert len({f"{value:g}" for value in values}) == len(values)


def test_a_figure_is_the_map_beside_its_legend():
    depth = np.tile(np.geomspace(1, 20, 300), (260, 1))
    pixels = np.asarray(depth_figure(depth))
    np.testing.assert_array_equal(pixels[:, :300], colour_depth(depth))
    legend = pixels[:, 300:]
    # The bar runs from the far colour on top to the near one at the bottom; labels are black on white.
    column = legend[:, 12].astype(int)
    inside = np.flatnonzero((column.max(axis=1) - column.min(axis=1)) > 60)
    assert column[inside[1], 2] > column[inside[1], 0] and column[inside[-2], 0] > column[inside[-2], 2]
    assert (legend == 0).all(axis=-1).sum() > 100
    assert not (pixels == 128).all(axis=-1).any()
    depth[:50, :50] = np.nan
    assert (np.asarray(depth_figure(depth))[:, 300:] == 128).all(axis=-1).any()
    small = np.array([[1.0, 2.0], [3.0, 4.0]])  # is enlarged by a whole factor
    figure = np.asarray(depth_figure(small, near=1, far=4))
    assert figure.shape[0] == 256
    np.testing.assert_array_equal(figure[::128, :256:128], colour_depth(small, near=1, far=4))


def test_grid_places_cells_and_titles():
    red = np.zeros((20, 40, 3), dtype=np.uint8)
    red[..., 0] = 255
    pictures = [red, np.zeros((40, 40)), np.ones((20, 40), bool), Image.new("L", (10, 5), 77), red / 255.0]
    titles = ["a", "b", "c", "d", "a title much too long for its cell" * 3]
    sheet = grid(pictures, titles, columns=2, cell_width=80)
    pixels = np.asarray(sheet)
    assert sheet.size == (6 + 2 * 86, 6 + (80 + 40 + 40) + 3 * (24 + 6))
    assert tuple(pixels[6 + 24 + 5, 6 + 40]) == (255, 0, 0)
    assert (pixels == 77).all(axis=-1).any()
