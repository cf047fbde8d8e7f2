"""The depth next to a metric prior's own."""

import pytest
import torch

from geodiff_plugin.trust import Call, measure_result
from geodiff_plugin.trust.prior_scale import PriorScale, Ratio
from geodiff_plugin.trust.search_range import Ends
from tests.unit.trust.made_stages import made_result
from tests.unit.trust.sheets import codes, good, judged

OVER_PRIOR = torch.tensor([[1.0, 2.0, 9.0], [1.5, 4.0, 0.1]])


def test_the_median_over_all_members_and_pixels_counts_if_lengths_have_a_unit():
    assert measure_result(made_result(over_prior=OVER_PRIOR))[PriorScale] == Ratio(1.5)
    no_unit = made_result(over_prior=OVER_PRIOR, call=Call(has_unit=False))
    assert measure_result(no_unit)[PriorScale] is None
    outside = torch.cat([OVER_PRIOR, torch.full_like(OVER_PRIOR, torch.nan)], 1)  # of the mask
    assert measure_result(made_result(over_prior=outside))[PriorScale] == Ratio(1.5)
    assert measure_result(made_result())[PriorScale] is None
    assert measure_result(made_result(over_prior=torch.full((1, 3), torch.nan)))[PriorScale] is None


@pytest.mark.parametrize(
    ("ratio", "expected"),
    [
        (1.0, []),
        (1.4, []),
        (1.89, []),
        (1.91, ["prior.metres"]),
        (19.9, ["prior.metres"]),
        (20.1, ["prior.unit"]),
    ],
)
def test_a_ratio_is_a_remark_and_one_that_only_units_explain_a_reason(ratio, expected):
    assert codes(good(Ratio(ratio))) == codes(good(Ratio(1 / ratio))) == expected
    assert codes(good(Ratio(0.0))) == []


@pytest.mark.parametrize(
    ("records", "expected"), [([], []), ([Ends(0.1)], []), ([Ends(0.3)], ["prior.unit"])]
)
def test_a_stated_range_confirms_the_unit(records, expected):
    found = codes(good(Ratio(21.0), *records, range_given=True))
    assert [code for code in found if code != "depth.range"] == expected


def test_findings_state_the_ratio():
    assert "The depth is 3.5 times the metric prior's depth" in judged(good(Ratio(3.456)), "prior.metres")
    finding = judged(good(Ratio(34.56)), "prior.unit")
    assert "The depth is 35 times the metric prior's depth" in finding and "depth_range, --near" in finding
