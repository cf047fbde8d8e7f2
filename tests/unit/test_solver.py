"""The smooth field of a weighted least-squares problem: exact where it can be checked, whatever the size."""

import pytest
import torch

from geodiff_plugin.algorithm.solver import FieldSystem, solve_field, solve_robust


def _system(height: int, width: int, link: float, seed: int = 0) -> FieldSystem:
    generator = torch.Generator().manual_seed(seed)
    weight = (torch.rand(1, 1, height, width, generator=generator) > 0.7).float() + 1e-3
    data = torch.randn(1, 1, height, width, generator=generator)
    across, down = torch.full((1, 1, height, width - 1), link), torch.full((1, 1, height - 1, width), link)
    return FieldSystem(weight, weight * data, across, down)


def applied(system: FieldSystem, u: torch.Tensor) -> torch.Tensor:
    """The left-hand side of the normal equations."""
    flow_x, flow_y = system.across * u.diff(dim=-1), system.down * u.diff(dim=-2)
    pad = torch.nn.functional.pad
    beside = pad(flow_x, (1, 0)) - pad(flow_x, (0, 1)) + pad(flow_y, (0, 0, 1, 0)) - pad(flow_y, (0, 0, 0, 1))
    return system.weight * u + beside


@pytest.mark.parametrize("link", [0.1, 30.0])
def test_a_small_system_is_solved_as_by_a_dense_solver(link):
    system = _system(7, 9, link)
    basis = torch.eye(63).view(63, 1, 7, 9)
    columns = [applied(system, unit[None]).flatten() for unit in basis]
    expected = torch.linalg.solve(torch.stack(columns, 1), system.pull.flatten())
    torch.testing.assert_close(solve_field(system, 40).flatten(), expected, atol=2e-4, rtol=1e-3)


@pytest.mark.parametrize(("size", "link"), [((60, 83), 1.0), ((240, 331), 400.0), ((481, 640), 400.0)])
def test_few_steps_are_enough_at_any_size(size, link):
    system = _system(*size, link)
    found = solve_field(system, 12)
    residual = system.pull - applied(system, found)
    assert float(residual.norm() / system.pull.norm()) < 0.02


def test_an_outlier_is_weighted_down_round_by_round():
    """Two thirds ask for 2, one for 20; a constant field ends where most of them are."""
    data = torch.full((1, 2, 9, 9), 2.0)
    data[..., ::3] = 20.0
    links = torch.full((1, 1, 9, 8), 1e4), torch.full((1, 1, 8, 9), 1e4)
    ones, free = torch.ones(1, 1, 9, 9), torch.zeros(1, 1, 1, 1)
    plain, _ = solve_robust(links, data, free, ones, lambda left_over: ones, 1, 60)
    robust, weights = solve_robust(links, data, free, ones, lambda off: 1.0 / (1.0 + off**2), 8, 60)
    torch.testing.assert_close(plain, torch.full_like(data, 8.0), atol=1e-2, rtol=0)
    torch.testing.assert_close(robust, torch.full_like(data, 2.0), atol=0.1, rtol=0)
    assert float(weights[..., ::3].max()) < 0.01 < 0.9 < float(weights[..., 1::3].min())
