"""The kernels of the searches for a scale against their references."""

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin.matching import CostVolume
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.scale import constants, points, sampling, volume_search
from geodiff_plugin.scale.points import fit_to_points
from geodiff_plugin.scale.space import SPACES, MetricMap
from geodiff_plugin.scale.volume_search import _best_range
from tests.kernels.drawn import drawn
from tests.kernels.test_refinement import random_matches


@pytest.fixture(autouse=True)
def small_grids(monkeypatch):
    """The interpreter runs one candidate after the other."""
    monkeypatch.setattr(sampling, "GROUPS", 37)
    for module in (volume_search, constants):
        monkeypatch.setattr(module, "COARSE_GRID", 7)
        monkeypatch.setattr(module, "FINE_GRIDS", (4, 3))
    for module in (points, constants):
        monkeypatch.setattr(module, "BASIN_CANDIDATES", 9)


def random_volume(seed: int, size: tuple[int, int], planes: int, device: torch.device):
    """Costs of planes around the depths 1.5 m to 8 m of the first of two relative maps, and noise."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(2, size[0] * size[1], generator=generator)
    inverse_depth = torch.linspace(0.01, 1.0, planes)
    away = (inverse_depth[:, None] - 1.0 / (1.5 + 6.5 * x[0])).abs()
    noise = 0.2 * torch.rand(planes, x.shape[1], generator=generator)
    levels = ((3.0 * away + noise).clamp_max(1.0) * COST_LEVELS).to(torch.uint8).view(planes, *size)
    in_view = (torch.rand(planes, *size, generator=generator) > 0.1).to(device)
    volume = CostVolume(levels.to(device), in_view, inverse_depth, x[:1], (), (), rectified=True)
    return volume, x.to(device)


@drawn(2)
@given(
    seed=st.integers(0, 999),
    size=st.tuples(st.integers(5, 30), st.integers(5, 30)),
    planes=st.integers(3, 70),
    space=st.sampled_from(sorted(SPACES)),
    current=st.booleans(),
)
@example(seed=0, size=(23, 31), planes=33, space="depth", current=False)
@example(seed=1, size=(29, 17), planes=66, space="log1p", current=True)
def test_the_best_range_of_two_maps_in_a_volume(device, seed, size, planes, space, current):
    volume, x = random_volume(seed, size, planes, device)
    at = torch.arange(1, x.shape[1], 2, device=device)
    x = x[:, at].contiguous()
    in_use = torch.tensor([[1.4, 3.0], [8.2, 2.0]], device=device).unbind() if current else None
    found = torch.stack(_best_range(volume, x, at, space, (0.8, 40.0), in_use))
    with without_kernels():
        expected = torch.stack(_best_range(volume, x, at, space, (0.8, 40.0), in_use))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0.0)


@drawn(2)
@given(
    seed=st.integers(0, 999),
    space=st.sampled_from(sorted(SPACES)),
    positive=st.sampled_from(["softplus", "square"]),
    size=st.tuples(st.integers(9, 30), st.integers(9, 30)),
    current=st.booleans(),
)
@example(seed=0, space="depth", positive="softplus", size=(23, 31), current=True)
@example(seed=1, space="disparity", positive="square", size=(19, 9), current=False)
def test_the_basin_of_two_maps_by_points(device, seed, space, positive, size, current):
    x, matches = random_matches(seed, space, size, device)
    x = torch.nn.functional.interpolate(1.2 * x - 0.1, scale_factor=0.7, mode="bilinear")
    in_use = torch.tensor([[1.3, 5.0], [7.0, 5.5]], device=device).unbind() if current else None
    found = torch.stack(fit_to_points(x, matches, MetricMap(space, positive), in_use))
    with without_kernels():
        expected = torch.stack(fit_to_points(x, matches, MetricMap(space, positive), in_use))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0.0)


def test_a_range_in_use_that_fits_stays(device):
    x, matches = random_matches(0, "depth", (12, 15), device)
    in_use = torch.tensor([1.3, 1.3], device=device), torch.tensor([7.0, 7.0], device=device)
    near_m, far_m = fit_to_points(x, matches, MetricMap(), in_use)
    assert torch.equal(near_m[:1], in_use[0][:1]) and torch.equal(far_m[:1], in_use[1][:1])
