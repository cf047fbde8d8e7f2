"""``examples/fitted_lora.py``: both ways run on one prior, and the peer is what it says it is."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from examples.fitted_lora import FittedLora, compare_completions, complete_by_lora, draw_points
from examples.marigold_v2 import tiny_marigold_v2
from geodiff_plugin.bundled.demo_pair import DemoPair
from geodiff_plugin.types import Rig


@pytest.fixture
def pair(textured_plane):
    left, right = (image / np.float32(255) for image in (textured_plane.left, textured_plane.right))
    rig = Rig(textured_plane.K, textured_plane.K, textured_plane.E)
    depth_m = textured_plane.depth_m
    return DemoPair(left, right, rig, depth_m, depth_m > 0)


def test_points_are_of_the_truth(pair):
    points = draw_points(pair, 50)
    assert np.count_nonzero(points) == 50
    assert np.array_equal(points[points > 0], pair.depth_m[points > 0])
    assert np.array_equal(points, draw_points(pair, 50)) and not np.array_equal(
        points, draw_points(pair, 50, 1)
    )


def test_a_fitted_lora_lowers_the_error_at_its_points_and_leaves_the_pipeline_as_it_was(pair):
    pipe = tiny_marigold_v2()
    points = torch.from_numpy(draw_points(pair, 200))
    before = {name: p.clone() for name, p in pipe.transformer.named_parameters()}
    errors = []
    for steps in (0, 6):
        depth_m = complete_by_lora(pipe, pair.left, points, FittedLora(steps=steps, rank=4))
        errors.append(float((depth_m - points).abs()[points > 0].mean()))
    assert errors[1] < errors[0]
    assert all(torch.equal(p, before[name]) for name, p in pipe.transformer.named_parameters())
    assert all(p.requires_grad for p in pipe.transformer.parameters())
    assert not any(m._forward_hooks for m in pipe.transformer.modules())


def test_the_start_is_the_least_squares_fit_of_log_depth(pair):
    pipe, points = tiny_marigold_v2(), draw_points(pair, 200)
    depth_m = complete_by_lora(pipe, pair.left, torch.from_numpy(points), FittedLora(steps=0)).numpy()
    x = pipe(pair.left).prediction[0, ..., 0]  # log depth is affine in it
    known = points > 0
    a, b = np.polyfit(x[known].astype(float), np.log(points[known].astype(float)), 1)
    np.testing.assert_allclose(np.log(depth_m), a * x + b, rtol=0, atol=2e-3)


def test_both_ways_are_measured(pair):
    found = compare_completions(
        tiny_marigold_v2(), pair, draw_points(pair, 300), 64, FittedLora(steps=3, rank=4)
    )
    assert [way.passes for way in found] == [2, 5, 1, 1]
    assert all(way.seconds > 0 and math.isfinite(way.mae_m) for way in found)
    assert found[2].abs_rel < found[1].abs_rel


def test_a_prior_in_another_space_is_refused(pair):
    with pytest.raises(ValueError, match="log depth"):
        complete_by_lora(tiny_marigold_v2(space="disparity"), pair.left, torch.ones(4, 4))
