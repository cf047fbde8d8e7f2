"""Emulated priors and the table over their strengths; what trust makes wrong, counts and prints."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import spearmanr

from geodiff_plugin._checks import InputError
from geodiff_plugin.evaluation import calibrations, strength
from geodiff_plugin.evaluation.baselines import METHODS, NotApplicable, find_method
from geodiff_plugin.evaluation.calibrations import KINDS, POINTS, RIGHT, WRONG
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.options import STRENGTHS, StrengthOptions, TrustOptions
from geodiff_plugin.evaluation.strength import relative_map, run_strength

SMALL = "synthetic:1+4@128x96"


@pytest.fixture(scope="module")
def sample():
    return load(find_pairs(SMALL)[0])


@pytest.mark.parametrize("space", ["disparity", "depth", "log"])
def test_a_prior_errs_as_much_as_it_says(sample, space):
    exact = relative_map(sample, STRENGTHS["exact"], space)
    assert exact.min() == 0.0 and exact.max() == 1.0
    off = [np.abs(relative_map(sample, STRENGTHS[s], space) - exact).mean() for s in ("2%", "5%", "20%")]
    assert 0 < off[0] < off[1] < off[2]
    assert np.array_equal(exact, relative_map(sample, STRENGTHS["exact"], space, seed=3))
    inner = sample.valid & (exact > 0.05) & (exact < 0.95)
    ranks = spearmanr(exact[inner], sample.depth_m[inner]).statistic  # without an error, one orders the other
    assert ranks == pytest.approx(-1.0 if space == "disparity" else 1.0, abs=1e-6)


def test_the_command_writes_a_page_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    methods = ("prior-aligned", "prior-fit", "guided")
    given = {"strengths": ("exact", "20%"), "methods": methods, "steps": 2, "resolution": 96, "quiet": True}
    options = StrengthOptions(data=(SMALL,), out=tmp_path, **given)
    page = run_strength("strength", options)
    rows = {(row[0], row[1]): float(row[2]) for row in page.tables[0].rows}
    assert len(rows) == 6 and rows["exact", "prior + oracle"] < rows["20%", "prior + oracle"]
    assert rows["20%", "guided"] < rows["20%", "prior + oracle"]
    monkeypatch.setattr(strength, "_measure", lambda *_: pytest.fail("every record is there"))
    assert run_strength("strength", options).tables == page.tables


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"methods": ("prior-fit@other",)}, "--methods must be methods that use a prior"),
        ({"methods": ("sgbm",)}, "--methods must be methods that use a prior"),
        ({"strengths": ("7%",)}, "--strengths"),
        ({"space": "inverse"}, "--space"),
        ({"methods": ("refuses",), "strengths": ("5%",)}, "not on synthetic/seed0004: no pose"),
    ],
)
def test_options_that_cannot_be_measured_or_shown(tmp_path, monkeypatch, wrong, said):
    def refuses(*_):
        raise NotApplicable("no pose could be estimated")

    monkeypatch.setitem(METHODS, "refuses", replace(find_method("prior-fit"), name="refuses", run=refuses))
    with pytest.raises(ValueError, match=said):
        run_strength("strength", StrengthOptions(data=(SMALL,), out=tmp_path, quiet=True, **wrong))


def test_every_kind_of_wrong_calibration_changes_what_it_says(sample):
    other = replace(sample, right=sample.right[::-1], K_right=2 * sample.K_right)
    cases = {kind: change(sample, other) for kind, (_, change, _) in KINDS.items()}
    for kind, case in cases.items():
        names = ("left", "right", "K_left", "K_right", "E")
        changed = {name for name in names if not np.array_equal(getattr(case, name), getattr(sample, name))}
        expected = {"swapped": {"left", "right"}, "unrelated": {"right", "K_right"}}
        expected |= dict.fromkeys(("mirrored", "one-picture", "shifted"), {"right"})
        expected |= {kind: set() for kind, (_, _, factor) in KINDS.items() if factor or kind in RIGHT}
        assert changed == expected.get(kind, {"K_left", "K_right"} if kind.startswith("K-") else {"E"}), kind
    assert cases["millimetres"].E[0, 3] == pytest.approx(1000 * sample.E[0, 3])
    assert cases["K-2"].K_left[0, 0] == pytest.approx(2 * sample.K_left[0, 0])
    assert cases["K-2"].K_left[0, 2] == sample.K_left[0, 2]
    np.testing.assert_allclose(cases["inverse"].E @ sample.E, np.eye(4), atol=1e-12)
    tilt = np.linalg.inv(sample.E[:3, :3]) @ cases["tilted"].E[:3, :3]
    assert np.degrees(np.arctan2(tilt[2, 1], tilt[1, 1])) == pytest.approx(2.0)
    points = calibrations._points(sample)
    column, row = np.rint(points[0] @ sample.K_left.T / points[0, 2]).astype(int)[:2]
    assert len(points) == POINTS and points[0, 2] == pytest.approx(sample.depth_m[row, column], rel=1e-6)


@pytest.fixture
def weights(monkeypatch):
    """What stands for the prior, which is never loaded."""
    weights = ["as they were"]
    monkeypatch.setattr(calibrations.PriorCache, "get", lambda *_: None)
    monkeypatch.setattr(calibrations.PriorCache, "fingerprint", lambda *_: weights[-1])
    return weights


def test_trust_counts_and_goes_on(tmp_path, monkeypatch, weights):
    """All but the rectified pair's K are detected; one right pair is not trusted."""
    asked = []

    def measure(ref, other, kind, read, pipe, settings):
        asked.append(kind)
        assert (ref is other) == (kind != "unrelated")
        rectified = not ref.files["posed"]
        missed, distrusted = kind == "K-2" and rectified, kind in RIGHT and not rectified
        status = "not trusted" if distrusted or (kind not in RIGHT and not missed) else "trusted"
        off = 0.01 if kind == "right" else 0.5
        return {"rectified": rectified, "status": status, "said": [], "off": off}

    monkeypatch.setattr(calibrations, "_measure", measure)
    options = TrustOptions(rendered=2, width=64, kinds=("swapped", "K-2"), out=tmp_path, quiet=True)
    for _ in range(2):
        calibrations.run_trust("trust", options)
        assert len(asked) == 6
    page = (tmp_path / "trust.md").read_text()
    assert "geodiff eval trust --rendered 2 --width 64 --kinds swapped,K-2\n" in page
    assert "3 of 4 (75 %)" in page and "1 of 2 (50 %)" in page and "2 of 2 (100 %)" in page
    weights.append("trained further")
    calibrations.run_trust("trust", options)
    assert len(asked) == 12
    calibrations.run_trust("trust", replace(options, kinds=()))
    assert asked[12:] == [kind for kind in [*RIGHT[1:], *WRONG] if kind not in ("swapped", "K-2")] * 2


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"kinds": ("bent",)}, "--kinds must be one of K-0.67"),
        ({"kinds": ("unrelated",)}, "without 'unrelated' where a pair is alone"),
        ({}, "the truth of synthetic/seed0004 must be known"),
        ({"rendered": 0}, "--data must be given, or --rendered above 0"),
        ({"limit": -1}, "--limit must be between 1"),
    ],
)
def test_what_cannot_be_counted(tmp_path, monkeypatch, weights, sample, changed, said):
    blind = replace(sample, valid=np.zeros_like(sample.valid))
    monkeypatch.setattr(calibrations, "load", lambda ref: blind)
    given = {"rendered": 1, "width": 64, "kinds": ("swapped",), "out": tmp_path / "out", "quiet": True}
    with pytest.raises(InputError, match=said):
        calibrations.run_trust("trust", TrustOptions(**given | changed))
