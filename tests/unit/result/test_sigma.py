"""The standard deviation of a depth: drawn errors of inliers and outliers, and a rig whose error is known."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from geodiff_plugin._internal import strips
from geodiff_plugin.result.sigma import depth_sigma, geometric_sigma, relative_sigma
from geodiff_plugin.trust import Epipolar, FactSheet, PoseUncertainty
from geodiff_plugin.trust.pose_uncertainty import Uncertainty
from geodiff_plugin.trust.rolling_shutter import RollingShutter
from tests.unit.jobs import made_runs

K = np.array([[500.0, 0, 40.0], [0, 500.0, 30.0], [0, 0, 1]])
RIG = np.eye(4)
RIG[0, 3] = 0.1


def within(spread: float) -> float:
    """The probability that a normal error is within 10 %."""
    return norm.cdf(0.1 / spread) - norm.cdf(-0.1 / spread)


@pytest.mark.parametrize("confidence", [0.5, 0.8, 0.95, 0.99])
@pytest.mark.parametrize("geometric", [0.001, 0.01, 0.025])
def test_drawn_errors_are_within_ten_percent_as_often_as_stated_and_have_the_mean_of_sigma(
    confidence, geometric
):
    inlier = min(np.hypot(1.5 * geometric, 0.005), brentq(lambda s: within(s) - confidence, 1e-3, 9.0))
    outlier = 0.2
    fraction = brentq(lambda w: w * within(inlier) + (1 - w) * within(outlier) - confidence, -1e-6, 1 + 1e-6)
    rng, count = np.random.default_rng(3), 400_000
    errors = rng.normal(size=count) * np.where(rng.random(count) < fraction, inlier, outlier)
    assert (np.abs(errors) < 0.1).mean() == pytest.approx(confidence, abs=0.004)
    # The mean absolute error of a normal distribution is sqrt(2 / pi) standard deviations.
    drawn = np.sqrt(np.pi / 2) * np.abs(errors).mean()
    assert relative_sigma(np.array(confidence), np.array(geometric)) == pytest.approx(drawn, rel=0.01)


@pytest.mark.parametrize("confidence", [0.05, 0.1, 0.3826, 0.6827, 0.999])
def test_an_error_that_geometry_does_not_explain_is_normal_with_the_stated_confidence(confidence):
    alone = relative_sigma(np.array(confidence))
    assert within(alone) == pytest.approx(confidence)
    # So is one whose match is no better than the confidence; no outlier has less than 20 %.
    match = np.array(alone / 1.2)
    wide = max(alone, 0.2) if alone > 0.2 else alone
    assert relative_sigma(np.array(confidence), match) == pytest.approx(wide, rel=1e-6)


def test_sigma_falls_with_confidence_and_is_never_below_the_error_of_the_match():
    confidence, geometric = np.meshgrid(np.linspace(0, 1, 201), np.geomspace(1e-4, 0.5, 60))
    found = relative_sigma(confidence, geometric)
    assert (np.diff(found, axis=1) <= 1e-9).all()
    assert (found >= np.hypot(geometric, 0.005) - 1e-9).all() and np.isfinite(found).all()
    sure = confidence[0] > 0.6
    assert (np.diff(found[:, sure], axis=0) >= -0.01).all()  # a worse match, up to what outliers explain


def test_a_sure_depth_has_the_error_of_its_match_which_grows_with_the_square_of_the_distance():
    depth_m = np.repeat(np.array([[1.0], [2.0], [4.0], [8.0]]), 6, 1)
    sure = np.full(depth_m.shape, 1.0)
    geometric_m = geometric_sigma(depth_m, K, [RIG], FactSheet())
    np.testing.assert_allclose(geometric_m, 0.25 * depth_m**2 / (500 * 0.1), rtol=1e-9)
    sigma_m = depth_sigma(depth_m, sure, geometric_m)
    assert sigma_m.dtype == np.float32
    low, high = (np.hypot(factor * geometric_m, 0.005 * depth_m) for factor in (1.0, 1.5))
    assert (sigma_m >= low * (1 - 1e-6)).all() and (sigma_m < 1.1 * high).all()
    assert sigma_m[3, 0] / sigma_m[1, 0] > 7  # four times as far: nearly eight times relative to the floor


def test_the_error_of_a_match_is_that_of_the_view_that_measures_best_with_the_errors_of_the_facts():
    """Moving a pixel's depth by its error moves it by one standard deviation in the best right view."""
    facts, depth_m = made_runs.FACTS, made_runs.depth_map()
    width, height = made_runs.SIZES[0]
    left, (v, u) = made_runs.K_LEFT, np.mgrid[:height, :width]
    across = max(facts[Epipolar].used_px) * facts[Epipolar].grid_px
    # The root mean square of a shear that grows over the image.
    noise_px = np.sqrt(0.25**2 + across**2 + (facts[RollingShutter].shear * width) ** 2 / 3)
    errors = []
    for E in made_runs.REFINED:
        t = E[:3, 3]
        shift_x = left[0, 0] * t[0] - (u - left[0, 2]) * t[2]
        shift_y = left[1, 1] * t[1] - (v - left[1, 2]) * t[2]
        errors.append((depth_m - t[2]) ** 2 * noise_px / np.hypot(shift_x, shift_y))
    expected = np.hypot(np.minimum(*errors), facts[PoseUncertainty].scale_rel_std * depth_m)
    found = geometric_sigma(depth_m, left, made_runs.REFINED, facts)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    output = made_runs.output()
    alone = depth_sigma(depth_m, output.confidence[0, ..., 0], expected, output.uncertainty[0, ..., 0])
    np.testing.assert_allclose(output.sigma[0, ..., 0], alone, rtol=1e-5)


def test_errors_of_the_pose_and_of_the_lines_widen_it():
    depth_m, sure = np.full((3, 4), 2.0), np.full((3, 4), 0.99)
    facts = FactSheet({PoseUncertainty: Uncertainty(0.04, 0.0, True)})
    sigmas = [
        depth_sigma(depth_m, sure, geometric_sigma(depth_m, K, [RIG], each))[0, 0]
        for each in (FactSheet(), facts)
    ]
    assert sigmas[0] < sigmas[1]
    scaled = depth_sigma(depth_m, sure, geometric_sigma(depth_m, K, [RIG], FactSheet()), scale_rel_std=0.3)
    np.testing.assert_allclose(scaled, np.hypot(sigmas[0], 0.3 * 2.0), rtol=1e-6)


def test_the_spread_of_an_ensemble_is_a_lower_bound():
    depth_m, sure = np.full((2, 3), 2.0), np.full((2, 3), 0.95)
    deviation_m = np.array([[0.0, 0.01, 0.5]] * 2)
    alone, found = depth_sigma(depth_m, sure), depth_sigma(depth_m, sure, None, deviation_m)
    np.testing.assert_allclose(found, np.maximum(alone, 1.4826 * deviation_m), rtol=1e-6)


def test_there_is_none_where_there_is_no_depth_in_any_strip(monkeypatch):
    monkeypatch.setattr(strips, "STRIP_PIXELS", 5)
    rng = np.random.default_rng(0)
    depth_m, confidence = rng.uniform(1, 5, (7, 4)), rng.uniform(0.1, 1, (7, 4))
    depth_m[0, 0], depth_m[3, 1], depth_m[6, 3], confidence[5, 2] = 0, np.nan, -1, 0
    found = depth_sigma(depth_m, confidence, 0.01 * np.abs(depth_m))
    unknown = ~(depth_m > 0) | (confidence == 0)
    np.testing.assert_array_equal(np.isnan(found), unknown)
    for v, u in np.argwhere(~unknown):
        one = depth_sigma(
            depth_m[v : v + 1, u : u + 1],
            confidence[v : v + 1, u : u + 1],
            np.array([[0.01]]) * depth_m[v, u],
        )
        assert found[v, u] == one[0, 0]
