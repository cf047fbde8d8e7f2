"""The laboratory of emulated priors."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from geodiff_plugin.evaluation.datasets import find_pairs, load
from tests.lab import strength
from tests.lab.edges import edge_error, surface_error
from tests.lab.options import STRENGTHS, StrengthOptions
from tests.lab.strength import against_table, relative_map

pytestmark = pytest.mark.end_to_end

SMALL = "synthetic:1+4@128x96"


@pytest.fixture(scope="module")
def sample():
    return load(find_pairs(SMALL)[0])


@pytest.mark.parametrize("space", ["disparity", "depth", "log"])
def test_an_emulated_prior_has_the_stated_error(sample, space):
    exact = relative_map(sample, STRENGTHS["exact"], space)
    assert exact.min() == 0.0 and exact.max() == 1.0
    off = [np.abs(relative_map(sample, STRENGTHS[s], space) - exact).mean() for s in ("2%", "5%", "20%")]
    assert 0 < off[0] < off[1] < off[2]
    inner = sample.valid & (exact > 0.05) & (exact < 0.95)
    ranks = spearmanr(exact[inner], sample.depth_m[inner]).statistic  # without an error, one orders the other
    assert ranks == pytest.approx(-1.0 if space == "disparity" else 1.0, abs=1e-6)


@pytest.mark.slow
def test_the_command_writes_a_page_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    methods = ("prior-aligned", "prior-fit", "guided")
    given = {"strengths": ("exact", "20%"), "methods": methods, "steps": 2, "resolution": 96, "quiet": True}
    options = StrengthOptions(data=(SMALL,), out=tmp_path, **given)
    page = strength.run("strength", options)
    rows = {(row[0], row[1]): float(row[2]) for row in page.tables[0].rows}
    assert len(rows) == 6 and rows["exact", "prior + oracle"] < rows["20%", "prior + oracle"]
    assert rows["20%", "guided"] < rows["20%", "prior + oracle"]
    monkeypatch.setattr(strength, "_measure", lambda *_: pytest.fail("every record is there"))
    assert strength.run("strength", options).tables == page.tables


def test_errors_at_edges_and_of_surfaces():
    ground_truth, shifted = (np.where(np.arange(60)[None] < c, 2.0, 4.0).repeat(40, 0) for c in (30, 32))
    valid = np.ones(ground_truth.shape, bool)
    assert (
        edge_error(ground_truth, ground_truth, valid)
        == surface_error(ground_truth, ground_truth, valid)
        == 0.0
    )
    assert edge_error(shifted, ground_truth, valid) > 0.1
    assert surface_error(shifted, ground_truth, valid) == 0.0
    rough = ground_truth * np.exp(0.01 * np.random.default_rng(0).normal(size=ground_truth.shape))
    assert surface_error(rough, ground_truth, valid) > 5.0
    assert np.isnan(edge_error(ground_truth, np.full(ground_truth.shape, 2.0), valid))


def test_the_default_is_compared_with_others_pair_by_pair():
    errors = {"guided": (0.1, 0.2, 0.3, 0.4, 0.5), "prior-fit": (0.2, 0.3, 0.4, 0.5, 0.4)}
    records = [{"strength": "5%", "method": m, "abs_rel": e} for m, all_ in errors.items() for e in all_]
    table = against_table("All pairs", records)
    ((strength_of, against, pairs, difference, fraction, won),) = table.rows
    assert (strength_of, against, pairs, won) == ("5%", "prior fit", "5", "4 of 5")
    assert difference.startswith("-0.0600 [-0.1000, ") and fraction == "-16.7"  # -0.06 of 0.36
    assert against_table("All pairs", records[5:]).rows == ()
