"""The ends of a given range: how many matches lie there, and what a stated range confirms."""

import numpy as np
import pytest
import torch

from geodiff_plugin.trust import Call, measure_result
from geodiff_plugin.trust.search_range import Ends, SearchRange
from tests.unit.trust.made_stages import GRID, made_result, matches_of
from tests.unit.trust.sheets import good, judged, sheet

PLANES = torch.linspace(0.1, 0.7, 61)
GIVEN = Call(range_given=True)


def ends_of(inverse: np.ndarray, confidence: np.ndarray, call: Call = GIVEN, planes=PLANES) -> Ends | None:
    stage = made_result(matches_of(inverse, confidence), call=call, planes=planes)
    return measure_result(stage)[SearchRange]


def test_confident_matches_within_three_quarters_of_a_step_of_an_end_are_counted():
    rng = np.random.default_rng(0)
    inverse = rng.uniform(0.15, 0.65, GRID)
    for value in (0.1 + 0.007, 0.7 - 0.007, 0.1 + 0.008, 0.7 - 0.008, 0.0, -0.02):
        inverse[rng.random(GRID) < 0.06] = value
    confidence = rng.random(GRID)
    in_front = (confidence > 0.5) & (inverse > 0)
    at_ends = (np.abs(inverse - 0.1) < 0.0075) | (np.abs(inverse - 0.7) < 0.0075)
    expected = (at_ends & in_front).sum() / in_front.sum()
    assert ends_of(inverse, confidence).fraction == pytest.approx(expected, rel=1e-4)
    for end in (0.1, 0.7):
        assert ends_of(np.full(GRID, end), np.ones(GRID)) == Ends(1.0)


def test_forty_matches_are_needed():
    inverse, confidence = np.full(GRID, 0.1), np.zeros(GRID)
    confidence.flat[:40] = 1.0
    assert ends_of(inverse, confidence) == Ends(1.0)
    confidence.flat[39] = 0.5
    assert ends_of(inverse, confidence) is None


def test_ends_of_a_range_that_was_not_given_or_not_searched_are_unknown():
    everywhere = np.full(GRID, 0.1), np.ones(GRID)
    assert ends_of(*everywhere, call=Call()) is None
    assert ends_of(*everywhere, planes=None) is None
    assert measure_result(made_result(call=GIVEN, planes=PLANES))[SearchRange] is None


@pytest.mark.parametrize(
    ("range_given", "ends", "confirmed"),
    [
        (False, None, False),
        (True, None, True),
        (True, Ends(0.2), True),
        (True, Ends(0.201), False),
        (False, Ends(0.1), False),
    ],
)
def test_a_given_range_confirms_the_unit_if_the_matches_are_in_it(range_given, ends, confirmed):
    records = [] if ends is None else [ends]
    assert SearchRange.confirms_unit(sheet(*records, range_given=range_given)) is confirmed


def test_the_finding_states_how_many_matches_are_at_an_end():
    assert "35 % of the matches are at an end" in judged(good(Ends(0.3456)), "depth.range")
