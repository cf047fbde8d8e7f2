"""How much of an image is a repeated pattern, and whether its depth is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geodiff_plugin.trust import measure_result
from geodiff_plugin.trust.repeated_pattern import RepeatedPattern, Repetition
from tests.unit.trust.made_stages import FULL, GRID, made_result, matches_of
from tests.unit.trust.sheets import Case, codes, good, judged

CASES = [
    Case("MIN_FRACTION", lambda x: good(Repetition(x, 0.0)), [], ["views.repeated-pattern"]),
    Case(
        "MAX_UNDECIDED",
        lambda x: good(Repetition(0.6, x)),
        ["views.repeated-pattern"],
        ["depth.repeated-pattern"],
    ),
]


def stage_of(fraction: float, doubtful: float):
    """A result whose left columns are on a pattern, and whose first columns have a low confidence."""
    matches = matches_of(np.full(GRID, 0.3), np.ones(GRID))
    repeated = torch.zeros_like(matches.confidence)
    repeated[..., : round(fraction * GRID[1])] = 1.0
    confidence = torch.full((1, 1, *FULL), 0.9)
    confidence[..., : round(doubtful * FULL[1])] = 0.2
    return replace(made_result(replace(matches, repeated=repeated)), confidence=confidence)


@pytest.mark.parametrize("doubtful", [0.0, 0.25, 0.75])
def test_both_fractions_of_the_image_are_measured(doubtful):
    fact = measure_result(stage_of(0.5, doubtful))[RepeatedPattern]
    assert fact.fraction == pytest.approx(0.5, abs=0.03)
    assert fact.undecided == pytest.approx(min(doubtful, 0.5), abs=0.03)


def test_matches_that_were_not_searched_and_depth_without_confidence_say_nothing():
    stage = stage_of(0.5, 0.5)
    assert measure_result(replace(stage, confidence=None))[RepeatedPattern] is None
    unsearched = replace(stage, matches=replace(stage.matches, repeated=None))
    assert measure_result(unsearched)[RepeatedPattern] is None
    assert measure_result(replace(stage, matches=None))[RepeatedPattern] is None


def test_the_findings_state_the_fractions():
    assert "31 % of the image" in judged(good(Repetition(0.5, 0.31)), "depth.repeated-pattern")
    assert "50 % of the image" in judged(good(Repetition(0.5, 0.1)), "views.repeated-pattern")
    assert codes(good()) == []
