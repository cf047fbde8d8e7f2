"""How much is matched, how certain the depth is, and how much a right view sees."""

import numpy as np
import pytest
import torch

from geodiff_plugin.trust import MatchedFraction, measure_result
from geodiff_plugin.trust.matched_fraction import Matched
from tests.unit.trust.made_stages import FULL, GRID, made_result, matches_of
from tests.unit.trust.sheets import codes, good, judged, sheet


def test_each_fraction_is_the_mean_of_its_own_map():
    confidence, visible = torch.zeros(1, 1, *FULL), torch.zeros(1, 1, *FULL, dtype=torch.bool)
    confidence[..., :15] = 0.5
    visible[..., :20, :] = True
    matched = np.zeros(GRID)
    matched[:10] = 0.6
    matches = matches_of(np.full(GRID, 0.5), matched)
    found = measure_result(made_result(matches, confidence=confidence, visible=visible))[MatchedFraction]
    assert (found.matched, found.confidence, found.visible) == pytest.approx((10 / 29, 7.5 / 61, 20 / 37))
    assert measure_result(made_result(matches))[MatchedFraction] == Matched(pytest.approx(10 / 29))
    assert measure_result(made_result())[MatchedFraction] is None


@pytest.mark.parametrize(
    ("records", "has_matches", "well_matched"),
    [
        ([], False, False),
        ([Matched(confidence=0.9)], False, False),
        ([Matched(0.0)], True, False),
        ([Matched(0.5)], True, False),
        ([Matched(0.51)], True, True),
    ],
)
def test_without_a_second_view_nothing_is_matched(records, has_matches, well_matched):
    facts = sheet(*records)
    assert MatchedFraction.has_matches(facts) is has_matches
    assert MatchedFraction.well_matched(facts) is well_matched


@pytest.mark.parametrize(("visible", "expected"), [(None, []), (0.3, []), (0.2901, ["views.overlap"])])
def test_views_that_overlap_little_are_reported(visible, expected):
    facts = good(Matched(0.8, 0.85, visible))
    assert codes(facts) == expected
    if expected:
        assert judged(facts, "views.overlap").startswith("Only 29% of the left image is visible")
