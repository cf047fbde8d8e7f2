"""Scoring, resuming, statistics and tables, with methods that cost nothing."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from geodiff_plugin.evaluation.table import mean_with_interval, paired_difference

from geodiff_plugin.evaluation import experiment, scoring
from geodiff_plugin.evaluation.baselines import find_method, with_priors
from geodiff_plugin.evaluation.baselines.base import Method, NotApplicable, Prediction, Settings
from geodiff_plugin.evaluation.datasets.changed import with_perturbed_poses
from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample
from geodiff_plugin.evaluation.experiment import RECORDS_NAME, cell_key, headline
from geodiff_plugin.evaluation.scoring import matched, out_of_view, regions, score
from geodiff_plugin.evaluation.tables import (
    disparity_table,
    pairs_tables,
    per_pair_table,
    regions_table,
    uncertainty_table,
)
from tests.evaluating import run

SHAPE = (6, 8)
K = np.array([[10.0, 0, 3.5], [0, 10.0, 2.5], [0, 0, 1]])


def make_sample(name="a", rectified=True, **changes) -> StereoSample:
    E = np.eye(4)
    E[0, 3] = 0.5
    image = np.zeros((*SHAPE, 3), np.uint8)
    depth_m = np.full(SHAPE, 2.0, np.float32)
    depth_m[:, :2] = 5.0
    given = {
        "K_left": K,
        "K_right": K,
        "E": E,
        "depth_m": depth_m,
        "valid": depth_m > 0,
        "rectified": rectified,
    }
    return StereoSample("middlebury2014", name, image, image, **(given | changes))


def make_method(name, answer, calls, configuration=None):
    def measure(sample, settings, priors):
        calls.append((name, sample.name))
        return answer(sample)

    return Method(name, name, name, measure, lambda settings: configuration or {}, uses_prior=False)


@pytest.fixture
def bench(monkeypatch, tmp_path):
    """Two methods, three samples (the last one posed); returns ``go(**keywords)`` and the list of calls."""
    calls = []

    def rectified_only(sample):
        if not sample.rectified:
            raise NotApplicable("not rectified")
        return Prediction(depth_m=2 * sample.depth_m)

    methods = {
        "exact": make_method("exact", lambda s: Prediction(depth_m=s.depth_m.astype(float)), calls),
        "double": make_method("double", rectified_only, calls),
    }
    samples = {name: make_sample(name, name != "c") for name in "abc"}
    monkeypatch.setattr("geodiff_plugin.evaluation.baselines.METHODS", methods)
    monkeypatch.setattr(experiment, "load", lambda ref: samples[ref.name])
    refs = [SampleRef("middlebury2014", name, {"left": Path(name)}) for name in samples]

    def go(**keywords):
        calls.clear()
        return run(refs, ["exact", "double"], Settings(), tmp_path, **keywords)

    return go, calls, methods, samples, tmp_path / RECORDS_NAME


def test_score_of_a_perfect_map_and_its_double():
    sample = make_sample()
    exact = score(sample, Prediction(depth_m=sample.depth_m), cap_m=None)
    assert exact["all_pixels"]["raw"]["abs_rel"] == 0 and exact["disparity"]["epe"] == pytest.approx(
        0, abs=1e-6
    )
    double = score(sample, Prediction(depth_m=2 * sample.depth_m), cap_m=None)
    assert double["all_pixels"]["raw"]["abs_rel"] == pytest.approx(1)
    assert double["capped"]["aligned"]["abs_rel"] == pytest.approx(0, abs=1e-6)


def test_score_keeps_capped_and_all_pixels_apart():
    sample = make_sample()
    record = score(sample, Prediction(depth_m=np.full(SHAPE, 4.0)), cap_m=3.0)
    assert record["all_pixels"]["raw"]["pixels"] == 48 and record["capped"]["raw"]["pixels"] == 36
    assert record["capped"]["raw"]["abs_rel"] == pytest.approx(0.5)  # clipped from 4 to the cap of 3


def test_score_of_relative_depth_has_no_raw_column():
    sample = make_sample()
    record = score(sample, Prediction(None, relative=0.1 * sample.depth_m + 0.3), cap_m=None)
    assert record["all_pixels"]["raw"] is None and record["disparity"] is None
    assert record["all_pixels"]["aligned"]["abs_rel"] == pytest.approx(0, abs=1e-6)
    assert headline({"status": "ok"} | record) == pytest.approx(0, abs=1e-6)


def test_a_map_that_is_all_holes_has_no_errors_and_covers_nothing():
    record = score(make_sample(), Prediction(depth_m=np.full(SHAPE, np.nan), space="disparity"), cap_m=None)
    raw, aligned = record["all_pixels"]["raw"], record["all_pixels"]["aligned"]
    assert raw["abs_rel"] is aligned["abs_rel"] is None and raw["coverage"] == 0
    assert headline({"status": "ok"} | record) is None


def test_poses_given_wrongly_change_no_mask_and_no_true_disparity():
    sample = make_sample()
    wrong = with_perturbed_poses(sample, (20.0, 0.5), "a")
    assert not np.allclose(wrong.E, sample.E)
    np.testing.assert_array_equal(out_of_view(wrong), out_of_view(sample))
    double = Prediction(depth_m=2 * sample.depth_m)
    assert score(wrong, double, None)["disparity"] == score(sample, double, None)["disparity"]


def test_matched_pixels_go_by_the_true_poses(monkeypatch):
    swept = []

    def seen(sample, device):
        swept.append(sample.E)
        raise ValueError("no overlap")

    monkeypatch.setattr(scoring, "sweep", seen)
    sample = make_sample()
    assert matched(with_perturbed_poses(sample, (20.0, 0.5), "a")) is None
    np.testing.assert_array_equal(swept[0], sample.E)


def test_score_refuses_a_map_of_another_shape_and_a_sample_without_truth():
    with pytest.raises(ValueError, match="prediction.depth_m must be of the left image's shape"):
        score(make_sample(), Prediction(depth_m=np.ones((3, 3))), None)
    blind = make_sample(valid=np.zeros(SHAPE, bool))
    with pytest.raises(ValueError, match="the truth of middlebury2014/a"):
        score(blind, Prediction(depth_m=np.ones(SHAPE)), None)


def test_regions_split_what_the_right_camera_sees():
    occluded = np.zeros(SHAPE, bool)
    occluded[2, 5] = True
    material = np.zeros(SHAPE, np.uint8)
    material[:, 6:] = 3
    sample = make_sample(occluded=occluded, material=material)
    # Shift f b / z: 1 px at 5 m (columns 0, 1), 2.5 px at 2 m: column 0 leaves, and column 2 falls on -0.5.
    assert out_of_view(sample)[0].tolist() == [True] + [False] * 7
    masks = regions(sample)
    assert masks["occluded"].sum() == 1 and masks["visible"].sum() == 48 - 6 - 1
    assert masks["material_3"].sum() == 12
    assert set(score(sample, Prediction(depth_m=sample.depth_m), None)["regions"]) == set(masks)


def test_uncertainty_is_scored():
    sample = make_sample()
    pred = sample.depth_m + np.arange(48).reshape(SHAPE) / 100
    record = score(sample, Prediction(depth_m=pred, uncertainty=np.abs(pred / sample.depth_m - 1)), None)
    assert record["ause"] == pytest.approx(0, abs=1e-9)


def test_run_measures_everything_once_and_resumes(bench):
    go, calls, _, _, path = bench
    first = go()
    assert len(calls) == 6 and [r["status"] for r in first].count("not applicable") == 1
    assert go() == first and calls == []
    assert len(path.read_bytes().splitlines()) == 6


@pytest.mark.parametrize("cut", [2, 40, 400])
def test_killed_run_does_only_what_is_missing(bench, cut):
    go, calls, _, _, path = bench
    first = go()
    os.truncate(path, path.stat().st_size - cut)
    whole = path.read_bytes().count(b"\n")
    again = go()
    assert len(calls) == 6 - whole
    drop = {"seconds"}
    assert [{k: v for k, v in r.items() if k not in drop} for r in again] == [
        {k: v for k, v in r.items() if k not in drop} for r in first
    ]


def test_another_configuration_is_another_result(bench):
    go, calls, methods, _, _ = bench
    go()
    methods["double"] = make_method("double", lambda s: Prediction(3 * s.depth_m), calls, {"factor": 3})
    records = go()
    assert {name for name, _ in calls} == {"double"} and len(calls) == 3
    assert headline(records[1]) == pytest.approx(2)


def test_broken_sample_stops_or_is_counted_and_tried_again(bench, monkeypatch):
    go, calls, _, samples, path = bench

    def fails(ref):
        if ref.name == "b":
            raise FileNotFoundError("left.png is missing")
        return samples[ref.name]

    monkeypatch.setattr(experiment, "load", fails)
    with pytest.raises(FileNotFoundError, match=r"left\.png"):
        go()
    records = go(skip_broken=True)
    assert [r["status"] for r in records] == ["ok", "ok", "broken", "broken", "ok", "not applicable"]
    assert records[2]["error"] == "left.png is missing"
    monkeypatch.setattr(experiment, "load", lambda ref: samples[ref.name])
    assert [r["status"] for r in go()] == ["ok"] * 5 + ["not applicable"]
    assert {name for _, name in calls} == {"b"}


def test_depth_maps_are_saved_on_request(bench):
    go, _, _, samples, path = bench
    go(save_depth=True)
    saved = np.load(path.parent / "depth" / "double" / "middlebury2014_a.npy")
    np.testing.assert_array_equal(saved, 2 * samples["a"].depth_m)
    again = find_method(f"files:{path.parent / 'depth' / 'double'}").run(samples["a"], Settings(), None)
    np.testing.assert_array_equal(again.depth_m, saved)
    assert not (path.parent / "depth" / "double" / "middlebury2014_c.npy").exists()


def test_a_saved_map_is_that_of_the_record(bench):
    """Another configuration leaves its map in the same place."""
    go, calls, methods, _, path = bench
    one = methods["exact"]
    two = make_method(
        "exact", lambda s: Prediction(depth_m=3.0 * s.depth_m), calls, configuration={"knob": 1}
    )
    target = path.parent / "depth" / "exact" / "middlebury2014_a.npy"
    maps = []
    for method in (one, two, one):
        methods["exact"] = method
        go(save_depth=True)
        maps.append(np.load(target))
    assert calls.count(("exact", "a")) == 1 and maps[1][0, 0] == 15.0
    np.testing.assert_array_equal(maps[0], maps[2])
    go(save_depth=True)
    assert ("exact", "a") not in calls


def test_a_finished_run_that_saved_no_maps_saves_them_when_asked(bench):
    go, calls, _, _, path = bench
    first = go()
    assert [r["status"] for r in go(save_depth=True)] == [r["status"] for r in first]
    assert len(calls) == 5 and len(list(path.parent.glob("depth/*/*.npy"))) == 5
    go(save_depth=True)
    assert calls == []


def test_tables_hold_pairs_means_and_differences(bench):
    pairs, seconds, versus, *summaries = pairs_tables_of(bench[0]())
    assert pairs.header == ("pair", "exact", "double")
    assert pairs.rows[0] == ("middlebury2014/a", "0.000", "1.000")
    assert pairs.rows[2] == ("middlebury2014/c", "0.000", "-")
    means = {row[0]: row[1:] for row in pairs.rows[3:]}
    assert means["mean of 3 pairs"] == ("0.000", "-")
    assert means["mean of 2 rectified pairs"] == ("0.000", "1.000") and means["mean of 1 posed pair"] == (
        "0.000",
        "-",
    )
    assert versus.rows == (("double", "2", "-1.000", "2 of 2"),)
    assert "| middlebury2014/a | 0.000 | 1.000 |" in pairs.markdown()
    assert r"middlebury2014/a & 0.000 & 1.000 \\" in pairs.latex()
    assert [table.title for table in summaries] == [
        "All metrics, 3 pairs",
        "All metrics, 2 rectified pairs",
        "All metrics, 1 posed pair",
        "AbsRel by region and material",
        "Disparity, rectified pairs",
        "Disparity by region, rectified pairs",
        "Boundaries, dense truth",
    ]
    assert [row[0] for row in summaries[0].rows] == ["exact", "exact, aligned", "double", "double, aligned"]


def test_detail_tables_say_where_and_whether_it_knows():
    hidden, glass = np.zeros(SHAPE, bool), np.zeros(SHAPE, np.uint8)
    hidden[:, 4:] = True
    glass[:, 6:] = 3
    with_masks, without = make_sample("a", occluded=hidden, material=glass), make_sample("b")
    records = []
    for sample, factor in ((with_masks, 2.0), (without, 3.0)):
        spread = np.ones(SHAPE)
        prediction = Prediction(factor * sample.depth_m, uncertainty=spread)
        head = {"dataset": sample.dataset, "sample": sample.name, "method": "guided", "status": "ok"}
        records.append(head | score(sample, prediction, None))
    regions_, disparity = regions_table(records), disparity_table(records)
    assert regions_.header == (
        "method",
        "visible (1 pair)",
        "occluded (1 pair)",
        "out of view (2 pairs)",
        "matched",
        "unmatched",
        "ToM (1 pair)",
        "other material (1 pair)",
        "class 0 (1 pair)",
        "class 3 (1 pair)",
    )
    # The images are too small to be matched.
    assert regions_.rows == (("guided", "1.000", "1.000", "1.500", "-", "-", *["1.000"] * 4),)
    # A doubled depth halves the shift of f b / z = 5 / z: by 0.5 px in 12 of 48 pixels, by 1.25 px in 36; a
    # tripled one by 0.667 and 1.667 px.
    epe = (0.25 * 0.5 + 0.75 * 1.25 + 0.25 * 2 / 3 + 0.75 * 5 / 3) / 2
    assert disparity.rows == (("guided", f"{epe:.3f}", "0.750", "0.000", "0.000", "0.000"),)
    assert uncertainty_table(records).rows == (("guided", "2", "0.000"),)
    bare = [records[1] | {"disparity": None, "ause": None, "regions": {}}]
    assert [table(bare).rows for table in (regions_table, disparity_table, uncertainty_table)] == [()] * 3


def test_crop_is_scored_and_is_another_result(bench):
    go, calls, _, samples, path = bench
    go()
    for name in samples:
        image = np.zeros((375, 1242, 3), np.uint8)
        depth_m = np.full(image.shape[:2], 2.0, np.float32)
        depth_m[0] = 4.0
        changed = {"left": image, "right": image, "depth_m": depth_m, "valid": depth_m > 0}
        samples[name] = replace(samples[name], **changed)
    records = go(crop="benchmark")
    assert len(calls) == 6 and records[0]["all_pixels"]["raw"]["pixels"] == 352 * 1216
    samples["a"] = replace(samples["a"], valid=samples["a"].depth_m > 3)
    with pytest.raises(ValueError, match="the truth of middlebury2014/a must be known somewhere in the crop"):
        experiment._cropped(samples["a"], "garg")


def test_further_priors_give_further_rows(bench, monkeypatch):
    go, calls, methods, _, path = bench
    methods["exact"] = replace(methods["exact"], uses_prior=True)
    monkeypatch.setattr(experiment.PriorCache, "fingerprint", lambda self, settings: settings.prior[::-1])
    names = with_priors(["exact", "double"], ["org/other"])
    assert names == ("exact", "double", "exact@org/other")
    refs = [SampleRef("middlebury2014", "a", {})]
    records = run(refs, names, Settings(), path.parent)
    assert [r["method"] for r in records] == list(names)
    assert per_pair_table(records, "", headline, 3, "").header == ("pair", "exact", "double", "exact (other)")
    calls.clear()
    # The other prior alone, named first: the same result under its plain name.
    again = run(refs, ["exact"], Settings(prior="org/other"), path.parent)
    assert calls == [] and again[0]["method"] == "exact" and again[0]["key"] == records[2]["key"]
    with pytest.raises(ValueError, match="METHOD@PRIOR with a method that uses a prior"):
        find_method("double@org/other")


def pairs_tables_of(records):
    return pairs_tables(records, reference="exact")


def test_key_depends_on_everything_but_where_the_files_lie(tmp_path, monkeypatch):
    def key(folder="here", method="guided", configuration=None, prior="bundled 12", **files):
        files = {"group": Path(f"/{folder}/scan"), "left": 0, "right": None, **files}
        ref = SampleRef("mvsnet", "scan", files)
        return cell_key(ref, method, configuration or {"seed": 0}, prior)

    assert key() == key("there")
    for name, text in (("a", "1.0"), ("b", "2.0"), ("c", "1.0")):
        (tmp_path / name).write_text(text)
    depths = [key(depth=tmp_path / name) for name in "abc"]
    assert depths[0] == depths[2]
    others = [key(right=2), key(method="paper"), key(configuration={"seed": 1}), key(prior="bundled 13")]
    monkeypatch.setattr(experiment, "__version__", "0.2.0")
    assert len({key("there"), *others, *depths, key()}) == len(others) + 3


def test_interval_covers_the_mean_and_needs_five():
    assert mean_with_interval([1, 2, 3, 4]).low is None
    mean = mean_with_interval([1, 2, 3, 4, 5])
    assert mean.low < mean.value == 3 < mean.high
    assert mean == mean_with_interval([1, 2, 3, 4, 5])
    same = mean_with_interval([2.0] * 6)
    assert (same.low, same.value, same.high) == (2, 2, 2)


def test_interval_width_is_that_of_the_normal_theory():
    values = np.random.default_rng(3).normal(size=400)
    mean = mean_with_interval(values)
    assert mean.high - mean.low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)


def test_paired_difference_uses_the_shared_images_only():
    difference = paired_difference({"a": 1.0, "b": 3.0}, {"b": 1.0, "c": 9.0})
    assert (difference.value, difference.count) == (2, 1)


def test_settings_are_checked():
    with pytest.raises(ValueError, match="ensemble must be at least 1"):
        Settings(ensemble=0)
    with pytest.raises(ValueError, match="dtype"):
        Settings(dtype="int8")
