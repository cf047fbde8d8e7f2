"""What ``geodiff eval`` prints of its pages, and the list of datasets and methods."""

import json
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

import tests.scenes.dataset  # noqa: F401  registers synthetic pairs
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cli import eval as module
from geodiff_plugin.cli.eval import eval_app, run_and_show
from geodiff_plugin.cli.terminal import EXIT_SOME_FAILED
from geodiff_plugin.evaluation import baselines, datasets, experiment, pairs, paper
from geodiff_plugin.evaluation.baselines import (
    FAMILIES,
    METHODS,
    Method,
    NotApplicable,
    Prediction,
    find_method,
)
from geodiff_plugin.evaluation.datasets import DATASETS, find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import changed_ref
from geodiff_plugin.evaluation.options import COMMANDS, PosesOptions
from geodiff_plugin.evaluation.pairs import CHANGES, FLATNESS, changes_table
from geodiff_plugin.evaluation.paper import LAYOUTS, layout_table
from geodiff_plugin.evaluation.poses import run_poses
from tests.evaluating import invoke, write_scenes

END_TO_END = pytest.mark.end_to_end


class Table:
    title, note, rows = "Errors", "smaller is better", [("a", "0.1"), ("b", "0.2")]

    def full_header(self):
        return ["method", "AbsRel"]


def page(*broken: str) -> SimpleNamespace:
    return SimpleNamespace(
        title="A page",
        facts={"command": "geodiff eval zero"},
        origin=lambda: "today",
        remarks=["A remark."],
        tables=[Table()],
        broken=broken,
    )


def options(out, quiet=False) -> SimpleNamespace:
    return SimpleNamespace(out=out, quiet=quiet)


def test_a_page_is_printed_with_its_tables_and_its_folder(tmp_path, capsys):
    asked = []
    given = options(tmp_path / "out")
    run_and_show(lambda made: asked.append(made) or page(), given)
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert asked == [given]
    assert lines[:4] == ["A page", "geodiff eval zero", "today", "A remark."]
    for line in ("Errors", "method AbsRel", "a 0.1", "b 0.2", "smaller is better"):
        assert line in lines
    assert lines[-1] == f"-> {tmp_path / 'out'}/"


def test_a_figure_is_its_path_and_quiet_prints_nothing(tmp_path, capsys):
    run_and_show(lambda made: Path("figure.pdf"), options(tmp_path))
    assert capsys.readouterr().out == "figure.pdf\n"
    for result in (Path("figure.pdf"), page(), None):
        run_and_show(lambda made, result=result: result, options(tmp_path, quiet=True))
        assert capsys.readouterr().out == ""
    run_and_show(lambda made: None, options(tmp_path))
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (1, "1 broken sample was skipped: s0. Run the same"),
        (5, "5 broken samples were skipped: s0, s1, s2, s3, s4. Run the same"),
        (6, "s3, s4 and 1 more. Run the same"),
    ],
)
def test_skipped_samples_are_reported_and_end_with_code_4(tmp_path, capsys, count, words):
    broken = [f"s{n}" for n in range(count)]
    with pytest.raises(SystemExit) as leaving:
        run_and_show(lambda made: page(*broken), options(tmp_path, quiet=True))
    assert leaving.value.code == 4 and words in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_rejected_before_the_work(tmp_path):
    (tmp_path / "file").write_text("text")
    with pytest.raises(InputError):
        run_and_show(lambda made: pytest.fail("the work was begun"), options(tmp_path / "file"))


def run(*words) -> int:
    try:
        return eval_app([str(word) for word in words], standalone_mode=False) or 0
    except SystemExit as leaving:
        return leaving.code


def test_every_command_measures_and_shows(monkeypatch):
    asked = []
    for name, command in module._COMMANDS.items():
        assert command.run.func is run_and_show and command.run.args == (COMMANDS[name].run,)
        assert command.options is COMMANDS[name].options and command.about == COMMANDS[name].about
        asked.append(name)
    assert asked == list(COMMANDS) and "list" not in COMMANDS


def test_the_list_shows_what_exists_and_how_to_get_the_rest(monkeypatch, capsys, tmp_path):
    counts = {"one": 1, "two": 2, "none": 0, "made": 0}
    monkeypatch.setattr(
        datasets,
        "DATASETS",
        {name: SimpleNamespace(needs_folder=name != "made", obtain=f"Get {name}.") for name in counts},
    )
    asked = []

    def find_pairs(folder, names):
        asked.append(folder)
        return ["sample"] * counts[names[0]]

    def plane(prior):
        """Fits a plane; the simplest."""

    class Alone:
        """Alone. Nothing else."""

    monkeypatch.setattr(datasets, "find_pairs", find_pairs)
    monkeypatch.setattr(baselines, "METHODS", {"ours": SimpleNamespace(summary="the method")})
    monkeypatch.setattr(baselines, "FAMILIES", {"plane": plane, "alone": Alone})
    assert run("list", "--data", tmp_path) == 0
    text = " ".join(capsys.readouterr().out.split())
    for part in (
        "one 1 sample Get one.",
        "two 2 samples Get two.",
        "none not found Get none.",
        "made any number of samples Get made.",
        "ours the method",
        "plane:... fits a plane",
        "alone:... alone",
        "METHOD@PRIOR",
        "METHOD#SEED",
    ):
        assert part in text, text
    assert asked == [tmp_path] * 4 and "the simplest" not in text and "Nothing else" not in text
    assert run("list") == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "one no --data set Get one." in text and len(asked) == 4
    assert "made any number of samples" in text


@pytest.fixture
def data(tmp_path):
    return write_scenes(tmp_path / "data", "one", "two")


def lines_of(out):
    return [json.loads(line) for line in (out / "samples.jsonl").read_text().splitlines()]


@END_TO_END
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


@END_TO_END
def test_pairs_selects_draws_and_reports_this(data, tmp_path):
    words = ("pairs", data, "--methods", "sgbm", "-o", tmp_path / "out")
    assert invoke(*words, "--scenes", "two", "-q") == "" and len(lines_of(tmp_path / "out")) == 1
    drawn = [invoke(*words, "--sample", 1, "--seed", i) for i in (0, 1, 2, 3, 4, 0)]
    picked = ["middlebury2014/two" in said for said in drawn]
    assert picked[0] == picked[-1] and set(picked) == {True, False}
    assert "Drawn with seed 0: middlebury2014/" in drawn[0]


@END_TO_END
def test_pairs_continues_after_a_broken_sample_reports_it_at_the_end_and_retries_it(data, tmp_path):
    image = data / "one" / "im1.png"
    words = ("pairs", data, "--methods", "sgbm,sweep-sgm", "-o", tmp_path / "out")
    image.rename(tmp_path / "kept.png")
    with pytest.raises(FileNotFoundError, match=r"im1\.png"):
        invoke(*words, "--stop-on-broken")
    answer = CliRunner().invoke(eval_app, [str(word) for word in words])
    assert answer.exit_code == EXIT_SOME_FAILED
    left_out = (
        "geodiff: 1 broken sample was skipped: middlebury2014/one. Run the same command again to retry."
    )
    assert answer.stderr.splitlines()[-1] == left_out
    said = invoke(*words)
    assert "1 broken sample was skipped" in said and said.count("im1.png") == 1
    assert "(sgbm, sweep-sgm)" in said
    (tmp_path / "kept.png").rename(image)
    assert "broken" not in invoke(*words)


@END_TO_END
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("pairs DATA --methods magic", "methods"),
        ("pairs DATA --limit 0", "--limit must be between 1"),
        ("pairs DATA --sample 3", "--sample must be at most 2"),
        ("pairs DATA --scenes three", "a sample with three in its name"),
        ("pairs TWICE --methods sgbm", "with several middlebury2014/one"),
        ("poses", "--data must be set, or --exact"),
        *((f"poses --data DATA --perturb {text}", "--perturb") for text in ("1.5", "1..2,0.1", "99,0")),
        ("poses --data DATA --drift 0.3,99", "--drift"),
        ("table1 --data EMPTY", r"--data must be a folder with the data of table1; .* https?://"),
        ("table2", r"--data must be set; got nothing. Booster: .*https?://"),
    ],
)
def test_bad_options_are_named(data, tmp_path, words, said):
    shutil.copytree(data, tmp_path / "twice" / "full")
    shutil.copytree(data, tmp_path / "twice" / "quarter")
    (tmp_path / "empty").mkdir()
    folders = {"DATA": data, "TWICE": tmp_path / "twice", "EMPTY": tmp_path / "empty"}
    with pytest.raises(ValueError, match=said):
        invoke(*(folders.get(word, word) for word in words.split()), "-o", tmp_path / "out")


@END_TO_END
def test_list_shows_what_exists(data):
    said = invoke("list", "--data", data)
    assert re.search(r"middlebury2014 +2 samples", said) and re.search(r"kitti2015 +not found", said)
    assert all(name in said for name in ("https://", *DATASETS, *METHODS, *FAMILIES))


@END_TO_END
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
    baseline, given = (np.linalg.norm(E[:3, 3]) for E in (sample.E, wrong.E))
    assert 0.3 * 1.5 <= np.degrees(turn) <= 1.5 and given == pytest.approx(baseline)
    assert 0 < np.linalg.norm(wrong.E[:3, 3] - sample.E[:3, 3]) < 0.12 * baseline
    moved, turned = changed("drifted", 0.0, 2.0), changed("drifted", 0.3, 1.5)
    assert any(np.array_equal(moved.right[10:60], sample.right[10 - px : 60 - px]) for px in (2, -2))
    assert np.abs(turned.right.astype(int) - sample.right).mean() > 1


POSED = Path("synthetic-posed:2@256x192")


@END_TO_END
def test_the_page_of_poses(tmp_path, monkeypatch):
    """Two rendered pairs: estimated, one has no pose and the other is off by half without a word."""

    def measure(ref, read, method, settings, priors, path):
        pose = method.name.partition("=")[2]
        errors = {"given": 0.1, "refine": 0.06, "estimated": None if ref.files["seed"] > 1 else 0.5}
        error = 0.05 if "perturbed" not in ref.files and pose == "given" else errors[pose]
        said = {"code": "views.inconsistent", "severity": "reason", "text": "Said."}
        findings = [] if pose == "estimated" else [said]
        notes = {"method": {"findings": findings, "residual_px_given": [1.25], "residual_px": [0.5]}}
        status = {"rectified": False, "status": "not applicable" if error is None else "ok"}
        return status | {"all_pixels": {"raw": {"abs_rel": error}, "aligned": None}, "notes": notes}

    monkeypatch.setattr(experiment, "_measure", measure)
    page = tmp_path / "docs" / "results-pose.md"
    options = PosesOptions(exact=POSED, out=tmp_path / "out", results=page, quiet=True)
    run_poses("poses", options)
    assert {
        f"    geodiff eval poses --exact {POSED}",
        "| pair | true, given | perturbed, given | perturbed, refined | estimated |",
        "| mean of 2 pairs | 0.050 | 0.100 | 0.060 | 0.500 of 1 |",
        "| without a result | 0 | 0 | 0 | 1 |",
        "| off by more than 0.25, no warning | 0 | 0 | 0 | 1 |",
    } <= set(page.read_text().splitlines())


def make_record(method, sample, raw, aligned, **rest):
    def scores(abs_rel):
        return None if abs_rel is None else dict.fromkeys(("delta1", "rmse"), 0.5) | {"abs_rel": abs_rel}

    head = {"method": method, "dataset": "kitti2015", "sample": sample, "status": "ok"}
    measured = {"capped": {"raw": scores(raw), "aligned": scores(aligned)}}
    return head | measured | {"seconds": 2.0, "peak_bytes": 5_000_000} | rest


@END_TO_END
def test_a_mean_needs_every_pair_and_a_method_fills_the_row_that_has_its_word(monkeypatch):
    peer = Method("files:maps/unidepth", "UniDepth files", "", lambda *_: None, lambda _: {}, False)
    find = paper.find_method
    monkeypatch.setattr(paper, "find_method", lambda name: peer if name == peer.name else find(name))
    layout, methods = LAYOUTS["table1"], ["prior-aligned", "sgbm", peer.name]
    records = [make_record("sgbm", "0", 0.3, 0.4), make_record("prior-aligned", "0", None, 0.5)]
    records += [make_record("sgbm", "1", None, None, status="not applicable", capped=None)]
    records += [make_record("prior-aligned", "1", None, 0.7)]
    records += [make_record(peer.name, label, 0.3, 0.4) for label in "01"]
    kitti, *others = layout.columns
    kitti = kitti._replace(dataset="kitti2015", labels=frozenset(("kitti2015/0", "kitti2015/1")))
    table = layout_table(layout, [kitti, *others], records, methods)
    rows = {row[:2]: row[2] for row in table.rows}
    assert rows["Marigold", "✓"] == "0.600" and rows["UniDepth", "✗"] == "0.300"
    assert rows[find_method("sgbm").title + "†", "✗"] == "-"
    assert len(rows) == len(layout.rows) + 2
    assert "hf:Intel/zoedepth-nyu-kitti" in table.note and "Not run here" in table.note


@END_TO_END
def test_changes_are_compared_pair_by_pair():
    errors = {"guided": 0.1, "guided:weights.matches=0": 0.3}
    records = [make_record(m, str(i), e + 0.01 * i, 1.0) for m, e in errors.items() for i in range(5)]
    rows = {row[0]: row for row in changes_table(records, "guided").rows}
    assert set(rows) == {"unchanged", "without matches"}
    assert rows["unchanged"][5] == "-" and rows["without matches"][5] == "+0.200 [+0.200, +0.200]"
    assert rows["without matches"][3] == "0.340"  # the worst pair


@END_TO_END
def test_cost_is_relative_to_the_plain_pipeline():
    records = [make_record("prior-aligned", str(i), None, 0.1, seconds=s) for i, s in enumerate((9, 1, 2))]
    records += [make_record("guided", str(i), 0.1, 0.1, seconds=6.0, peak_bytes=20_000_000) for i in range(3)]
    table = pairs.cost_table(records)
    assert table.title == "Cost on 3 pairs"
    assert table.rows[0] == ("plain pipeline", "3", "2.00", "1.00", "5", "1.00")
    assert table.rows[1][2:] == ("6.00", "3.00", "20", "4.00")
    with pytest.raises(ValueError, match="the pairs must be some that prior-aligned supports"):
        pairs.cost_table([records[0] | {"status": "broken"}])


@pytest.fixture
def free_methods(monkeypatch):
    """Replace every method of a table by one that costs nothing: twice ground truth, or a reason why not."""

    def measure(name, sample, settings, priors):
        if name == "sgbm":
            raise NotApplicable("not rectified")
        twice = 2.0 * np.where(sample.valid, sample.depth_m, 1.0)
        twice[0, 0] += 0.1
        return Prediction(None, relative=twice) if name == "prior-aligned" else Prediction(twice)

    names = {name for own in LAYOUTS for name in paper.methods_of(own, ())} | {*pairs.COST_METHODS}
    names |= {*FLATNESS, *(method for _, method in CHANGES["parts"])}
    free = {n: Method(n, n, n, partial(measure, n), lambda s: {"steps": s.steps}, False) for n in names}
    monkeypatch.setattr("geodiff_plugin.evaluation.baselines.METHODS", free)


@pytest.fixture
def scene(data):
    return data / "one"


@END_TO_END
def test_the_papers_tables_run_its_ensemble_and_others_one_member():
    of_paper = {name for name, command in COMMANDS.items() if _ensemble_of(command) == 10}
    assert of_paper == set(LAYOUTS)
    assert {_ensemble_of(COMMANDS[name]) for name in ("pairs", "parts", "flatness", "cost")} == {1}


def _ensemble_of(command):
    described = command.options.__dataclass_fields__.get("ensemble")
    return None if described is None else described.default


@END_TO_END
def test_table1_runs_what_exists_and_states_how_to_obtain_the_rest(
    free_methods, scene, tmp_path, monkeypatch
):
    out, layout = tmp_path / "out", LAYOUTS["table1"]
    said = invoke("table1", "--data", scene, "-o", out)
    tables = json.loads((out / "table1.json").read_text())["tables"]
    latex = (out / "table1.tex").read_text()
    assert r"\multicolumn{3}{c}{Booster (not found)}" in latex and r"AbsRel $\downarrow$ &" in latex
    assert all(cell in said for table in tables for row in table["rows"] for cell in row)
    assert "Middlebury (middlebury2014, 1 pair): AbsRel ↓" in said and "as published" not in said
    assert "KITTI-Stereo was not found. To obtain it: data_scene_flow.zip" in said
    rows = {(row[0], row[1]): row for row in tables[0]["rows"]}
    assert float(rows["GeoDiff†, Algorithm 1 as printed", "✗"][-3]) == pytest.approx(1.0, abs=2e-3)
    assert float(rows["Marigold", "✓"][-3]) < 0.01
    lines = (out / "samples.jsonl").read_text()
    small = tuple(column._replace(datasets=column.datasets[::-1], full_count=1) for column in layout.columns)
    monkeypatch.setitem(LAYOUTS, "table1", layout._replace(columns=small))
    again = invoke("table1", "--data", scene, "-o", out)  # a full set now
    assert "Middlebury, as published: RMSE m ↓" in again and re.search(r" 2\.31\s", again)
    assert (out / "samples.jsonl").read_text() == lines  # everything was there


@END_TO_END
def test_ablation_parts_and_flatness_take_any_data(free_methods, scene, tmp_path):
    words = ("--data", scene, "-o", tmp_path / "out", "--methods", "sweep-sgm")
    ablation, parts, flat = (invoke(name, *words) for name in ("ablation", "parts", "flatness"))
    assert re.search("Learning scale and shift only +✗ +1.000 ", ablation)
    for said, presets in ((ablation, ("guided", "paper")), (parts, ("parts",))):
        titles = [title for preset in presets for title, _ in CHANGES[preset]]
        assert all(re.search(f"{re.escape(title)} +1 ", said) for title in titles)
    for said in (parts, flat):
        further = said.partition("Further methods and priors, 1 pair")[2]
        assert re.search("sweep-sgm +1 +1.000", further) and not re.search("guided +1 ", further)
    assert re.search("`smoothness` +40 ", flat) and (tmp_path / "out" / "flatness.md").is_file()


@END_TO_END
def test_cost_measures_each_method_in_a_process_of_its_own(free_methods, scene, tmp_path, monkeypatch):
    started = []

    def inline():
        started.append(ThreadPoolExecutor(1))
        return started[-1]

    monkeypatch.setattr(pairs, "fresh_process", inline)
    out = tmp_path / "out"
    answer = invoke("cost", "--data", scene, "-o", out, "--save-depth")
    assert len(started) == len(pairs.COST_METHODS) and re.search("plain pipeline +1 ", answer)
    assert "Denoising steps per method: 4 with bundled." in answer and (out / "cost.md").is_file()
    assert (out / "cost" / "depth" / "guided" / "middlebury2014_one.npy").is_file()
