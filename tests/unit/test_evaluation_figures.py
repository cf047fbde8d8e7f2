"""Every figure on one tiny pair with a tiny random prior, and the parts that they are drawn with."""

import json

import numpy as np
import pytest
from geodiff_plugin.evaluation.figures.gs_sweep import sweep_g_s
from PIL import Image
from typer.testing import CliRunner

from geodiff_plugin.algorithm.terms import TERMS, Term
from geodiff_plugin.cli.eval.app import eval_app
from geodiff_plugin.config import DEFAULT_WEIGHTS
from geodiff_plugin.evaluation.baselines import METHODS, PriorCache, Settings
from geodiff_plugin.evaluation.baselines.guided import call_arguments
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.datasets.changed import exposed_ref
from geodiff_plugin.evaluation.figures.canvas import (
    mark,
    new_figure,
    save_png,
    show_depth,
    show_error,
    show_values,
)
from geodiff_plugin.evaluation.figures.maps import SHRINK, orbit, render_cloud
from geodiff_plugin.evaluation.figures.one_pair import term_by_term
from geodiff_plugin.formats import write_depth_npy
from geodiff_plugin.guidance.guidance import GeometryGuidance


@pytest.fixture
def pair_folder(tmp_path, textured_plane):
    """The rendered plane as a folder of our own layout."""
    folder = tmp_path / "data" / "plane"
    folder.mkdir(parents=True)
    Image.fromarray(textured_plane.left).save(folder / "left.png")
    Image.fromarray(textured_plane.right).save(folder / "right.png")
    write_depth_npy(folder / "depth.npy", textured_plane.depth_m)
    K, (height, width) = textured_plane.K, textured_plane.depth_m.shape
    camera = f"[{K[0, 0]} 0 {K[0, 2]}; 0 {K[1, 1]} {K[1, 2]}; 0 0 1]"
    (folder / "calib.txt").write_text(
        f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline={1000 * textured_plane.E[0, 3]}\n"
        f"width={width}\nheight={height}\nndisp=64\n"
    )
    return tmp_path / "data"


@pytest.fixture
def draw(pair_folder, make_pipeline, tmp_path):
    """``draw(name, *words)`` -> picture and numbers."""
    make_pipeline().save_pretrained(tmp_path / "prior")

    def run(name, *words):
        out = tmp_path / "out"
        options = ("--data", pair_folder, "--prior", tmp_path / "prior", "--steps", 1, "--resolution", 64)
        answer = CliRunner().invoke(
            eval_app,
            [str(word) for word in ("figure", name, *options, "-o", out, *words)],
            catch_exceptions=False,
        )
        assert answer.exit_code == 0 and answer.stdout == f"{out / f'figure-{name}.png'}\n"
        picture = np.asarray(Image.open(out / f"figure-{name}.png").convert("RGB"))
        assert picture.shape[0] > 100 and picture.std() > 5
        numbers = json.loads((out / f"figure-{name}.json").read_text())
        assert "eval figure" in numbers["command"] and f"--data {pair_folder}" in numbers["command"]
        return picture, numbers

    return run


def test_gs_sweep(draw):
    _, numbers = draw("gs-sweep", "--max", 20)
    assert len(numbers["g_s_m"]) == len(numbers["loss"]) == len(numbers["abs_rel"])
    assert numbers["g_s_m"][0] == 1 and numbers["g_s_m"][-1] == pytest.approx(20)
    assert "--max 20" in numbers["command"]


def test_inner_steps(draw):
    _, numbers = draw("inner-steps", "--updates", "2,1")
    assert numbers["updates"] == [1, 2]
    assert all(len(numbers[preset]["seconds"]) == 2 for preset in ("guided", "paper"))


def test_exposure(draw):
    _, numbers = draw("exposure", "--methods", "plane-sweep,sgbm")
    assert numbers["gain"]["values"] == numbers["gamma"]["values"] == [0.5, 0.7, 1.0, 1.4, 2.0]
    # The unchanged pair is in both panels.
    assert numbers["gain"]["sgbm"][2] == numbers["gamma"]["sgbm"][2] is not None


def test_ablation(draw):
    _, numbers = draw("ablation", "--methods", "prior-aligned,search-only")
    assert set(numbers["abs_rel"]["folder/plane"]) == {"prior-aligned", "search-only"}


def test_qualitative_with_clouds_is_higher(draw):
    words = ("--methods", "sgbm,plane-sweep")
    without, _ = draw("qualitative", *words)
    with_clouds, numbers = draw("qualitative", *words, "--clouds")
    assert with_clouds.shape[0] > without.shape[0] and "--clouds" in numbers["command"]


def test_terms(draw):
    _, numbers = draw("terms", "--steps", 3)
    assert set(numbers["abs_rel"]) == {"first", "denoised", "final"}
    terms = numbers["terms"]
    assert set(terms) == {"photometric", "matches", "prior_pull", "anchor", "weighted sum"}
    assert all(len(values) == 2 for values in terms.values())  # two of the three steps are guided
    assert 0 < numbers["match_weight"] <= 1 and 0 < numbers["matched"] <= 1
    with pytest.raises(ValueError, match="ensemble must be 1"):
        draw("terms", "--ensemble", 2)


@pytest.fixture
def plane_sample(pair_folder):
    return load(find_pairs(pair_folder)[0])


@pytest.fixture
def tiny_settings(make_pipeline, tmp_path):
    make_pipeline().save_pretrained(tmp_path / "prior")
    return Settings(prior=str(tmp_path / "prior"), steps=2, resolution=64)


def test_terms_shows_the_guided_method_and_what_it_started_from(plane_sample, tiny_settings, monkeypatch):
    priors = PriorCache()
    parts = term_by_term(plane_sample, tiny_settings, priors)
    guided = METHODS["guided"].run(plane_sample, tiny_settings, priors)
    np.testing.assert_array_equal(parts.final_m, guided.depth_m)
    np.testing.assert_array_equal(parts.confidence, guided.confidence)
    # The call itself rejected the same matches at its own first estimate.
    used = []

    def spy(estimate):
        used.append(estimate.matches.confidence)
        return 0.0 * estimate.z0.flatten(1).mean(1)

    monkeypatch.setitem(TERMS, "spy", Term(spy, "matches"))
    views = plane_sample.right, (plane_sample.K_left, plane_sample.K_right), plane_sample.E
    priors.get(tiny_settings)(
        Image.fromarray(plane_sample.left),
        guidance=GeometryGuidance(*views, weights=DEFAULT_WEIGHTS | {"spy": 1.0}),
        **call_arguments(tiny_settings),
    )
    own = used[0]
    let_in = np.nan_to_num(parts.match_weight) > 0
    assert let_in.mean() > 0.3
    np.testing.assert_allclose(parts.match_weight[let_in], own[0, 0].numpy()[let_in], atol=1e-3)


def test_terms_of_a_plane(plane_sample, tiny_settings):
    parts = term_by_term(plane_sample, tiny_settings, PriorCache())
    matched = np.isfinite(parts.matches_m)
    error = np.abs(parts.matches_m / plane_sample.depth_m - 1.0)[matched]
    assert np.median(error) < 0.02
    np.testing.assert_array_equal(np.isfinite(parts.residual), matched)
    nearer = (parts.final_m < parts.matches_m)[matched]
    np.testing.assert_array_equal(parts.residual[matched] > 0, nearer)
    # The right camera is to the right: it does not see the left edge of a plane, and nothing hides the rest.
    assert np.isnan(parts.difference[:, 0]).all() and np.isfinite(parts.difference[:, -1]).all()
    assert not (parts.hidden & np.isnan(parts.difference)).any()
    assert parts.hidden.mean() < 0.05


def test_a_method_that_does_not_apply_is_drawn_as_its_reason(draw, pair_folder):
    text = (pair_folder / "plane" / "calib.txt").read_text()
    (pair_folder / "plane" / "calib.txt").write_text(text.replace("cam1=[60", "cam1=[61", 1))
    _, numbers = draw("qualitative", "--methods", "sgbm,plane-sweep")
    assert numbers["abs_rel"]["folder/plane"]["sgbm"] is None


def test_poses_are_perturbed_where_a_figure_is_asked_to(draw, pair_folder, tmp_path):
    maps = tmp_path / "maps"
    maps.mkdir()
    write_depth_npy(maps / "folder_plane-turn3-shift0.1.npy", np.zeros((96, 128), np.float32))
    words = ("--methods", f"files:{maps}", "--perturb", "3,0.1")
    _, numbers = draw("qualitative", *words)
    assert numbers["abs_rel"] == {"folder/plane-turn3-shift0.1": {f"files:{maps}": None}}  # an empty map


def test_bad_options_are_named(draw):
    with pytest.raises(ValueError, match="the figure must be one of"):
        draw("pie")
    with pytest.raises(ValueError, match="--updates must be whole numbers"):
        draw("inner-steps", "--updates", "1,a")
    with pytest.raises(ValueError, match="--max must be between"):
        draw("gs-sweep", "--max", "1")


def test_the_sweep_of_a_true_map_is_best_at_the_true_scale(textured_plane, pair_folder):
    sample = load(find_pairs(pair_folder)[0])
    sweep = sweep_g_s(sample, textured_plane.depth_m / 2.5, "depth", 10.0)
    step = sweep.g_s[1] / sweep.g_s[0]
    assert 1 / step < sweep.g_s[sweep.abs_rel.argmin()] / 2.5 < step
    assert 1 / step**2 < sweep.g_s[sweep.loss.argmin()] / 2.5 < step**2
    assert sweep.visible[-1] > sweep.visible[0] and len(sweep.shown) == len(sweep.rendered)


def test_exposure_changes_the_right_view_only(pair_folder):
    ref = find_pairs(pair_folder)[0]
    plain, dark = load(ref), load(exposed_ref(ref, 0.5, 1.0))
    np.testing.assert_array_equal(dark.left, plain.left)
    np.testing.assert_allclose(dark.right, 0.5 * plain.right, atol=0.51)
    assert load(exposed_ref(ref, 2.0, 1.0)).right.max() == 255
    assert dark.label == "folder/plane-gain0.5-gamma1"
    np.testing.assert_array_equal(load(exposed_ref(ref, 1.0, 1.0)).right, plain.right)


def test_a_cloud_seen_from_its_own_camera_is_the_image():
    K = np.array([[40.0, 0, 19.5], [0, 40.0, 14.5], [0, 0, 1]])
    image = np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    picture = render_cloud(np.full((30, 40), 2.0), image, K, np.eye(4))
    assert picture.shape == (round(30 * SHRINK), round(40 * SHRINK), 3)
    assert (picture < 255).all()
    colours = {tuple(c) for c in image.reshape(-1, 3)}
    assert {tuple(c) for c in picture.reshape(-1, 3)} <= colours


def test_the_nearest_point_wins_and_unknown_depth_is_white():
    K = np.array([[10.0, 0, 1.0], [0, 10.0, 1.0], [0, 0, 1]])
    depth_m = np.array([[3.0, 1.0, np.nan], [3.0, 0.0, np.inf], [3.0, 3.0, 3.0]])
    image = np.zeros((3, 3, 3), np.uint8)
    image[0, 1] = (9, 9, 9)
    far_away = np.diag([0.0, 0.0, 1.0, 1.0])  # every point moves onto the optical axis
    picture = render_cloud(depth_m, image, K, far_away)
    assert sorted(picture.reshape(-1, 3).min(1)) == [9, 255, 255, 255]


def test_orbit_keeps_its_centre():
    T = orbit(3.0)
    np.testing.assert_allclose(T @ [0, 0, 3, 1], [0, 0, 3, 1], atol=1e-12)
    camera = np.linalg.inv(T)[:3, 3]
    assert camera[0] < 0 and camera[1] < 0  # to the left and above


def test_maps_show_what_is_unknown_in_grey(tmp_path):
    figure = new_figure(2, 1)
    axes = figure.subplots(1, 2)
    depth_m = np.array([[1.0, np.nan], [0.0, 2.0]])
    depth = show_depth(axes[0], depth_m, 1.0, 2.0)
    error = show_error(axes[1], depth_m, np.full((2, 2), 2.0), np.array([[True, True], [True, False]]))
    assert depth.get_array().mask.tolist() == [[False, True], [True, False]]
    assert error.get_array().mask.tolist() == [[False, True], [True, True]]
    assert error.get_array()[0, 0] == pytest.approx(0.5)
    save_png(figure, tmp_path / "a" / "b.png")
    with Image.open(tmp_path / "a" / "b.png") as picture:
        assert picture.mode == "P"


def test_values_have_the_colours_of_their_range_and_marks_cover_them():
    axes = new_figure(1, 1).subplots()
    drawn = show_values(axes, np.array([[0.0, np.nan], [2.0, 9.0]]), "", "viridis", 0.0, 4.0)
    assert drawn.get_array().mask.tolist() == [[False, True], [False, False]]
    assert (drawn.norm.vmin, drawn.norm.vmax) == (0.0, 4.0)
    mark(axes, np.array([[True, False], [False, False]]), "#ff0000")
    painted = axes.images[-1].get_array()
    assert painted[0, 0].tolist() == [1, 0, 0, 1] and (painted[..., 3].sum() == 1)
