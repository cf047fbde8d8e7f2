"""Other priors than Marigold from the command line, as a user would."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.contracts.tiny_priors import TINY


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
