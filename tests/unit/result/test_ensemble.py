"""Members become one map and their spread around it, pixel by pixel, against NumPy."""

import numpy as np
import pytest
import torch

from geodiff_plugin.result.ensemble import ensemble_metric, median, spread_around


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("lower", [False, True])
def test_the_median_and_the_absolute_deviation_of_every_pixel(count, lower):
    members = np.random.default_rng(count).lognormal(0, 1, (count, 1, 5, 7))
    found, spread = ensemble_metric(torch.from_numpy(members), lower=lower)
    middle = np.quantile(members, 0.5, axis=0, keepdims=True, method="lower" if lower else "linear")
    np.testing.assert_allclose(found, middle)
    np.testing.assert_allclose(spread, np.median(np.abs(members - middle), axis=0, keepdims=True))


def test_the_mean_has_the_standard_deviation():
    members = np.random.default_rng(0).lognormal(0, 1, (4, 1, 5, 7))
    found, spread = ensemble_metric(torch.from_numpy(members), "mean", lower=True)
    np.testing.assert_allclose(found, members.mean(0, keepdims=True))
    np.testing.assert_allclose(spread, members.std(0, keepdims=True))


def test_spread_is_measured_around_the_given_map_and_not_around_the_members_own_middle():
    rng = np.random.default_rng(1)
    members, middle = rng.lognormal(0, 1, (4, 1, 5, 7)), rng.lognormal(0, 1, (1, 1, 5, 7))
    away = members - middle
    for reduction, expected in (("median", np.median(np.abs(away), 0)), ("mean", np.sqrt((away**2).mean(0)))):
        found = spread_around(*map(torch.from_numpy, (middle, members)), reduction)
        np.testing.assert_allclose(found[0], expected)


@pytest.mark.parametrize("dim", [0, 1, -1])
def test_the_median_along_any_axis(dim):
    values = np.random.default_rng(2).normal(size=(4, 6, 8))
    np.testing.assert_allclose(median(torch.from_numpy(values), dim), np.median(values, axis=dim))
