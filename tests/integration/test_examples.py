"""Every example runs as it stands, on a tiny random prior to be quick."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
#: Arguments that make an example small; an example without an entry fails below.
ARGUMENTS = {
    "depth_from_stereo": ["--steps", "1", "--out", "depth"],
    "posed_photographs": ["--steps", "1", "--size", "64", "96"],
}


def load(path: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def prior(make_pipeline, tmp_path):
    make_pipeline().save_pretrained(tmp_path / "prior")
    return tmp_path / "prior"


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_example_runs(path, prior, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    load(path).main([*ARGUMENTS[path.stem], "--prior", str(prior)])
    assert " m" in capsys.readouterr().out


def test_example_saves_metres(prior, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    load(EXAMPLES / "depth_from_stereo.py").main([*ARGUMENTS["depth_from_stereo"], "--prior", str(prior)])
    assert (np.load("depth.npy") > 0).all() and Path("depth.png").stat().st_size > 0


def test_world_poses_compose_to_the_relative_pose():
    E = np.eye(4)
    E[0, 3] = 0.3
    left, right = load(EXAMPLES / "posed_photographs.py").world_poses(E)
    np.testing.assert_allclose(np.linalg.inv(left) @ right, E, atol=1e-12)
    assert not np.allclose(left, np.eye(4))
