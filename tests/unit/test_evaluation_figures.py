"""Every figure on one tiny pair with a tiny random prior, and the parts that they are drawn with."""

import json

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from geodiff_plugin.cli.eval import eval_app
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.figures import sweep_g_s
from geodiff_plugin.evaluation.options import FIGURES
from geodiff_plugin.formats import write_depth_npy


@pytest.fixture
def pair_folder(tmp_path, textured_plane):
    """The rendered plane as a folder of our own layout."""
    folder = tmp_path / "data" / "plane"
    folder.mkdir(parents=True)
    for side in ("left", "right"):
        Image.fromarray(getattr(textured_plane, side)).save(folder / f"{side}.png")
    write_depth_npy(folder / "depth.npy", textured_plane.depth_m)
    rows = " ".join(map(str, textured_plane.K.ravel()))
    (folder / "calib.txt").write_text(f"{rows}\n{textured_plane.E[0, 3]}\n")
    return tmp_path / "data"


@pytest.fixture
def draw(pair_folder, make_pipeline, tmp_path):
    """``draw(name, *words)`` -> picture and numbers."""
    make_pipeline().save_pretrained(tmp_path / "prior")

    def run(name, *words):
        out = tmp_path / "out"
        options = ("--data", pair_folder, "--prior", tmp_path / "prior", "--resolution", 64, "-o", out)
        given = [str(word) for word in ("figure", name, "--steps", 1, *options, *words)]
        answer = CliRunner().invoke(eval_app, given, catch_exceptions=False)
        assert answer.exit_code == 0 and answer.stdout == f"{out / f'figure-{name}.png'}\n"
        with Image.open(out / f"figure-{name}.png") as image:
            assert image.mode == "P"
            picture = np.asarray(image.convert("RGB"))
        assert picture.shape[0] > 100 and picture.std() > 5
        numbers = json.loads((out / f"figure-{name}.json").read_text())
        assert "eval figure" in numbers["command"] and f"--data {pair_folder}" in numbers["command"]
        return picture, numbers

    return run


#: Figure -> options, and what its numbers owe; the unchanged pair is in both panels of ``exposure``.
CASES = {
    "gs-sweep": (
        ["--max", 20],
        lambda n: n["g_s_m"][::79] == [1, 20] and len(n["loss"]) == len(n["abs_rel"]),
    ),
    "inner-steps": (
        ["--updates", "2,1"],
        lambda n: n["updates"] == [1, 2] and len(n["paper"]["seconds"]) == 2,
    ),
    "exposure": (
        ["--methods", "sweep-sgm,sgbm"],
        lambda n: n["gain"]["sgbm"][2] == n["gamma"]["sgbm"][2] > 0,
    ),
    "ablation": (["--methods", "prior-aligned,sgbm"], lambda n: len(n["abs_rel"]["folder/plane"]) == 2),
}


@pytest.mark.parametrize("name", [name for name in FIGURES if name != "qualitative"])
def test_a_figure_has_its_numbers_beside_it(draw, name):
    words, is_right = CASES[name]
    assert is_right(draw(name, *words)[1])


def test_qualitative_has_clouds_reasons_and_perturbed_poses(draw, pair_folder, tmp_path):
    words = ("--methods", "sgbm,sweep-sgm")
    without, _ = draw("qualitative", *words)
    with_clouds, numbers = draw("qualitative", *words, "--clouds")
    assert with_clouds.shape[0] > without.shape[0] and "--clouds" in numbers["command"]
    maps = tmp_path / "maps"
    maps.mkdir()
    write_depth_npy(maps / "folder_plane-turn3-shift0.1.npy", np.zeros((96, 128), np.float32))
    with Image.open(pair_folder / "plane" / "right.png") as right:
        right.crop((0, 0, 120, 96)).save(pair_folder / "plane" / "right.png")
    _, numbers = draw("qualitative", "--methods", f"files:{maps},sgbm", "--perturb", "3,0.1")
    # An empty map, and views of different sizes.
    assert numbers["abs_rel"] == {"folder/plane-turn3-shift0.1": {f"files:{maps}": None, "sgbm": None}}


def test_the_sweep_of_a_true_map_is_best_at_the_true_scale(textured_plane, pair_folder):
    sample = load(find_pairs(pair_folder)[0])
    sweep, rendered = sweep_g_s(sample, textured_plane.depth_m / 2.5, "depth", 10.0)
    g_s, loss, abs_rel = (sweep[name] for name in ("g_s_m", "loss", "abs_rel"))
    step = g_s[1] / g_s[0]
    assert 1 / step < g_s[abs_rel.argmin()] / 2.5 < step
    assert 1 / step**2 < g_s[loss.argmin()] / 2.5 < step**2
    assert sweep["visible"][-1] > sweep["visible"][0] and len(rendered) == 4
    assert {loss.argmin(), abs_rel.argmin(), len(g_s) - 1} <= set(rendered)
