"""Ratios of depth by the length of the baseline, and what the command measures."""

import numpy as np
import pytest

from geodiff_plugin.evaluation import baseline_scale
from geodiff_plugin.evaluation.baseline_scale import CHANGES, GIVEN, ratio_of, ratio_table, run_baseline_scale
from geodiff_plugin.evaluation.experiment import map_path
from geodiff_plugin.evaluation.options import PairsOptions
from geodiff_plugin.formats import write_depth_npy
from tests.evaluating import write_scenes


def test_the_ratio_is_that_of_pixels_with_both_depths():
    given = np.array([[1.0, 2.0, 4.0, np.nan, 5.0]])
    changed = np.array([[2.0, 5.0, 8.0, 3.0, 0.0]])
    median, low, high = ratio_of(changed, given)
    assert median == 2.0 and low == pytest.approx(2.0) and high == pytest.approx(2.45)
    assert np.isnan(ratio_of(changed, np.zeros((1, 5)))).all()


def record(sample, change, error, rectified=True, status="ok"):
    name = f"{sample}-{change.translation:g}-{change.right:g}"
    scores = {"raw": {"abs_rel": error}, "aligned": None}
    head = {"dataset": "d", "sample": name, "method": "guided", "status": status, "rectified": rectified}
    return head | {"all_pixels": scores}


def test_a_table_has_ratios_and_errors_of_each_pair_and_means_by_kind(tmp_path):
    changes = (GIVEN, *CHANGES.values())
    pairs = {
        "d/a": {c: record("a", c, 0.1 * (k + 1)) for k, c in enumerate(changes)},
        "d/b": {c: record("b", c, 0.2, rectified=False) for c in changes},
    }
    pairs["d/b"][changes[3]] |= {"status": "not applicable"}
    for sample, wrong in (("a", 1.0), ("b", 1.1)):
        for change in changes:
            path = map_path(tmp_path, "guided", "d", f"{sample}-{change.translation:g}-{change.right:g}")
            path.parent.mkdir(parents=True, exist_ok=True)
            scale = 1.0 if change == GIVEN else change.translation * wrong
            write_depth_npy(path, np.full((4, 5), 2 * scale, np.float32))
    table = ratio_table("T", pairs, tmp_path)
    a, b, both, rectified, posed = table.rows
    assert a == (
        *("d/a", "0.500 [0.500, 0.500]", "2.000 [2.000, 2.000]", "1.000 [1.000, 1.000]"),
        *("0.100", "0.200", "0.300", "0.400"),
    )
    assert b[1].startswith("0.550 ") and b[3] == b[7] == "-" and b[4] == "0.200"
    assert both[:4] == ("mean of 2 pairs", "0.525", "2.100", "1.000")
    assert rectified[0] == "mean of 1 rectified pair" and posed[2] == "2.200"
    assert table.full_header()[1:5] == (
        "ratio: b × 0.5",
        "ratio: b × 2",
        "ratio: right × 0.75",
        "AbsRel: as given",
    )


@pytest.mark.end_to_end
def test_depth_of_the_sweep_follows_the_baseline(tmp_path):
    write_scenes(tmp_path / "data", "wall")
    options = PairsOptions(data=tmp_path / "data", out=tmp_path / "out", methods=("sweep-sgm",), quiet=True)
    (table,) = run_baseline_scale("baseline", options).tables
    half, twice, other = (float(cell.split()[0]) for cell in table.rows[0][1:4])
    assert (half, twice) == (pytest.approx(0.5, rel=1e-3), pytest.approx(2, rel=1e-3))
    assert other == pytest.approx(1, abs=0.05)
    assert baseline_scale.NOTE in (tmp_path / "out" / "baseline.md").read_text(encoding="utf-8")
