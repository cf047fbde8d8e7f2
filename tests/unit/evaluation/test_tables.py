"""Tables of records whose numbers are recomputed here, cell by cell."""

import re

import numpy as np
import pytest

from geodiff_plugin.evaluation import tables
from geodiff_plugin.evaluation.tables import DETAILS, REGIONS, Table

METRICS = ("abs_rel", "delta1", "delta2", "delta3", "rmse", "log_rmse", "silog")
DISPARITY = ("epe", "bad1", "bad2", "bad3", "d1")
REGION_NAMES = ("visible", "occluded", "out_of_view", "matched", "unmatched", "tom", "not_tom")


def make_records(method, seed, count=6, metric=True, **changes):
    """Records of one method on ``count`` pairs, every second of them rectified; all numbers differ."""
    rng = np.random.default_rng(seed)

    def scores():
        return {name: float(v) for name, v in zip(METRICS, rng.uniform(0.1, 0.9, 7), strict=True)} | {
            "coverage": float(rng.uniform(0.5, 1)),
            "pixels": 100.0,
        }

    records = []
    for i in range(count):
        disparity = dict(zip(DISPARITY, rng.uniform(0.1, 3, 5), strict=True))
        disparity["regions"] = {
            region: dict(zip(DISPARITY, rng.uniform(0.1, 3, 5), strict=True))
            for region in ("visible", "edge", "flat")
        }
        record = {"method": method, "dataset": f"set{i % 2}", "sample": f"s{i}", "status": "ok"}
        record |= {"rectified": i % 2 == 0, "seconds": float(rng.uniform(1, 9))}
        for name in ("all_pixels", "capped"):
            record[name] = {"raw": scores() if metric else None, "aligned": scores()}
        record["regions"] = dict(zip(REGION_NAMES, rng.uniform(0.1, 0.9, 7), strict=True))
        record["disparity"] = disparity if metric and i % 2 == 0 else None
        record["boundaries"] = dict(zip(("f1", "dbe_acc", "dbe_comp"), rng.uniform(1, 5, 3), strict=True))
        record["ause"] = float(rng.uniform()) if metric else None
        record["ause_confidence"] = {"ause": float(rng.uniform()), "random": float(rng.uniform())}
        record["confidence"] = None
        records.append(record | changes)
    return records


def interval(values, digits=3):
    """A bootstrap of its own, with more draws; near enough for one digit less than is shown."""
    values, rng = np.asarray(values), np.random.default_rng(7)
    means = rng.choice(values, (4000, len(values))).mean(axis=1)
    return [round(float(v), digits) for v in (values.mean(), *np.quantile(means, (0.025, 0.975)))]


def numbers(cell):
    return [float(number) for number in re.findall(r"[-+]?\d+\.\d+", cell)]


def test_the_interval_is_that_of_another_bootstrap_and_is_asymmetric_where_the_values_are():
    values = np.random.default_rng(1).exponential(size=9)
    mean = tables.mean_with_interval([None, *values])
    assert mean.count == 9 and mean == tables.mean_with_interval(values)
    expected = interval(values)
    assert (mean.value, mean.low, mean.high) == pytest.approx(expected, abs=0.03)
    assert mean.high - mean.value > 1.1 * (mean.value - mean.low)
    few = tables.mean_with_interval([0.25, 0.5, None, 1.0, 1.25])
    assert (few.value, few.low, few.high, few.count) == (0.75, None, None, 4)
    assert few.cell() == "0.750" and few.cell(1, "+") == "+0.8"
    assert tables.mean_with_interval([-1.0] * 5).cell(2, "+") == "-1.00 [-1.00, -1.00]"
    assert np.isnan(tables.mean_with_interval([None]).value)


def test_differences_are_paired_over_common_images_and_keep_their_sign():
    first, second = {"a": 1.0, "b": 5.0, "c": 9.0}, {"b": 2.0, "c": 2.0, "d": 100.0}
    difference = tables.paired_difference(first, second)
    assert (difference.value, difference.count) == (5.0, 2)
    assert tables.paired_difference(second, first).value == -5.0


def test_cells_of_numbers_nothing_and_nan():
    assert (tables.cell(1.23456), tables.cell(0.0), tables.cell(None)) == ("1.235", "0.000", "-")
    assert tables.mean_cell([1.0, None, float("nan"), 2.0], 1) == "1.5"
    assert tables.mean_cell([None, float("nan")]) == "-"
    assert (tables.whole_mean([1.0, 2.0], 2), tables.whole_mean([1.0, None])) == ("1.50", "-")
    record = {"a": {"b": {"c": 0.5}, "none": None}}
    assert tables.value_at(record, "a.b.c") == 0.5 and tables.value_at(record, "a.none.c") is None
    group = [record, {}, {"a": {"b": {"c": 1.5}}}]
    assert tables.mean_of("a.b.c")(group) == "1.000" and tables.mean_of("a.b.c", 1, 100.0)(group) == "100.0"
    assert tables.max_of("x", 1)([{"x": 1.0}, {"x": 3.0}, {"x": 2.0}]) == "3.0"
    assert (tables.count_of_pairs(1), tables.count_of_pairs(2, "posed ")) == ("1 pair", "2 posed pairs")
    twice = [{"dataset": "d", "sample": s} for s in "aab"]
    assert tables.pairs_of(twice) == "2 pairs" and tables.label_of(twice[2]) == "d/b"


GROUPS = (("", 1), ("one | two", 2))
TABLE = Table(
    "Errors & more", ("name", "a_b", "δ ↓"), (("x|y", "1 %", "-"), ("z", "2", "3")), "Note.", GROUPS
)


def test_markdown_has_a_rectangle_of_cells_and_one_heading_a_column():
    lines = TABLE.markdown().splitlines()
    assert lines[:4] == ["## Errors & more", "", "Note.", ""]
    rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines[4:]]
    assert rows == [
        ["name", r"one \| two: a_b", r"one \| two: δ ↓"],
        ["---", "---:", "---:"],
        [r"x\|y", "1 %", "-"],
        ["z", "2", "3"],
    ]
    plain = Table("T", ("a", "b"), (("1", "2"),))
    assert plain.full_header() == ("a", "b") and TABLE.markdown().endswith("|\n")
    assert plain.markdown() == "## T\n\n| a | b |\n| --- | ---: |\n| 1 | 2 |\n"


def test_latex_has_as_many_columns_as_it_declares_and_escapes_what_is_a_command():
    lines = TABLE.latex().splitlines()
    assert lines == [
        "% Errors & more",
        r"\begin{tabular}{lrr}",
        r"\toprule",
        r"\multicolumn{1}{c}{} & \multicolumn{2}{c}{one $|$ two} \\",
        r"name & a\_b & $\delta$ $\downarrow$ \\",
        r"\midrule",
        r"x$|$y & 1 \% & - \\",
        r"z & 2 & 3 \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]
    odd = Table("T", ("\\~^_%&#${}<>",), ((("γε±↑†✓✗×"),),)).latex()
    assert r"\textbackslash{}\textasciitilde{}\textasciicircum{}\_\%\&\#\$\{\}$<$$>$ \\" in odd
    assert r"$\gamma$$\epsilon$$\pm$$\uparrow$$^\dagger$$\checkmark$$\times$$\times$ \\" in odd
    assert "multicolumn" not in odd and TABLE.latex().endswith("}\n")


def test_records_are_grouped_in_the_order_in_which_they_occur():
    records = [{"m": m, "s": s} for m, s in (("b", 1), ("a", 1), ("b", 2), ("a", 1))]
    assert list(tables.grouped(records, "m").items()) == [("b", records[::2]), ("a", records[1::2])]
    assert list(tables.grouped(records, "m", "s")) == [("b", 1), ("a", 1), ("b", 2)]
    columns = {"M": lambda group: group[0]["m"], "n": lambda group: str(len(group))}
    table = tables.table_of_groups("T", records, ("m",), columns, "N")
    assert (table.title, table.note, table.header) == ("T", "N", ("M", "n"))
    assert table.rows == (("b", "2"), ("a", "2"))


def test_the_headline_is_of_all_pixels_and_aligned_only_without_metres():
    (record,) = make_records("guided", 0, 1)
    assert tables.headline(record) == record["all_pixels"]["raw"]["abs_rel"]
    (relative,) = make_records("prior-aligned", 0, 1, metric=False)
    assert tables.headline(relative) == relative["all_pixels"]["aligned"]["abs_rel"]
    assert tables.headline(record | {"status": "not applicable"}) is None
    values = tables.metric_values([record, record | {"sample": "z", "status": "broken"}], "aligned", "rmse")
    assert values == {"guided": {"set0/s0": record["capped"]["aligned"]["rmse"]}}


def test_summaries_are_means_under_the_cap_of_the_members_as_is_and_aligned():
    records = make_records("guided", 1) + make_records("prior-aligned", 2, metric=False)
    records[5]["status"] = "not applicable"
    members = {"set0/s0", "set1/s1", "set0/s2", "set1/s3", "set0/s4", "set1/s5"}
    table = tables.summary_table(records, members, "All")
    assert table.title == "All" and len(table.note) > 20
    assert table.header == (
        *("method", "pairs", "AbsRel", "δ1", "δ2", "δ3"),
        *("RMSE m", "log RMSE", "SILog", "coverage"),
    )
    rows = {row[0]: row for row in table.rows}
    assert list(rows) == ["guided", "guided, aligned", "prior + oracle, aligned"]
    for title, kind, group in (
        ("guided", "raw", records[:5]),
        ("guided, aligned", "aligned", records[:5]),
        ("prior + oracle, aligned", "aligned", records[6:]),
    ):
        assert rows[title][1] == str(len(group))
        for at, name in enumerate(METRICS, 2):
            values = [r["capped"][kind][name] for r in group]
            shown = numbers(rows[title][at])
            assert shown[0] == pytest.approx(np.mean(values), abs=5.1e-4)
            assert shown == pytest.approx(interval(values), abs=0.03)
        coverage = np.mean([r["capped"][kind]["coverage"] for r in group])
        assert float(rows[title][-1]) == pytest.approx(coverage, abs=5.1e-4)
    some = tables.summary_table(records, {"set0/s0"}, "Some").rows
    assert [row[1] for row in some] == ["1", "1", "1"]


def test_groups_keep_the_order_of_the_records_on_which_intervals_depend():
    records = make_records("guided", 1) + make_records("sgbm", 2)
    labels = ["set0/s0", "set1/s1", "set0/s2", "set1/s3", "set0/s4", "set1/s5"]
    expected = {"6 pairs": labels, "3 rectified pairs": labels[::2], "3 posed pairs": labels[1::2]}
    assert tables.groups_of(records) == expected
    backwards = {name: members[::-1] for name, members in expected.items()}
    assert tables.groups_of(records[::-1]) == backwards
    del records[0]["rectified"], records[6]["rectified"]
    assert tables.groups_of(records)["5 pairs"] == labels[1:]


def test_the_reference_is_compared_with_each_other_method_on_common_pairs():
    records = make_records("guided", 1, 4) + make_records("sgbm", 2, 3) + make_records("paper", 3, 4)
    ours, theirs = ([r["all_pixels"]["raw"]["abs_rel"] for r in records[a:b]] for a, b in ((0, 4), (4, 7)))
    table = tables.versus_table(records, "guided")
    won = sum(a < b for a, b in zip(ours, theirs, strict=False))
    difference = np.mean(np.subtract(ours[:3], theirs))
    assert 0 < won < 3
    assert table.rows[0] == ("SGBM + fill", "3", f"{difference:+.3f}", f"{won} of 3")
    assert [row[:2] for row in table.rows] == [("SGBM + fill", "3"), ("paper", "4")]
    assert table.title == "guided against each other method, AbsRel" and len(table.header) == 4
    assert tables.versus_table(records[:4], "guided").rows == ()


def test_pairs_have_a_row_each_and_means_of_all_and_of_each_kind():
    records = make_records("guided", 1, 3) + make_records("prior-aligned", 2, 3, metric=False)
    records[1]["status"] = "not applicable"
    errors, seconds, versus, *rest = tables.pairs_tables(records)
    assert errors.title == "AbsRel of 3 pairs" and errors.header == ("pair", "guided", "prior + oracle")
    raw = [r["all_pixels"]["raw"]["abs_rel"] for r in records[:3]]
    aligned = [r["all_pixels"]["aligned"]["abs_rel"] for r in records[3:]]
    assert errors.rows == (
        ("set0/s0", f"{raw[0]:.3f}", f"{aligned[0]:.3f}"),
        ("set1/s1", "-", f"{aligned[1]:.3f}"),
        ("set0/s2", f"{raw[2]:.3f}", f"{aligned[2]:.3f}"),
        ("mean of 3 pairs", "-", f"{np.mean(aligned):.3f}"),
        ("mean of 2 rectified pairs", f"{(raw[0] + raw[2]) / 2:.3f}", f"{np.mean(aligned[::2]):.3f}"),
        ("mean of 1 posed pair", "-", f"{aligned[1]:.3f}"),
    )
    assert seconds.title == "Seconds" and seconds.rows[0][1] == f"{records[0]['seconds']:.1f}"
    assert versus.title.startswith("guided against")
    titles = [table.title for table in rest]
    assert titles[:3] == [f"All metrics, {g}" for g in ("3 pairs", "2 rectified pairs", "1 posed pair")]
    benchmarks = [f"Metrics of the datasets' benchmarks, {kind} pairs" for kind in ("rectified", "posed")]
    assert titles[3:] == [*benchmarks, *DETAILS, "Confidence by decile", "Risk and coverage"]
    assert [row[1] for row in rest[1].rows] == ["2", "2", "2"]
    assert not any("against" in t.title for t in tables.pairs_tables(records[3:]))
    assert tables.pairs_tables(records, "prior-aligned")[2].title.startswith("prior + oracle against")
    only = tables.per_pair_table("T", [("guided", records[:1])], tables.headline, 2, "N")
    assert (only.note, len(only.rows), only.rows[-1][0]) == ("N", 2, "mean of 1 pair")


def test_a_method_without_metres_needs_an_oracle_and_its_heading_states_this(monkeypatch):
    relative, metric = (make_records("sgbm", i, 2, metric=bool(i)) for i in (0, 1))
    assert [heading for heading, _ in tables.method_columns(relative)] == ["SGBM + fill + oracle"]
    assert tables.method_columns(metric) == [("SGBM + fill", metric)]
    ((heading, _),) = tables.method_columns(make_records("prior-aligned", 0, 2, metric=False))
    assert heading == "prior + oracle"
    nothing = [r | {"status": "broken"} for r in relative]
    assert tables.method_columns(nothing)[0][0] == "SGBM + fill"
    assert tables.method_columns([relative[0], *metric])[0][0] == "SGBM + fill"


@pytest.mark.parametrize("title", DETAILS)
def test_details_are_means_of_the_entries_that_they_name(title):
    records = make_records("guided", 1) + make_records("sgbm", 2, 4) + make_records("paper", 3, 2)
    for record in records[:3]:
        record["regions"] |= {"material_3": 0.25, "material_11": 0.75}
    records[-2]["status"] = records[-1]["status"] = "broken"
    table = tables.details_table(records, title)
    assert table.title == title and table.note == DETAILS[title].note
    assert [row[0] for row in table.rows] == ["guided", "SGBM + fill"]
    expected = {
        REGIONS: [("regions", name) for name in (*REGION_NAMES, "material_11", "material_3")],
        "Disparity, rectified pairs": [("disparity", name) for name in DISPARITY],
        "Disparity by region, rectified pairs": [
            ("disparity", "regions", region, name)
            for region in ("visible", "edge", "flat")
            for name in ("epe", "bad1", "bad2", "d1")
        ],
        "Boundaries, dense ground truth": [("boundaries", name) for name in ("f1", "dbe_acc", "dbe_comp")],
        "AUSE": [("ause",), ("ause_confidence", "ause"), ("ause_confidence", "random")],
    }[title]

    def found(record, path):
        for name in path:
            record = (record or {}).get(name)
        return record

    assert len(table.header) == 1 + len(expected)
    for at, path in enumerate(expected, 1):
        for row, group in zip(table.rows, (records[:6], records[6:10]), strict=True):
            values = [v for r in group if (v := found(r, path)) is not None]
            assert row[at] == (f"{np.mean(values):.3f}" if values else "-")
        labels = {r["sample"] for r in records[:10] if found(r, path) is not None}
        assert table.header[at].endswith(f"({len(labels)} pairs)")
    if title == REGIONS:
        assert table.header[-2:] == ("class 11 (3 pairs)", "class 3 (3 pairs)")
        words = ("visible", "occluded", "out of view", "matched", "unmatched", "ToM", "other material")
        assert [heading.partition(" (")[0] for heading in table.header[1:8]] == list(words)


def test_a_detail_that_no_record_has_shows_no_row():
    records = make_records("guided", 1, 2, disparity=None)
    table = tables.details_table(records, "Disparity, rectified pairs")
    assert table.rows == () and table.header == ("method", "EPE px", "bad-1", "bad-2", "bad-3", "D1")


def test_the_risk_of_the_most_confident_pixels_is_the_mean_over_pairs_at_each_coverage():
    rng, records = np.random.default_rng(6), make_records("guided", 1, 3)
    for record in records[:2]:
        record["risk_coverage"] = {name: rng.uniform(0, 0.5, 20).tolist() for name in ("risk", "oracle")}
    table = tables.risk_table(records)
    assert [row[:2] for row in table.rows] == [("guided", "confidence"), ("guided", "error (best possible)")]
    curves = [record["risk_coverage"] for record in records[:2]]
    areas = [np.mean([np.subtract(c["risk"], c["oracle"]).mean() for c in curves]), 0.0]
    for row, name, area in zip(table.rows, ("risk", "oracle"), areas, strict=True):
        # Of 20 points, from all pixels down to a twentieth of them.
        expected = [np.mean([c[name][k] for c in curves]) for k in (0, 2, 5, 10, 15)]
        np.testing.assert_allclose(list(map(float, row[2:])), [*expected, area], atol=5.1e-4)
    assert table.header[2:] == ("best 100 %", "best 90 %", "best 75 %", "best 50 %", "best 25 %", "AUSE")
    assert tables.risk_table(records[2:]).rows == ()


def test_confidence_by_decile_weighs_pairs_equally_and_pixels_by_their_fraction():
    rng, records = np.random.default_rng(5), make_records("guided", 1, 3)
    for record in records[:2]:
        fractions = rng.dirichlet(np.ones(10))
        fractions[[2, 9]] = 0.0
        record["confidence"] = [
            {"fraction": float(fraction)}
            | {n: float(rng.uniform()) if fraction else None for n in ("predicted", "observed", "abs_rel")}
            for fraction in fractions
        ]
    records[1]["confidence"][4] = {"fraction": 0.0, "predicted": None, "observed": None, "abs_rel": None}
    table = tables.confidence_table(records)
    assert table.header == ("method", "confidence", "fraction of pixels", "predicted", "observed", "AbsRel")
    assert len(table.rows) == 8 and table.title == "Confidence by decile"
    for row, k in zip(table.rows, (0, 1, 3, 4, 5, 6, 7, 8), strict=True):
        parts = [record["confidence"][k] for record in records[:2]]
        total = sum(part["fraction"] for part in parts)
        assert row[:2] == ("guided", f"{k / 10:.1f} to {k / 10 + 0.1:.1f}")
        assert row[2] == f"{total / 2:.3f}"
        for at, name in enumerate(("predicted", "observed", "abs_rel"), 3):
            mean = sum(part["fraction"] * (part[name] or 0) for part in parts) / total
            assert float(row[at]) == pytest.approx(mean, abs=5.1e-4)


def test_benchmarks_have_a_row_per_set_and_method_for_rectified_and_for_posed_pairs():
    records = [*make_records("guided", 1), *make_records("sgbm", 2, rectified=True)]
    for i, record in enumerate(records):
        scores = {"bad_px": 2.0, "all": None if i % 3 else 0.01 * i, "noc": 0.02 * i}
        record["benchmark"] = scores if record["rectified"] else None
        record["all_pixels"]["raw"]["inliers"] = 0.05 * i
    relative = make_records("prior-aligned", 3, metric=False, benchmark=None)
    rectified, posed = tables.benchmark_tables([*records, *relative])
    mine = [r for r in records if r["rectified"] and (r["dataset"], r["method"]) == ("set0", "guided")]
    row = next(row for row in rectified.rows if row[:2] == ("set0", "guided"))
    known = [r["benchmark"]["all"] for r in mine if r["benchmark"]["all"] is not None]
    assert row[2:] == (
        *(str(len(mine)), f"{np.mean([r['all_pixels']['raw']['abs_rel'] for r in mine]):.3f}", "> 2 px"),
        f"{100 * np.mean(known):.2f} ({len(known)} of {len(mine)})",
        f"{100 * np.mean([r['benchmark']['noc'] for r in mine]):.2f}",
    )
    assert {row[:2] for row in rectified.rows} == {
        ("set0", "guided"),
        *((f"set{i}", "SGBM + fill") for i in range(2)),
    }
    (row,) = posed.rows
    theirs = [r for r in records if not r["rectified"]]
    assert row[:3] == ("set1", "guided", "3")
    assert row[4] == f"{100 * np.mean([r['all_pixels']['raw']['inliers'] for r in theirs]):.1f}"


def scored(dataset, sample, method, error, rectified=True):
    scores = {"raw": {"abs_rel": error}, "aligned": {"abs_rel": 9.0}}
    head = {"dataset": dataset, "sample": sample, "method": method, "status": "ok"}
    return head | {"rectified": rectified, "all_pixels": scores}


def test_each_split_has_a_table_with_mean_and_median_of_each_kind_of_pairs():
    errors = {"000000": 0.1, "000013": 0.2, "000061": 0.6}
    records = [scored("kitti2012", name, "guided", error) for name, error in errors.items()]
    records += [scored("mvsnet", "7scenes_f050", "guided", 0.5, rectified=False)]
    records += [scored("kitti2012", name, "sgbm", 2 * error) for name, error in errors.items()]
    records += [scored("middlebury2003", name, "guided", e) for name, e in (("cones", 0.3), ("teddy", 0.5))]
    records += [scored("folder", "mine", "guided", 7.0)]
    tuned, unseen = tables.split_tables(records)
    assert tuned.title == "4 pairs used to tune the defaults"
    assert tuned.groups == (("", 1), ("4 pairs", 2), ("3 rectified pairs", 2), ("1 posed pair", 2))
    assert tuned.rows == (
        ("guided", "0.350", "0.350", "0.300", "0.200", "0.500", "0.500"),
        ("SGBM + fill", "0.600 (3 of 4)", "0.400", "0.600", "0.400", "-", "-"),
    )
    assert unseen.title == "2 pairs held out"
    assert unseen.rows == (("guided", "0.400", "0.400"),)
    assert tables.split_tables([scored("folder", "mine", "guided", 7.0)]) == []
    assert [t.title for t in tables.pairs_tables([r | other_scores() for r in records])[:2]] == [
        tuned.title,
        unseen.title,
    ]


def other_scores():
    """What the other tables read of a record."""
    names = ("disparity", "ause", "boundaries", "confidence", "ause_confidence", "benchmark")
    empty = {"raw": None, "aligned": None}
    return dict.fromkeys(names) | {"regions": {}, "seconds": 1.0, "capped": empty}
