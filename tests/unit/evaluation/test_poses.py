"""Which pairs and poses each table of ``geodiff eval poses`` compares, and which warnings were missing."""

from types import SimpleNamespace

import numpy as np
import pytest

from geodiff_plugin.evaluation import experiment, poses
from geodiff_plugin.evaluation.baselines import Settings
from geodiff_plugin.evaluation.datasets import SampleRef
from geodiff_plugin.evaluation.options import PosesOptions
from geodiff_plugin.jobs.journal import Item

REFS = [SampleRef("d", name, {}) for name in "abcd"]
#: Name -> rectified, number of further views.
KINDS = {"a": (True, 0), "b": (False, 2), "c": (True, 1), "d": (False, 0)}


def record(sample, error, severities=(), rectified=True, **notes):
    scores = {"raw": None if error is None else {"abs_rel": error}, "aligned": {"abs_rel": 0.01}}
    status = "not applicable" if error is None else "ok"
    head = {
        "dataset": "d",
        "sample": sample,
        "status": status,
        "rectified": rectified,
        "key": f"{sample}{error}",
    }
    findings = [{"code": "a", "severity": severity, "text": "Said."} for severity in severities]
    return head | {"all_pixels": scores, "notes": {"method": {"findings": findings, **notes}}}


@pytest.mark.parametrize("severity", ["reason", "remark", "warning"])
def test_errors_of_changed_pairs_are_shown_under_the_names_of_the_first_column(severity):
    """An assumption alone does not indicate an error."""
    columns = {
        "true": [record("a", 0.1), record("b", 0.2), record("c", 0.3, rectified=False)],
        "wrong": [
            record("a-turn", 0.26),
            record("b-turn", 0.5, ["assumption", severity]),
            record("c-turn", None, rectified=False),
        ],
        "lost": [record(name, None) for name in ("a-x", "b-x")] + [record("c-x", None, rectified=False)],
        "edge": [record("a", 0.25), record("b", 0.9, ["assumption"]), record("c", 0.8, rectified=False)],
    }
    table = poses.poses_table("Title", columns, "Note")
    assert (table.title, table.note, table.header) == (
        "Title",
        "Note",
        ("pair", "true", "wrong", "lost", "edge"),
    )
    assert table.rows == (
        ("d/a", "0.100", "0.260", "-", "0.250"),
        ("d/b", "0.200", "0.500", "-", "0.900"),
        ("d/c", "0.300", "-", "-", "0.800"),
        ("mean of 3 pairs", "0.200", "0.380 of 2", "-", "0.650"),
        ("mean of 2 rectified pairs", "0.150", "0.380", "-", "0.575"),
        ("mean of 1 posed pair", "0.300", "-", "-", "0.800"),
        ("without a result", "0", "1", "3", "0"),
        ("off by more than 0.25, no warning", "1", "1", "0", "2"),
    )


def test_residuals_are_one_number_a_right_view():
    group = [record("a", 0.1, residual_px_given=[1.234, 0.5], residual_px=[0.25])]
    cells = {name: cell_of(group) for name, cell_of in poses._RESIDUALS.items()}
    assert cells == {"pair": "d/a", "refined, as given": "1.23 / 0.50", "refined, as used": "0.25"}
    assert poses._residual("residual_px", [record("a", 0.1)]) == "-"
    assert poses._residual("residual_px", [{"status": "not applicable"}]) == "-"


@pytest.fixture
def known(monkeypatch):
    """Pairs of ``KINDS`` in place of files, and what a run would measure."""

    def load(ref):
        rectified, more = KINDS[ref.name]
        return SimpleNamespace(rectified=rectified, extra_views=(None,) * more)

    monkeypatch.setattr(poses, "load", load)
    monkeypatch.setattr(poses, "find_pairs", lambda folder: REFS[2:] if folder.name == "exact" else REFS)
    monkeypatch.setattr(poses, "some_pairs", lambda refs, folder: refs)

    def method_cells(refs, methods, settings, out):
        (method,) = methods
        head = {"method": method, "views": settings.views, "out": out}
        return [Item(ref.label + method, head=head | {"sample": ref.name}) for ref in refs]

    run = []
    monkeypatch.setattr(experiment, "method_cells", method_cells)
    monkeypatch.setattr(poses, "run_experiment", lambda *given: run.append(given))
    monkeypatch.setattr(PosesOptions, "settings", property(lambda options: Settings(seed=options.seed)))
    return run


def test_every_table_has_its_pairs_poses_and_number_of_views(known, tmp_path):
    given = PosesOptions(
        data=tmp_path / "real", exact=tmp_path / "exact", out=tmp_path, perturb="2,0.25", drift="0.5,3"
    )
    poses.run_poses("poses", given)
    ((name, options, made),) = known
    assert (name, options, made.title, made.journal) == ("poses", given, "Results by pose", "samples.jsonl")
    assert made.remarks([])[0].startswith("Prior bundled, seed 0.")
    names = {title: [] for title in dict.fromkeys(cell.head["table"] for cell in made.cells)}
    for cell in made.cells:
        head = cell.head
        names[head["table"]].append(
            (head["column"], head["method"].partition("=")[2], head["sample"], head["views"])
        )
        assert head["out"] == tmp_path and head["method"].startswith("guided:pose=")
    ways = (("refined", "refine"), ("given", "given"), ("estimated", "estimated"))
    drifted, turned = "-drift0.5-3px", "-turn2-shift0.25"
    assert names == {
        "AbsRel of 4 real pairs, two views": [(*way, s, 2) for way in ways for s in "abcd"],
        "AbsRel of 2 real pairs, three views": [(*way, s, 3) for way in ways for s in "bc"],
        "AbsRel of 2 rectified pairs, drifted rig": [
            *(("true, given", "given", s, 2) for s in "ac"),
            *(("drifted, given", "given", s + drifted, 2) for s in "ac"),
            *(("drifted, refined", "refine", s + drifted, 2) for s in "ac"),
        ],
        "AbsRel of 2 pairs, poses perturbed": [
            *(("true, given", "given", s, 2) for s in "cd"),
            *(("perturbed, given", "given", s + turned, 2) for s in "cd"),
            *(("perturbed, refined", "refine", s + turned, 2) for s in "cd"),
            *(("estimated", "estimated", s, 2) for s in "cd"),
        ],
    }
    records = [
        {
            **record(c.head["sample"], 0.1 + i / 99, residual_px=[i / 4]),
            "table": c.head["table"],
            "column": c.head["column"],
        }
        for i, c in enumerate(made.cells)
    ]
    shown = made.tables(records)
    assert [table.title for table in shown] == [*list(names)[:1], "Residuals", *list(names)[1:]]
    assert [row[:3] for row in shown[1].rows] == [
        (f"d/{s}", "-", f"{i / 4:.2f}") for i, s in enumerate("abcd")
    ]
    assert shown[1].note == poses.RESIDUAL_NOTE
    for table, words in zip(
        (shown[0], shown[2], shown[3], shown[4]),
        (
            "the length of the first baseline, and no poses",
            "",
            "rotated by 0.5 degrees and its image is shifted by 3 px",
            "by up to 2 degrees and translated by up to 25 %",
        ),
        strict=True,
    ):
        assert words in table.note and bool(table.note) == bool(words)
    assert shown[3].header[1:] == ("true, given", "drifted, given", "drifted, refined")
    row = dict(zip(shown[0].header, shown[0].rows[0], strict=True))
    assert (row["refined"], row["given"], row["estimated"]) == tuple(f"{0.1 + i / 99:.3f}" for i in (0, 4, 8))


def test_no_drift_drifts_no_pair_and_the_limit_is_of_real_pairs(known, tmp_path):
    reported = {"out": tmp_path, "drift": "0,0", "limit": 3}
    poses.run_poses("poses", PosesOptions(data=tmp_path / "real", exact=tmp_path / "exact", **reported))
    poses.run_poses("poses", PosesOptions(data=tmp_path / "real", out=tmp_path, drift="0,2"))
    poses.run_poses("poses", PosesOptions(exact=tmp_path / "exact", out=tmp_path))
    tables = [[c.head["table"] for c in made.cells] for _, _, made in known]
    assert {"AbsRel of 3 real pairs, two views", "AbsRel of 2 pairs, poses perturbed"} <= set(tables[0])
    assert not any("drifted" in title for title in tables[0]) and any("drifted" in t for t in tables[1])
    assert set(tables[2]) == {"AbsRel of 2 pairs, poses perturbed"}
    with pytest.raises(ValueError, match="--data must be set, or --exact; got neither"):
        poses.run_poses("poses", PosesOptions(out=tmp_path))


def test_the_settings_of_a_table_are_those_of_the_options_but_for_the_views(known, monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr(
        experiment, "method_cells", lambda refs, methods, settings, out: seen.append(settings) or []
    )
    poses.run_poses("poses", PosesOptions(data=tmp_path / "real", out=tmp_path, seed=7))
    assert {s.seed for s in seen} == {7} and np.unique([s.views for s in seen]).tolist() == [2, 3]
