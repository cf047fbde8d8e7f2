"""Inconsistent views, by one bad indicator or two weak ones."""

import itertools

import pytest

from geodiff_plugin.trust import judge
from geodiff_plugin.trust.agreement import Agreement
from geodiff_plugin.trust.epipolar import Residuals
from geodiff_plugin.trust.known_points import Points
from geodiff_plugin.trust.matched_fraction import Matched
from geodiff_plugin.trust.prior_correlation import Correlation
from tests.unit.trust.sheets import codes, good, judged, sheet


def residual(px: float) -> Residuals:
    return Residuals("fits", (px,), (px,), 0.0, 1.0, False, None, None)


def disagree(*records) -> bool:
    return "views.inconsistent" in [finding.code for finding in Agreement.findings(sheet(*records), ())]


@pytest.mark.parametrize(("matched", "confidence"), [(0.119, 0.9), (0.9, 0.499), (0.119, None)])
def test_one_bad_indicator_is_enough(matched, confidence):
    assert disagree(Matched(matched, confidence), Correlation(0.9), residual(0.1))


def test_one_weak_indicator_is_not_enough_and_two_are():
    """Matched fraction, confidence, correlation and residual, each good or weak."""
    values = (0.381, 0.379), (0.531, 0.529), (0.451, 0.449), (0.99, 1.01)
    for weak in itertools.product((0, 1), repeat=4):
        matched, confidence, correlation, px = (
            pair[is_weak] for pair, is_weak in zip(values, weak, strict=True)
        )
        records = Matched(matched, confidence), Correlation(correlation), residual(px)
        assert disagree(*records) is (sum(weak) > 1), weak


def test_unknown_indicators_are_not_weak():
    assert not disagree(Matched(0.379)) and not disagree(Matched(0.9, 0.529))
    assert not disagree(Matched(0.379), residual(0.1)) and not disagree(Matched(0.9), Correlation(-0.1))


def test_without_matches_there_are_no_views_that_could_disagree():
    alone = Points(99, 0, 1.0, None, None), Correlation(0.3), Matched(None, 0.1)
    assert not disagree(*alone) and judge(sheet(*alone)).trusted


@pytest.mark.parametrize(
    ("records", "words"),
    [
        ([Matched(0.0456, 0.85)], "are inconsistent (5 % of the left image is matched). Check"),
        ([Matched(0.8, 0.4567)], "are inconsistent (mean confidence is 0.46). Check"),
        (
            [Matched(0.0456, 0.4567), Correlation(0.3)],
            "(5 % of the left image is matched, mean confidence is 0.46). Check",
        ),
        (
            [Correlation(0.3456), residual(1.5)],
            "are inconsistent (rank correlation with the prior is 0.35). Check",
        ),
        ([Matched(0.8, 0.52), residual(1.5)], "(mean confidence is 0.52)"),
    ],
)
def test_the_finding_states_the_weak_numbers(records, words):
    assert words in judged(good(*records), "views.inconsistent")


def test_a_good_pair_with_one_weak_number_is_trusted_in_silence():
    for weak in (Matched(0.8, 0.52), Matched(0.35, 0.85), residual(1.5)):
        assert codes(good(weak)) == []
