"""Tables of changed methods and of cost, and what the commands over pairs run."""

import statistics
from types import SimpleNamespace

import numpy as np
import pytest

from geodiff_plugin.algorithm.optimizers import OPTIMIZERS
from geodiff_plugin.config import DEFAULT, PAPER, value_of
from geodiff_plugin.evaluation import experiment, pairs
from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.datasets import DATASETS
from geodiff_plugin.evaluation.datasets.sample import SampleRef
from geodiff_plugin.evaluation.options import DirOptions, PairsOptions
from geodiff_plugin.evaluation.pairs import CHANGES, FLATNESS, NUMBERS


def record(method, sample, abs_rel=0.5, delta1=0.5, seconds=2.0, **rest):
    scores = {"raw": {"abs_rel": abs_rel, "delta1": delta1}, "aligned": {"abs_rel": 9.0, "delta1": 9.0}}
    head = {"method": method, "dataset": "d", "sample": sample, "status": "ok", "peak_bytes": 4_000_000}
    return head | {"capped": scores, "all_pixels": scores, "seconds": seconds} | rest


def test_remarks_state_the_prior_what_did_not_apply_and_what_was_broken(tmp_path):
    options = PairsOptions(out=tmp_path, prior="x/y", seed=3, ensemble=4)
    no = {"status": "not applicable", "reason": "not rectified"}
    records = [record("guided", "a"), record("sgbm", "a", **no), record("sgbm", "b", **no)]
    records += [record("sgbm", "c", status="not applicable", reason="of different sizes")]
    records += [record(m, "d", status="broken", error="cut off") for m in ("guided", "sgbm")]
    assert pairs.remarks_on(records, options) == [
        "Prior x/y, seed 3, ensemble 4.",
        "SGBM + fill: '-' for 2 pairs, not rectified.",
        "SGBM + fill: '-' for 1 pair, of different sizes.",
        "1 broken sample was skipped:",
        "- d/d (guided, sgbm): cut off",
    ]
    records += [record("guided", "e", status="broken", error="missing")]
    assert pairs.remarks_on(records, options)[3:] == [
        "2 broken samples were skipped:",
        "- d/d (guided, sgbm): cut off",
        "- d/e (guided): missing",
    ]
    assert len(pairs.remarks_on(records[:1], options)) == 1


def test_every_change_is_one_of_its_preset_and_the_first_is_none():
    configs = {"guided": DEFAULT, "paper": PAPER, "parts": DEFAULT}
    for name, config in configs.items():
        methods = [method for _, method in CHANGES[name]]
        assert methods[0] == {"parts": "guided"}.get(name, name) and len(set(methods)) == len(methods)
        for method in methods:
            base, _, text = method.partition(":")
            find_method(method)  # names a method that there is
            for parameter, _, value in (part.partition("=") for part in filter(None, text.split("+"))):
                assert base == methods[0]
                assert str(value_of(parameter, config)) != value, f"{method} changes nothing"
    names = {row.removeprefix("optimizer ") for row, _ in CHANGES["guided"] if row.startswith("optimizer ")}
    assert names == set(OPTIMIZERS) - {"adam"}
    rules = {row.removeprefix("optimizer ") for row, _ in CHANGES["paper"] if row.startswith("optimizer ")}
    assert rules == set(OPTIMIZERS) - {"summed"}
    without = {row: method for row, method in CHANGES["guided"] if row.startswith("without ")}
    assert without == {
        f"without {name}": f"guided:weights.{name}=0" for name in DEFAULT.weights if name != "points"
    }


def test_changes_are_means_worst_and_paired_differences_to_the_unchanged_preset():
    rng, methods = np.random.default_rng(0), ("paper", "paper:weights.affine_reg=0", "paper:optimizer=adam")
    records = [
        record(method, str(i), *rng.uniform(0.1, 0.9, 3))
        for method in methods
        for i in range(7 - (method != "paper"))
    ]
    table = pairs.changes_table([*records, record("sgbm", "0")], "paper")
    assert table.title == "Algorithm 1 as printed, one change at a time, 7 pairs"
    assert table.header == (
        *("change", "pairs", "AbsRel ↓ [95 %]", "worst"),
        *("δ1 ↑ [95 %]", "AbsRel change", "seconds"),
    )
    assert [row[:2] for row in table.rows] == [("unchanged", "7"), ("γ = 0", "6"), ("optimizer adam", "6")]
    base = {r["sample"]: r["capped"]["raw"]["abs_rel"] for r in records[:7]}
    for row, group in zip(table.rows, (records[:7], records[7:13], records[13:]), strict=True):
        errors = [r["capped"]["raw"]["abs_rel"] for r in group]
        assert row[2].split()[0] == f"{np.mean(errors):.3f}" and row[3] == f"{max(errors):.3f}"
        assert row[4].split()[0] == f"{np.mean([r['capped']['raw']['delta1'] for r in group]):.3f}"
        assert row[6] == f"{np.mean([r['seconds'] for r in group]):.1f}"
        more = np.mean([r["capped"]["raw"]["abs_rel"] - base[r["sample"]] for r in group])
        assert row[5].split()[0] == ("-" if row[0] == "unchanged" else f"{more:+.3f}")


def test_flatness_halves_and_doubles_every_number_and_names_the_pair_that_moves_most():
    assert FLATNESS[0] == "guided" and len(FLATNESS) == len(set(FLATNESS)) == 1 + 2 * len(NUMBERS)
    for number, half, twice in zip(NUMBERS, FLATNESS[1::2], FLATNESS[2::2], strict=True):
        value = value_of(number, DEFAULT)
        for method, factor in ((half, 0.5), (twice, 2.0)):
            name, _, changed = method.removeprefix("guided:").partition("=")
            assert name == number and abs(float(changed) - factor * value) <= (
                0.5 if type(value) is int else 1e-5
            )
            find_method(method)
    rng = np.random.default_rng(3)
    records = [record(m, s, rng.uniform(0.2, 0.8)) for m in FLATNESS[:5] for s in "abc"]
    records.append(record(FLATNESS[1], "of no default", 99.0))
    errors = {(r["method"], r["sample"]): r["capped"]["raw"]["abs_rel"] for r in records}
    table = pairs.flatness_table(records)
    assert table.title.endswith("twice its value, 3 pairs") and len(table.rows) == len(NUMBERS)
    assert f"{np.mean([errors['guided', s] for s in 'abc']):.4f} with default values" in table.note
    for row, number, at in zip(table.rows, NUMBERS, range(2), strict=False):
        changed = FLATNESS[1 + 2 * at : 3 + 2 * at]
        means = [f"{np.mean([errors[m, s] for s in 'abc']):.4f}" for m in changed]
        moved = {(abs(errors[m, s] - errors["guided", s]), f"d/{s}") for m in changed for s in "abc"}
        most, label = max(moved)
        assert row == (f"`{number}`", f"{value_of(number, DEFAULT):g}", *means, f"{most:.3f} ({label})")
    assert table.rows[-1][2:] == ("-", "-", "0.000")
    assert table.header == ("parameter", "value", "at half", "at twice", "largest change of a pair")


def test_cost_is_the_median_time_and_the_greatest_peak_of_finished_pairs():
    rng = np.random.default_rng(2)
    methods = ("guided", pairs.PLAIN, "paper")
    records = [
        record(m, str(i), seconds=rng.uniform(1, 99), peak_bytes=int(rng.uniform(1e6, 9e8)))
        for m in methods
        for i in range(5)
    ]
    records.append(record("guided", "9", seconds=1e6, status="broken"))
    table = pairs.cost_table(records)
    assert table.header == ("method", "pairs", "seconds", "time × plain", "peak MB", "memory × plain")
    assert table.title == "Cost on 6 pairs"

    def cost(group):
        return statistics.median(r["seconds"] for r in group), max(r["peak_bytes"] for r in group)

    plain = cost(records[5:10])
    for row, title, group in zip(
        table.rows,
        ("guided", "plain pipeline", "paper"),
        (records[:5], records[5:10], records[10:15]),
        strict=True,
    ):
        seconds, peak = cost(group)
        assert row[:3] == (title, "5", f"{seconds:.2f}") and row[3] == f"{seconds / plain[0]:.2f}"
        assert row[4:] == (f"{peak / 1e6:.0f}", f"{peak / plain[1]:.2f}")
    free = pairs.cost_table([record(pairs.PLAIN, "a", seconds=0.0, peak_bytes=0), record("guided", "a")])
    assert free.rows[1][3] == "2000.00" and free.rows[1][5] == "4000000.00"


def test_a_prior_that_was_trained_for_fewer_steps_takes_its_own_number(monkeypatch):
    most = {"any": None, "one": 1, "three": 3, "four": 4, "fifty": 50}
    monkeypatch.setattr(pairs, "PRIORS", {k: SimpleNamespace(max_steps=n) for k, n in most.items()})
    monkeypatch.setattr(pairs, "find_prior", lambda name: SimpleNamespace(key=name))
    assert {name: pairs._steps_of(name) for name in most} == {
        **{"any": 4, "one": None, "three": None, "four": 4, "fifty": 4}
    }


def test_other_processes_import_the_modules_of_every_registered_set(monkeypatch):
    def read(module):
        def load(ref):
            return None

        load.__module__ = module
        return SimpleNamespace(load=load)

    known = {name: read(name) for name in ("json", "base64", "__main__")}
    monkeypatch.setattr(pairs, "DATASETS", known)
    assert pairs.modules_of_datasets() == ["base64", "json"]
    imported = []
    monkeypatch.setattr(pairs.importlib, "import_module", imported.append)
    pairs._import_all(["a", "b"])
    assert imported == ["a", "b"]
    assert {"geodiff_plugin.evaluation.datasets.layouts"} <= {d.load.__module__ for d in DATASETS.values()}


REFS = [SampleRef("d", name, {}) for name in "ab"]


@pytest.fixture
def compared(monkeypatch):
    """What is handed to ``compare`` in place of a run."""
    handed = []
    monkeypatch.setattr(pairs, "select", lambda options: REFS)
    monkeypatch.setattr(pairs, "compare", lambda name, options, made: handed.append((name, options, made)))
    return handed


def test_pairs_state_what_was_drawn_and_use_the_methods_of_the_options(compared, tmp_path):
    drawn, whole = (
        DirOptions(data=tmp_path, out=tmp_path, methods=("sgbm",), seed=8, sample=n) for n in (2, None)
    )
    pairs.run_pairs("pairs", drawn), pairs.run_pairs("pairs", whole)
    (name, options, made), (_, _, other) = compared
    assert (name, options, made.refs, made.methods) == ("pairs", drawn, REFS, ("sgbm",))
    assert (made.title, made.tables) == ("Results per pair", pairs.tables.pairs_tables)
    assert list(made.remarks) == ["Drawn with seed 8: d/a, d/b."] and list(other.remarks) == []


@pytest.mark.parametrize(
    ("name", "title"), [("parts", "Ablation"), ("flatness", "Hyperparameter sensitivity")]
)
def test_changes_run_their_methods_first_and_show_added_ones_separately(compared, tmp_path, name, title):
    options = PairsOptions(out=tmp_path, methods=("sgbm", "fast"))
    pairs.run_changes(name, options)
    ((given, _, made),) = compared
    own = FLATNESS if name == "flatness" else tuple(m for _, m in CHANGES["parts"])
    assert (given, made.title, made.refs) == (name, title, REFS)
    assert made.methods == (*own, "sgbm", "fast")
    records = [record(m, s, **{"regions": {"visible": 0.5}}) for m in ("guided", "sgbm") for s in "ab"]
    for each in records:
        each["capped"] = {"raw": {k: 0.5 for k in (*pairs.tables.HEADINGS, "coverage")}, "aligned": None}
    first, further, *more = made.tables(records)
    assert "default" in first.title and further.title == "Further methods and priors, 2 pairs"
    assert [row[0] for row in further.rows] == ["SGBM + fill"]
    assert [table.title for table in more] == ([pairs.tables.REGIONS] if name == "parts" else [])


def test_a_comparison_hands_cells_tables_and_both_kinds_of_remarks_on(monkeypatch, tmp_path):
    handed = []
    monkeypatch.setattr(experiment, "method_cells", lambda *given: given)
    monkeypatch.setattr(experiment, "run_experiment", lambda *given: handed.append(given))
    options = PairsOptions(out=tmp_path, save_depth=True, seed=5)
    made = pairs.Comparison("Title", REFS, ("guided", "sgbm", "guided"), tables=list, remarks=("More.",))
    pairs.compare("parts", options, made)
    ((name, given, of_pairs),) = handed
    refs, names, settings, out, save = of_pairs.cells
    assert (name, given, of_pairs.title, of_pairs.tables) == ("parts", options, "Title", list)
    assert (refs, names, out, save) == (REFS, ("guided", "sgbm"), tmp_path, True) and settings.seed == 5
    assert of_pairs.journal == "samples.jsonl"
    assert of_pairs.remarks([record("guided", "a")]) == ["Prior bundled, seed 5, ensemble 1.", "More."]


class Inline:
    """A process that is this one."""

    started = 0

    def __enter__(self):
        Inline.started += 1
        return self

    def __exit__(self, *_):
        pass

    def submit(self, work, *given):
        return SimpleNamespace(result=lambda: work(*given))


def test_cost_runs_every_method_alone_with_the_steps_of_its_prior(monkeypatch, tmp_path, compared):
    asked, written = [], []

    def measured(refs, method, options):
        asked.append((refs, method, options.steps, options.out))
        return [record(method, "a"), record(method, "b")]

    monkeypatch.setattr(pairs, "fresh_process", Inline)
    monkeypatch.setattr(pairs, "_method_records", measured)
    monkeypatch.setattr(pairs, "_steps_of", lambda prior: None if prior == "x/y" else 4)
    monkeypatch.setattr(experiment, "write_page", lambda *given: written.append(given))
    options = PairsOptions(out=tmp_path, methods=("guided@x/y", "paper"))
    pairs.run_cost("cost", options)
    names = [*pairs.COST_METHODS, "guided@x/y"]
    steps = [4] * len(pairs.COST_METHODS) + [None]
    assert asked == [(REFS, m, n, tmp_path / "cost") for m, n in zip(names, steps, strict=True)]
    assert Inline.started == len(names)
    ((name, given, title, (table,), remarks),) = written
    assert (name, given, title) == ("cost", options, "Cost") and len(table.rows) == len(names)
    assert remarks[0].startswith("Prior bundled") and remarks[-1] == (
        "Denoising steps per method: 4 with bundled, default number with x/y."
    )
    pairs.run_cost("cost", PairsOptions(out=tmp_path, steps=7))
    assert {n for _, _, n, _ in asked[len(names) :]} == {7}
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ValueError, match="the number of processes must be 1 for cost; got 2"):
        pairs.run_cost("cost", options)


def test_records_of_one_method_are_those_of_its_cells(monkeypatch, tmp_path):
    monkeypatch.setattr(experiment, "method_cells", lambda refs, names, *_: [refs, names])
    monkeypatch.setattr(experiment, "measure_cells", lambda cells, options: [cells, options.out])
    options = PairsOptions(out=tmp_path)
    assert pairs._method_records(REFS, "sgbm", options) == [[REFS, ("sgbm",)], tmp_path]
    monkeypatch.setattr(experiment, "measure_cells", lambda cells, options: None)
    assert pairs._method_records(REFS, "sgbm", options) == []


def test_an_actor_measures_the_cell_of_a_key(monkeypatch, tmp_path, compared):
    cells = [SimpleNamespace(key=k, payload=lambda k=k: {"of": k}) for k in "pq"]
    monkeypatch.setattr(pairs, "pair_cells", lambda refs, methods, options: cells if refs is REFS else [])
    measure = pairs._cells_by_key(DirOptions(data=tmp_path, out=tmp_path), ["json"])
    assert measure("q") == {"of": "q"} and measure("p") == {"of": "p"}
