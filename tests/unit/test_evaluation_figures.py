"""Every figure on one tiny pair with a tiny random prior, and the parts that they are drawn with."""

import json

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from geodiff_plugin.algorithm.terms import TERMS, Term
from geodiff_plugin.cli.eval import eval_app
from geodiff_plugin.config import DEFAULT_WEIGHTS
from geodiff_plugin.evaluation.baselines import METHODS, PriorCache, Settings
from geodiff_plugin.evaluation.baselines.guided import call_arguments
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.figures import FIGURES
from geodiff_plugin.evaluation.figures.canvas import (
    colour_bar,
    depth_scale,
    mark,
    new_figure,
    relative_error,
    save_png,
    show_map,
    value_scale,
)
from geodiff_plugin.evaluation.figures.curves import sweep_g_s
from geodiff_plugin.evaluation.figures.maps import SHRINK, orbit, render_cloud
from geodiff_plugin.evaluation.figures.one_pair import term_by_term
from geodiff_plugin.formats import write_depth_npy
from geodiff_plugin.guidance.guidance import GeometryGuidance


@pytest.fixture
def pair_folder(tmp_path, textured_plane):
    """The rendered plane as a folder of our own layout."""
    folder = tmp_path / "data" / "plane"
    folder.mkdir(parents=True)
    for side in ("left", "right"):
        Image.fromarray(getattr(textured_plane, side)).save(folder / f"{side}.png")
    write_depth_npy(folder / "depth.npy", textured_plane.depth_m)
    K, (height, width) = textured_plane.K, textured_plane.depth_m.shape
    camera = f"[{K[0, 0]} 0 {K[0, 2]}; 0 {K[1, 1]} {K[1, 2]}; 0 0 1]"
    (folder / "calib.txt").write_text(
        f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline={1000 * textured_plane.E[0, 3]}\n"
        f"width={width}\nheight={height}\nndisp=64\n"
    )
    return tmp_path / "data"


@pytest.fixture
def prior(make_pipeline, tmp_path):
    make_pipeline().save_pretrained(tmp_path / "prior")
    return tmp_path / "prior"


@pytest.fixture
def draw(pair_folder, prior, tmp_path):
    """``draw(name, *words)`` -> picture and numbers."""

    def run(name, *words):
        out = tmp_path / "out"
        options = ("--data", pair_folder, "--prior", prior, "--steps", 1, "--resolution", 64, "-o", out)
        given = [str(word) for word in ("figure", name, *options, *words)]
        answer = CliRunner().invoke(eval_app, given, catch_exceptions=False)
        assert answer.exit_code == 0 and answer.stdout == f"{out / f'figure-{name}.png'}\n"
        picture = np.asarray(Image.open(out / f"figure-{name}.png").convert("RGB"))
        assert picture.shape[0] > 100 and picture.std() > 5
        numbers = json.loads((out / f"figure-{name}.json").read_text())
        assert "eval figure" in numbers["command"] and f"--data {pair_folder}" in numbers["command"]
        return picture, numbers

    return run


def check_gs_sweep(numbers):
    assert len(numbers["g_s_m"]) == len(numbers["loss"]) == len(numbers["abs_rel"])
    assert numbers["g_s_m"][0] == 1 and numbers["g_s_m"][-1] == pytest.approx(20)
    assert "--max 20" in numbers["command"]


def check_inner_steps(numbers):
    assert numbers["updates"] == [1, 2]
    assert all(len(numbers[preset]["seconds"]) == 2 for preset in ("guided", "paper"))


def check_exposure(numbers):
    assert numbers["gain"]["values"] == numbers["gamma"]["values"] == [0.5, 0.7, 1.0, 1.4, 2.0]
    # The unchanged pair is in both panels.
    assert numbers["gain"]["sgbm"][2] == numbers["gamma"]["sgbm"][2] is not None


def check_ablation(numbers):
    assert set(numbers["abs_rel"]["folder/plane"]) == {"prior-aligned", "search-only"}


def check_terms(numbers):
    assert set(numbers["abs_rel"]) == {"first", "denoised", "final"}
    assert set(numbers["terms"]) == {"photometric", "matches", "prior_pull", "anchor", "weighted sum"}
    assert all(len(values) == 2 for values in numbers["terms"].values())  # two of the three steps are guided
    assert 0 < numbers["match_weight"] <= 1 and 0 < numbers["matched"] <= 1


CASES = {
    "gs-sweep": (["--max", 20], check_gs_sweep),
    "inner-steps": (["--updates", "2,1"], check_inner_steps),
    "exposure": (["--methods", "plane-sweep,sgbm"], check_exposure),
    "ablation": (["--methods", "prior-aligned,search-only"], check_ablation),
    "terms": (["--steps", 3], check_terms),
}


@pytest.mark.parametrize("name", [name for name in FIGURES if name not in ("qualitative", "epipolar")])
def test_figure(draw, name):
    words, check = CASES[name]
    check(draw(name, *words)[1])


def test_epipolar(tmp_path):
    words = ["figure", "epipolar", "--data", "synthetic:1@256x192", "-o", str(tmp_path)]
    assert CliRunner().invoke(eval_app, words, catch_exceptions=False).exit_code == 0
    numbers = json.loads((tmp_path / "figure-epipolar.json").read_text())
    assert numbers["median_px"]["as refined"] < numbers["median_px"]["as given"]


def test_qualitative_has_clouds_reasons_and_perturbed_poses(draw, pair_folder, tmp_path):
    words = ("--methods", "sgbm,plane-sweep")
    without, _ = draw("qualitative", *words)
    with_clouds, numbers = draw("qualitative", *words, "--clouds")
    assert with_clouds.shape[0] > without.shape[0] and "--clouds" in numbers["command"]
    maps = tmp_path / "maps"
    maps.mkdir()
    write_depth_npy(maps / "folder_plane-turn3-shift0.1.npy", np.zeros((96, 128), np.float32))
    _, numbers = draw("qualitative", "--methods", f"files:{maps}", "--perturb", "3,0.1")
    assert numbers["abs_rel"] == {"folder/plane-turn3-shift0.1": {f"files:{maps}": None}}  # an empty map
    text = (pair_folder / "plane" / "calib.txt").read_text()
    (pair_folder / "plane" / "calib.txt").write_text(text.replace("cam1=[60", "cam1=[61", 1))
    _, numbers = draw("qualitative", *words)
    assert numbers["abs_rel"]["folder/plane"]["sgbm"] is None  # not rectified any more


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["pie"], "the figure must be one of"),
        (["inner-steps", "--updates", "1,a"], "--updates must be whole numbers"),
        (["gs-sweep", "--max", "1"], "--max must be between"),
        (["terms", "--ensemble", 2], "ensemble must be 1"),
    ],
)
def test_bad_options_are_named(draw, words, said):
    with pytest.raises(ValueError, match=said):
        draw(*words)


def test_terms_shows_the_guided_method_and_what_it_started_from(pair_folder, prior, monkeypatch):
    sample, settings = load(find_pairs(pair_folder)[0]), Settings(prior=str(prior), steps=2, resolution=64)
    priors = PriorCache()
    parts = term_by_term(sample, settings, priors)
    guided = METHODS["guided"].run(sample, settings, priors)
    np.testing.assert_array_equal(parts.final_m, guided.depth_m)
    np.testing.assert_array_equal(parts.confidence, guided.confidence)
    used = []  # the call itself rejected the same matches at its own first estimate

    def spy(estimate):
        used.append(estimate.matches.confidence)
        return 0.0 * estimate.z0.flatten(1).mean(1)

    monkeypatch.setitem(TERMS, "spy", Term(spy, "matches"))
    views = sample.right, (sample.K_left, sample.K_right), sample.E
    guidance = GeometryGuidance(*views, weights=DEFAULT_WEIGHTS | {"spy": 1.0})
    priors.get(settings)(Image.fromarray(sample.left), guidance=guidance, **call_arguments(settings))
    let_in = np.nan_to_num(parts.match_weight) > 0
    assert let_in.mean() > 0.3
    np.testing.assert_allclose(parts.match_weight[let_in], used[0][0, 0].numpy()[let_in], atol=1e-3)
    matched = np.isfinite(parts.matches_m)
    assert np.median(np.abs(parts.matches_m / sample.depth_m - 1.0)[matched]) < 0.02
    np.testing.assert_array_equal(np.isfinite(parts.residual), matched)
    nearer = (parts.final_m < parts.matches_m)[matched]
    np.testing.assert_array_equal(parts.residual[matched] > 0, nearer)
    # The right camera is to the right: it does not see the left edge of a plane, and nothing hides the rest.
    assert np.isnan(parts.difference[:, 0]).all() and np.isfinite(parts.difference[:, -1]).all()
    assert not (parts.hidden & np.isnan(parts.difference)).any() and parts.hidden.mean() < 0.05


def test_the_sweep_of_a_true_map_is_best_at_the_true_scale(textured_plane, pair_folder):
    sample = load(find_pairs(pair_folder)[0])
    sweep = sweep_g_s(sample, textured_plane.depth_m / 2.5, "depth", 10.0)
    step = sweep.g_s[1] / sweep.g_s[0]
    assert 1 / step < sweep.g_s[sweep.abs_rel.argmin()] / 2.5 < step
    assert 1 / step**2 < sweep.g_s[sweep.loss.argmin()] / 2.5 < step**2
    assert sweep.visible[-1] > sweep.visible[0] and len(sweep.rendered) == 4
    assert {sweep.loss.argmin(), sweep.abs_rel.argmin(), len(sweep.g_s) - 1} <= set(sweep.rendered)


def test_clouds_from_their_own_camera_and_from_another():
    K = np.array([[40.0, 0, 19.5], [0, 40.0, 14.5], [0, 0, 1]])
    image = np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    picture = render_cloud(np.full((30, 40), 2.0), image, K, np.eye(4))
    assert picture.shape == (round(30 * SHRINK), round(40 * SHRINK), 3) and (picture < 255).all()
    colours = {tuple(c) for c in image.reshape(-1, 3)}
    assert {tuple(c) for c in picture.reshape(-1, 3)} <= colours
    K = np.array([[10.0, 0, 1.0], [0, 10.0, 1.0], [0, 0, 1]])
    depth_m = np.array([[3.0, 1.0, np.nan], [3.0, 0.0, np.inf], [3.0, 3.0, 3.0]])
    image = np.zeros((3, 3, 3), np.uint8)
    image[0, 1] = (9, 9, 9)
    on_the_axis = np.diag([0.0, 0.0, 1.0, 1.0])  # every point moves there: the nearest wins
    assert sorted(render_cloud(depth_m, image, K, on_the_axis).reshape(-1, 3).min(1)) == [9, 255, 255, 255]
    T = orbit(3.0)
    np.testing.assert_allclose(T @ [0, 0, 3, 1], [0, 0, 3, 1], atol=1e-12)
    camera = np.linalg.inv(T)[:3, 3]
    assert camera[0] < 0 and camera[1] < 0  # to the left and above


def test_maps_show_what_is_unknown_in_grey_and_marks_cover_them(tmp_path, pair_folder):
    figure = new_figure(2, 1)
    axes = figure.subplots(1, 2)
    depth = show_map(axes[0], np.array([[1.0, np.nan], [np.inf, 2.0]]), depth_scale(1.0, 2.0))
    assert depth.get_array().mask.tolist() == [[False, True], [True, False]]
    scale = value_scale("viridis", 0.0, 4.0, "quantity, unit")
    drawn = show_map(axes[1], np.array([[0.0, np.nan], [2.0, 9.0]]), scale)
    assert (drawn.norm.vmin, drawn.norm.vmax) == (0.0, 4.0)
    colour_bar(figure, drawn, [axes[1]], scale, "bottom", "max")
    mark(axes[1], np.array([[True, False], [False, False]]), "#ff0000")
    painted = axes[1].images[-1].get_array()
    assert painted[0, 0].tolist() == [1, 0, 0, 1] and (painted[..., 3].sum() == 1)
    save_png(figure, tmp_path / "a" / "b.png")
    with Image.open(tmp_path / "a" / "b.png") as picture:
        assert picture.mode == "P"
    sample = load(find_pairs(pair_folder)[0])
    error = relative_error(np.where(sample.depth_m > 2.5, 0.0, 2 * sample.depth_m), sample)
    np.testing.assert_array_equal(np.isnan(error), sample.depth_m > 2.5)
    assert np.nanmin(error) == pytest.approx(1.0)
