"""Near and far swapped by the prior's order, and what shows that only the prior is wrong."""

import itertools

import pytest

from geodiff_plugin.trust import judge
from geodiff_plugin.trust.depth_order import DepthOrder
from geodiff_plugin.trust.epipolar import Residuals
from geodiff_plugin.trust.inverse_pose import Preference
from geodiff_plugin.trust.matched_fraction import Matched
from geodiff_plugin.trust.occlusion_order import Order
from geodiff_plugin.trust.order_ambiguity import Ambiguity
from geodiff_plugin.trust.prior_correlation import Correlation
from geodiff_plugin.trust.result_vs_matches import Deviation
from geodiff_plugin.trust.shifted_copy import DepthRange
from tests.unit.trust.sheets import codes, good, judged, sheet


def residual(px: float) -> Residuals:
    return Residuals("fits", (px,), (px,), 0.0, 1.0, False, None, None)


def found(*records) -> list[str]:
    return [finding.code for finding in DepthOrder.findings(sheet(*records), ())]


@pytest.mark.parametrize("spread", [None, 0.149, 0.15])
@pytest.mark.parametrize("matched", [None, 0.45, 0.51])
@pytest.mark.parametrize("correlation", [-0.9, -0.201, -0.2, 0.199, 0.2])
def test_a_prior_of_another_order_is_a_reason_if_depths_vary_and_something_is_matched(
    spread, matched, correlation
):
    """An unknown range of depths may be a wide one."""
    records = [Correlation(correlation), Matched(matched, 0.9)]
    records += [] if spread is None else [DepthRange(spread, 9.0)]
    expected = []
    if matched is not None and spread != 0.149:
        if correlation < -0.2:
            expected = ["depth.inverted-order"]
        elif correlation < 0.2 and matched < 0.5:
            expected = ["depth.order"]
    assert found(*records) == expected


def test_a_prior_is_wrong_only_if_everything_about_the_matches_is_right():
    """Whether an exchange is excluded, how exact and how many matches are, and whether the result follows."""
    wrong = Correlation(-0.5), DepthRange(0.7, 30.0)
    shown = (Ambiguity(0.29), Ambiguity(0.31), Order(0.36), Order(0.34))
    residuals, deviations, fractions = (0.99, 1.01), (0.048, 0.049), (0.51, 0.5)
    for order, px, deviation, matched in itertools.product(shown, residuals, deviations, fractions):
        records = (*wrong, order, residual(px), Deviation(deviation), Matched(matched, 0.9))
        known = order in (shown[0], shown[2]) and (px, deviation, matched) == (0.99, 0.048, 0.51)
        assert found(*records) == (["prior.order"] if known else ["depth.inverted-order"]), records
    assert found(*wrong, Matched(0.9, 0.9)) == ["depth.inverted-order"]


def test_only_a_remark_is_made_of_a_wrong_prior():
    known = Ambiguity(0.1), residual(0.3), Deviation(0.01)
    facts = good(Correlation(-0.5678), *known)
    assert codes(facts) == ["prior.order"] and judge(facts).trusted
    finding = judged(facts, "prior.order")
    assert "(rank correlation -0.57)" in finding


def test_an_exchange_explains_that_prior_and_matches_hardly_agree():
    hardly = Correlation(0.1), Matched(0.45, 0.85)
    assert codes(good(*hardly)) == ["depth.order"]
    assert codes(good(*hardly, Preference(True))) == ["depth.inverted-order"]


def test_findings_state_the_correlation():
    assert "(rank correlation -0.12)" in judged(
        good(Correlation(-0.1234), Matched(0.45, 0.85)), "depth.order"
    )
    assert "swapped" in judged(good(Correlation(-0.57)), "depth.inverted-order")
