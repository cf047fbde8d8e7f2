"""Every field of a record against metrics of explicit masks; pages, cells, keys and shards."""

import json
import os
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin.evaluation import experiment, metrics
from geodiff_plugin.evaluation.baselines import (
    Method,
    NotApplicable,
    Prediction,
    PriorCache,
    Settings,
    find_method,
)
from geodiff_plugin.evaluation.baselines.unguided import sweep
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import with_perturbed_poses
from geodiff_plugin.evaluation.experiment import RECORDS_NAME, out_of_view, regions, score
from geodiff_plugin.evaluation.tables import (
    DETAILS,
    Table,
    details_table,
    headline,
    mean_with_interval,
    pairs_tables,
)
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.jobs.journal import Item
from tests.evaluating import write_scenes

SHAPE, RIGHT = (18, 26), (14, 30)
CAP_M = 7.0


def make_sample(**changes) -> StereoSample:
    """Random depth from 1 to 9 m with holes; the right camera is turned and has another K and size."""
    rng = np.random.default_rng(0)
    E = np.eye(4)
    E[:3, :3] = Rotation.from_euler("xyz", (4, -9, 6), degrees=True).as_matrix()
    E[:3, 3] = 0.5, -0.1, 0.2
    given = {
        "left": rng.integers(0, 256, (*SHAPE, 3), np.uint8),
        "right": rng.integers(0, 256, (*RIGHT, 3), np.uint8),
        "K_left": np.array([[20.0, 0, 13.5], [0, 23.0, 7.5], [0, 0, 1]]),
        "K_right": np.array([[22.0, 0, 15.0], [0, 19.0, 6.0], [0, 0, 1]]),
        "E": E,
        "depth_m": rng.uniform(1, 9, SHAPE).astype(np.float32),
        "valid": rng.random(SHAPE) > 0.2,
        "occluded": rng.random(SHAPE) > 0.7,
        "material": rng.integers(0, 5, SHAPE).astype(np.uint8),
    }
    return StereoSample("booster", "a", **given | changes)


def make_rectified() -> StereoSample:
    """A rectified pair with offset principal points, and ground truth in steps."""
    E = np.eye(4)
    E[0, 3] = 0.5
    sample = make_sample(E=E, right=make_sample().left, rectified=True, notes={"disparity_step_px": 0.5})
    K = sample.K_left + [[0, 0, 1.25], [0, 0, 0], [0, 0, 0]]
    depth_m = np.where(np.arange(SHAPE[1]) < 11, 1.5, sample.depth_m).astype(np.float32)
    return replace(sample, K_right=K, depth_m=depth_m)


def outside(sample):
    """Pixel by pixel: ground truth that falls behind or next to the right image by the true pose."""
    out = np.zeros(sample.valid.shape, bool)
    for (v, u), z in np.ndenumerate(sample.depth_m):
        point = np.linalg.inv(sample.K_left) @ [u, v, 1.0] * z
        point = np.linalg.inv(sample.E_scored) @ [*point, 1.0]
        x, y, w = sample.K_right @ point[:3]
        height, width = sample.right.shape[:2]
        inside = w > 0 and -0.5 < x / w < width - 0.5 and -0.5 < y / w < height - 0.5
        out[v, u] = sample.valid[v, u] and not inside
    return out


def predict(sample, seed=1, **more) -> Prediction:
    rng = np.random.default_rng(seed)
    depth_m = sample.depth_m * np.exp(rng.normal(0, 0.2, SHAPE))
    depth_m[2:4, 5:9] = np.nan
    return Prediction(
        depth_m, uncertainty=rng.random(SHAPE), confidence=rng.random(SHAPE), space="disparity", **more
    )


@pytest.fixture
def matches(monkeypatch):
    """A mask in place of our sweep's."""
    mask = np.random.default_rng(9).random(SHAPE) > 0.4
    monkeypatch.setattr(experiment, "matched", lambda sample: mask)
    return mask


def plain(scores):
    return {k: None if np.isnan(v) else pytest.approx(v, rel=1e-6) for k, v in scores.items()}


def test_regions_equal_a_loop_and_split_the_ground_truth(matches):
    for sample in (make_sample(), make_sample(E=np.eye(4), E_true=make_sample().E)):
        away, masks = outside(make_sample()), experiment.regions(sample)
        assert 20 < away.sum() < 0.8 * sample.valid.sum()
        valid, hidden = sample.valid, sample.occluded
        expected = {
            "out_of_view": away,
            "matched": matches,
            "unmatched": ~matches,
            "occluded": hidden & ~away,
            "visible": ~hidden & ~away,
            "tom": (sample.material == 2) | (sample.material == 3),
            "not_tom": (sample.material != 2) & (sample.material != 3),
            **{f"material_{k}": sample.material == k for k in range(5)},
        }
        assert set(masks) == set(expected)
        for name, mask in expected.items():
            np.testing.assert_array_equal(masks[name], mask & valid, err_msg=name)
    bare = make_sample(occluded=None, material=None)
    assert set(experiment.regions(bare)) == {"out_of_view", "matched", "unmatched"}


def test_a_record_has_the_errors_of_each_mask_under_the_cap(matches):
    sample = make_sample()
    prediction, ground_truth, valid = predict(sample), sample.depth_m, sample.valid
    depth_m, capped = prediction.depth_m, sample.valid & (sample.depth_m < CAP_M)
    record = experiment.score(sample, prediction, CAP_M)
    inverse = np.where(np.isfinite(depth_m), 1 / depth_m, np.nan)
    for name, cap, mask in (("all_pixels", None, valid), ("capped", CAP_M, capped)):
        aligned = metrics.align(inverse, ground_truth, mask, "disparity")
        assert record[name]["raw"] == plain(metrics.evaluate_depth(depth_m, ground_truth, valid, cap))
        assert record[name]["aligned"] == plain(metrics.evaluate_depth(aligned, ground_truth, valid, cap))
    assert record["all_pixels"]["raw"]["pixels"] == valid.sum() > capped.sum()
    masks = experiment.regions(sample)
    assert set(record["regions"]) == set(masks)
    for name, mask in masks.items():
        of = mask & capped & np.isfinite(depth_m)
        errors = np.abs(np.minimum(depth_m, CAP_M) - ground_truth)[of] / ground_truth[of]
        assert record["regions"][name] == pytest.approx(errors.mean(), rel=1e-5), name
    assert record["disparity"] is None
    order = prediction.uncertainty
    assert record["ause"] == pytest.approx(metrics.ause(depth_m, ground_truth, capped, order), rel=1e-5)
    confidence = prediction.confidence
    areas = [metrics.ause(depth_m, ground_truth, capped, order) for order in (1 - confidence, None)]
    assert [record["ause_confidence"][n] for n in ("ause", "random")] == pytest.approx(areas, rel=1e-5)
    deciles = metrics.confidence_deciles(depth_m, ground_truth, capped, confidence, 0.1)
    assert len(record["confidence"]) == 10
    for found, wanted in zip(record["confidence"], deciles, strict=True):
        assert found == pytest.approx(wanted, rel=1e-5)
    edges = {"f1": metrics.boundary_f1(depth_m, ground_truth, valid)} | metrics.boundary_errors(
        depth_m, ground_truth, valid
    )
    assert record["boundaries"] == plain(edges)
    sparse = replace(sample, valid=valid & (np.arange(SHAPE[1]) < 13))
    assert experiment.score(sparse, prediction, CAP_M)["boundaries"] is None
    bare = experiment.score(sample, Prediction(depth_m), CAP_M)
    assert [bare[n] for n in ("ause", "confidence", "ause_confidence")] == [None] * 3
    assert (
        experiment.score(sample, prediction, None)["capped"]
        == experiment.score(sample, prediction, 99)["capped"]
    )


def test_relative_depth_is_aligned_under_each_cap_and_by_region(matches):
    sample = make_sample()
    values = 3 - 0.7 / sample.depth_m + np.random.default_rng(3).normal(0, 0.02, SHAPE)
    record = experiment.score(sample, Prediction(None, values, "disparity"), CAP_M)
    capped = sample.valid & (sample.depth_m < CAP_M)
    for name, mask in (("all_pixels", sample.valid), ("capped", capped)):
        x, y = values[mask], 1 / sample.depth_m[mask].astype(float)
        slope, offset = np.polyfit(x, y, 1)
        aligned = 1 / np.maximum(slope * values + offset, 1e-3)
        cap = CAP_M if name == "capped" else np.inf
        error = np.abs(np.minimum(aligned, cap) / sample.depth_m - 1)[mask].mean()
        assert record[name]["raw"] is None
        assert record[name]["aligned"]["abs_rel"] == pytest.approx(error, rel=1e-4)
    of = capped & matches
    error = np.abs(np.minimum(aligned, CAP_M) / sample.depth_m - 1)[of].mean()
    assert record["regions"]["matched"] == pytest.approx(error, rel=1e-4)
    assert all(
        record[n] is None for n in ("disparity", "ause", "confidence", "ause_confidence", "boundaries")
    )


def test_disparity_is_scored_on_all_visible_edge_and_flat_pixels(matches):
    sample = make_rectified()
    prediction = predict(sample)
    true_px, pred_px = (20 * 0.5 / z.astype(float) - 1.25 for z in (sample.depth_m, prediction.depth_m))
    valid, edge = sample.valid, metrics.near_disparity_steps(true_px, sample.valid)
    hidden = metrics.occluded_by_ground_truth(true_px, valid)
    away = outside(sample)

    def scores(mask):
        known = mask & np.isfinite(pred_px)
        error, ground_truth = np.abs(pred_px - true_px)[known], true_px[known]
        means = {"epe": error.mean()} | {f"bad{k}": (error > k).mean() for k in (1, 2, 3)}
        return plain(means | {"d1": ((error > 3) & (error > 0.05 * ground_truth)).mean()})

    assert edge.any() and (hidden & ~away).any() and away.any()
    for occluded, covered in ((sample.occluded, sample.occluded), (None, hidden)):
        given = replace(sample, occluded=occluded)
        found = experiment.score(given, prediction, None)["disparity"]
        by_region = found.pop("regions")
        assert found == scores(valid) and set(by_region) == {"visible", "edge", "flat"}
        assert by_region["visible"] == scores(valid & ~covered & ~away)
        assert by_region["edge"] == scores(edge) and by_region["flat"] == scores(valid & ~edge)
    coarse = replace(sample, notes={"disparity_step_px": 1.5})
    found = experiment.score(coarse, prediction, None)["disparity"]
    assert found["bad1"] is None and found["bad2"] is not None and found["regions"]["flat"]["bad1"] is None
    sparse = replace(sample, occluded=None, valid=valid & (np.arange(SHAPE[1]) < 12))
    assert set(experiment.disparity_scores(sparse, prediction.depth_m)) == {"all", "edge", "flat"}


def test_a_benchmark_counts_holes_as_errors_and_only_what_its_files_tell():
    sample = replace(make_rectified(), dataset="eth3d")
    prediction = predict(sample)
    true_px, pred_px = (20 * 0.5 / z.astype(float) - 1.25 for z in (sample.depth_m, prediction.depth_m))
    bad = ~(np.abs(pred_px - true_px) <= 1)
    assert (~np.isfinite(pred_px) & sample.valid).any()
    fractions = {"all": bad[sample.valid].mean(), "noc": bad[sample.valid & ~sample.occluded].mean()}
    assert experiment.benchmark_scores(sample, prediction) == plain({"bad_px": 1.0} | fractions)
    without = experiment.benchmark_scores(replace(sample, occluded=None), prediction)
    assert without["noc"] is None and without["all"] == plain(fractions)["all"]
    only = experiment.benchmark_scores(replace(sample, notes={"noc_only": True}), prediction)
    assert only["all"] is None and only["noc"] == plain(fractions)["noc"]
    kitti = experiment.benchmark_scores(replace(sample, dataset="kitti2012"), prediction)
    far_off = (~(np.abs(pred_px - true_px) <= 3))[sample.valid].mean()
    assert kitti["bad_px"] == 3 and kitti["all"] == pytest.approx(far_off, abs=1e-6)
    for none in (replace(sample, dataset="booster"), replace(sample, rectified=False)):
        assert experiment.benchmark_scores(none, prediction) is None
    assert experiment.benchmark_scores(sample, Prediction(None, sample.depth_m)) is None


@pytest.mark.parametrize("name", ["depth_m", "relative", "uncertainty", "confidence"])
def test_maps_of_another_shape_and_no_ground_truth_are_rejected(matches, name):
    sample = make_sample()
    wrong = replace(Prediction(sample.depth_m), **{name: np.ones((SHAPE[1], SHAPE[0]))})
    with pytest.raises(ValueError, match=rf"prediction.{name} must be of the left image's shape \(18, 26\)"):
        experiment.score(sample, wrong, None)
    with pytest.raises(ValueError, match="the ground truth of booster/a"):
        experiment.score(replace(sample, valid=np.zeros(SHAPE, bool)), Prediction(sample.depth_m), None)


def test_depth_in_metres_is_as_it_is_and_relative_depth_is_aligned():
    sample = make_sample()
    kept = sample.valid & (sample.depth_m < 5)
    assert experiment.in_metres(Prediction(sample.left[..., 0]), sample.depth_m, kept) is not None
    aligned = experiment.in_metres(
        Prediction(None, np.log(sample.depth_m) / 3 + 1, "log"), sample.depth_m, kept
    )
    np.testing.assert_allclose(aligned, sample.depth_m, rtol=1e-5)
    metres = 3 * sample.depth_m
    assert experiment.in_metres(Prediction(metres, sample.depth_m), sample.depth_m, kept) is metres
    assert experiment._plain({"a": 1 / 3, "b": None, "c": float("nan"), "d": 123456789.0}) == {
        **{"a": 0.3333333, "b": None, "c": None, "d": 123456800.0}
    }


TABLES = (
    Table("First", ("a", "b"), (("x", "1"),)),
    Table("Empty", ("a",), ()),
    Table("Third", ("c",), (("_",),)),
)


def options(tmp_path, **changes):
    given = {"out": tmp_path / "out", "results": None, "quiet": True, "program": "geodiff eval"}
    return SimpleNamespace(**given | changes)


@pytest.fixture
def facts(monkeypatch):
    known = {
        "command": "geodiff eval x",
        "date": "2026-01-02",
        "versions": {"p": "1", "q": "2"},
        "machine": "m, 4",
    }
    monkeypatch.setattr(experiment, "run_facts", lambda command, options: known)
    return known


def test_a_page_is_written_as_markdown_latex_and_json(facts, tmp_path):
    results = tmp_path / "docs" / "page.md"
    page = experiment.write_page(
        "parts", options(tmp_path, results=results), "Title", TABLES, ["One.", "Two."]
    )
    shown = (TABLES[0], TABLES[2])
    assert (page.title, page.tables, page.remarks, page.broken) == ("Title", shown, ("One.", "Two."), ())
    assert page.facts == facts and page.origin() == "2026-01-02; p 1, q 2; m, 4."
    text = (tmp_path / "out" / "parts.md").read_text(encoding="utf-8")
    head = "# Title\n\n    geodiff eval x\n\n2026-01-02; p 1, q 2; m, 4.\n\nOne.\n\nTwo.\n\n"
    assert (
        text == head + shown[0].markdown() + "\n" + shown[1].markdown() == results.read_text(encoding="utf-8")
    )
    latex = (tmp_path / "out" / "parts.tex").read_text(encoding="utf-8")
    assert latex == shown[0].latex() + "\n" + shown[1].latex()
    plain = json.loads((tmp_path / "out" / "parts.json").read_text(encoding="utf-8"))
    assert plain["remarks"] == ["One.", "Two."] and {k: plain[k] for k in facts} == facts
    assert [t["title"] for t in plain["tables"]] == ["First", "Third"]
    assert plain["tables"][0]["rows"] == [["x", "1"]]
    experiment.write_page("pairs", options(tmp_path), "T", TABLES, [])
    assert {p.name for p in (tmp_path / "out").glob("table.*")} == {"table.md", "table.tex", "table.json"}


def test_facts_are_command_date_versions_and_machine(monkeypatch):
    monkeypatch.setattr(experiment, "command_line", lambda command, options: f"{command} of {options}")
    monkeypatch.setattr(experiment.os, "cpu_count", lambda: 77)
    before = time.strftime("%Y-%m-%d")
    found = experiment.run_facts("cost", "o")
    assert found["command"] == "cost of o" and before <= found["date"] <= time.strftime("%Y-%m-%d")
    assert set(found) == {"command", "date", "versions", "machine"} and "77 cores, " in found["machine"]
    assert {"torch", "opencv"} <= set(found["versions"]) and "torch threads" in found["machine"]


def item(sample, value, method="m"):
    def work():
        if value is None:
            raise OSError(f"{sample} is cut off")
        return {"status": "ok", "value": value}

    head = {"dataset": "d", "sample": sample, "method": method}
    return Item(f"{sample}-{method}-{value}", work, name=sample, head=head)


def test_an_experiment_shows_records_in_order_and_lists_broken_samples_once(facts, tmp_path):
    cells = [item("b", 2), item("a", 1), item("c", None, "m"), item("c", None, "n"), item("b", 2)]
    seen = []

    def tables(records):
        seen.extend(records)
        return TABLES[:1]

    made = experiment.Experiment("Title", cells, tables, lambda records: [f"{len(records)} records."])
    page = experiment.run_experiment("parts", options(tmp_path, stop_on_broken=False), made)
    assert page.broken == ("d/c",) and page.remarks == ("5 records.",) and page.title == "Title"
    assert [(r["sample"], r["method"], r.get("value")) for r in seen] == [
        *(("b", "m", 2), ("a", "m", 1), ("c", "m", None), ("c", "n", None), ("b", "m", 2)),
    ]
    assert (tmp_path / "out" / "parts.jsonl").is_file() and seen[2]["status"] == "broken"
    other = experiment.Experiment("T", cells[:1], tables, journal="other.jsonl")
    assert experiment.run_experiment("parts", options(tmp_path), other).remarks == ()
    assert (tmp_path / "out" / "other.jsonl").is_file()
    with pytest.raises(OSError, match="c is cut off"):
        experiment.measure_cells([item("c", None)], options(tmp_path))


def test_processes_share_samples_and_the_last_one_has_all_records(facts, tmp_path, monkeypatch):
    cells = [item(sample, n, method) for n, sample in enumerate("abc") for method in "mn"]
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "1")
    made = experiment.Experiment("T", cells, lambda records: TABLES)
    assert experiment.run_experiment("parts", options(tmp_path), made) is None
    (mine,) = (tmp_path / "out").glob("parts*.jsonl")
    assert [json.loads(line)["sample"] for line in mine.read_text().splitlines()] == ["b", "b"]
    monkeypatch.setenv("RANK", "0")
    records = experiment.measure_cells(cells, options(tmp_path), "parts.jsonl")
    assert [(r["sample"], r["method"], r["value"]) for r in records] == [
        (s, m, n) for n, s in enumerate("abc") for m in "mn"
    ]


REF = SampleRef("booster", "a", {"left": Path("nowhere"), "views": (1, 2), "mask": None})


def method(**changes):
    def run(sample, settings, priors):
        time.sleep(0.02)
        return Prediction(2.0 * sample.depth_m, notes={"scale": settings.seed})

    given = {"title": "M", "summary": "", "run": run, "configuration": vars, "uses_prior": False}
    return Method("files:a b/c", **given | changes)


def test_a_measured_cell_records_cost_scores_notes_and_the_map(monkeypatch, tmp_path, matches):
    sample = make_sample(notes={"truth": "t"})
    priors = SimpleNamespace(
        evidence=SimpleNamespace(take_spared_seconds=iter([50.0, 7.0, 0.0, 0.0]).__next__)
    )
    monkeypatch.setenv("RANK", "3")
    monkeypatch.setenv("WORLD_SIZE", "4")
    path = tmp_path / "maps" / "m.npy"
    read, settings = {REF: sample}.get, Settings(seed=6)
    record = experiment._measure(REF, read, method(), settings, priors, path)
    assert 7.02 <= record["seconds"] < 10 and isinstance(record["peak_bytes"], int)
    assert record["notes"] == {"sample": {"truth": "t"}, "method": {"scale": 6}} and record["process"] == 3
    assert record["map"] == file_digest(path) and record["status"] == "ok" and record["rectified"] is False
    np.testing.assert_allclose(np.load(path), 2 * sample.depth_m)
    scores = experiment.score(sample, Prediction(2.0 * sample.depth_m), 10.0)  # Booster's cap
    assert {name: record[name] for name in scores} == scores

    def never(*_):
        raise experiment.NotApplicable("no reason")

    record = experiment._measure(REF, read, method(run=never), settings, priors, None)
    assert record == {"rectified": False, "status": "not applicable", "reason": "no reason", "process": 3}


def test_a_key_changes_with_everything_that_changes_a_result(monkeypatch, tmp_path):
    file = tmp_path / "left.png"
    file.write_bytes(b"1")
    ref = SampleRef("d", "a", {"left": file, "views": (1, 2), "mask": None})

    def key(ref=ref, name="m", configuration=(("a", 1),), prior="p"):
        return experiment.cell_key(ref, name, dict(configuration), prior)

    first = key()
    assert first == key() == key(replace(ref, files={"left": file, "views": (1, 2)}))
    others = [key(name="n"), key(configuration=(("a", 2),)), key(prior="q"), key(replace(ref, dataset="e"))]
    others += [key(replace(ref, name="b")), key(replace(ref, files={"left": file, "views": (2, 1)}))]
    monkeypatch.setattr(experiment, "__version__", "99")
    others.append(key())
    monkeypatch.undo()
    file.write_bytes(b"2")
    others.append(key())
    assert len({first, *others}) == 9


def test_cells_are_every_method_on_every_sample_with_a_name_a_map_and_a_key(monkeypatch, tmp_path):
    methods = {"plain": method(), "seeded": method(uses_prior=True, seed=4, prior="x/y")}
    monkeypatch.setattr(experiment, "find_method", methods.__getitem__)
    monkeypatch.setattr(PriorCache, "fingerprint", lambda _, settings: settings.prior[::-1])
    refs = [REF, replace(REF, name="b")]
    settings = Settings(device="cpu:0", seed=1)
    keys = []

    def cells(settings=settings, **more):
        made = experiment.method_cells(refs, ["plain", "seeded"], settings, tmp_path, **more)
        keys.append([cell.key for cell in made])
        return made

    first, second, third, _ = cells(save_depth=True)
    assert first.head == {"dataset": "booster", "sample": "a", "method": "files:a b/c"}
    assert (first.name, first.words) == ("booster/a, files:a b/c", ("files:a b/c",))
    assert third.head["sample"] == "b" and len(set(keys[0])) == 4
    assert first.payload.keywords == {"path": tmp_path / "depth" / "files_a_b_c" / "booster_a.npy"}
    ref, _, given, chosen, _ = second.payload.args
    assert (ref, given) == (REF, methods["seeded"])
    assert chosen == replace(settings, seed=4, prior="x/y")
    expected = experiment.cell_key(REF, "files:a b/c", vars(chosen), "x/y y/x")
    assert second.key == expected
    assert first.key == experiment.cell_key(REF, "files:a b/c", vars(settings), "")
    assert cells()[0].payload.keywords == {"path": None} and keys[0] == keys[1]
    monkeypatch.setenv("WORLD_SIZE", "3")
    monkeypatch.setenv("LOCAL_RANK", "5")
    monkeypatch.setattr(experiment.torch.cuda, "device_count", lambda: 4)
    on_gpu = cells(replace(settings, device="cuda"))
    assert on_gpu[0].payload.args[3].device == "cuda:1"
    assert on_gpu[0].key == experiment.cell_key(
        REF, "files:a b/c", vars(replace(settings, device="cuda")), ""
    )
    assert cells()[0].payload.args[3].device == "cpu:0"


def test_a_saved_map_must_be_there_and_be_that_of_the_record(tmp_path):
    path = tmp_path / "m.npy"
    record = {"status": "ok", "all_pixels": {"raw": {"abs_rel": 0.1}}}

    def has(record, path=path):
        return experiment._has_map(Item("k", SimpleNamespace(keywords={"path": path})), record)

    assert has(record, None) and not has(record) and has(record | {"status": "not applicable"})
    assert has(record | {"all_pixels": {"raw": None}})
    np.save(path, np.ones(3))
    assert not has(record) and has(record | {"map": file_digest(path)}) and not has(record | {"map": "other"})


SHAPE_EVALUATION_EXPERIMENT = (6, 8)


def make_sample_of_evaluation_experiment(name="a", **changes) -> StereoSample:
    """A wall 2 m away, 5 m in its first two columns; 0.52 m of baseline; fy is not fx."""
    K, E = np.array([[10.0, 0, 3.5], [0, 12.0, 2.5], [0, 0, 1]]), np.eye(4)
    E[0, 3] = 0.52
    image, depth_m = (
        np.zeros((*SHAPE_EVALUATION_EXPERIMENT, 3), np.uint8),
        np.full(SHAPE_EVALUATION_EXPERIMENT, 2.0, np.float32),
    )
    depth_m[:, :2] = 5.0
    cameras = {"K_left": K, "K_right": K, "E": E}
    given = cameras | {"depth_m": depth_m, "valid": depth_m > 0, "rectified": True}
    return StereoSample("middlebury2014", name, image, image, **(given | changes))


def test_raw_aligned_and_capped():
    sample = make_sample_of_evaluation_experiment()
    exact = score(sample, Prediction(sample.depth_m), None)
    assert exact["all_pixels"]["raw"]["abs_rel"] == 0 and exact["capped"] is exact["all_pixels"]
    double = score(sample, Prediction(2 * sample.depth_m), None)
    assert double["all_pixels"]["raw"]["abs_rel"] == pytest.approx(1)
    assert double["all_pixels"]["aligned"]["abs_rel"] == pytest.approx(0, abs=1e-6)
    # A doubled depth halves the shift of f b / z = 5.2 / z: by 0.52 px in 12 of 48 pixels, by 1.3 px in 36.
    assert double["disparity"]["epe"] == pytest.approx(0.25 * 0.52 + 0.75 * 1.3, rel=1e-5)
    assert double["disparity"]["bad1"] == 0.75
    capped = score(sample, Prediction(np.full(SHAPE_EVALUATION_EXPERIMENT, 4.0)), cap_m=3.0)
    assert capped["all_pixels"]["raw"]["pixels"] == 48 and capped["capped"]["raw"]["pixels"] == 36
    assert capped["capped"]["raw"]["abs_rel"] == pytest.approx(0.5)  # clipped from 4 to the cap of 3


def test_relative_depth_has_no_raw_column_and_holes_no_errors():
    sample = make_sample_of_evaluation_experiment()
    relative = score(sample, Prediction(None, relative=0.1 * sample.depth_m + 0.3), None)
    assert relative["all_pixels"]["raw"] is relative["disparity"] is None
    assert headline({"status": "ok"} | relative) == pytest.approx(0, abs=1e-6)
    holes = score(sample, Prediction(np.full(SHAPE_EVALUATION_EXPERIMENT, np.nan), space="disparity"), None)
    raw, aligned = holes["all_pixels"]["raw"], holes["all_pixels"]["aligned"]
    assert raw["abs_rel"] is aligned["abs_rel"] is None and raw["coverage"] == 0
    assert headline({"status": "ok"} | holes) is None


def test_poses_given_wrongly_change_no_mask_and_no_true_disparity(monkeypatch):
    sample, swept = make_sample_of_evaluation_experiment(), []
    monkeypatch.setattr(experiment, "sweep", lambda sample, _: swept.append(sample.E) or sweep(sample, "cpu"))
    wrong, double = with_perturbed_poses(sample, (20.0, 0.5), "a"), Prediction(2 * sample.depth_m)
    assert not np.allclose(wrong.E, sample.E)
    np.testing.assert_array_equal(out_of_view(wrong), out_of_view(sample))
    assert score(wrong, double, None)["disparity"] == score(sample, double, None)["disparity"]
    np.testing.assert_array_equal(swept[0], sample.E)


def test_regions_split_what_the_right_camera_sees_and_tables_show_them():
    occluded, material = (
        np.zeros(SHAPE_EVALUATION_EXPERIMENT, bool),
        np.zeros(SHAPE_EVALUATION_EXPERIMENT, np.uint8),
    )
    occluded[2, 5], material[:, 6:] = True, 3
    sample = make_sample_of_evaluation_experiment(occluded=occluded, material=material)
    # Shift: 1.04 px at 5 m (columns 0, 1), 2.6 px at 2 m: columns 0 and 2 leave.
    assert out_of_view(sample)[0].tolist() == [True, False, True] + [False] * 5
    sizes = {name: mask.sum() for name, mask in regions(sample).items()}
    assert (sizes["occluded"], sizes["visible"], sizes["material_3"]) == (1, 48 - 12 - 1, 12)
    records = []
    for each, factor in ((sample, 2.0), (make_sample_of_evaluation_experiment("b"), 3.0)):
        head = {"dataset": each.dataset, "sample": each.name, "method": "guided", "status": "ok"}
        prediction = Prediction(factor * each.depth_m, uncertainty=np.ones(SHAPE_EVALUATION_EXPERIMENT))
        records.append(head | score(each, prediction, None))
    by_region, *_, areas = (details_table(records, title) for title in DETAILS)
    names = ("visible", "occluded", "ToM", "other material", "class 0", "class 3")
    header = [f"{name} (1 pair)" for name in names]
    header[2:2] = ["out of view (2 pairs)", "matched", "unmatched"]
    assert by_region.header == ("method", *header)
    assert by_region.rows == (("guided", "1.000", "1.000", "1.500", "-", "-", *["1.000"] * 4),)
    assert areas.rows == (("guided", "0.000", "-", "-"),)


def test_regions_split_by_whether_the_views_match_which_is_found_once_a_sample(monkeypatch, tmp_path):
    swept, whole = [], load(find_pairs(write_scenes(tmp_path, "wall"))[0])
    left, right, valid = whole.left.copy(), whole.right.copy(), whole.valid.copy()
    left[:, 80:], right[:, 72:], valid[:8] = 128, 128, False  # nothing to match on the right
    sample = replace(whole, left=left, right=right, valid=valid)
    monkeypatch.setattr(experiment, "sweep", lambda sample, device: swept.append(1) or sweep(sample, device))
    for factor in (1, 2):
        score(sample, Prediction(factor * sample.depth_m), None)
    masks = regions(sample)
    assert len(swept) == 1
    np.testing.assert_array_equal(masks["matched"] ^ masks["unmatched"], valid)
    assert masks["matched"][8:, 12:65].mean() > 0.8 and masks["matched"][8:, 100:].mean() < 0.1
    away = np.diag([-1.0, 1, -1, 1])
    away[0, 3] = 0.12
    assert set(regions(replace(sample, E=away))) == {"out_of_view"}  # no overlap


SIZES = {"a": 0.1, "b": 0.2, "c": 0.4}
REFS = [SampleRef("middlebury2014", name, {"left": Path(name)}) for name in SIZES]


class Bench:
    """Three samples, the last one posed, and methods that cost nothing, in the place of all others."""

    def __init__(self, monkeypatch, out):
        self.calls, self.methods, self.out, self.path = [], {}, out, out / RECORDS_NAME
        self.samples = {
            name: make_sample_of_evaluation_experiment(name, rectified=name != "c") for name in SIZES
        }
        self.add("exact", lambda sample, seed: 1.0)
        self.add("double", lambda sample, seed: 2.0 if sample.rectified else None)
        self.add("noisy", lambda sample, seed: 1 + SIZES[sample.name] * seed, uses_prior=True)
        monkeypatch.setattr("geodiff_plugin.evaluation.baselines.METHODS", self.methods)
        monkeypatch.setattr(experiment, "load", lambda ref: self.samples[ref.name])
        monkeypatch.setattr(experiment.PriorCache, "fingerprint", lambda _, settings: settings.prior[::-1])

    def add(self, name, factor_of, parameters=None, uses_prior=False):
        def measure(sample, settings, priors):
            self.calls.append((name, sample.name))
            if (factor := factor_of(sample, settings.seed)) is None:
                raise NotApplicable("not rectified")
            return Prediction(factor * sample.depth_m.astype(float))

        def configure(settings):
            return parameters or ({"seed": settings.seed} if uses_prior else {})

        self.methods[name] = Method(name, name, name, measure, configure, uses_prior)

    def go(self, methods=("exact", "double"), settings=None, refs=REFS, **keywords):
        self.calls.clear()
        cells = experiment.method_cells(refs, list(methods), settings or Settings(), self.out, **keywords)
        return experiment.measure_cells(cells, SimpleNamespace(out=self.out, quiet=True))


@pytest.fixture
def bench(monkeypatch, tmp_path):
    return Bench(monkeypatch, tmp_path)


def test_a_run_does_only_what_is_missing(bench, monkeypatch):
    first = bench.go()
    assert len(bench.calls) == 6 and [r["status"] for r in first].count("not applicable") == 1
    os.truncate(bench.path, bench.path.stat().st_size - 2)  # killed while it wrote
    again = bench.go()
    assert len(bench.calls) == 1
    assert [r | {"seconds": 0} for r in again] == [r | {"seconds": 0} for r in first]
    bench.add("double", lambda *_: 3.0, {"factor": 3})  # another configuration is another result
    records = bench.go()
    assert [call[0] for call in bench.calls] == ["double"] * 3 and headline(records[1]) == pytest.approx(2)
    monkeypatch.setattr(experiment, "__version__", "0.2.0")
    assert bench.go() and len(bench.calls) == 6


def test_a_saved_map_is_that_of_the_record(bench):
    """Another configuration leaves its map in the same place; a finished run saves its maps when asked."""
    bench.go()
    one, target, maps = bench.methods["exact"], bench.out / "depth" / "exact" / "middlebury2014_a.npy", []
    bench.add("exact", lambda *_: 3.0, {"knob": 1})
    for method in (one, bench.methods["exact"], one):
        bench.methods["exact"] = method
        bench.go(save_depth=True)
        maps.append(np.load(target)[0, 0])
    assert maps == [5.0, 15.0, 5.0] and ("exact", "a") in bench.calls
    bench.go(save_depth=True)
    assert bench.calls == [] and len(list(bench.out.glob("depth/*/*.npy"))) == 5


def test_tables_hold_pairs_means_and_differences(bench):
    pairs, _, versus, metrics, *_ = pairs_tables(bench.go(), reference="exact")
    assert pairs.header == ("pair", "exact", "double")
    assert pairs.rows == (
        ("middlebury2014/a", "0.000", "1.000"),
        ("middlebury2014/b", "0.000", "1.000"),
        ("middlebury2014/c", "0.000", "-"),
        ("mean of 3 pairs", "0.000", "-"),
        ("mean of 2 rectified pairs", "0.000", "1.000"),
        ("mean of 1 posed pair", "0.000", "-"),
    )
    assert versus.rows == (("double", "2", "-1.000", "2 of 2"),)
    assert [row[0] for row in metrics.rows] == ["exact", "exact, aligned", "double", "double, aligned"]


def test_priors_and_seeds_make_rows_whose_results_are_those_of_the_settings(bench):
    bound = {"noisy#1": ("bundled", 1), "noisy@org/x": ("org/x", 0), "noisy@org/x#1": ("org/x", 1)}
    records = bench.go(("noisy", "exact", *bound))
    assert [r["method"] for r in records[:5]] == ["noisy", "exact", *bound] and len(bench.calls) == 15
    for method, (prior, seed) in bound.items():
        again = bench.go(["noisy"], Settings(prior, seed=seed))
        assert bench.calls == [] and {r["method"] for r in again} == {"noisy"}
        assert [r["key"] for r in again] == [r["key"] for r in records if r["method"] == method]
    header = ("pair", "noisy", "exact", "noisy, seed 1", "noisy (x)", "noisy (x), seed 1")
    assert pairs_tables(records, reference="exact")[0].header == header


def test_names_that_are_no_method_are_rejected(bench, tmp_path):
    for said, names in (
        ("METHOD#SEED with a method that uses a prior", ("exact#1", "noisy#1#2")),
        ("METHOD@PRIOR with a method that uses a prior", ("noisy#1@org/x", "double@org/x")),
        ("methods must be one of", ("noisy#", "magic:1")),
        ("NAME=VALUE with a guidance parameter", ("paper:", "guided:speed=2", "guided:optimizer")),
    ):
        for name in names:
            with pytest.raises(ValueError, match=said):
                find_method(name)
    (tmp_path / "maps@work#3").mkdir()  # an @ or # of a folder binds nothing
    assert find_method(f"files:{tmp_path}/maps@work#3").title == "maps@work#3"


def test_intervals_cover_the_mean_and_need_five():
    assert mean_with_interval([1, 2, 3, 4, None]).low is None
    mean = mean_with_interval([1, 2, 3, 4, 5])
    assert mean.low < mean.value == 3 < mean.high and mean == mean_with_interval([1, 2, 3, 4, 5])
    assert mean.cell(1, "+") == f"+3.0 [{mean.low:+.1f}, {mean.high:+.1f}]"
    assert mean_with_interval([]).cell() == "-" and mean_with_interval([-0.5, 0.5]).cell(2) == "0.00"
    values = np.random.default_rng(3).normal(size=400)
    wide = mean_with_interval(values)
    assert wide.high - wide.low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)  # normal theory
