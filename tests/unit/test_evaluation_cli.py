"""The eval commands on own images in Middlebury's layout and on rendered ones, with methods that are free."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin.evaluation import experiment
from geodiff_plugin.evaluation.baselines import FAMILIES, METHODS
from geodiff_plugin.evaluation.calibrations import run_poses
from geodiff_plugin.evaluation.datasets import DATASETS, find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import changed_ref
from geodiff_plugin.evaluation.options import PosesOptions
from tests.evaluating import invoke, write_scenes


@pytest.fixture
def data(tmp_path):
    return write_scenes(tmp_path / "data", "one", "two")


def lines_of(out):
    return [json.loads(line) for line in (out / "samples.jsonl").read_text().splitlines()]


def test_pairs_writes_every_table_and_prints_it(data, tmp_path):
    out, page = tmp_path / "out", tmp_path / "docs" / "results.md"
    said = invoke("pairs", data, "--methods", "sgbm", "--out", out, "--results", page)
    assert "middlebury2014/one" in said and "mean of 2 pairs" in said
    assert page.read_text() == (out / "table.md").read_text()
    assert f"geodiff eval pairs {data} --methods sgbm" in page.read_text()
    facts = json.loads((out / "table.json").read_text())
    assert facts["versions"]["torch"] and facts["tables"][0]["header"] == ["pair", "SGBM + fill"]
    assert [line["sample"] for line in lines_of(out)] == ["one", "two"]
    assert all(line["all_pixels"]["raw"]["abs_rel"] < 0.05 for line in lines_of(out))


def test_pairs_selects_draws_and_says_so(data, tmp_path):
    words = ("pairs", data, "--methods", "sgbm", "-o", tmp_path / "out")
    assert invoke(*words, "--scenes", "two", "-q") == "" and len(lines_of(tmp_path / "out")) == 1
    drawn = [invoke(*words, "--sample", 1, "--seed", i) for i in (0, 1, 2, 3, 4, 0)]
    picked = ["middlebury2014/two" in said for said in drawn]
    assert picked[0] == picked[-1] and set(picked) == {True, False}
    assert "Drawn with seed 0: middlebury2014/" in drawn[0]


def test_pairs_goes_on_after_a_broken_sample_on_request_and_tries_it_again(data, tmp_path):
    picture = data / "one" / "im1.png"
    words = ("pairs", data, "--methods", "sgbm,sweep-sgm", "-o", tmp_path / "out")
    picture.rename(tmp_path / "kept.png")
    with pytest.raises(FileNotFoundError, match=r"im1\.png"):
        invoke(*words)
    said = invoke(*words, "--skip-broken")
    assert "1 broken sample was skipped" in said and said.count("im1.png") == 1
    assert "(sgbm, sweep-sgm)" in said
    (tmp_path / "kept.png").rename(picture)
    assert "broken" not in invoke(*words)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("pairs DATA --methods magic", "methods"),
        ("pairs DATA --limit 0", "--limit must be between 1"),
        ("pairs DATA --sample 3", "--sample must be at most 2"),
        ("pairs DATA --scenes three", "a sample with three in its name"),
        ("pairs TWICE --methods sgbm", "with several middlebury2014/one"),
        ("poses", "--data must be given, or --rendered above 0"),
        ("poses --rendered 1 --width 16", "--width must be between 64"),
        *((f"poses --rendered 1 --perturb {text}", "--perturb") for text in ("1.5", "1..2,0.1", "99,0")),
        *((f"poses --rendered 1 --drift {text}", "--drift") for text in ("0.3", "a,b", "9,1", "0.3,99")),
    ],
)
def test_bad_options_are_named(data, tmp_path, words, said):
    shutil.copytree(data, tmp_path / "twice" / "full")
    shutil.copytree(data, tmp_path / "twice" / "quarter")
    folders = {"DATA": data, "TWICE": tmp_path / "twice"}
    with pytest.raises(ValueError, match=said):
        invoke(*(folders.get(word, word) for word in words.split()), "-o", tmp_path / "out")


def test_list_tells_what_is_there(data):
    said = invoke("list", "--data", data)
    assert re.search(r"middlebury2014 +2 samples", said) and re.search(r"kitti2015 +not found", said)
    assert all(name in said for name in ("https://", *DATASETS, *METHODS, *FAMILIES))


def test_changed_samples_differ_in_what_was_changed_only():
    (ref,) = find_pairs("synthetic:1@96x72")
    sample = load(ref)

    def changed(kind, *change):
        other = load(changed_ref(ref, kind, change))
        for name in ("left", "depth_m", "K_right"):
            assert np.array_equal(getattr(other, name), getattr(sample, name))
        assert np.array_equal(other.E, sample.E) == (kind != "perturbed")
        return other

    wrong, again = (changed("perturbed", 1.5, 0.1) for _ in range(2))
    assert np.array_equal(wrong.E, again.E) and np.array_equal(wrong.right, sample.right)
    assert wrong.name == "seed0000-turn1.5-shift0.1" and np.array_equal(wrong.E_scored, sample.E)
    turn = Rotation.from_matrix(wrong.E[:3, :3] @ sample.E[:3, :3].T).magnitude()
    baseline, shift = (np.linalg.norm(E[:3, 3]) for E in (sample.E, wrong.E - sample.E))
    assert 0.3 * 1.5 <= np.degrees(turn) <= 1.5 and 0 < shift < 0.12 * baseline
    assert np.linalg.norm(wrong.E[:3, 3]) == pytest.approx(baseline)
    moved, turned = changed("drifted", 0.0, 2.0), changed("drifted", 0.3, 1.5)
    down, up = (np.array_equal(moved.right[10:60], sample.right[10 - px : 60 - px]) for px in (2, -2))
    assert down or up, "by whole pixels nothing is interpolated"
    assert np.abs(turned.right.astype(int) - sample.right).mean() > 1
    dark = changed("right_exposure", 0.5, 1.0)
    np.testing.assert_allclose(dark.right, 0.5 * sample.right, atol=0.51)


def test_the_page_of_poses(tmp_path, monkeypatch):
    """Two rendered pairs: estimated, one has no pose and the other is off by half without a word."""
    sizes = set()

    def measure(ref, read, method, settings, priors, path):
        pose = method.name.partition("=")[2]
        sizes.add(ref.files["size"])
        errors = {"given": 0.1, "refine": 0.06, "estimated": None if ref.files["seed"] > 1 else 0.5}
        error = 0.05 if "perturbed" not in ref.files and pose == "given" else errors[pose]
        warnings = [] if pose == "estimated" else ["said"]
        notes = {"method": {"warnings": warnings, "residual_px_given": [1.25], "residual_px": [0.5]}}
        status = {"rectified": False, "status": "not applicable" if error is None else "ok"}
        return status | {"all_pixels": {"raw": {"abs_rel": error}, "aligned": None}, "notes": notes}

    monkeypatch.setattr(experiment, "_measure", measure)
    page = tmp_path / "docs" / "results-pose.md"
    options = PosesOptions(rendered=2, out=tmp_path / "out", results=page, quiet=True)
    run_poses("poses", options)
    for line in (
        "    geodiff eval poses --rendered 2",
        "| pair | true, given | perturbed, given | perturbed, refined | estimated |",
        "| mean of 2 pairs | 0.050 | 0.100 | 0.060 | 0.500 of 1 |",
        "| without a result | 0 | 0 | 0 | 1 |",
        "| off by more than 0.25, no warning | 0 | 0 | 0 | 1 |",
    ):
        assert line in page.read_text().splitlines()
    run_poses("poses", replace(options, width=256, steps=2, out=tmp_path / "small"))
    assert "geodiff eval poses --steps 2 --rendered 2 --width 256\n" in page.read_text()
    assert sizes == {(384, 512), (192, 256)}
