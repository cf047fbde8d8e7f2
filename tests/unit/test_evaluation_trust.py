"""What ``geodiff eval trust`` makes wrong, counts and prints."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
from geodiff_plugin.evaluation.mistakes import WRONG, WRONG_POINTS, case_kinds, make_case

from geodiff_plugin._checks import InputError
from geodiff_plugin.evaluation import trust
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.options import TrustOptions
from geodiff_plugin.runtime.verdict import Indicators


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    return [load(ref) for ref in find_pairs("synthetic:2@64x48", None)]


def test_every_kind_changes_what_it_says(samples):
    sample, other = samples
    kinds = case_kinds((*WRONG, *WRONG_POINTS))
    assert kinds == ("right", "right, points", *WRONG, *WRONG_POINTS) and case_kinds(("axis",)) == (
        "right",
        "axis",
    )
    cases = {kind: make_case(kind, sample, lambda: other) for kind in kinds}
    for kind in WRONG:
        made = cases[kind][0]
        same = all(
            np.array_equal(getattr(made, name), getattr(sample, name))
            for name in ("left", "right", "K_left", "K_right", "E")
        )
        assert not same, kind
        assert cases[kind][2] == np.array_equal(made.left, sample.left)
    assert cases["millimetres"][0].E[0, 3] == pytest.approx(1000 * sample.E[0, 3])
    assert cases["K-2"][0].K_left[0, 0] == pytest.approx(2 * sample.K_left[0, 0])
    assert cases["K-2"][0].K_left[0, 2] == sample.K_left[0, 2]
    np.testing.assert_allclose(cases["inverse"][0].E @ sample.E, np.eye(4), atol=1e-12)
    points = cases["right, points"][1]
    uv = points @ sample.K_left.T / points[:, 2:]
    column, row = np.rint(uv[0, :2]).astype(int)
    assert points[0, 2] == pytest.approx(sample.depth_m[row, column], rel=1e-6)
    np.testing.assert_allclose(cases["points-3"][1], 3 * points)


def test_counts_and_resumption(tmp_path, monkeypatch, capsys):
    """All but the rectified pair's K are detected; one right pair is not trusted."""
    asked = []

    def measure(ref, other, kind, read, pipe, settings):
        asked.append(kind)
        rectified = not ref.files["posed"]
        missed = kind == "K-2" and rectified
        distrusted = kind == "right" and not rectified
        bad = distrusted or (kind != "right" and not missed)
        signs = asdict(Indicators(confidence=0.1 if bad else 0.9, matched=0.8, order=0.8))
        signs = {name: None if value != value else value for name, value in signs.items()}
        off = 0.01 if kind == "right" else 0.5
        return {"rectified": rectified, "status": "finished", "said": [], "off": off, "signs": signs}

    monkeypatch.setattr(trust, "_measure", measure)
    monkeypatch.setattr(trust.PriorCache, "get", lambda *_: None)
    monkeypatch.setattr(trust.PriorCache, "fingerprint", lambda *_: weights[-1])
    weights = ["as they were"]
    options = TrustOptions(rendered=2, width=64, kinds=("swapped", "K-2"), out=tmp_path, quiet=True)
    trust.run_trust("trust", options)
    assert len(asked) == 6
    monkeypatch.setattr(trust, "load", None)  # what is measured needs no picture
    trust.run_trust("trust", options)
    assert len(asked) == 6 and capsys.readouterr().out == ""
    page = (tmp_path / "trust.md").read_text()
    assert "geodiff eval trust --rendered 2 --width 64 --kinds swapped,K-2\n" in page
    assert "3 of 4 (75 %)" in page and "1 of 2 (50 %)" in page and "2 of 2 (100 %)" in page
    with pytest.raises(InputError, match="--kinds must be some of swapped"):
        trust.run_trust("trust", replace(options, rendered=1, kinds=("bent",)))
    monkeypatch.setattr(trust, "load", load)
    weights.append("trained further")
    trust.run_trust("trust", replace(options, seed=3))
    assert len(asked) == 12 and "--seed 3" in (tmp_path / "trust.md").read_text()


def test_what_cannot_be_counted(tmp_path, monkeypatch, samples):
    """A pair alone has no unrelated one; without truth nothing says whether a depth is off."""
    monkeypatch.setattr(trust.PriorCache, "fingerprint", lambda *_: "")
    monkeypatch.setattr(trust.PriorCache, "get", lambda *_: None)
    options = TrustOptions(rendered=1, width=64, kinds=("unrelated",), out=tmp_path / "out", quiet=True)
    with pytest.raises(InputError, match="without 'unrelated' where a pair is alone"):
        trust.run_trust("trust", options)
    blind = replace(samples[0], valid=np.zeros_like(samples[0].valid))
    monkeypatch.setattr(trust, "load", lambda ref: blind)
    with pytest.raises(InputError, match="the truth of synthetic/seed0000 must be known"):
        trust.run_trust("trust", replace(options, kinds=("swapped",)))
    with pytest.raises(InputError, match="--limit must be between 1"):
        replace(options, data=tmp_path, limit=-1)
    with pytest.raises(InputError, match="--data must be given, or --rendered above 0"):
        trust.run_trust("trust", replace(options, rendered=0))
    with pytest.raises(InputError, match="--prior must be given once"):
        replace(options, prior=("bundled", "org/other"))
