"""Members in metres become one map."""

import pytest
import torch

from geodiff_plugin.result.ensemble import ensemble_metric, median


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
