"""The range of a relative map by sure matches: they tell basins apart where raw costs do not."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.points import fit_to_points, reliable_matches
from geodiff_plugin.scale.space import MetricMap

SIZE = (40, 60)


def matches_of(depth_m: torch.Tensor, confidence: float = 0.9) -> Matches:
    inverse = 1.0 / depth_m
    return Matches(inverse, torch.full_like(inverse, confidence), torch.tensor(2e-3))


@pytest.fixture
def street():
    """Metres of a road, and a relative map of it that errs by 15 %."""
    x = torch.linspace(0.0, 1.0, SIZE[0]).view(1, -1, 1).expand(1, *SIZE)
    depth_m = 1.0 / (1 / 80 + (1 / 6 - 1 / 80) * x)
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(0))
    return depth_m, (x * torch.exp(0.15 * noise)).clamp(0, 1)[None]


def test_a_wrong_basin_is_left_and_a_right_one_kept(street):
    depth_m, x = street
    sure = reliable_matches(matches_of(depth_m))
    metric = MetricMap("disparity")
    wrong = (torch.tensor([42.0]), torch.tensor([84.0]))
    near, far = fit_to_points(x, sure, metric, wrong)
    assert near.item() == pytest.approx(6.0, rel=0.3) and far.item() > 40.0
    kept = fit_to_points(x, sure, metric, (torch.tensor([6.0]), torch.tensor([80.0])))
    assert [v.item() for v in kept] == pytest.approx([6.0, 80.0])


def test_a_third_of_wrong_matches_does_not_matter(street):
    depth_m, x = street
    wrong = depth_m.clone()
    wrong[:, :, :20] = 5.0
    near, far = fit_to_points(x, reliable_matches(matches_of(wrong)), MetricMap("disparity"))
    assert near.item() == pytest.approx(6.0, rel=0.3) and far.item() > 30.0


def test_too_few_sure_matches_say_nothing(street):
    assert reliable_matches(matches_of(street[0], confidence=0.4)) is None
