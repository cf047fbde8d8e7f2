"""What ``geodiff eval trust`` makes wrong, counts and prints."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.evaluation import trust
from geodiff_plugin.evaluation.baselines import Settings
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.wrong import WRONG, WRONG_POINTS, case_kinds, cases_of
from geodiff_plugin.runtime.verdict import Indicators


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    return [load(ref) for ref in find_pairs("synthetic:2@64x48", None)]


def test_every_kind_changes_what_it_says(samples):
    sample, other = samples
    cases = {case.kind: case for case in cases_of(sample, lambda: other, (*WRONG, *WRONG_POINTS))}
    assert (
        tuple(cases)
        == case_kinds((*WRONG, *WRONG_POINTS))
        == ("right", "right, points", *WRONG, *WRONG_POINTS)
    )
    for kind in WRONG:
        made = cases[kind].sample
        same = all(
            np.array_equal(getattr(made, name), getattr(sample, name))
            for name in ("left", "right", "K_left", "K_right", "E")
        )
        assert not same, kind
        assert cases[kind].truth == np.array_equal(made.left, sample.left)
    assert cases["millimetres"].sample.E[0, 3] == pytest.approx(1000 * sample.E[0, 3])
    assert cases["K-2"].sample.K_left[0, 0] == pytest.approx(2 * sample.K_left[0, 0])
    assert cases["K-2"].sample.K_left[0, 2] == sample.K_left[0, 2]
    np.testing.assert_allclose(cases["inverse"].sample.E @ sample.E, np.eye(4), atol=1e-12)
    points = cases["right, points"].points
    uv = points @ sample.K_left.T / points[:, 2:]
    column, row = np.rint(uv[0, :2]).astype(int)
    assert points[0, 2] == pytest.approx(sample.depth_m[row, column], rel=1e-6)
    np.testing.assert_allclose(cases["points-3"].points, 3 * points)


def test_counts_and_resumption(tmp_path, monkeypatch, capsys):
    """All but the rectified pair's K are detected; one right pair is not trusted."""
    asked = []

    def measure(case, pipe, settings):
        asked.append(case.kind)
        missed = case.kind == "K-2" and case.sample.rectified
        distrusted = case.kind == "right" and not case.sample.rectified
        bad = distrusted or (case.kind != "right" and not missed)
        signs = asdict(Indicators(confidence=0.1 if bad else 0.9, matched=0.8, order=0.8))
        signs = {name: None if value != value else value for name, value in signs.items()}
        off = 0.01 if case.kind == "right" else 0.5
        return {"status": "finished", "said": [], "off": off, "signs": signs}

    monkeypatch.setattr(trust, "_measure", measure)
    monkeypatch.setattr(trust.PriorCache, "get", lambda *_: None)
    monkeypatch.setattr(trust.PriorCache, "fingerprint", lambda *_: weights[-1])
    weights = ["as they were"]
    options = trust.TrustOptions(None, 2, 64, ("swapped", "K-2"), None, Settings("bundled"), tmp_path, True)
    trust.run_trust(options)
    assert len(asked) == 6
    monkeypatch.setattr(trust, "load", None)  # what is measured needs no picture
    trust.run_trust(options)
    assert len(asked) == 6 and capsys.readouterr().out == ""
    page = (tmp_path / "trust.md").read_text()
    assert "geodiff eval trust --rendered 2 --width 64 --kinds swapped,K-2\n" in page
    assert "3 of 4 (75 %)" in page and "1 of 2 (50 %)" in page and "2 of 2 (100 %)" in page
    with pytest.raises(InputError, match="--kinds must be some of swapped"):
        trust.run_trust(replace(options, rendered=1, kinds=("bent",)))
    monkeypatch.setattr(trust, "load", load)
    weights.append("trained further")
    trust.run_trust(replace(options, settings=Settings("bundled", seed=3)))
    assert len(asked) == 12 and "--seed 3\n" in (tmp_path / "trust.md").read_text()


def test_what_cannot_be_counted(tmp_path, monkeypatch, samples):
    """A pair alone has no unrelated one; without truth nothing says whether a depth is off."""
    monkeypatch.setattr(trust.PriorCache, "fingerprint", lambda *_: "")
    options = trust.TrustOptions(
        None, 1, 64, ("unrelated",), None, Settings("bundled"), tmp_path / "out", True
    )
    with pytest.raises(InputError, match="without 'unrelated' where a pair is alone"):
        trust.run_trust(options)
    blind = replace(samples[0], valid=np.zeros_like(samples[0].valid))
    monkeypatch.setattr(trust, "load", lambda ref: blind)
    with pytest.raises(InputError, match="the truth of synthetic/seed0000 must be known"):
        trust.run_trust(replace(options, kinds=("swapped",)))
    with pytest.raises(InputError, match="limit must be at least 1; got -1"):
        trust.run_trust(replace(options, data=tmp_path, limit=-1))
