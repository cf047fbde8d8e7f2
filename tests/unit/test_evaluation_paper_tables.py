"""The paper's tables: rows, columns, published numbers beside a full set only, LaTeX; with free methods."""

import json
import re

import numpy as np
import pytest
from geodiff_plugin.evaluation.published import LAYOUTS
from geodiff_plugin.evaluation.table import Table, label_of, latex_escape
from PIL import Image
from typer.testing import CliRunner

from geodiff_plugin.cli.eval.app import eval_app
from geodiff_plugin.evaluation import cost, paper
from geodiff_plugin.evaluation.baselines import METHODS, Settings, find_method
from geodiff_plugin.evaluation.baselines.base import Method, NotApplicable, Prediction
from geodiff_plugin.evaluation.changes import (
    CHANGES,
    NUMBERS,
    changes_table,
    flatness_methods,
    flatness_table,
)
from geodiff_plugin.evaluation.paper import FoundColumn, layout_table
from geodiff_plugin.formats import write_pfm
from tests.contracts.tiny_transformers import make_transformers


def make_record(method, sample, raw, aligned, dataset="kitti2015", **rest):
    def scores(abs_rel):
        return None if abs_rel is None else dict.fromkeys(("delta1", "rmse"), 0.5) | {"abs_rel": abs_rel}

    head = {"method": method, "dataset": dataset, "sample": sample, "status": "ok"}
    cost_of = {"seconds": 2.0, "peak_bytes": 5_000_000}
    return head | {"capped": {"raw": scores(raw), "aligned": scores(aligned)}} | cost_of | rest


def found(layout, index, count, dataset):
    labels = frozenset(f"{dataset}/{i}" for i in range(count))
    return FoundColumn(layout.columns[index], dataset, labels)


def columns_of(layout, kitti):
    none = frozenset()
    return [found(layout, 0, kitti, "kitti2015"), *(FoundColumn(c, None, none) for c in layout.columns[1:])]


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


def test_a_full_count_of_another_set_is_not_the_papers():
    layout = LAYOUTS["table1"]
    assert found(layout, 2, 15, "middeval3").complete
    other = found(layout, 2, 15, "middlebury2014")
    assert not other.complete and other.heading == "Middlebury (middlebury2014, 15 pairs)"


def test_columns_and_rows_are_the_papers():
    assert [c.full_count for name in ("table1", "table3") for c in LAYOUTS[name].columns] == [
        200,
        228,
        15,
        116,
    ]
    assert [len(LAYOUTS[name].rows) for name in LAYOUTS] == [8, 4, 4, 2]
    for layout in LAYOUTS.values():
        for row in layout.rows:
            assert {title for title, _ in row.published} == {column.title for column in layout.columns}
            assert all(len(cells) == len(layout.metrics) for _, cells in row.published)


def test_a_mean_needs_every_pair_and_own_methods_get_rows_of_their_own(monkeypatch):
    layout = LAYOUTS["table1"]
    records = [make_record("sgbm", "0", 0.3, 0.4), make_record("prior-aligned", "0", None, 0.5)]
    records += [make_record("sgbm", "1", None, None, status="not applicable", capped=None)]
    records += [make_record("prior-aligned", "1", None, 0.7)]
    table = layout_table(layout, columns_of(layout, 2), records, ["prior-aligned", "sgbm"])
    rows = {row[:2]: row[2] for row in table.rows}
    assert rows["Marigold", "✓"] == "0.600"
    assert rows[find_method("sgbm").title + "†", "✗"] == "-"
    assert len(layout.rows) in table.rules


def test_a_method_fills_the_row_that_its_name_has_the_word_of(monkeypatch):
    peer = Method(
        "files:maps/unidepth", "UniDepth files", "", lambda *_: None, lambda _: {}, uses_prior=False
    )
    monkeypatch.setattr(paper, "find_method", lambda name: peer)
    layout = LAYOUTS["table1"]
    records = [make_record(peer.name, "0", 0.3, 0.4)]
    rows = {r[0]: r[2] for r in layout_table(layout, columns_of(layout, 1), records, [peer.name]).rows}
    assert rows["UniDepth"] == "0.300" and len(rows) == len(layout.rows)


def test_changes_are_compared_pair_by_pair():
    errors = {"guided": 0.1, "guided:weights.matches=0": 0.3}
    records = [make_record(m, str(i), e + 0.01 * i, 1.0) for m, e in errors.items() for i in range(5)]
    rows = {row[0]: row for row in changes_table(records, "guided").rows}
    assert set(rows) == {"as it is", "without matches"}
    assert rows["as it is"][5] == "-" and rows["without matches"][5] == "+0.200 [+0.200, +0.200]"
    assert rows["without matches"][3] == "0.340"  # the worst pair


@pytest.mark.parametrize("name", [name for own in CHANGES.values() for _, name in own if ":" in name])
def test_changes_are_configurations_of_the_guidance(name):
    preset = find_method(name.partition(":")[0]).configuration(Settings())
    changed = find_method(name).configuration(Settings())
    # The default's own rule may be the one that a row names; every other row changes something.
    assert changed["guidance"] != preset["guidance"]


def test_flatness_tries_every_number_at_half_and_at_twice():
    names = flatness_methods()
    assert len(names) == 1 + 2 * len(NUMBERS) == len(set(names))
    assert "guided:outlier_width=6" in names and "guided:smoothness=80" in names
    records = [make_record(name, "0", 0.2 if name.endswith("smoothness=80") else 0.1, 1.0) for name in names]
    rows = {row[0]: row for row in flatness_table(records).rows}
    assert rows["`smoothness`"][1:] == ("40", "0.1000", "0.2000", f"0.100 ({label_of(records[0])})")
    assert rows["`min_steps`"][-1] == "0.000"


def test_a_variant_changes_its_knob_and_no_other():
    preset = find_method("guided").configuration(Settings())["guidance"]
    changed = find_method("guided:smoothness=4").configuration(Settings())["guidance"]
    assert changed.pop("smoothness") == 4.0
    assert preset.pop("smoothness") == 40.0
    assert changed == preset


def test_variants_name_what_they_do_not_know():
    for wrong in ("guided:speed=2", "guided:rule", "paper:", "guided:colour=1"):
        with pytest.raises(ValueError, match="a knob of GeometryGuidance"):
            find_method(wrong)
    with pytest.raises(ValueError, match="methods must be one of"):
        find_method("magic:1")


def test_cost_is_told_as_multiples_of_the_plain_pipeline():
    records = [make_record("prior-aligned", str(i), None, 0.1, seconds=s) for i, s in enumerate((9, 1, 2))]
    records += [make_record("guided", str(i), 0.1, 0.1, seconds=6.0, peak_bytes=20_000_000) for i in range(3)]
    table = cost.cost_table(records)
    assert table.title == "Cost on 3 pairs"
    assert table.rows[0] == ("plain pipeline", "3", "2.00", "1.00", "5", "1.00")
    assert table.rows[1][2:] == ("6.00", "3.00", "20", "4.00")
    broken = [{"dataset": "a", "sample": "b", "method": "prior-aligned", "status": "broken", "error": "gone"}]
    with pytest.raises(ValueError, match="the pairs must be some on which prior-aligned works"):
        cost.cost_table(broken)


def test_latex_is_escaped():
    text = latex_escape("50 % & g_s #1 $x$ {a} ~ ^ \\ δ1 ↓ γ † ✓")
    assert text == (
        r"50 \% \& g\_s \#1 \$x\$ \{a\} \textasciitilde{} \textasciicircum{} \textbackslash{} "
        r"$\delta$1 $\downarrow$ $\gamma$ $^\dagger$ $\checkmark$"
    )


def test_grouped_columns_in_every_format():
    table = Table(
        "T",
        ("Method", "A ↓", "B", "A ↓"),
        (("x|y", "1", "2", "3"), ("z", "4", "5", "6")),
        "",
        (("", 1), ("One", 2), ("Two", 1)),
        (1,),
    )
    assert r"| Method | One: A ↓ | One: B | Two: A ↓ |" in table.markdown()
    assert r"| x\|y | 1 | 2 | 3 |" in table.markdown()
    latex = table.latex().splitlines()
    assert latex[3] == r" & \multicolumn{2}{c}{One} & \multicolumn{1}{c}{Two} \\"
    assert latex[4] == r"\cmidrule(lr){2-3} \cmidrule(lr){4-4}"
    assert latex[7:10] == [r"x$|$y & 1 & 2 & 3 \\", r"\midrule", r"z & 4 & 5 & 6 \\"]
    assert json.loads(json.dumps(table.as_json()))["groups"] == [["", 1], ["One", 2], ["Two", 1]]


@pytest.fixture
def free_methods(monkeypatch):
    """Every method that a table asks for, as one that costs nothing: twice the truth, or a reason why not."""

    def free(name):
        def measure(sample, settings, priors):
            if name == "sgbm":
                raise NotApplicable("not rectified")
            twice = 2.0 * np.where(sample.valid, sample.depth_m, 1.0)
            twice[0, 0] += 0.1
            if name == "prior-aligned":
                return Prediction(None, relative=twice)
            return Prediction(twice)

        return Method(name, name, name, measure, lambda settings: {"steps": settings.steps}, uses_prior=False)

    names = {name for own in LAYOUTS for name in paper.methods_of(own, ())} | {*cost.COST_METHODS}
    names |= {*flatness_methods(), *(method for _, method in CHANGES["parts"])}
    monkeypatch.setattr("geodiff_plugin.evaluation.baselines.METHODS", {name: free(name) for name in names})


@pytest.fixture
def scene(tmp_path):
    """One scene in Middlebury's layout."""
    folder = tmp_path / "data" / "one"
    folder.mkdir(parents=True)
    image = np.random.default_rng(0).integers(0, 256, (32, 48, 3), dtype=np.uint8)
    for name in ("im0.png", "im1.png"):
        Image.fromarray(image).save(folder / name)
    write_pfm(folder / "disp0.pfm", np.linspace(4, 9, 32 * 48, dtype=np.float32).reshape(32, 48))
    camera = "[50 0 24; 0 50 16; 0 0 1]"
    (folder / "calib.txt").write_text(
        f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline=100\nwidth=48\nheight=32\nndisp=16\n"
    )
    return tmp_path / "data"


def invoke(*words):
    return CliRunner().invoke(eval_app, [str(word) for word in words], catch_exceptions=False)


def test_table1_runs_what_is_there_and_tells_how_to_obtain_the_rest(free_methods, scene, tmp_path):
    out = tmp_path / "out"
    answer = invoke("table1", "--data", scene, "-o", out)
    assert answer.exit_code == 0
    for table in json.loads((out / "table1.json").read_text())["tables"]:
        assert all(cell in answer.stdout for row in table["rows"] for cell in row)
    assert "Middlebury (middlebury2014, 1 pair): AbsRel ↓" in answer.stdout
    assert "KITTI-Stereo was not found. To obtain it: data_scene_flow.zip" in answer.stdout
    assert "as published" not in answer.stdout and f"geodiff eval table1 --data {scene}\n" in answer.stdout
    assert r"\multicolumn{3}{c}{Booster (not found)}" in (out / "table1.tex").read_text()
    table = json.loads((out / "table1.json").read_text())["tables"][0]
    rows = {(row[0], row[1]): row for row in table["rows"]}
    assert float(rows["GeoDiff†, Algorithm 1 as printed", "✗"][-3]) == pytest.approx(1.0, abs=2e-3)
    assert float(rows["Marigold", "✓"][-3]) < 0.01
    lines = (out / "samples.jsonl").read_text()
    invoke("table1", "--data", scene, "-o", out, "-q")
    assert (out / "samples.jsonl").read_text() == lines  # everything was there


def test_published_columns_after_a_run_on_a_faked_full_set(free_methods, scene, tmp_path, monkeypatch):
    layout = LAYOUTS["table1"]
    small = tuple(column._replace(datasets=column.datasets[::-1], full_count=1) for column in layout.columns)
    monkeypatch.setitem(LAYOUTS, "table1", layout._replace(columns=small))
    answer = invoke("table1", "--data", scene, "-o", tmp_path / "out")
    assert "Middlebury, as published: RMSE m ↓" in answer.stdout
    assert re.search(r" 2\.31\s", answer.stdout)


@pytest.mark.parametrize("name", ["table1", "table2", "table3"])
def test_without_data_the_error_says_how_to_obtain_them(free_methods, name, tmp_path):
    (tmp_path / "empty").mkdir()
    for words in ((), ("--data", tmp_path / "empty")):
        with pytest.raises(
            ValueError, match=r"--data must be .* https?://|--data must be .*folders of images"
        ):
            invoke(name, *words, "-o", tmp_path / "out")


def test_ablation_takes_any_data(free_methods, scene, tmp_path):
    answer = invoke("ablation", "--data", scene, "-o", tmp_path / "out", "--methods", "sweep-sgm")
    assert "middlebury2014 (1 pair): AbsRel ↓" in answer.stdout
    assert re.search("Learning scale and shift only +✗ +1.000 ", answer.stdout)
    for title, _ in (*CHANGES["guided"], *CHANGES["paper"]):
        assert re.search(f"{re.escape(title)} +1 ", answer.stdout)


def test_parts_and_flatness_take_any_data(free_methods, scene, tmp_path):
    answer = invoke("parts", "--data", scene, "-o", tmp_path / "out")
    for title, _ in CHANGES["parts"]:
        assert re.search(f"{re.escape(title)} +1 ", answer.stdout)
    assert "Further methods" not in answer.stdout
    answer = invoke("parts", "--data", scene, "-o", tmp_path / "out", "--methods", "sweep-sgm")
    further = answer.stdout.partition("Further methods and priors, 1 pair")[2]
    assert re.search("sweep-sgm +1 +1.000", further) and not re.search("guided +1 ", further)
    answer = invoke("flatness", "--data", scene, "-o", tmp_path / "flat")
    assert re.search("`smoothness` +40 ", answer.stdout) and (tmp_path / "flat" / "flatness.md").is_file()


def test_cost_measures_each_method_in_a_process_of_its_own(free_methods, scene, tmp_path, monkeypatch):
    jobs = []

    class Inline:
        """Stands in for the executor: the same calls, in this process."""

        def __init__(self, **_):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def submit(self, function, refs, method, options):
            jobs.append(method)
            self.answer = function(refs, method, options)
            return self

        def result(self):
            return self.answer

    monkeypatch.setattr(cost, "ProcessPoolExecutor", Inline)
    answer = invoke("cost", "--data", scene, "-o", tmp_path / "out", "--save-depth")
    assert jobs == list(cost.COST_METHODS)
    assert re.search("plain pipeline +1 ", answer.stdout)
    assert "Denoising steps of each: 4 with bundled." in answer.stdout
    assert (tmp_path / "out" / "cost" / "samples.jsonl").is_file()
    assert (tmp_path / "out" / "cost.tex").is_file()
    assert (tmp_path / "out" / "cost" / "depth" / "guided" / "middlebury2014_one.npy").is_file()


def test_cost_asks_no_prior_for_more_steps_than_it_was_trained_for(tmp_path):
    make_transformers("glpn").save_pretrained(tmp_path)
    assert cost._steps_of("bundled") == cost.STEPS and cost._steps_of(str(tmp_path)) is None


def test_every_built_in_row_is_a_method():
    for name in LAYOUTS:
        for method in paper.methods_of(name, ()):
            assert find_method(method).name == method
    assert set(METHODS) >= {"guided", "paper"}
