"""The eval commands on own images in Middlebury's layout, with the method that needs no prior."""

import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from geodiff_plugin._checks import InputError
from geodiff_plugin.cli.eval.app import eval_app
from geodiff_plugin.evaluation.baselines import FAMILIES, METHODS
from geodiff_plugin.evaluation.datasets import DATASETS
from geodiff_plugin.evaluation.options import COMMANDS
from geodiff_plugin.formats import write_pfm

SHIFT = 8


@pytest.fixture
def data(tmp_path):
    """Two scenes of a fronto-parallel textured wall, 8 px of disparity, 1.25 m away."""
    for seed, name in enumerate(("one", "two")):
        scene = tmp_path / "data" / name
        scene.mkdir(parents=True)
        wide = np.random.default_rng(seed).integers(0, 256, (48, 160, 3), dtype=np.uint8)
        Image.fromarray(wide[:, :144]).save(scene / "im0.png")
        Image.fromarray(wide[:, SHIFT : SHIFT + 144]).save(scene / "im1.png")
        write_pfm(scene / "disp0.pfm", np.full((48, 144), SHIFT, np.float32))
        (scene / "calib.txt").write_text(
            "cam0=[100 0 72; 0 100 24; 0 0 1]\ncam1=[100 0 72; 0 100 24; 0 0 1]\ndoffs=0\nbaseline=100\n"
            "width=144\nheight=48\nndisp=16\n"
        )
    return tmp_path / "data"


def invoke(*words):
    return CliRunner().invoke(eval_app, [str(word) for word in words], catch_exceptions=False)


def test_pairs_writes_every_table_and_prints_it(data, tmp_path):
    out, page = tmp_path / "out", tmp_path / "docs" / "results.md"
    result = invoke("pairs", data, "--methods", "sgbm", "--out", out, "--results", page)
    assert result.exit_code == 0
    assert "middlebury2014/one" in result.stdout and "mean of 2 pairs" in result.stdout
    assert page.read_text() == (out / "table.md").read_text()
    assert f"geodiff eval pairs {data} --methods sgbm" in page.read_text()
    assert r"\toprule" in (out / "table.tex").read_text()
    facts = json.loads((out / "table.json").read_text())
    assert facts["versions"]["torch"] and facts["tables"][0]["header"] == ["pair", "SGBM + fill"]
    lines = [json.loads(line) for line in (out / "samples.jsonl").read_text().splitlines()]
    assert [line["sample"] for line in lines] == ["one", "two"]
    assert all(line["all_pixels"]["raw"]["abs_rel"] < 0.05 for line in lines)


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_out_that_can_be_no_folder_is_told_at_once(tmp_path, command):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--out must be a folder; got the file"):
        invoke(command, *{"pairs": ["DIR"], "figure": ["terms"]}.get(command, ()), "--out", tmp_path / "file")


def test_pairs_selects_scenes(data, tmp_path):
    result = invoke("pairs", data, "--methods", "sgbm", "--scenes", "two", "-o", tmp_path / "out", "-q")
    assert result.exit_code == 0 and result.stdout == ""
    assert len((tmp_path / "out" / "samples.jsonl").read_text().splitlines()) == 1
    with pytest.raises(ValueError, match="a sample with three in its name"):
        invoke("pairs", data, "--methods", "sgbm", "--scenes", "three", "-o", tmp_path / "out")


def test_two_samples_of_one_name_are_refused(data, tmp_path):
    """As two resolutions of a set side by side: one result would stand for both."""
    shutil.copytree(data, data / "quarter")
    with pytest.raises(ValueError, match="with several middlebury2014/one"):
        invoke("pairs", data, "--methods", "sgbm", "-o", tmp_path / "out")
    assert invoke("pairs", data / "quarter", "--methods", "sgbm", "-o", tmp_path / "out").exit_code == 0


def test_pairs_names_bad_options(data, tmp_path):
    with pytest.raises(ValueError, match="methods"):
        invoke("pairs", data, "--methods", "magic", "-o", tmp_path / "out")
    with pytest.raises(ValueError, match="--limit must be between 1"):
        invoke("pairs", data, "--methods", "sgbm", "--limit", 0, "-o", tmp_path / "out")


def test_limit_counts_all_sets_together_and_says_so(tmp_path):
    """In a table of the paper each column is a set, which is limited by itself."""
    words = " ".join(invoke("pairs", "--help").stdout.replace("│", " ").split())
    assert "The first N samples alone; in a table of the paper, of each set." in words


def test_pairs_draws_a_seeded_sample(data, tmp_path):
    words = ("pairs", data, "--methods", "sgbm", "-o", tmp_path / "out", "--sample")
    picked = ["middlebury2014/two" in invoke(*words, 1, "--seed", seed).stdout for seed in (0, 1, 2, 3, 4, 0)]
    assert picked[0] == picked[-1] and set(picked) == {True, False}
    assert "Drawn with seed 0: middlebury2014/" in invoke(*words, 1).stdout
    with pytest.raises(ValueError, match="--sample must be at most 2"):
        invoke(*words, 3)


def test_pairs_reads_maps_made_elsewhere_and_writes_down_how(data, tmp_path):
    maps = tmp_path / "RAFT-Stereo"
    maps.mkdir()
    np.save(maps / "middlebury2014_one.npy", np.full((48, 144), SHIFT, np.float32))
    words = ("pairs", data, "--methods", f"files:disparity:{maps}", "--scenes", "one", "-o", tmp_path / "out")
    result = invoke(*words, "--crop", "eigen", "--prior", "one", "--prior", "two", "--space", "disparity")
    assert re.search(r"middlebury2014/one +0\.000\n", result.stdout) and "RAFT-Stereo" in result.stdout
    assert "--prior one --prior two --space disparity" in result.stdout
    assert (
        "--crop eigen" in result.stdout
        and "the crop 'eigen'" in result.stdout
        and "--seeds" not in result.stdout
    )
    seeded = invoke(*words, "--seed", 2, "--seeds", 3).stdout
    assert "--seeds 3" in seeded and "--seed 2" in seeded and "Spread" not in seeded
    assert "Every table but the spread over 3 seeds is of seed 2." in seeded
    with pytest.raises(ValueError, match="--crop must be one of"):
        invoke(*words, "--crop", "middle")


def test_pairs_goes_on_after_a_broken_sample_on_request(data, tmp_path):
    (data / "one" / "im1.png").unlink()
    words = ("pairs", data, "--methods", "sgbm,plane-sweep", "-o", tmp_path / "out")
    with pytest.raises(FileNotFoundError, match=r"im1\.png"):
        invoke(*words)
    said = invoke(*words, "--skip-broken").stdout
    assert "1 broken sample was skipped" in said and said.count("im1.png") == 1
    assert "(sgbm, plane-sweep)" in said


def test_list_tells_what_is_there(data):
    found = invoke("list", "--data", data).stdout
    assert re.search(r"middlebury2014 +2 samples", found) and re.search(r"kitti2015 +not found", found)
    assert "https://" in found and "guided" in found and "files:..." in found
    assert all(name in found for name in (*DATASETS, *METHODS, *FAMILIES))
    assert "no --data given" in invoke("list").stdout


def test_two_processes_share_the_samples(data, tmp_path):
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += [
        "-m",
        "geodiff_plugin",
        "eval",
        "pairs",
        str(data),
        "--methods",
        "sgbm",
        "-o",
        str(tmp_path / "out"),
    ]
    environment = os.environ | {"ACCELERATE_USE_CPU": "true", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert "2 processes" in done.stdout
    lines = [json.loads(line) for line in (tmp_path / "out" / "samples.jsonl").read_text().splitlines()]
    assert sorted(line["sample"] for line in lines) == ["one", "two"]
    assert {line["process"] for line in lines} <= {0, 1}
