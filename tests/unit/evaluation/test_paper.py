"""The paper's tables: its published numbers, which data set stands for which column, and their cells."""

from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin.evaluation import paper
from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.datasets import DATASETS, SampleRef
from geodiff_plugin.evaluation.options import PairsOptions
from geodiff_plugin.evaluation.pairs import CHANGES
from geodiff_plugin.evaluation.paper import LAYOUTS, Column, Layout, Row
from geodiff_plugin.evaluation.tables import REGIONS

#: As the package has the tables, so that a slip shows: columns with pairs, metrics, rows by title and kind.
PRINTED = {
    "table1": (
        {"KITTI-Stereo": 200, "Booster": 228, "Middlebury": 15},
        ("abs_rel", "delta1", "rmse"),
        {
            ("MiDaS", True): "0.63 0.24 11.72 0.18 0.71 0.23 0.22 0.72 2.09",
            ("Marigold", True): "0.13 0.85 4.81 0.04 0.98 0.06 0.14 0.83 1.61",
            ("GeoWizard", True): "0.18 0.75 5.7 0.04 0.96 0.08 0.15 0.81 1.55",
            ("ZoeDepth", False): "0.74 - 16.26 7.37 - 7.72 0.60 - 6.04",
            ("UniDepth", False): "0.19 0.86 4.18 4.55 - 4.91 0.61 - 6.03",
            ("DepthPro", False): "0.16 0.81 4.43 0.34 0.51 0.67 0.54 0.02 5.60",
            ("GeoDiff†", False): "0.07 0.91 3.94 0.11 0.81 0.18 0.11 0.85 2.31",
            ("GeoDiff", True): "0.09 0.91 3.72 0.04 0.98 0.06 0.11 0.87 1.41",
        },
    ),
    "table2": (
        {"Booster": 228},
        ("abs_rel", "delta1", "rmse"),
        {
            ("RAFT-Stereo", False): "5.4 - 18.89",
            ("IGEV-Stereo", False): "0.10 0.94 0.31",
            ("GeoDiff†", False): "0.11 0.81 0.18",
            ("GeoDiff", True): "0.04 0.98 0.06",
        },
    ),
    "table3": (
        {"Tanks and Temples": 116},
        ("abs_rel", "delta1", "rmse"),
        {
            ("DUSt3R", False): "0.51 0.35 0.56",
            ("GeoDiff†", False): "0.47 0.38 0.62",
            ("DUSt3R", True): "0.07 0.93 0.17",
            ("GeoDiff", True): "0.08 0.92 0.18",
        },
    ),
    "ablation": (
        {"KITTI-Stereo": 200},
        ("abs_rel", "delta1"),
        {
            ("Learning scale and shift only", False): "0.14 0.80",
            ("Our full model", False): "0.07 0.91",
        },
    ),
}
ALIGNED_ONLY = {"prior-aligned"}


@pytest.mark.parametrize("name", PRINTED)
def test_layouts_hold_what_the_paper_prints(name):
    layout, (columns, metrics, rows) = LAYOUTS[name], PRINTED[name]
    assert {c.title: c.full_count for c in layout.columns} == columns and layout.metrics == metrics
    assert all(dataset in DATASETS for column in layout.columns for dataset in column.datasets)
    held = {(row.title.partition(",")[0], row.aligned): row for row in layout.rows}
    assert list(held) == list(rows)
    for key, cells in rows.items():
        row = held[key]
        assert [cell for title in columns for cell in row.published[title]] == cells.split()
        if not row.method.startswith(("hf:", "files:")):
            find_method(row.method)
        if key[0].startswith("GeoDiff") or key[0] == "Our full model":
            assert row.method == "paper"
    for method in layout.methods:
        find_method(method)
    wanted = {"guided", "no-diffusion", "sweep-sgm"} if name != "ablation" else {"guided", "scale-shift-only"}
    assert wanted <= set(layout.methods) and ("sgbm" in layout.methods) == (name in ("table1", "table2"))
    assert [c.datasets[0] for c in layout.columns] == {
        **{"table1": ["kitti2015", "booster", "middeval3"], "table2": ["booster"]},
        **{"table3": ["robustmvd"], "ablation": ["kitti2015"]},
    }[name]


def test_methods_run_once_the_papers_rows_before_peers_and_the_users():
    assert paper.methods_of("table1", ("fast", "guided")) == (
        *("prior-aligned", "paper", "guided", "no-diffusion", "sweep-sgm", "sgbm", "fast"),
    )
    ablation = paper.methods_of("ablation", ())
    changed = [method for preset in ("guided", "paper") for _, method in CHANGES[preset]]
    assert ablation[:2] == ("paper:optimize_latents=false", "paper")
    assert set(changed) <= set(ablation) and len(ablation) == len(set(ablation))
    assert not set(paper.methods_of("table3", ())) & {m for _, m in CHANGES["parts"]} - {
        "guided",
        "no-diffusion",
    }


def test_a_column_is_complete_with_the_papers_own_set_in_full():
    column = Column("M", ("first", "second"), 2)
    assert not column.complete and column.heading == "M (not found)"
    one, two = frozenset(["a"]), frozenset("ab")
    own, other = (column._replace(dataset=d, labels=two) for d in ("first", "second"))
    assert own.complete and own.heading == "M (2 pairs)"
    assert not other.complete and other.heading == "M (second, 2 pairs)"
    assert not own._replace(labels=one).complete and own._replace(labels=one).heading == "M (1 pair)"


def test_a_users_method_fills_the_row_whose_word_it_names():
    methods = [
        "guided",
        "files:maps/RAFT-Stereo",
        "hf:apple/DepthPro-hf",
        "hf:other/zoedepth",
        "prior-aligned",
    ]
    filled = {
        "guided": "guided",
        "files:DIR/raft-stereo": "files:maps/RAFT-Stereo",
        "hf:apple/DepthPro-hf": "hf:apple/DepthPro-hf",
        "hf:Intel/zoedepth-nyu-kitti": "hf:other/zoedepth",
        "files:DIR/igev-stereo": "",
        "paper": "",
        "prior": "",
    }
    assert {method: paper._filler(method, methods) for method in filled} == filled


def record(method, dataset, sample, seed, metric=True):
    rng = np.random.default_rng(seed)
    scores = (
        {m: float(v) for m, v in zip(paper.METRICS, rng.uniform(1, 9, 3), strict=True)} for _ in range(2)
    )
    raw, aligned = scores
    head = {"method": method, "dataset": dataset, "sample": sample, "status": "ok"}
    return head | {"capped": {"raw": raw if metric else None, "aligned": aligned}}


def test_the_table_has_raw_and_aligned_means_and_published_cells_of_complete_columns():
    columns = (Column("One", ("one",), 2), Column("Two", ("two", "more"), 1))
    rows = (
        Row("Ours", False, "guided", {"One": ("1", "2", "3"), "Two": ("4", "5", "6")}),
        Row("Ours aligned", True, "guided", {"One": ("7", "8", "9"), "Two": ("a", "b", "c")}),
        Row("Theirs", False, "files:DIR/theirs", {"One": ("x", "y", "z"), "Two": ("u", "v", "w")}),
        Row("Theirs aligned", True, "files:DIR/theirs", {"One": ("x", "y", "z"), "Two": ("u", "v", "w")}),
    )
    layout = Layout("Title", columns, (), ("abs_rel", "delta1", "rmse"), rows)
    methods = ["prior-aligned", "guided", "sgbm"]
    names = (("one", "a"), ("one", "b"), ("more", "c"))
    records = [
        record(method, *name, 10 * i + k, method not in ALIGNED_ONLY)
        for i, method in enumerate(methods)
        for k, name in enumerate(names)
    ]
    records.pop()  # one method lacks the last pair
    labels = frozenset(["one/a", "one/b"])
    found = [columns[0]._replace(dataset="one", labels=labels)]
    found += [columns[1]._replace(dataset="more", labels=frozenset(["more/c"]))]
    table = paper.layout_table(layout, found, records, methods)
    assert table.title == "Title"
    assert table.groups == (
        ("", 2),
        ("One (2 pairs)", 3),
        ("One, as published", 3),
        ("Two (more, 1 pair)", 3),
    )
    assert table.header == ("Method", "GT-aligned", *["AbsRel ↓", "δ1 ↑", "RMSE m ↓"] * 3)

    def means(method, kind, wanted):
        of = [r["capped"][kind] for r in records if r["method"] == method and r["sample"] in wanted]
        return [
            f"{np.mean([s[m] for s in of]):.3f}" if len(of) == len(wanted) else "-" for m in paper.METRICS
        ]

    def line(title, method, kind, published):
        sign = "✓" if kind == "aligned" else "✗"
        return title, sign, *means(method, kind, "ab"), *published, *means(method, kind, "c")

    nothing = ["-"] * 3
    assert table.rows == (
        line("Ours", "guided", "raw", "123"),
        line("Ours aligned", "guided", "aligned", "789"),
        ("Theirs", "✗", *nothing, *"xyz", *nothing),
        ("Theirs aligned", "✓", *nothing, *"xyz", *nothing),
        line("prior + oracle", "prior-aligned", "aligned", nothing),
        line("SGBM + fill†", "sgbm", "raw", nothing),
        line("SGBM + fill", "sgbm", "aligned", nothing),
    )
    assert table.note.endswith(
        " Not run here: Theirs (--methods files:DIR/theirs), Theirs aligned (--methods files:DIR/theirs)."
    )
    two = layout._replace(metrics=("abs_rel", "delta1"), rows=rows[:1])
    table = paper.layout_table(two, found, records, ["guided"])
    assert "Not run" not in table.note and len(table.header) == 8 and table.groups[1] == ("One (2 pairs)", 2)


@pytest.fixture
def there(monkeypatch):
    """Data sets with some pairs, in place of folders."""
    counts = {"kitti2015": 3, "middlebury2014": 4, "mvsnet": 130}

    def all_refs(options, datasets=()):
        names = datasets or options.datasets or counts
        return [
            SampleRef(d, f"s{i}", {"pairs": options.pairs}) for d in names for i in range(counts.get(d, 0))
        ]

    monkeypatch.setattr(paper, "all_refs", all_refs)
    return counts


def test_a_column_takes_the_first_set_that_is_there_and_asked_for(there, tmp_path):
    options = PairsOptions(data=tmp_path, out=tmp_path)
    column = Column("M", ("middeval3", "middlebury2014", "kitti2015"), 2)
    found, refs = paper._find(column, options, draw=False)
    assert found.dataset == "middlebury2014" and [r.name for r in refs] == ["s0", "s1", "s2", "s3"]
    only = PairsOptions(data=tmp_path, out=tmp_path, datasets=("kitti2015",))
    assert paper._find(column, only, draw=False)[0].dataset == "kitti2015"
    drawn = paper._find(column, options, draw=True)[1]
    assert len(drawn) == 2
    many = {
        tuple(
            r.name
            for r in paper._find(column, PairsOptions(data=tmp_path, out=tmp_path, seed=s), draw=True)[1]
        )
        for s in range(9)
    }
    assert len(many) > 1
    exact = column._replace(full_count=4)
    assert len(paper._find(exact, options, draw=True)[1]) == 4
    assert len(paper._find(column._replace(full_count=9), options, draw=True)[1]) == 4
    asked = PairsOptions(data=tmp_path, out=tmp_path, sample=3)
    assert len(paper._find(column, asked, draw=True)[1]) == 3
    scenes = PairsOptions(data=tmp_path, out=tmp_path, scenes=("s2", "s3", "none"))
    assert [r.name for r in paper._find(column, scenes, draw=False)[1]] == ["s2", "s3"]
    missing = PairsOptions(data=tmp_path, out=tmp_path, scenes=("none",))
    assert paper._find(column, missing, draw=False) == (column, [])


def test_the_ablation_takes_kitti_first_and_whatever_else_is_there(there, tmp_path):
    options = PairsOptions(data=tmp_path, out=tmp_path)
    columns = paper._ablation_columns(options)
    assert [c.datasets for c in columns] == [("kitti2015",), ("middlebury2014",), ("mvsnet",)]
    assert [c.full_count for c in columns] == [200, 0, 0] and columns[1].title == "middlebury2014"
    del there["kitti2015"]
    assert [c.title for c in paper._ablation_columns(options)] == ["middlebury2014", "mvsnet"]
    there.clear()
    assert [c.title for c in paper._ablation_columns(options)] == ["KITTI-Stereo"]


@pytest.fixture
def compared(monkeypatch):
    handed = []
    monkeypatch.setattr(paper, "compare", lambda *given: handed.append(given))
    return handed


def test_a_table_measures_the_pairs_of_its_columns_and_lists_what_is_missing(there, compared, tmp_path):
    options = PairsOptions(data=tmp_path, out=tmp_path, methods=("fast",))
    paper.run_paper_table("table1", options)
    ((name, given, made),) = compared
    assert (name, given, made.title) == ("table1", options, LAYOUTS["table1"].title)
    assert made.methods == paper.methods_of("table1", ("fast",))
    assert [r.dataset for r in made.refs] == ["kitti2015"] * 3 + ["middlebury2014"] * 4
    booster = DATASETS["booster"].obtain
    assert made.remarks == [f"Booster was not found. To obtain it: {booster}"]

    def of(ref, i, status):
        measured = record("guided", ref.dataset, ref.name, i)
        for scores in measured["capped"].values():
            scores |= dict.fromkeys(("delta2", "delta3", "log_rmse", "silog", "coverage"), 0.5)
        return measured | {"status": status, "regions": {"visible": 0.5}}

    records = [of(ref, i, "broken" if i == 1 else "ok") for i, ref in enumerate(made.refs)]
    first, *summaries, last = made.tables(records)
    assert [heading for heading, _ in first.groups[1:]] == [
        *("KITTI-Stereo (2 pairs)", "Booster (not found)", "Middlebury (middlebury2014, 4 pairs)"),
    ]
    assert [t.title for t in summaries] == [
        *(
            "All metrics, KITTI-Stereo, 2 pairs",
            "All metrics, Booster, 0 pairs",
            "All metrics, Middlebury, 4 pairs",
        ),
    ]
    assert [len(t.rows) for t in summaries] == [2, 0, 2] and last.title == REGIONS


def test_posed_pairs_are_all_found_drawn_and_listed(there, compared, tmp_path):
    options = PairsOptions(data=tmp_path, out=tmp_path)
    paper.run_paper_table("table3", options)
    ((_, given, made),) = compared
    assert given.pairs == "all" and {r.files["pairs"] for r in made.refs} == {"all"} and len(made.refs) == 116
    assert made.remarks == ["Pairs: " + ", ".join(r.label for r in made.refs) + "."]


def test_the_ablation_shows_both_presets_changed(there, compared):
    paper.run_paper_table("ablation", PairsOptions(out=Path("out"), sample=2))
    ((_, given, made),) = compared
    assert given.pairs == "default" and len(made.refs) == 6 and made.remarks == []
    titles = [
        table.title
        for table in made.tables(
            [
                record("paper", "kitti2015", made.refs[0].name, 0)
                | {"seconds": 1.0, "regions": {}}
                | {"capped": {"raw": None, "aligned": None}}
            ]
        )
    ]
    assert titles[0] == LAYOUTS["ablation"].title and titles[-1] == REGIONS
    assert [t.partition(",")[0] for t in titles[1:3]] == ["The default preset", "Algorithm 1 as printed"]
    assert len(titles) == 7


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("table2", None, "--data must be set; got nothing. Booster: booster_gt.zip"),
        (
            "table2",
            "here",
            "--data must be a folder with the data of table2; got here.* Booster was not found",
        ),
        ("ablation", "none", "--data must be a folder with the data of ablation; got none"),
    ],
)
def test_a_table_without_data_states_how_to_obtain_it(there, compared, name, data, words):
    there.pop("booster", None)
    if name == "ablation":
        there.clear()
    with pytest.raises(ValueError, match=words):
        paper.run_paper_table(name, PairsOptions(data=None if data is None else Path(data), out=Path("out")))
    assert compared == []
