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


@pytest.mark.parametrize(
    ("members", "middle", "deviation"),
    [
        ([2.0], 2.0, 0.0),
        ([1.0, 3.0], 2.0, 1.0),
        ([1.0, 2.0, 9.0], 2.0, 1.0),
        ([1.0, 2.0, 3.0, 4.0], 2.5, 1.0),
    ],
)
def test_median_of_even_and_odd_numbers(members, middle, deviation):
    depth_m = torch.tensor(members)[:, None, None, None].expand(-1, 1, 2, 3)
    found, spread = ensemble_metric(depth_m)
    assert found.shape == spread.shape == (1, 1, 2, 3)
    assert (found == middle).all() and (spread == deviation).all()
    assert torch.equal(median(depth_m, 0), found[0])
    torch.testing.assert_close(ensemble_metric(depth_m, lower=True)[0][0], depth_m.median(0).values)


def test_mean_and_an_unknown_reduction():
    depth_m = torch.tensor([1.0, 2.0, 6.0])[:, None, None, None]
    found, spread = ensemble_metric(depth_m, "mean")
    assert found.item() == 3.0 and spread.item() == pytest.approx(14**0.5 / 3**0.5)
    with pytest.raises(ValueError, match="reduction"):
        ensemble_metric(depth_m, "mode")
