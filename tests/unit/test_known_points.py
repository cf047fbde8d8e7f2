from __future__ import annotations

import numpy as np
import pytest
import torch

from geodiff_plugin.matching import Matches, points_to_matches, with_points
from geodiff_plugin.scale.points import depth_span, fit_to_points
from geodiff_plugin.scale.space import SPACES, MetricMap

K = torch.tensor([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
SIZE = (48, 64)


def test_points_land_on_their_pixels_and_the_nearest_wins():
    at_centre = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 5.0]]) + torch.tensor([0.02, 0.02, 0.0])
    one_focal_right = torch.tensor([[30.0 / 60.0 * 4.0, 0.0, 4.0]])
    found, left_out = points_to_matches(torch.cat([at_centre, one_focal_right]), K, SIZE, SIZE)
    assert left_out == 0 and found.confidence.sum() == 2
    assert [float(m) for m in depth_span(found)] == pytest.approx([2.0, 4.0])
    assert found.inverse_depth[0, 24, 32] == 0.5  # (31.5 + 0.6, 23.5 + 0.6), not the one at 5 m
    assert found.inverse_depth[0, 24, 62] == 0.25 or found.inverse_depth[0, 23, 61] == 0.25
    assert found.plane_step == pytest.approx(0.01 * 0.25)


def test_a_map_of_the_grid_stays_as_it_is():
    depth_m = torch.zeros(SIZE)
    depth_m[3, 4], depth_m[47, 63] = 2.0, 8.0
    found, left_out = points_to_matches(depth_m, K, SIZE, SIZE)
    assert left_out == 0
    assert torch.equal(found.confidence[0] > 0, depth_m > 0)
    torch.testing.assert_close(found.inverse_depth[0][depth_m > 0], torch.tensor([0.5, 0.125]))


def test_a_smaller_grid_keeps_every_pixel_inside():
    depth_m = torch.zeros(SIZE)
    depth_m[0, 0] = depth_m[-1, -1] = depth_m[0, -1] = 3.0
    found, _ = points_to_matches(depth_m, K, SIZE, (17, 23))
    known = found.confidence[0] > 0
    assert known[0, 0] and known[-1, -1] and known[0, -1] and known.sum() == 3


def test_points_outside_are_counted_and_none_left_is_an_error():
    points = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [9.0, 0.0, 2.0]])
    _, left_out = points_to_matches(points, K, SIZE, SIZE)
    assert left_out == 2
    with pytest.raises(ValueError, match="2 of 2 behind it or outside"):
        points_to_matches(points[1:], K, SIZE, SIZE)
    with pytest.raises(ValueError, match="points must be a map of the left image's 64x48 pixels"):
        points_to_matches(torch.ones(24, 32), K, SIZE, SIZE)


def test_points_take_the_place_of_matches():
    points, _ = points_to_matches(torch.tensor([[0.0, 0.0, 2.0]]), K, SIZE, SIZE)
    half = torch.full((1, *SIZE), 0.5)
    both = with_points(Matches(0.2 * half, half, torch.tensor(0.01)), points)
    assert (both.inverse_depth == 0.5).sum() == 1 and (both.confidence == 48 * 64).sum() == 1
    assert torch.equal(with_points(None, points).inverse_depth, points.inverse_depth)


@pytest.mark.parametrize("space", SPACES)
def test_fit_finds_the_ends_in_spite_of_wrong_points(space):
    rng = np.random.default_rng(0)
    x = torch.from_numpy(rng.random((1, 1, *SIZE), dtype=np.float32)) * 0.9 + 0.05
    metric = MetricMap(space)
    ends = torch.tensor([1.5, 1.5]), torch.tensor([9.0, 9.0])
    truth = metric(x, metric.from_range(*(e[:1] for e in ends)))
    sparse = torch.where(torch.from_numpy(rng.random(SIZE) < 0.05), truth[0, 0], torch.zeros(SIZE))
    wrong = torch.from_numpy(rng.random(SIZE) < 0.1) & (sparse > 0)
    points, _ = points_to_matches(torch.where(wrong, 3 * sparse, sparse), K, SIZE, SIZE)
    near, far = fit_to_points(x.expand(2, -1, -1, -1), points, metric)
    assert near.shape == (2,) and torch.equal(near[0], near[1])
    found = metric(x, metric.from_range(near[:1], far[:1]))
    assert ((found - truth).abs() / truth).median() < 0.1
    kept = fit_to_points(x, points, metric, (ends[0][:1], ends[1][:1]))
    assert float(kept[0]) == 1.5 and float(kept[1]) == 9.0
