"""Flicker of sequences, and resumed runs."""

import numpy as np
import pytest

from geodiff_plugin.evaluation.baselines import PriorCache
from tests.lab import sequence
from tests.lab.options import WAYS, SequenceOptions
from tests.scenes import render_sequence

pytestmark = pytest.mark.end_to_end


def test_flicker_is_the_change_at_the_same_surface_points():
    ground_truth = sequence.true_frames(render_sequence(3, 3, size=(48, 64)))
    still = [np.full((48, 64), 0.1)] * 3
    assert sequence.flicker(still, ground_truth) == (0.0, 0.0)  # wrong, but constant
    drifting = [np.full((48, 64), value) for value in (0.0, 0.02, 0.0)]
    assert sequence.flicker(drifting, ground_truth) == pytest.approx((0.02, 0.02))
    noise = np.random.default_rng(0).normal(size=(3, 48, 64)) * 0.1
    points, medians = sequence.flicker(list(noise), ground_truth)
    # For two normal variables of standard deviation s, the mean of |a - b| is 2 s / sqrt(pi).
    assert points == pytest.approx(0.2 / np.sqrt(np.pi), rel=0.1) and medians < 0.02


@pytest.mark.slow
def test_the_command_measures_and_resumes(tmp_path, monkeypatch):
    given = {
        "size": (64, 96),
        "ways": ("alone", "temporal_smoothing"),
        "steps": 2,
        "out": tmp_path,
        "quiet": True,
    }
    options = SequenceOptions(scenes=1, frames=2, **given)
    page = sequence.run("sequence", options)
    assert [row[0] for row in page.tables[0].rows] == [WAYS["alone"], WAYS["temporal_smoothing"]]
    assert all(0 < float(row[1]) < 2 and float(row[-1]) > 0 for row in page.tables[0].rows)
    monkeypatch.setattr(sequence, "_measure", lambda *_: pytest.fail("it was measured"))
    assert sequence.run("sequence", options).tables == page.tables
    monkeypatch.setattr(PriorCache, "fingerprint", lambda self, settings: "trained further")
    with pytest.raises(pytest.fail.Exception):
        sequence.run("sequence", options)
