"""The prior's depth order against that of the evidence."""

import pytest
import torch

from geodiff_plugin.trust import measure_result
from geodiff_plugin.trust.known_points import Points
from geodiff_plugin.trust.matched_fraction import Matched
from geodiff_plugin.trust.prior_correlation import Correlation, PriorCorrelation
from tests.unit.trust.made_stages import made_result
from tests.unit.trust.sheets import codes, good, judged, sheet

POINTS = Points(99, 0, 1.0, None, None)


def test_the_correlation_of_a_result_is_a_fact_if_it_is_known():
    measured = (
        measure_result(made_result(rank_correlation=each))[PriorCorrelation]
        for each in (torch.tensor(-0.25), torch.tensor(torch.nan), None)
    )
    assert list(measured) == [Correlation(-0.25), None, None]
    numbers = {"rank_correlation": torch.tensor(0.5), "prior_error": torch.tensor(0.25)}
    assert measure_result(made_result(**numbers))[PriorCorrelation] == Correlation(0.5, 0.25)


@pytest.mark.parametrize("error", [None, 0.02, 0.149, 0.151, 0.3, 0.449, 0.451, 0.5])
@pytest.mark.parametrize("matched", [0.45, 0.35, 0.8])
def test_the_depth_order_of_a_weak_prior_is_not_evidence(error, matched):
    """Unless its error is at the maximum, where the matches contradict each other."""
    is_weak = error in (0.151, 0.3, 0.449)
    low = good(Correlation(0.1, error), Matched(matched, 0.85))
    assert ("depth.order" in codes(low)) is (not is_weak and matched < 0.5)
    unordered = good(Correlation(0.3, error), Matched(matched, 0.85))
    assert ("views.inconsistent" in codes(unordered)) is (not is_weak and matched < 0.38)
    assert "depth.inverted-order" in codes(good(Correlation(-0.5, error), Matched(matched, 0.85)))
    certain = (
        good(Correlation(0.3, error), Matched(0.1, 0.85)),
        good(Correlation(0.3, error), Matched(0.8, 0.4)),
    )
    assert all("views.inconsistent" in codes(each) for each in certain)


@pytest.mark.parametrize("matched", [None, 0.8])
@pytest.mark.parametrize("correlation", [-0.9, 0.19, 0.21])
def test_points_in_another_order_than_the_prior_are_a_reason_without_matches(correlation, matched):
    facts = sheet(POINTS, Correlation(correlation), Matched(matched))
    expected = matched is None and correlation < 0.2
    assert ("depth.order-points" in codes(facts)) is expected


@pytest.mark.parametrize(("records", "confirms"), [([0.45], True), ([0.44], False), ([], False)])
def test_a_prior_confirms_the_order_from_a_correlation_on(records, confirms):
    assert PriorCorrelation.confirms(sheet(*map(Correlation, records))) is confirms


def test_the_finding_states_the_correlation():
    finding = judged(sheet(POINTS, Correlation(0.1234)), "depth.order-points")
    assert "(rank correlation +0.12)" in finding
    assert codes(good(Correlation(0.21))) == []
