"""``examples/fitted_lora.py``: both ways run on one prior, and the peer is what it says it is."""

import numpy as np
import pytest
import torch

from examples.fitted_lora import FittedLora, complete_by_lora, draw_points
from examples.marigold_v2 import tiny_marigold_v2
from geodiff_plugin.bundled.demo_pair import DemoPair
from geodiff_plugin.types import Rig


@pytest.fixture
def pair(textured_plane):
    left, right = (image / np.float32(255) for image in (textured_plane.left, textured_plane.right))
    rig = Rig(textured_plane.K, textured_plane.K, textured_plane.E)
    return DemoPair(left, right, rig, textured_plane.depth_m, textured_plane.depth_m > 0)


def test_a_lora_lowers_the_error_at_its_points_from_the_least_squares_fit_on(pair):
    pipe, points = tiny_marigold_v2(), torch.from_numpy(draw_points(pair, 200))
    before = {name: p.clone() for name, p in pipe.transformer.named_parameters()}
    known = points > 0
    start, fitted = (
        complete_by_lora(pipe, pair.left, points, FittedLora(steps=steps, rank=4)) for steps in (0, 6)
    )
    x = pipe(pair.left).prediction[0, ..., 0]  # log depth is affine in it
    a, b = np.polyfit(x[known].astype(float), np.log(points[known].double().numpy()), 1)
    np.testing.assert_allclose(np.log(start.numpy()), a * x + b, rtol=0, atol=2e-3)
    assert (fitted - points).abs()[known].mean() < (start - points).abs()[known].mean()
    assert all(torch.equal(p, before[name]) for name, p in pipe.transformer.named_parameters())
    assert not any(m._forward_hooks for m in pipe.transformer.modules())
    with pytest.raises(ValueError, match="log depth"):
        complete_by_lora(tiny_marigold_v2(space="disparity"), pair.left, torch.ones(4, 4))
