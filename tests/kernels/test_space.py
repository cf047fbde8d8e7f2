"""The kernel of metric and relative maps against its references in ``scale.space``."""

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin.scale.affine import AffineState
from geodiff_plugin.scale.space import SPACES, MetricMap, smooth_floor
from tests.kernels.drawn import drawn


@drawn(6)
@given(
    seed=st.integers(0, 999),
    space=st.sampled_from(sorted(SPACES)),
    positive=st.sampled_from(["softplus", "square"]),
    size=st.tuples(st.integers(1, 50), st.integers(1, 50)),
)
@example(seed=0, space="depth", positive="softplus", size=(31, 45))
@example(seed=1, space="sqrt_disparity", positive="square", size=(17, 9))
def test_two_metric_maps_and_back(device, seed, space, positive, size):
    generator = torch.Generator().manual_seed(seed)
    x = (1.2 * torch.rand(2, 1, *size, generator=generator) - 0.1).to(device)
    metric = MetricMap(space, positive)
    ends = torch.tensor([1.3, 0.7], device=device), torch.tensor([8.0, 30.0], device=device)
    affine = metric.from_range(*ends)
    depth_m = metric(x, affine)
    found = depth_m, metric.relative(depth_m, affine), smooth_floor(x)
    with without_kernels():
        expected = metric(x, affine), metric.relative(depth_m, affine), smooth_floor(x)
    for one, other in zip(found, expected, strict=True):
        # The inverse of a floor near 0 is a difference of large numbers.
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


def test_numbers_of_maps_may_be_expanded_or_strided(device):
    x = torch.rand(3, 1, 5, 7, generator=torch.Generator().manual_seed(0)).to(device)
    raw = torch.tensor([[0.1, 0.4], [0.2, 0.5], [0.3, 0.6]], device=device)
    one_of_all = torch.linspace(1.0, 9.0, 5, device=device)[1].expand(3)
    affine, metric = AffineState(raw[:, 0], raw[:, 1], one_of_all), MetricMap()
    depth_m = metric(x, affine)
    back = metric.relative(depth_m, affine)
    with without_kernels():
        torch.testing.assert_close(depth_m, metric(x, affine), rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(back, metric.relative(depth_m, affine), rtol=1e-5, atol=1e-5)


def test_what_needs_a_gradient_has_one(device):
    x = torch.rand(2, 1, 5, 7, device=device, requires_grad=True)
    metric = MetricMap()
    affine = metric.from_range(torch.ones(2, device=device), torch.full((2,), 5.0, device=device))
    (gradient,) = torch.autograd.grad(metric(x, affine).sum(), x)
    assert (gradient > 0).all()
    with torch.no_grad():
        torch.testing.assert_close(metric(x, affine), metric(x.requires_grad_(), affine))


@pytest.mark.parametrize("shape", [(), (3,), (0,)])
def test_a_floor_of_any_shape(device, shape):
    x = torch.full(shape, 0.2, device=device)
    torch.testing.assert_close(smooth_floor(x), 0.5 * (x + (x * x + 4e-6).sqrt()))
