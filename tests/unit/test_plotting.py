"""Pictures: colours, legend, contact sheet, and every figure of the evaluation on one tiny pair."""

import json

import matplotlib
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from geodiff_plugin.cli.eval import eval_app
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.figures import sweep_g_s
from geodiff_plugin.formats import write_depth_npy
from geodiff_plugin.plotting import colour_depth, depth_figure, depth_range, grid, ticks
from tests.evaluating import write_scenes


def test_near_is_yellow_far_is_blue_unknown_is_grey():
    depth = np.array([[1.0, 2.0, 4.0, np.inf], [np.nan, 0.0, -1.0, -np.inf]])
    picture = colour_depth(depth, near=1, far=4)
    assert picture.dtype == np.uint8 and picture.shape == (2, 4, 3)
    expected = matplotlib.colormaps["plasma"]([1.0, 0.5, 0.0])[:, :3] * 255
    np.testing.assert_allclose(picture[0, :3], expected, atol=1)
    assert (np.concatenate([picture[0, 3:], picture[1]]) == 128).all()
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
        (lambda: colour_depth(np.ones((2, 3, 4))), "depth_m"),
        (lambda: grid([np.zeros((2, 2))], ["a", "b"]), "each with a title; got 1, 2 titles"),
        (lambda: grid([np.zeros((2, 2, 4))], ["a"]), "images"),
    ],
)
def test_what_is_no_picture_or_range_is_named(call, match):
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
    pictures = [red, np.zeros((40, 40)), np.ones((20, 40), bool), Image.new("L", (10, 5), 77), red / 255.0]
    sheet = grid(pictures, ["a", "b", "c", "d", "too long for its cell" * 3], columns=2, cell_width=80)
    pixels = np.asarray(sheet)
    assert sheet.size == (6 + 2 * 86, 6 + (80 + 40 + 40) + 3 * (24 + 6))
    assert tuple(pixels[35, 46]) == (255, 0, 0) and (pixels == 77).all(axis=-1).any()


@pytest.fixture
def scenes(tmp_path):
    return write_scenes(tmp_path / "data", "wall")


@pytest.fixture
def draw(scenes, make_pipeline, tmp_path):
    """``draw(name, *words)`` -> picture and numbers."""
    make_pipeline().save_pretrained(tmp_path / "prior")

    def run(name, *words):
        out = tmp_path / "out"
        options = ("--data", scenes, "--prior", tmp_path / "prior", "--resolution", 64, "-o", out)
        given = [str(word) for word in ("figure", name, "--steps", 1, *options, *words)]
        answer = CliRunner().invoke(eval_app, given, catch_exceptions=False)
        assert answer.exit_code == 0 and answer.stdout == f"{out / f'figure-{name}.png'}\n"
        with Image.open(out / f"figure-{name}.png") as image:
            assert image.mode == "RGB"
            picture = np.asarray(image)
        assert picture.shape[0] > 100 and picture.std() > 5
        numbers = json.loads((out / f"figure-{name}.json").read_text())
        assert "eval figure" in numbers["command"] and f"--data {scenes}" in numbers["command"]
        return picture, numbers

    return run


@pytest.mark.parametrize(
    ("name", "words", "is_right"),
    [
        ("gs-sweep", ["--max", 20], lambda n: n["g_s_m"][::79] == [1, 20] and len(n["loss"]) == 80),
        ("inner-steps", ["--updates", "2,1"], lambda n: n["updates"] == [1, 2] and n["paper"]["seconds"][1]),
        ("ablation", ["--methods", "prior-aligned,sgbm"], lambda n: len(*n["abs_rel"].values()) == 2),
    ],
)
def test_a_figure_has_its_numbers_beside_it(draw, name, words, is_right):
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
