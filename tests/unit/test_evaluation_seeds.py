"""Methods with further seeds: names, results of their own, one table of their spread."""

from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin.evaluation import experiment
from geodiff_plugin.evaluation.baselines import find_method, with_priors, with_seeds
from geodiff_plugin.evaluation.baselines.base import Method, Prediction, Settings
from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample
from geodiff_plugin.evaluation.experiment import headline
from geodiff_plugin.evaluation.tables import groups, pairs_tables, spread_table, without_copies
from tests.evaluating import run

SIZES = {"a": 0.1, "b": 0.2, "c": 0.4}
REFS = [SampleRef("middlebury2014", name, {"left": Path(name)}) for name in SIZES]


def make_sample(name):
    K, E = np.array([[10.0, 0, 3.5], [0, 10.0, 2.5], [0, 0, 1]]), np.eye(4)
    E[0, 3] = 0.5
    image, depth_m = np.zeros((6, 8, 3), np.uint8), np.full((6, 8), 2.0, np.float32)
    return StereoSample(
        "middlebury2014", name, image, image, K, K, E, depth_m, depth_m > 0, rectified=name != "c"
    )


@pytest.fixture
def calls(monkeypatch):
    """Two methods, ``noisy`` with an AbsRel of its seed times ``SIZES``; the list of its calls."""
    made = []

    def noisy(sample, settings, priors):
        made.append((settings.seed, sample.name))
        return Prediction(sample.depth_m * (1 + SIZES[sample.name] * settings.seed))

    def exact(sample, settings, priors):
        return Prediction(sample.depth_m)

    methods = {
        "noisy": Method("noisy", "noisy", "", noisy, lambda settings: {"seed": settings.seed}, True),
        "exact": Method("exact", "exact", "", exact, lambda settings: {}, False),
    }
    monkeypatch.setattr("geodiff_plugin.evaluation.baselines.METHODS", methods)
    monkeypatch.setattr(experiment, "load", lambda ref: make_sample(ref.name))
    monkeypatch.setattr(experiment.PriorCache, "fingerprint", lambda self, settings: settings.prior[::-1])
    return made


def test_only_methods_with_a_prior_get_further_seeds(calls):
    assert with_seeds(["noisy", "exact"], 0, 3) == ("noisy", "exact", "noisy#1", "noisy#2")
    assert with_seeds(["noisy", "noisy#1"], 0, 2) == ("noisy", "noisy#1")
    assert with_seeds(["noisy"], 0, 1) == ("noisy",)
    assert with_seeds(with_priors(["noisy"], ["org/x"]), 4, 2)[2:] == ("noisy#5", "noisy@org/x#5")
    with pytest.raises(ValueError, match="seeds must be at least 1"):
        with_seeds(["noisy"], 0, 0)


def test_a_name_binds_a_prior_and_a_seed_once(calls):
    bound = find_method("noisy@org/x#3")
    assert (bound.prior, bound.seed, bound.base_name) == ("org/x", 3, "noisy")
    assert find_method(bound.name).title == "noisy (x), seed 3"
    for wrong in ("exact#1", "noisy#1#2"):
        with pytest.raises(ValueError, match="METHOD#SEED with a method that uses a prior"):
            find_method(wrong)
    with pytest.raises(ValueError, match="METHOD@PRIOR with a method that uses a prior"):
        find_method("noisy#1@org/x")
    with pytest.raises(ValueError, match="methods must be one of"):
        find_method("noisy#")


def test_a_seed_that_is_named_by_itself_is_a_row(calls, tmp_path):
    records = run(REFS, ["noisy#2", "exact"], Settings(), tmp_path)
    tables = pairs_tables(records, reference="exact")
    assert tables[0].header == ("pair", "noisy, seed 2", "exact")
    assert not any(table.title.startswith("Spread") for table in tables)


def test_another_seed_first_finds_the_same_record(calls, tmp_path):
    first = run(REFS, ["noisy", "noisy#2"], Settings(), tmp_path)
    assert len(calls) == 6
    calls.clear()
    again = run(REFS, ["noisy"], Settings(seed=2), tmp_path)
    assert calls == [] and {r["method"] for r in again} == {"noisy"}
    assert [r["key"] for r in again] == [r["key"] for r in first if r["method"] == "noisy#2"]


def test_further_seeds_have_one_table_and_no_part_in_others(calls, tmp_path):
    names = with_seeds(["noisy", "exact"], 0, 3)
    records = run(REFS, names, Settings(), tmp_path)
    assert {r["method"] for r in without_copies(records)} == {"noisy", "exact"}
    *others, spread = pairs_tables(records, reference="exact")
    assert others == pairs_tables(without_copies(records), reference="exact")
    assert spread.title == "Spread over 3 seeds"
    assert spread.rows == (
        ("noisy", "3 pairs", "0.2333", "0.2333", "0.0000", "0.4667", "0.8000", "middlebury2014/c"),
        ("noisy", "2 rectified pairs", "0.1500", "0.1500", "0.0000", "0.3000", "0.4000", "middlebury2014/b"),
        ("noisy", "1 posed pair", "0.4000", "0.4000", "0.0000", "0.8000", "0.8000", "middlebury2014/c"),
    )


def test_a_mean_over_seeds_needs_every_pair_of_each(calls, tmp_path):
    records = run(REFS, ["noisy", "noisy#1", "noisy#2"], Settings(), tmp_path)
    torn = [r for r in records if (r["method"], r["sample"]) != ("noisy#2", "c")]
    rows = spread_table(torn, groups(torn), headline).rows
    assert rows[0][2:] == ("-", "-", "-", "-", "0.4000", "middlebury2014/b")
    assert [row[1] for row in rows] == ["3 pairs", "2 rectified pairs"]
