"""Matches of one depth only."""

import math

import numpy as np
import pytest

from geodiff_plugin.trust import measure_result
from geodiff_plugin.trust.prior_correlation import Correlation
from geodiff_plugin.trust.shifted_copy import DepthRange, ShiftedCopy
from tests.unit.trust.made_stages import GRID, made_result, matches_of
from tests.unit.trust.sheets import codes, good


@pytest.mark.parametrize(("count", "is_known"), [(40, True), (39, False)])
def test_the_range_of_forty_matches_is_measured(count, is_known):
    inverse, confidence = np.full(GRID, 0.25), np.zeros(GRID)
    inverse.flat[20:] = 0.5
    confidence.flat[:count] = 1.0
    found = measure_result(made_result(matches_of(inverse, confidence)))[ShiftedCopy]
    assert (found is not None) is is_known
    if found is not None:
        assert (found.log_ratio, found.planes) == pytest.approx((math.log(2.0), 25.0), rel=1e-5)
    assert measure_result(made_result())[ShiftedCopy] is None


@pytest.mark.parametrize(
    ("log_ratio", "planes", "flat"),
    [(0.19, 1.9, True), (0.2, 1.9, False), (0.19, 2.0, False), (0.3, 5.0, False), (0.19, 9.0, False)],
)
def test_a_scene_is_one_plane_if_its_depths_are_together_and_within_two_planes(log_ratio, planes, flat):
    assert codes(good(DepthRange(log_ratio, planes))) == (["views.shifted"] if flat else [])


def test_a_flat_scene_has_no_depth_order():
    assert codes(good(DepthRange(0.01, 0.5), Correlation(0.05))) == ["views.shifted"]
