"""Other priors than Marigold from the command line, as a user would."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.contracts.tiny_priors import TINY

#: Of a plane of 64 x 48 pixels, too small to check its pose by.
QUICK = ("--knob", "pose=given", "--knob", "inner_steps=0", "--device", "cpu")


@pytest.fixture
def saved(tmp_path):
    """Factory: the folder of a tiny prior."""

    def save(key: str):
        TINY[key]().save_pretrained(tmp_path / key)
        return tmp_path / key

    return save


@pytest.mark.parametrize(("key", "space"), [("lotus", "disparity"), ("depthmaster", "sqrt_disparity")])
def test_info_tells_what_the_adapter_found(geodiff, saved, key, space):
    folder = saved(key)
    (folder / "README.md").write_text("---\nlicense: cc-by-4.0\n---\n")
    answer = geodiff("info", "--prior", folder)
    assert answer.code == 0, answer.err
    told = dict(line.split("  ", 1) for line in answer.out.splitlines() if "  " in line)
    told = {name.strip(): value.strip() for name, value in told.items()}
    assert (told["adapter"], told["space"], told["licence"]) == (key, space, "cc-by-4.0")
    assert told["steps"] == "1 by default, at most 1"
    assert told["gradients"] == ("denoised" if key == "depthmaster" else "denoised, full")
    assert told["same every time"].startswith("yes" if key == "depthmaster" else "no")


def test_geowizard_with_its_option(geodiff, saved, pair_files):
    prior = ["--prior", saved("geowizard"), "--steps", "1", "--resolution", "32"]
    answer = geodiff(*pair_files.command, *prior, "--option", "domain=outdoor", "--out", "out")
    assert answer.code == 0, answer.err
    assert "(geowizard; licence unknown)" in answer.err
    normals = np.load("out/normals.npy")
    assert normals.shape == (*np.load("out/depth.npy").shape, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-3)
    report = json.loads((pair_files.folder / "out" / "report.json").read_text())
    assert "normals.npy" in report["files"]["names"]


def test_a_deterministic_prior_says_so(geodiff, saved, pair_files):
    prior = ["--prior", saved("e2e-ft"), "--ensemble", "3", "--resolution", "32", "--space", "disparity"]
    answer = geodiff(*pair_files.command, *prior, "--out", "out")
    assert answer.code == 0, answer.err
    assert "warning: This prior gives the same map every time" in answer.err
    assert not (pair_files.folder / "out" / "uncertainty.npy").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--option", "domain"], "--option must be NAME=VALUE"),
        (["--option", "domain=outdoor"], "--option must be one that marigold takes (none); got 'domain'"),
        (["--space", "metres"], "--space must be one of"),
        (["--prior", "developy/ApDepth"], "It is refused because"),
    ],
)
def test_bad_options(geodiff, saved, pair_files, options, said):
    prior = [] if "--prior" in options else ["--prior", saved("marigold")]
    answer = geodiff(*pair_files.command, *prior, *options, "--quiet")
    assert answer.code == 2 and said in answer.err and len(answer.err.splitlines()) == 1


def test_a_map_of_another_model_as_the_prior(geodiff, pair_files, textured_plane):
    np.save("map.npy", 1 / np.asarray(textured_plane.depth_m) + np.linspace(0, 1e-3, 64))
    options = ["--space", "disparity", *QUICK]
    answer = geodiff(*pair_files.command, "--prior-map", "map.npy", *options, "--out", "out")
    assert answer.code == 0, answer.err
    assert "prior: map (map; that of the model which made the map)" in answer.err
    depth_m, truth = np.load("out/depth.npy"), np.asarray(textured_plane.depth_m)
    assert np.median(np.abs(depth_m / truth - 1)) < 0.05
    for more, said in (
        (["--prior-map", "map.npy", "--prior", "somewhere"], "in place of a --prior"),
        (["--prior", "map"], "--prior map and no --prior-map"),
        (["--prior-map", "none.npy"], "none.npy"),
    ):
        answer = geodiff(*pair_files.command, *more, "--out", "other")
        assert answer.code == 2 and said in answer.err


def test_a_folder_of_maps(geodiff, pair_files, textured_plane):
    for folder in ("lefts", "rights", "maps"):
        Path(folder).mkdir()
    for name in ("a", "b"):
        Path("lefts", f"{name}.png").write_bytes(pair_files.left.read_bytes())
        Path("rights", f"{name}.png").write_bytes(pair_files.right.read_bytes())
        np.save(f"maps/{name}.npy", np.add.outer(np.arange(24.0), np.ones(32)))
    command = ["depth", "lefts", "rights", "--calib", pair_files.calib, "--prior-map", "maps", "--out", "out"]
    assert geodiff(*command, *QUICK).code == 0
    assert np.load("out/a/depth.npy").shape == np.load("out/b/depth.npy").shape
    np.save("maps/b.npy", np.add.outer(np.ones(24), np.arange(32.0)))
    answer = geodiff(*command, *QUICK)  # a map that changed is another input
    assert answer.code == 2 and "b.npy changed" in answer.err
    Path("maps/b.npy").unlink()
    answer = geodiff(*command, "--overwrite", *QUICK)
    assert answer.code == 2 and "maps without b{.npy" in answer.err
