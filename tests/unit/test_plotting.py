"""Images: colours, legend, contact sheet, and every figure of the evaluation on one tiny pair."""

import json

import cv2
import matplotlib
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from PIL import Image

from geodiff_plugin import plotting
from geodiff_plugin._internal import strips as _strips
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cli.eval import eval_app
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.figures import sweep_g_s
from geodiff_plugin.formats import write_depth_npy
from geodiff_plugin.plotting import (
    check_video,
    colour_depth,
    colour_fraction,
    depth_figure,
    depth_frames,
    depth_range,
    fraction_figure,
    grid,
    measured_range,
    overview,
    shrunk,
    ticks,
    write_depth_video,
)
from tests.evaluating import write_scenes


def test_near_is_yellow_far_is_blue_unknown_is_grey():
    depth = np.array([[1.0, 2.0, 4.0, np.inf], [np.nan, 0.0, -1.0, -np.inf]])
    rgb = colour_depth(depth, near=1, far=4)
    assert rgb.dtype == np.uint8 and rgb.shape == (2, 4, 3)
    expected = matplotlib.colormaps["plasma"]([1.0, 0.5, 0.0])[:, :3] * 255
    np.testing.assert_allclose(rgb[0, :3], expected, atol=1)
    assert (np.concatenate([rgb[0, 3:], rgb[1]]) == 128).all()
    lightness = colour_depth(np.geomspace(1, 9, 100)[None], near=1, far=9)[0] @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(lightness) <= 1).all() and lightness[0] - lightness[-1] > 180


@pytest.mark.parametrize(
    ("depth", "ends"),
    [
        (np.full((4, 4), 2.0), {}),
        (np.full((4, 4), np.nan), {}),
        (np.array([[2.0, 2.5, 3.0]]), {"near": 10.0}),
        (np.array([[2.0, 2.5, 3.0]]), {"far": 0.5}),
    ],
)
def test_flat_and_empty_maps_and_ends_beyond_the_data_have_a_range(depth, ends):
    near, far = depth_range(depth, **ends)
    assert 0 < near < far and colour_depth(depth, **ends).shape == (*depth.shape, 3)
    assert depth_figure(depth, **ends).height >= 256


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: depth_range(np.ones((3, 4)), far=float("inf")), "far"),
        (lambda: colour_depth(np.ones((2, 3, 4))), r"depth_m must be one map of shape \(H, W\)"),
        (lambda: grid([np.zeros((2, 2))], ["a", "b"]), "each with a title; got 1, 2 titles"),
        (lambda: grid([np.zeros((2, 2, 4))], ["a"]), "images"),
    ],
)
def test_values_that_are_no_image_or_range_are_named(call, match):
    with pytest.raises(ValueError, match=match):
        call()


@pytest.mark.parametrize("near", [0.001, 2.0, 47.0])
@pytest.mark.parametrize("ratio", [1.001, 1.9, 5.0, 30.0, 1e4])
def test_ticks_are_few_rising_inside_and_round(near, ratio):
    values = ticks(near, near * ratio)
    assert 2 <= len(values) <= 8
    assert near * (1 - 1e-6) <= values[0] and values[-1] <= near * ratio * (1 + 1e-6)
    assert (np.diff(values) > 0).all()
    assert len({f"{value:g}" for value in values}) == len(values)


def test_a_figure_is_the_map_next_to_its_legend():
    depth = np.tile(np.geomspace(1, 20, 300), (260, 1))
    pixels = np.asarray(depth_figure(depth))
    np.testing.assert_array_equal(pixels[:, :300], colour_depth(depth))
    legend = pixels[:, 300:]
    # The bar runs from the far colour on top to the near one at the bottom; labels are black on white.
    column = legend[:, 12].astype(int)
    inside = np.flatnonzero((column.max(axis=1) - column.min(axis=1)) > 60)
    assert column[inside[1], 2] > column[inside[1], 0] and column[inside[-2], 0] > column[inside[-2], 2]
    assert (legend == 0).all(axis=-1).sum() > 100
    depth[:50, :50] = np.nan
    keyed = np.asarray(depth_figure(depth))[:, 300:]
    grey, key = ((each == 128).all(axis=-1).sum() for each in (legend, keyed))
    assert grey < 10 and key > 50  # letters have an edge of this grey, the key an area
    small = np.array([[1.0, 2.0], [3.0, 4.0]])  # is enlarged by a whole factor
    figure = np.asarray(depth_figure(small, near=1, far=4))
    np.testing.assert_array_equal(figure[::128, :256:128], colour_depth(small, near=1, far=4))


def test_grid_places_cells_and_titles():
    red = np.zeros((20, 40, 3), dtype=np.uint8)
    red[..., 0] = 255
    rgb_images = [red, np.zeros((40, 40)), np.ones((20, 40), bool), Image.new("L", (10, 5), 77), red / 255.0]
    sheet = grid(rgb_images, ["a", "b", "c", "d", "too long for its cell" * 3], columns=2, cell_width=80)
    pixels = np.asarray(sheet)
    assert sheet.size == (6 + 2 * 86, 6 + (80 + 40 + 40) + 3 * (24 + 6))
    assert tuple(pixels[35, 46]) == (255, 0, 0) and (pixels == 77).all(axis=-1).any()


def white(pixels: np.ndarray) -> np.ndarray:
    return (pixels == 255).all(axis=-1)


def table(name: str) -> np.ndarray:
    return (matplotlib.colormaps[name](np.linspace(0, 1, 1024))[:, :3] * 255).round()


def place_in(name: str, colours: np.ndarray) -> np.ndarray:
    """Where on a colour map these colours are, from 0 to 1."""
    off = np.abs(table(name)[:, None] - colours[None].astype(float)).sum(axis=-1)
    assert (off.min(axis=0) < 4).all(), "the colours are those of the map"
    return off.argmin(axis=0) / 1023


@pytest.mark.parametrize("strip", [7, 1 << 20])
def test_every_shade_of_a_map_is_the_place_of_its_logarithm_between_the_ends(strip, monkeypatch):
    monkeypatch.setattr(_strips, "STRIP_PIXELS", strip)
    depth = np.geomspace(0.5, 60, 90).reshape(6, 15)
    near, far = 1.0, 30.0
    expected = np.clip(np.log(far / depth) / np.log(far / near), 0, 1)
    np.testing.assert_allclose(
        place_in("plasma", colour_depth(depth, near, far).reshape(-1, 3)), expected.ravel(), atol=0.01
    )
    for top in (1.0, 4.0):
        values = np.linspace(-0.2 * top, 1.2 * top, 60).reshape(4, 15)
        values[2, 3] = np.nan
        colours = colour_fraction(values, top)
        known = np.isfinite(values)
        assert (colours[~known] == 128).all()
        np.testing.assert_allclose(
            place_in("YlGnBu_r", colours[known]), np.clip(values[known] / top, 0, 1), atol=0.02
        )
    np.testing.assert_array_equal(colour_fraction(values / 4), colour_fraction(values, 4.0))


def test_the_ends_of_the_colours_leave_two_per_cent_on_either_side():
    depth = np.linspace(1, 101, 5001).reshape(3, 1667)
    assert depth_range(depth) == pytest.approx((3, 99))
    unknown = np.vstack([depth, np.full((1, 1667), np.nan), np.zeros((1, 1667)), np.full((1, 1667), -5.0)])
    assert depth_range(unknown) == pytest.approx((3, 99)), "unknown pixels count for nothing"
    assert depth_range(depth[None, ..., None], near=10.0) == pytest.approx((10, 99))
    assert depth_range(torch.from_numpy(depth)[None, None], far=50.0) == pytest.approx((3, 50))
    assert depth_range(depth, 5, 6) == (5, 6)
    assert depth_range(np.full((2, 3), np.nan)) == (1, 2)
    assert depth_range(np.full((2, 3), 2.0)) == pytest.approx((2, 2.02))
    assert depth_range(depth, near=200.0) == pytest.approx((200, 202))
    assert depth_range(depth, far=0.5) == pytest.approx((0.5 / 1.01, 0.5))
    near_only = np.where(depth < 21, depth, 0)
    assert measured_range(near_only, depth) == depth_range(near_only) == pytest.approx((1.4, 20.6), rel=1e-2)
    assert measured_range(0 * depth, depth) == depth_range(depth), "nothing was measured"
    for near, far, said in (
        (2.0, 2.0, r"near \(--near\) must be less than far \(--far\); got 2 and 2"),
        (3.0, 2.0, "got 3 and 2"),
        (0.0, None, "near must be"),
        (None, -1.0, "far must be"),
    ):
        with pytest.raises(ValueError, match=said):
            depth_range(depth, near, far)


def test_the_colours_of_a_video_keep_nine_tenths_of_their_range():
    colours = plotting.SmoothedRange()
    unknown = np.zeros((20, 20))
    assert colours.update(unknown, unknown) == (None, None)
    depth_m = np.linspace(1.0, 3.0, 400).reshape(20, 20)
    sky_m = np.where(np.arange(20) < 5, 80.0, depth_m)
    first = colours.update(np.where(sky_m < 80, sky_m, 0), sky_m)
    assert first == pytest.approx(depth_range(depth_m[:, 5:])), "the sky is not measured"
    assert colours.update(unknown, unknown) == first, "a frame without depth changes nothing"
    assert colours.update(unknown, 2 * depth_m) == pytest.approx(
        0.9 * np.array(first) + 0.1 * np.array(depth_range(2 * depth_m))
    ), "all of it, if nothing was measured"


def test_the_ends_of_a_large_map_are_those_of_a_sample_of_its_known_pixels(monkeypatch):
    monkeypatch.setattr(plotting, "MAX_RANGE_PIXELS", 100)
    depth = np.random.default_rng(0).uniform(1, 9, (30, 30))
    depth[1::3], depth[:, 1::3], depth[2::3], depth[:, 2::3] = 50, 50, 50, 50
    near, far = depth_range(depth)  # every third row and column
    assert 1 < near < 1.6 and 8.4 < far < 9
    depth[::3, ::3] = np.nan
    assert depth_range(depth) == pytest.approx((50, 50.5)), "all, if the sample has none"


def test_a_range_of_ticks_uses_1_2_and_5_or_more_of_them():
    assert ticks(1, 100) == [1, 2, 5, 10, 20, 50, 100]
    assert ticks(0.9, 5.1) == [1, 1.5, 2, 3, 4, 5]
    assert ticks(0.11, 0.9, 3) == pytest.approx([0.15, 0.3, 0.5])
    assert ticks(10, 30) == [10, 15, 20, 25, 30] and ticks(10, 22) == [10, 12, 14, 16, 18, 20, 22]
    assert ticks(2.0, 4.0, 4) == [2, 3, 4] and ticks(2.0, 2.5) == [2, 2.1, 2.2, 2.3, 2.4, 2.5]
    wide = ticks(1e-3, 1e5)
    assert 4 <= len(wide) <= 8 and wide[0] == 1e-3


@pytest.mark.parametrize("height", [260, 700])
def test_marks_of_a_legend_are_at_their_places_next_to_the_bar(height):
    """The black tick of each depth is where the bar has the colour of that depth in the map."""
    depth = np.tile(np.geomspace(1, 16, 300), (height, 1))
    figure = np.asarray(depth_figure(depth, near=1, far=16))
    assert figure.shape[0] == height
    letters = max(12, height // 26)
    left, right = letters // 2, letters // 2 + max(14, height // 24)
    assert figure.shape[1] == 300 + right + 5 * letters
    bar = figure[:, 300 + (left + right) // 2]
    top, bottom = 2 * letters, height - letters
    line = max(1, letters // 12)
    inside = slice(top + line, bottom - line)
    rows = np.arange(height)[inside]
    wanted = np.log(16) * (bottom - rows - 0.5) / (bottom - top) / np.log(16)
    np.testing.assert_allclose(1 - place_in("plasma", bar[inside]), wanted, atol=0.02)
    assert white(figure[: letters // 8, 300:]).all(), "the label leaves a margin"
    assert white(bar[bottom + 1 :]).all() and not white(bar[top : bottom - 1]).any()
    marks = (figure[:, 300 + right + 1] < 100).all(axis=-1)
    dark = np.flatnonzero(marks & (np.arange(height) > 1.7 * letters))  # below the label
    values = ticks(1, 16)
    centres = [rows.mean() for rows in np.split(dark, np.flatnonzero(np.diff(dark) > 1) + 1)]
    expected = [bottom - (bottom - top) * np.log(value) / np.log(16) for value in values][::-1]
    np.testing.assert_allclose(centres, expected, atol=line + 1)


def test_a_map_with_unknown_pixels_has_a_key_to_the_grey():
    depth = np.tile(np.geomspace(1, 16, 300), (520, 1))
    whole = np.asarray(depth_figure(depth))
    depth[:9, :9] = np.nan
    keyed = np.asarray(depth_figure(depth))
    letters = 520 // 26
    left, right = letters // 2, letters // 2 + max(14, 520 // 24)
    box = keyed[520 - 2 * letters : 520 - letters, 300 + left : 300 + right]
    assert (box[2:-2, 2:-2] == 128).all() and (box[0] == 0).all() and (box[:, -1] == 0).all()
    assert (keyed[-letters:, 300 + left : 300 + right] == 255).all()
    assert (whole[-letters + 1 :, 300 + left : 300 + right] == 255).all()
    text = keyed[520 - 2 * letters : 520 - letters, 300 + right + letters // 2 :]
    assert (text < 100).any() and (
        keyed[:, 300 + left + 5][520 - 3 * letters + 1 : 520 - 2 * letters - 1] == 255
    ).all()


def test_the_label_states_the_unit():
    depth = np.tile(np.geomspace(1, 16, 60), (260, 1))
    metres, feet, none = (np.asarray(depth_figure(depth, unit=unit))[:22, 60:] for unit in ("m", "ft", None))
    assert not np.array_equal(metres, feet) and not np.array_equal(metres, none)
    np.testing.assert_array_equal(metres, np.asarray(depth_figure(depth))[:22, 60:])


def test_a_figure_of_fractions_has_its_colours_and_round_marks():
    values = np.tile(np.linspace(0, 0.5, 300), (300, 1))
    pixels = np.asarray(fraction_figure(values, "difference", 0.5))
    np.testing.assert_array_equal(pixels[:, :300], colour_fraction(values, 0.5))
    letters = 12
    right = letters // 2 + max(14, 300 // 24)
    marks = (pixels[:, 300 + right + 1] < 100).all(axis=-1)
    dark = np.flatnonzero(marks & (np.arange(300) > 20))  # below the label
    expected = [288 - fraction * (288 - 24) for fraction in (1, 0.8, 0.6, 0.4, 0.2, 0)]
    np.testing.assert_allclose(dark, expected, atol=1)
    bar = pixels[30:280, 300 + letters // 2 + 6]
    np.testing.assert_allclose(place_in("YlGnBu_r", bar), (288 - np.arange(30, 280) - 0.5) / 264, atol=0.02)
    values[0, 0] = np.inf
    assert (np.asarray(fraction_figure(values, "difference", 0.5))[:, 300:] == 128).all(axis=-1).sum() > 50


def test_ticks_of_an_error_are_round():
    """0.0763 is the 98 % quantile of a real pair: its quarter would be labelled 0.019."""
    labels = []
    values = np.linspace(0, 0.0763, 300)[None].repeat(300, axis=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plotting, "_figure", lambda rgb, colours, label, marks, unknown: labels.extend(marks))
        fraction_figure(values, "difference", 0.0763)
    assert [text for _, text in labels] == ["0", "0.02", "0.04", "0.06"]
    np.testing.assert_allclose([place for place, _ in labels], np.array([0, 0.02, 0.04, 0.06]) / 0.0763)


def test_titles_are_centred_above_images_and_rows_have_a_legend():
    images = [np.full((60, 100), 90, np.uint8)] * 4
    plain = np.asarray(grid(images, ["ab"] * 4, columns=2, cell_width=100))
    narrow = np.asarray(grid(images, ["ab"] * 4, columns=2, cell_width=100, image_width=60))
    for sheet, centre in ((plain, 6 + 50), (narrow, 6 + 30)):
        letters = np.flatnonzero((sheet[6:30, : 6 + 100] < 128).any(axis=(0, 2)))
        assert (letters.min() + letters.max()) / 2 == pytest.approx(centre, abs=1.5)
    coloured = np.asarray(grid(images, ["ab"] * 4, columns=2, cell_width=100, depth_ranges=[(1, 2), (1, 10)]))
    np.testing.assert_array_equal(coloured[:, : plain.shape[1]], plain)
    legends = coloured[:, plain.shape[1] :]
    assert legends.shape[1] > 40 and not white(legends[:90]).all() and not white(legends[90:]).all()
    drawn = np.flatnonzero(~white(legends).all(axis=1))
    assert drawn.min() >= 6 + 24 and drawn.max() < 6 + 2 * 90 - 6, "bars are as high as the images"
    assert (legends[:90] != legends[90:180][: len(legends[:90])]).any(), "each row has its own range"
    second = [None, (1, 10)]
    coloured = np.asarray(grid(images, ["ab"] * 4, columns=2, cell_width=100, depth_ranges=second))
    first, last = np.split(coloured[:, plain.shape[1] :], [90])
    assert white(first).all() and not white(last).all(), "a row without depth has no bar"


def test_cells_of_a_grid_keep_their_shape_and_stand_in_rows():
    """Each cell is at its place under its title; a row is as high as its highest."""
    sizes = ((40, 30), (60, 20), (20, 40), (50, 50), (30, 60))
    shades = (40, 80, 120, 160, 200)
    rgb_images = [np.full((h, w), shade, np.uint8) for (w, h), shade in zip(sizes, shades, strict=True)]
    for columns, shape in ((2, (2, 3)), (3, (3, 2)), (None, (4, 2))):
        sheet = np.asarray(grid(rgb_images, list("abcde"), columns=columns, cell_width=80))
        across, _ = shape
        heights = [round(h * 80 / w) for w, h in sizes]
        top = 6
        for start in range(0, 5, across):
            row = range(start, min(start + across, 5))
            for k, number in enumerate(row):
                x, y = 6 + k * 86, top + 24
                cell = sheet[y : y + heights[number], x : x + 80]
                assert (cell == shades[number]).all()
                heading = sheet[top : top + 24, x : x + 80]
                assert (
                    not white(heading).all()
                    and white(heading[:, :20]).all()
                    and white(heading[:, -20:]).all()
                )
                assert white(sheet[y + heights[number], x : x + 80]).all()
            top += 24 + 6 + max(heights[number] for number in row)
        assert sheet.shape[:2] == (top, 6 + across * 86)
    assert grid(rgb_images[:1], ["a"]).size == (6 + 326, 6 + 24 + 6 + 240)
    with pytest.raises(TypeError):
        grid(rgb_images[:1], ["a"], 2)  # settings are given by name


def test_images_of_every_kind_are_rgb():
    floats = np.array([[0.0, 0.5, np.nan], [1.0, 2.0, -1.0]])
    levels = np.array([[0, 128, 0], [255, 255, 0]])
    np.testing.assert_array_equal(np.asarray(plotting.as_rgb_image(floats))[..., 1], levels)
    np.testing.assert_array_equal(
        np.asarray(plotting.as_rgb_image(floats > 0.4))[..., 0], 255 * (floats > 0.4)
    )
    colours = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    np.testing.assert_array_equal(np.asarray(plotting.as_rgb_image(colours)), colours)
    assert plotting.as_rgb_image(Image.new("L", (3, 2), 7)).getpixel((1, 1)) == (7, 7, 7)
    for bad in (np.zeros((2, 3), int), np.zeros((2, 3, 4), np.uint8), np.zeros(3), np.zeros((1, 2, 3, 3))):
        with pytest.raises(ValueError, match="images must be PIL, or"):
            plotting.as_rgb_image(bad)


def test_an_overview_has_the_left_image_next_to_its_maps_on_one_scale(monkeypatch):
    left = np.full((300, 400, 3), 0.25)
    depth = shrunk(Image.new("RGB", (600, 300), (0, 255, 0)))
    assert depth.size == (480, 240)
    sure = Image.new("RGB", depth.size, (255, 0, 255))
    error = np.full((300, 400), 0.02)
    error[:, 200:] = 0.2
    error[:50] = np.nan
    cells = []
    monkeypatch.setattr(
        plotting, "grid", lambda images, titles, **options: cells.append((images, titles, options))
    )
    overview(left, depth, sure, error)
    overview(left, depth, None, None)
    (images, titles, options), (few, few_titles, _) = cells
    assert titles == [
        "left image",
        "depth",
        "confidence: within 10 % of ground truth",
        "photometric error (grey: not seen from the right)",
    ]
    assert few_titles == titles[:2] and options == {"columns": 2, "cell_width": 480, "image_width": 320}
    beside = np.asarray(images[0])
    assert beside.shape == (240, 480, 3) and (beside[:, :320] == 64).all() and white(beside[:, 320:]).all()
    assert images[1] is depth and images[2] is sure and few[1] is depth
    drawn = np.asarray(images[3])[:, :400]
    np.testing.assert_array_equal(drawn, colour_fraction(error, 0.2))
    for values, top in ((np.full((300, 400), 0.01), 0.05), (np.full((300, 400), np.nan), 0.05)):
        overview(left, depth, None, values)
        np.testing.assert_array_equal(np.asarray(cells[-1][0][2])[:, :400], colour_fraction(values, top))
    spread = np.linspace(0, 1, 300 * 400).reshape(300, 400)
    overview(left, depth, None, spread)
    np.testing.assert_array_equal(
        np.asarray(cells[-1][0][2])[:, :400], colour_fraction(spread, np.quantile(spread, 0.98))
    )


def test_large_maps_are_thinned_in_an_overview(monkeypatch):
    monkeypatch.setattr(plotting, "CELL_WIDTH", 20)
    cells = []
    monkeypatch.setattr(plotting, "grid", lambda images, *_, **__: cells.append(images))
    left = np.random.default_rng(0).random((260, 130, 3))
    overview(left, Image.new("RGB", (100, 87)), None, left[..., 0])
    third = left[::3, ::3, 0]
    drawn = np.asarray(cells[0][2])[::3, : 3 * third.shape[1] : 3]  # enlarged by three for its legend
    np.testing.assert_array_equal(drawn, colour_fraction(third, np.quantile(third, 0.98)))
    thin = np.asarray(cells[0][0])
    assert thin.shape == (87, 100, 3) and (thin[:, 44:] == 255).all()


def test_all_frames_of_a_video_have_the_colours_of_one_range():
    rng = np.random.default_rng(0)
    depths = [rng.uniform(1 + n, 4 + n, (260, 40)) for n in range(3)]
    depths[1][:5] = np.nan
    near, far = depth_range(np.concatenate([depth.ravel() for depth in depths])[None])
    frames = list(depth_frames(depths))
    assert len(frames) == 3
    for frame, depth in zip(frames, depths, strict=True):
        np.testing.assert_array_equal(np.asarray(frame), np.asarray(depth_figure(depth, near, far)))
    frames = list(depth_frames(depths, near=2.0, far=3.0, unit=None))
    np.testing.assert_array_equal(np.asarray(frames[2]), np.asarray(depth_figure(depths[2], 2.0, 3.0, None)))
    for bad in ([], [np.ones((2, 3)), np.ones((3, 2))]):
        with pytest.raises(ValueError, match="depths_m must be at least one map, all of one shape"):
            depth_frames(bad)


@pytest.mark.parametrize("suffix", ["mp4", "webp", "gif"])
def test_a_video_has_its_frames_in_order_at_their_rate(suffix, tmp_path):
    path = tmp_path / f"v.{suffix}"
    shades = [30, 90, 150, 210]
    write_depth_video(path, (Image.new("RGB", (65, 49), (shade, 20, 20)) for shade in shades), fps=8.0)
    if suffix == "mp4":
        capture = cv2.VideoCapture(str(path))
        assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(8)
        got = [capture.read()[1] for _ in shades]
        assert not capture.grab() and got[0].shape == (48, 64, 3), "of even sides"
        found = [round(float(image[..., 2].mean())) for image in got]
    else:
        with Image.open(path) as image:
            assert image.n_frames == 4 and image.size == (65, 49) and image.info["loop"] == 0
            found = []
            for number in range(4):
                image.seek(number)
                image.load()
                assert image.info["duration"] in (125, 120)
                found.append(image.convert("RGB").getpixel((9, 9))[0])
    np.testing.assert_allclose(found, shades, atol=12)


def test_a_non_video_is_rejected(tmp_path):
    for name, fps, said in (
        ("v.avi", 10, "the video must be a file with a suffix in .mp4, .webp, .gif; got v.avi"),
        ("v.MP4", 0.09, "fps must be between 0.1 and 120"),
        ("v.gif", 120.1, "fps must be between 0.1 and 120"),
    ):
        with pytest.raises(ValueError, match=said):
            check_video(tmp_path / name, fps)
    for fps in (0.1, 120):
        check_video("v.WEBP", fps)
    with pytest.raises(ValueError, match="frames must be at least one image; got none"):
        write_depth_video(tmp_path / "v.gif", [])
    with pytest.raises(InputError, match=r"in an existing folder"):
        write_depth_video(tmp_path / "none" / "v.gif", [Image.new("RGB", (4, 4))])

    def broken():
        yield Image.new("RGB", (40, 40))
        raise OSError(28, "No space left on device")

    for name in ("v.gif", "v.mp4"):
        with pytest.raises(InputError, match=rf"got {tmp_path / name} \(No space left on device\)"):
            write_depth_video(tmp_path / name, broken())
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def scenes(tmp_path):
    return write_scenes(tmp_path / "data", "wall")


@pytest.fixture
def draw(scenes, make_pipeline, tmp_path):
    """``draw(name, *words)`` -> image and numbers."""
    make_pipeline().save_pretrained(tmp_path / "prior")

    def run(name, *words):
        out = tmp_path / "out"
        options = ("--data", scenes, "--prior", tmp_path / "prior", "--resolution", 64, "-o", out)
        given = [str(word) for word in ("figure", name, "--steps", 1, *options, *words)]
        answer = CliRunner().invoke(eval_app, given, catch_exceptions=False)
        assert answer.exit_code == 0 and answer.stdout == f"{out / f'figure-{name}.png'}\n"
        with Image.open(out / f"figure-{name}.png") as image:
            assert image.mode == "RGB"
            rgb = np.asarray(image)
        assert rgb.shape[0] > 100 and rgb.std() > 5
        numbers = json.loads((out / f"figure-{name}.json").read_text())
        assert "eval figure" in numbers["command"] and f"--data {scenes}" in numbers["command"]
        return rgb, numbers

    return run


@pytest.mark.parametrize(
    ("name", "words", "is_right"),
    [
        ("gs-sweep", ["--max", 20], lambda n: n["g_s_m"][::79] == [1, 20] and len(n["loss"]) == 80),
        (
            "guidance-steps",
            ["--updates", "2,1"],
            lambda n: n["updates"] == [1, 2] and n["paper"]["seconds"][1],
        ),
        ("ablation", ["--methods", "prior-aligned,sgbm"], lambda n: len(*n["abs_rel"].values()) == 2),
    ],
)
def test_a_figure_has_its_numbers_next_to_it(draw, name, words, is_right):
    assert is_right(draw(name, *words)[1])


def test_qualitative_has_clouds_reasons_and_perturbed_poses(draw, scenes, tmp_path):
    words = ("--methods", "sgbm")
    without, _ = draw("qualitative", *words)
    with_clouds, numbers = draw("qualitative", *words, "--clouds")
    assert with_clouds.shape[0] > without.shape[0] and "--clouds" in numbers["command"]
    maps = tmp_path / "maps"
    maps.mkdir()
    write_depth_npy(maps / "middlebury2014_wall-turn3-shift0.1.npy", np.zeros((48, 144), np.float32))
    methods = [f"files:{maps}", f"files:{scenes}"]  # an empty map, and none
    _, numbers = draw("qualitative", "--methods", ",".join(methods), "--perturb", "3,0.1")
    assert numbers["abs_rel"] == {"middlebury2014/wall-turn3-shift0.1": dict.fromkeys(methods)}


def test_the_sweep_of_a_true_map_is_best_at_the_true_scale(scenes):
    sample = load(find_pairs(scenes)[0])
    sweep, rendered = sweep_g_s(sample, sample.depth_m / 2.5, "depth", 10.0)
    g_s, loss, abs_rel = (sweep[name] for name in ("g_s_m", "loss", "abs_rel"))
    step = g_s[1] / g_s[0]
    assert 1 / step < g_s[abs_rel.argmin()] / 2.5 < step
    assert 1 / step**2 < g_s[loss.argmin()] / 2.5 < step**2
    assert sweep["visible"][-1] > sweep["visible"][0] and len(rendered) == 4
    assert {loss.argmin(), abs_rel.argmin(), len(g_s) - 1} <= set(rendered)
