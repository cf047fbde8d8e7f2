"""The certain part of an estimate, which is 0 within four standard errors."""

import pytest

from geodiff_plugin._internal.statistics import certain_part


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [
        (10.0, 2.0, 2.0),
        (-10.0, 2.0, -2.0),
        (7.9, 2.0, 0.0),
        (-7.9, 2.0, 0.0),
        (3.0, 0.0, 3.0),
        (-0.5, 0.1, -0.1),
        (0.0, 1.0, 0.0),
    ],
)
def test_four_standard_errors_are_taken_from_an_estimate(value, error, expected):
    assert certain_part(value, error) == pytest.approx(expected)
