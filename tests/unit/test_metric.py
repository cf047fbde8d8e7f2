import pytest
import torch

from geodiff_plugin.scale.space import SPACES, MetricMap

NEAR, FAR = torch.tensor([0.5, 4.0, 0.8]), torch.tensor([0.9, 80.0, 60.0])


@pytest.mark.parametrize("space", SPACES)
def test_the_formulas_of_a_space_belong_together(space):
    kind, near, far = SPACES[space], NEAR.double(), FAR.double()
    depth = torch.stack([near, torch.sqrt(near * far), far])
    g = torch.tensor([0.5, 2.0, 30.0], dtype=torch.float64)
    torch.testing.assert_close(kind.forward(kind.inverse(depth / g), g), depth)
    v = kind.inverse(depth)
    assert ((v[1:] > v[:-1]) == kind.grows_with_depth).all()
    s, t, unit = kind.from_ends(*kind.ends(near, far))
    at_zero, at_one = kind.ends(kind.forward(t, unit), kind.forward(s + t, unit))
    torch.testing.assert_close((at_zero, at_one), (near, far))
    assert (s > 0).all() and (t > 0).all()
    x = torch.linspace(0, 1, 9, dtype=torch.float64)
    between = kind.depth_at(x, near[:, None], far[:, None])
    torch.testing.assert_close(between, kind.forward(s[:, None] * x + t[:, None], unit[:, None]))
    torch.testing.assert_close(kind.ends(between[:, 0], between[:, -1]), (near, far))


@pytest.mark.parametrize("space", SPACES)
def test_squares_start_at_one_and_clip(space):
    metric = MetricMap(space, "square")
    affine = metric.from_range(NEAR, FAR)
    assert torch.equal(affine.s_hat, torch.ones(3)) and torch.equal(affine.t_hat, torch.ones(3))
    torch.testing.assert_close(metric.range_of(affine), (NEAR, FAR), rtol=2e-3, atol=0)
    beyond = torch.tensor([-0.5, 1.5]).view(1, 1, 1, 2).requires_grad_()
    depth = metric(beyond.expand(3, -1, -1, -1), affine)
    ends = SPACES[space].ends(*depth.flatten(1).unbind(1))
    torch.testing.assert_close(ends, metric.range_of(affine))
    assert torch.autograd.grad(depth.sum(), beyond)[0].abs().max() == 0
