"""The edge-aware fit to matches: follows them, stops at edges, keeps what nobody knows."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin.metric import GROWS_WITH_DEPTH, SPACES, AffineState, MetricMap, inverse_softplus
from geodiff_plugin.refinement import refine_depth
from geodiff_plugin.terms import MatchTarget

SIZE = (40, 60)


def _target(depth_m: torch.Tensor, confidence: torch.Tensor) -> MatchTarget:
    return MatchTarget(1.0 / depth_m, confidence, torch.full((len(depth_m),), 1e-3))


def _grey(value: float = 0.5) -> torch.Tensor:
    return torch.full((1, 3, *SIZE), value)


def test_sure_matches_everywhere_are_followed():
    truth = torch.linspace(2.0, 4.0, SIZE[1]).expand(1, 1, *SIZE)
    refined = refine_depth(1.3 * truth, _target(truth, torch.ones_like(truth)), _grey())
    assert ((refined.depth_m - truth).abs() / truth).max() < 0.01
    assert refined.support.min() > 0.99


def test_without_a_match_nothing_moves():
    depth = torch.linspace(2.0, 4.0, SIZE[1]).expand(1, 1, *SIZE)
    refined = refine_depth(depth, _target(depth, torch.zeros_like(depth)), _grey())
    assert torch.equal(refined.depth_m, depth)
    assert refined.support.max() == 0.0


def test_a_correction_spreads_over_its_surface_and_stops_at_an_edge():
    left, truth = _grey(0.2), torch.full((1, 1, *SIZE), 2.0)
    left[..., 30:] = 0.9  # another surface, of which nothing is known
    confidence = torch.zeros_like(truth)
    confidence[..., :, 5:10] = 1.0
    refined = refine_depth(1.2 * truth, _target(truth, confidence), left)
    own, other = refined.depth_m[..., 10:20], refined.depth_m[..., 31:]
    assert (own / 2.0 - 1.0).abs().max() < 0.08
    assert (other / 2.4 - 1.0).abs().max() < 0.05
    assert refined.support[..., 10:20].min() > 0.5
    assert refined.support[..., 31:].max() < 0.3


def test_an_outlier_among_matches_loses():
    truth = torch.full((1, 1, *SIZE), 2.0)
    matched = truth.clone()
    matched[..., 20, 30] = 8.0
    refined = refine_depth(1.1 * truth, _target(matched, torch.ones_like(truth)), _grey())
    assert (refined.depth_m / 2.0 - 1.0).abs().max() < 0.05


def test_samples_of_a_batch_do_not_mix_and_any_resolution_comes_back():
    truth = torch.full((2, 1, *SIZE), 3.0)
    confidence = torch.stack([torch.ones(1, *SIZE), torch.zeros(1, *SIZE)])
    refined = refine_depth(
        torch.full((2, 1, 90, 130), 3.3), _target(truth, confidence), _grey().expand(2, -1, -1, -1)
    )
    assert refined.depth_m.shape == (2, 1, 90, 130)
    assert refined.depth_m[0].mean() == pytest.approx(3.0, rel=0.01)
    assert refined.depth_m[1].mean() == pytest.approx(3.3, rel=1e-5)


@pytest.mark.parametrize("space", sorted(SPACES))
@pytest.mark.parametrize("positive", ["softplus", "square"])
def test_relative_is_the_inverse_of_the_metric_map(space, positive):
    metric, x = MetricMap(space, positive), torch.linspace(0.05, 0.95, 12).view(1, 1, 3, 4)
    near, far = torch.tensor([1.5]), torch.tensor([9.0])
    affine = metric.from_range(*((near, far) if space in GROWS_WITH_DEPTH else (far, near)))
    assert torch.allclose(metric.relative(metric(x, affine), affine), x, atol=1e-4)


def test_relative_of_a_depth_before_the_nearest_one_is_bounded():
    metric = MetricMap("depth")
    one = inverse_softplus(torch.ones(1))
    x = metric.relative(torch.full((1, 1, 1, 1), 1e-6), AffineState(one, one, torch.ones(1)))
    assert -0.1 < float(x) < 0.0
