"""The paper's tables, changes of presets and cost: rows, columns, and published numbers beside full sets."""

import json
import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from geodiff_plugin.evaluation import pairs, paper
from geodiff_plugin.evaluation.baselines import Method, NotApplicable, Prediction, find_method
from geodiff_plugin.evaluation.pairs import CHANGES, FLATNESS, changes_table
from geodiff_plugin.evaluation.paper import LAYOUTS, layout_table
from tests.contracts.tiny_transformers import make_transformers
from tests.evaluating import invoke, write_scenes


def make_record(method, sample, raw, aligned, dataset="kitti2015", **rest):
    def scores(abs_rel):
        return None if abs_rel is None else dict.fromkeys(("delta1", "rmse"), 0.5) | {"abs_rel": abs_rel}

    head = {"method": method, "dataset": dataset, "sample": sample, "status": "ok"}
    measured = {"capped": {"raw": scores(raw), "aligned": scores(aligned)}}
    return head | measured | {"seconds": 2.0, "peak_bytes": 5_000_000} | rest


def columns_of(layout, count, index=0, dataset="kitti2015"):
    """The columns of a layout with so many pairs of a set in one of them."""
    labels = frozenset(f"{dataset}/{i}" for i in range(count))
    of_layout = list(layout.columns)
    of_layout[index] = of_layout[index]._replace(dataset=dataset, labels=labels)
    return of_layout


@pytest.mark.parametrize("count", [199, 200])
def test_published_numbers_stand_beside_the_full_set_only(count):
    layout = LAYOUTS["table1"]
    records = [make_record("paper", str(i), 0.1, 0.2) for i in range(count)]
    table = layout_table(layout, columns_of(layout, count), records, ["paper"])
    groups = dict(table.groups)
    assert f"KITTI-Stereo ({count} pairs)" in groups and "Booster (not found)" in groups
    assert ("KITTI-Stereo, as published" in groups) == (count == 200)
    rows = {row[:2]: row[2:] for row in table.rows}
    ours = rows["GeoDiff†, Algorithm 1 as printed", "✗"]
    assert ours[:3] == ("0.100", "0.500", "0.500")
    assert (ours[3:6] == ("0.07", "0.91", "3.94")) == (count == 200)
    assert rows["GeoDiff, Algorithm 1 as printed", "✓"][0] == "0.200"
    assert rows["ZoeDepth", "✗"][:3] == ("-", "-", "-")
    assert "hf:Intel/zoedepth-nyu-kitti" in table.note and "Not run here" in table.note


def test_a_mean_needs_every_pair_and_a_method_fills_the_row_that_has_its_word(monkeypatch):
    peer = Method("files:maps/unidepth", "UniDepth files", "", lambda *_: None, lambda _: {}, False)
    find = paper.find_method
    monkeypatch.setattr(paper, "find_method", lambda name: peer if name == peer.name else find(name))
    layout, methods = LAYOUTS["table1"], ["prior-aligned", "sgbm", peer.name]
    records = [make_record("sgbm", "0", 0.3, 0.4), make_record("prior-aligned", "0", None, 0.5)]
    records += [make_record("sgbm", "1", None, None, status="not applicable", capped=None)]
    records += [make_record("prior-aligned", "1", None, 0.7)]
    records += [make_record(peer.name, label, 0.3, 0.4) for label in "01"]
    table = layout_table(layout, columns_of(layout, 2), records, methods)
    rows = {row[:2]: row[2] for row in table.rows}
    assert rows["Marigold", "✓"] == "0.600" and rows["UniDepth", "✗"] == "0.300"
    assert rows[find_method("sgbm").title + "†", "✗"] == "-"
    assert len(rows) == len(layout.rows) + 2


def test_changes_are_compared_pair_by_pair():
    errors = {"guided": 0.1, "guided:weights.matches=0": 0.3}
    records = [make_record(m, str(i), e + 0.01 * i, 1.0) for m, e in errors.items() for i in range(5)]
    rows = {row[0]: row for row in changes_table(records, "guided").rows}
    assert set(rows) == {"as it is", "without matches"}
    assert rows["as it is"][5] == "-" and rows["without matches"][5] == "+0.200 [+0.200, +0.200]"
    assert rows["without matches"][3] == "0.340"  # the worst pair


def test_cost_is_told_as_multiples_of_the_plain_pipeline(tmp_path):
    records = [make_record("prior-aligned", str(i), None, 0.1, seconds=s) for i, s in enumerate((9, 1, 2))]
    records += [make_record("guided", str(i), 0.1, 0.1, seconds=6.0, peak_bytes=20_000_000) for i in range(3)]
    table = pairs.cost_table(records)
    assert table.title == "Cost on 3 pairs"
    assert table.rows[0] == ("plain pipeline", "3", "2.00", "1.00", "5", "1.00")
    assert table.rows[1][2:] == ("6.00", "3.00", "20", "4.00")
    with pytest.raises(ValueError, match="the pairs must be some on which prior-aligned works"):
        pairs.cost_table([records[0] | {"status": "broken"}])
    make_transformers("glpn").save_pretrained(tmp_path)  # asked for no more steps than it was trained for
    assert pairs._steps_of("bundled") == pairs.STEPS and pairs._steps_of(str(tmp_path)) is None


@pytest.fixture
def free_methods(monkeypatch):
    """Every method that a table asks for, as one that costs nothing: twice the truth, or a reason why not."""

    def free(name):
        def measure(sample, settings, priors):
            if name == "sgbm":
                raise NotApplicable("not rectified")
            twice = 2.0 * np.where(sample.valid, sample.depth_m, 1.0)
            twice[0, 0] += 0.1
            return Prediction(None, relative=twice) if name == "prior-aligned" else Prediction(twice)

        return Method(name, name, name, measure, lambda settings: {"steps": settings.steps}, uses_prior=False)

    names = {name for own in LAYOUTS for name in paper.methods_of(own, ())} | {*pairs.COST_METHODS}
    names |= {*FLATNESS, *(method for _, method in CHANGES["parts"])}
    monkeypatch.setattr("geodiff_plugin.evaluation.baselines.METHODS", {name: free(name) for name in names})


@pytest.fixture
def scene(tmp_path):
    return write_scenes(tmp_path / "data", "one")


def test_table1_runs_what_is_there_and_tells_how_to_obtain_the_rest(
    free_methods, scene, tmp_path, monkeypatch
):
    out = tmp_path / "out"
    said = invoke("table1", "--data", scene, "-o", out)
    tables = json.loads((out / "table1.json").read_text())["tables"]
    latex = (out / "table1.tex").read_text()
    assert r"\multicolumn{3}{c}{Booster (not found)}" in latex and r"AbsRel $\downarrow$ &" in latex
    assert all(cell in said for table in tables for row in table["rows"] for cell in row)
    assert "Middlebury (middlebury2014, 1 pair): AbsRel ↓" in said
    assert "KITTI-Stereo was not found. To obtain it: data_scene_flow.zip" in said
    assert "as published" not in said and f"geodiff eval table1 --data {scene}\n" in said
    rows = {(row[0], row[1]): row for row in tables[0]["rows"]}
    assert float(rows["GeoDiff†, Algorithm 1 as printed", "✗"][-3]) == pytest.approx(1.0, abs=2e-3)
    assert float(rows["Marigold", "✓"][-3]) < 0.01
    lines, layout = (out / "samples.jsonl").read_text(), LAYOUTS["table1"]
    small = tuple(column._replace(datasets=column.datasets[::-1], full_count=1) for column in layout.columns)
    monkeypatch.setitem(LAYOUTS, "table1", layout._replace(columns=small))
    again = invoke("table1", "--data", scene, "-o", out)  # a full set now
    assert "Middlebury, as published: RMSE m ↓" in again and re.search(r" 2\.31\s", again)
    assert (out / "samples.jsonl").read_text() == lines  # everything was there


@pytest.mark.parametrize("name", ["table1", "table2", "table3"])
def test_without_data_the_error_says_how_to_obtain_them(free_methods, name, tmp_path):
    (tmp_path / "empty").mkdir()
    for words in ((), ("--data", tmp_path / "empty")):
        with pytest.raises(ValueError, match=r"--data must be .* (https?://|folders of images)"):
            invoke(name, *words, "-o", tmp_path / "out")


def test_ablation_parts_and_flatness_take_any_data(free_methods, scene, tmp_path):
    words = ("--data", scene, "-o", tmp_path / "out", "--methods", "sweep-sgm")
    ablation = invoke("ablation", *words)
    assert "middlebury2014 (1 pair): AbsRel ↓" in ablation
    assert re.search("Learning scale and shift only +✗ +1.000 ", ablation)
    parts = invoke("parts", *words)
    for said, presets in ((ablation, ("guided", "paper")), (parts, ("parts",))):
        titles = [title for preset in presets for title, _ in CHANGES[preset]]
        assert all(re.search(f"{re.escape(title)} +1 ", said) for title in titles)
    further = parts.partition("Further methods and priors, 1 pair")[2]
    assert re.search("sweep-sgm +1 +1.000", further) and not re.search("guided +1 ", further)
    flat = invoke("flatness", *words[:4])
    assert re.search("`smoothness` +40 ", flat) and (tmp_path / "out" / "flatness.md").is_file()
    assert "Further methods" not in flat


def test_cost_measures_each_method_in_a_process_of_its_own(free_methods, scene, tmp_path, monkeypatch):
    started = []

    def inline(max_workers, mp_context):
        started.append((max_workers, mp_context.get_start_method()))
        return ThreadPoolExecutor(1)

    monkeypatch.setattr(pairs, "ProcessPoolExecutor", inline)
    out = tmp_path / "out"
    answer = invoke("cost", "--data", scene, "-o", out, "--save-depth")
    assert started == [(1, "spawn")] * len(pairs.COST_METHODS) and re.search("plain pipeline +1 ", answer)
    assert "Denoising steps of each: 4 with bundled." in answer and (out / "cost.md").is_file()
    assert (out / "cost" / "depth" / "guided" / "middlebury2014_one.npy").is_file()
