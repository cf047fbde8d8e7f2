"""The laboratory of sequences: what flicker measures, and runs that go on."""

import numpy as np
import pytest

from geodiff_plugin.evaluation.baselines import PriorCache
from tests.lab import sequence
from tests.lab.options import WAYS, SequenceOptions
from tests.scenes import render_sequence


def test_flicker_is_what_changes_on_the_same_points():
    truth = sequence.true_frames(render_sequence(3, 3, size=(48, 64)))
    still = [np.full((48, 64), 0.1)] * 3
    assert sequence.flicker(still, truth) == (0.0, 0.0)  # wrong, but steadily so
    breathing = [np.full((48, 64), value) for value in (0.0, 0.02, 0.0)]
    assert sequence.flicker(breathing, truth) == pytest.approx((0.02, 0.02))
    noise = np.random.default_rng(0).normal(size=(3, 48, 64)) * 0.1
    points, breath = sequence.flicker(list(noise), truth)
    # The mean of |a - b| of two normal numbers of deviation s is 2 s / sqrt(pi).
    assert points == pytest.approx(0.2 / np.sqrt(np.pi), rel=0.1) and breath < 0.02


@pytest.mark.slow
def test_the_command_measures_and_goes_on(tmp_path, monkeypatch):
    given = {"size": (64, 96), "ways": ("alone", "steady"), "steps": 2, "out": tmp_path, "quiet": True}
    options = SequenceOptions(scenes=1, frames=2, **given)
    page = sequence.run("sequence", options)
    assert [row[0] for row in page.tables[0].rows] == ["each frame alone", WAYS["steady"]]
    assert all(0 < float(row[1]) < 2 and float(row[-1]) > 0 for row in page.tables[0].rows)
    monkeypatch.setattr(sequence, "_measure", lambda *_: pytest.fail("it was measured"))
    assert sequence.run("sequence", options).tables == page.tables
    monkeypatch.setattr(PriorCache, "fingerprint", lambda self, settings: "trained further")
    with pytest.raises(pytest.fail.Exception):
        sequence.run("sequence", options)
