"""Poses that too few matches check, and depths that confirm them all the same."""

import itertools
from dataclasses import replace

import pytest

from geodiff_plugin.trust.epipolar import Residuals
from geodiff_plugin.trust.known_points import Points
from geodiff_plugin.trust.matched_fraction import Matched
from geodiff_plugin.trust.prior_correlation import Correlation
from geodiff_plugin.trust.result_vs_matches import Deviation
from geodiff_plugin.trust.unchecked_pose import UncheckedPose
from tests.unit.trust.sheets import codes, good, sheet

NOT_CHECKED = Residuals("not checked", (), (None,), 0.0, 1.0, False, None, None)
AGREE = Points(50, 0, 0.5, 1.0, 0.0)


def is_unchecked(*records) -> bool:
    return bool(list(UncheckedPose.findings(sheet(*records), ())))


def test_a_depth_confirms_a_pose_if_much_is_matched_and_result_and_prior_follow():
    values = (0.51, 0.5), (0.048, 0.049), (0.45, 0.449)
    for matched, deviation, correlation in itertools.product(*values):
        records = Matched(matched, 0.9), Deviation(deviation), Correlation(correlation)
        confirmed = (matched, deviation, correlation) == (0.51, 0.048, 0.45)
        assert is_unchecked(NOT_CHECKED, *records) is not confirmed, records
        assert not is_unchecked(replace(NOT_CHECKED, status="fits"), *records)
        assert not is_unchecked(*records)
    assert is_unchecked(NOT_CHECKED, Matched(0.9, 0.9)), "nothing is known to follow"


@pytest.mark.parametrize(
    ("points", "confirmed"),
    [
        (AGREE, True),
        (replace(AGREE, ratio=1.21), False),
        (replace(AGREE, fraction_off=0.51), False),
        (replace(AGREE, ratio=None, fraction_off=None), False),
        (replace(AGREE, ratio=0.0), False),
    ],
)
def test_points_that_agree_with_the_matches_confirm_a_pose(points, confirmed):
    assert is_unchecked(NOT_CHECKED, Matched(0.4, 0.9), points) is not confirmed


def test_without_matches_no_pose_is_in_use():
    assert not is_unchecked(NOT_CHECKED, Matched(None, 0.9)) and not is_unchecked(NOT_CHECKED)
    assert codes(good(NOT_CHECKED)) == ["pose.unchecked"]
