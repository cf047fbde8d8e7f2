"""Readings of a map, against plane geometry and drawn errors."""

import math
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from scipy.stats import norm

from geodiff_plugin.result.readings import Reading, beyond_limit, distance_m, measured, metres, read_pixel

K = np.array([[50.0, 0.7, 21.0], [0, 40.0, 13.0], [0, 0, 1]])
DEPTH = np.random.default_rng(0).uniform(1.0, 9.0, (24, 37))


@pytest.mark.parametrize("pixel", [(0, 0), (36, 0), (0, 23), (36, 23), (11, 17)])
def test_a_pixels_point_projects_back_to_it(pixel):
    at = read_pixel(DEPTH, K, pixel)
    x, y, z = K @ at.point_m
    np.testing.assert_allclose((x / z, y / z), pixel, atol=1e-9)
    assert at.depth_m == z == DEPTH[pixel[1], pixel[0]] and at.pixel == pixel
    assert at.spread is None and at.spread_m is None and at.confidence is None
    with pytest.raises(FrozenInstanceError):
        at.pixel = (0, 0)


@pytest.mark.parametrize("pixel", [(-1, 3), (37, 3), (3, -1), (3, 24), (24, 24)])
def test_pixels_outside_are_named_with_the_size_of_the_map(pixel):
    with pytest.raises(ValueError, match=rf"inside the map of 37x24; got \({pixel[0]}, {pixel[1]}\)"):
        read_pixel(DEPTH, K, pixel)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_pixel_without_a_depth_is_named(value):
    depth = DEPTH.copy()
    depth[7, 5] = value
    with pytest.raises(ValueError, match="a pixel with a depth"):
        read_pixel(depth, K, (5, 7))
    assert read_pixel(depth, K, (7, 5)).depth_m == DEPTH[5, 7]


@pytest.mark.parametrize(
    ("confidence", "counted"),
    [(0.0, 0.05), (0.04, 0.05), (0.06, 0.06), (0.5, 0.5), (0.99, 0.99), (1.0, 0.999)],
)
def test_the_spread_of_a_normal_error_that_is_within_a_tenth_with_this_confidence(confidence, counted):
    sure = np.full_like(DEPTH, 0.3)
    sure[7, 5] = confidence
    at = read_pixel(DEPTH, K, (5, 7), sure)
    within = norm.cdf(0.1 / at.spread) - norm.cdf(-0.1 / at.spread)
    assert within == pytest.approx(counted) and at.confidence == confidence
    assert at.spread_m == pytest.approx(at.spread * DEPTH[7, 5])


def test_a_given_sigma_counts_instead_of_the_confidence_and_may_be_unknown():
    sure, sigma_m = np.full_like(DEPTH, 0.9), np.full_like(DEPTH, np.nan)
    sigma_m[3, 9] = 0.2
    for confidence in (sure, None):
        at = read_pixel(DEPTH, K, (9, 3), confidence, sigma_m)
        assert at.spread == pytest.approx(0.2 / DEPTH[3, 9]) and at.spread_m == pytest.approx(0.2)
        assert at.confidence == (None if confidence is None else 0.9)
    unknown = read_pixel(DEPTH, K, (8, 3), sure, sigma_m)
    assert unknown.spread is None and unknown.spread_m is None and unknown.confidence == 0.9


def reading(point, spread) -> Reading:
    return Reading((1, 2), np.array(point, float), spread, None)


def test_a_distance_is_as_uncertain_as_drawn_points_along_their_rays():
    a, b = reading((0.5, -0.2, 2.0), 0.02), reading((-0.8, 0.9, 3.5), 0.05)
    rng = np.random.default_rng(1).normal(size=(2, 200_000, 1)) * 0.05
    drawn = np.linalg.norm(b.point_m * (1 + 0.05 * rng[1]) - a.point_m * (1 + 0.02 * rng[0]), axis=1)
    for one, other in ((a, b), (b, a)):
        length, spread = distance_m(one, other)
        assert length == pytest.approx(math.sqrt(1.3**2 + 1.1**2 + 1.5**2))
        assert spread == pytest.approx(drawn.std() / 0.05, rel=0.01)
    for unknown in ((a, reading(b.point_m, None)), (reading(a.point_m, None), b)):
        assert distance_m(*unknown) == (pytest.approx(length), None)


def test_two_readings_of_one_point_differ_by_their_own_errors():
    point = (0.6, 0.0, 0.8)
    assert distance_m(reading(point, 0.3), reading(point, 0.4)) == (0.0, pytest.approx(0.5))
    assert distance_m(reading(2 * np.array(point), 0.3), reading(2 * np.array(point), 0.4))[
        1
    ] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("value", "spread", "unit", "text"),
    [
        (2.3146, None, "m", "2.31 m"),
        (2.3146, 0.0699, "m", "2.31 ± 0.07 m"),
        (2.3146, 0.005, "m", "2.31 ± 0.01 m"),
        (2.3146, 0.0049, "m", "2.315 ± 0.005 m"),
        (2.3146, 0.0712, None, "2.31 ± 0.07 units of the poses"),
        (2.3146, None, None, "2.31 units of the poses"),
    ],
)
def test_lengths_as_text(value, spread, unit, text):
    assert metres(value, spread, unit) == text


def test_depths_that_are_invalid_or_too_far_are_not_measured():
    depth = np.array([[0.0, 3.0, 70.0, 70.5, np.nan, np.inf]])
    valid = np.array([[True, True, True, True, False, False]])
    np.testing.assert_array_equal(beyond_limit(depth, 70.0), [[False, False, False, True, False, False]])
    assert not beyond_limit(depth, None).any()
    np.testing.assert_array_equal(measured(depth, valid, 70.0), [[0, 3, 70, 0, 0, 0]])
    np.testing.assert_array_equal(measured(depth, valid, None), [[0, 3, 70, 70.5, 0, 0]])
    valid[0, 1] = False
    np.testing.assert_array_equal(measured(depth, valid, 70.0), [[0, 0, 70, 0, 0, 0]])
