"""How far a result is from its matches."""

import math

import numpy as np
import pytest

from geodiff_plugin.trust import measure_result
from geodiff_plugin.trust.known_points import Points
from geodiff_plugin.trust.result_vs_matches import Deviation, ResultVsMatches
from tests.unit.trust.made_stages import FULL, GRID, STEP, made_result, matches_of
from tests.unit.trust.sheets import codes, good, judged, sheet


@pytest.mark.parametrize(("count", "expected"), [(40, math.log(1.5)), (39, None)])
def test_the_deviation_from_forty_matches_beyond_the_first_plane_is_measured(count, expected):
    inverse, confidence = np.full(GRID, STEP / 2), np.ones(GRID)
    inverse.flat[:count] = 1 / 3.0
    stage = made_result(matches_of(inverse, confidence), depth_m=np.full(FULL, 4.5))
    found = measure_result(stage)[ResultVsMatches]
    assert (None if found is None else found.log_deviation) == (expected and pytest.approx(expected))
    assert measure_result(made_result())[ResultVsMatches] is None


@pytest.mark.parametrize("count", [0, 2, 3])
@pytest.mark.parametrize("ratio", [1.19, 1.21])
def test_a_result_far_from_its_matches_is_not_trusted_unless_points_fix_the_scale(count, ratio):
    facts = good(Deviation(math.log(ratio)), Points(count, 0, 0.5, None, None))
    expected = ratio > 1.2 and count < 3
    assert ("depth.off-matches" in codes(facts)) is expected


@pytest.mark.parametrize(("records", "follows"), [([0.048], True), ([0.049], False), ([], False)])
def test_a_result_follows_its_matches_within_five_per_cent(records, follows):
    assert ResultVsMatches.follows(sheet(*map(Deviation, records))) is follows


def test_the_finding_states_the_difference():
    assert "differs by 46 %" in judged(good(Deviation(math.log(1.4567))), "depth.off-matches")
