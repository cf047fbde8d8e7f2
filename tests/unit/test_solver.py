"""The smooth field of a weighted least-squares problem: exact where it can be checked, whatever the size."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin.algorithm.solver import FieldSystem, reweighted, solve_field


def _system(height: int, width: int, link: float, seed: int = 0) -> FieldSystem:
    generator = torch.Generator().manual_seed(seed)
    weight = (torch.rand(1, 1, height, width, generator=generator) > 0.7).float() + 1e-3
    data = torch.randn(1, 1, height, width, generator=generator)
    across, down = torch.full((1, 1, height, width - 1), link), torch.full((1, 1, height - 1, width), link)
    return FieldSystem(weight, weight * data, across, down)


@pytest.mark.parametrize("link", [0.1, 30.0])
def test_a_small_system_is_solved_as_by_a_dense_solver(link):
    system = _system(7, 9, link)
    basis = torch.eye(63).view(63, 1, 7, 9)
    columns = [system.apply(one[None]).flatten() for one in basis]
    expected = torch.linalg.solve(torch.stack(columns, 1), system.pull.flatten())
    torch.testing.assert_close(solve_field(system, 40).flatten(), expected, atol=2e-4, rtol=1e-3)


@pytest.mark.parametrize("size", [(60, 83), (240, 331), (481, 640)])
@pytest.mark.parametrize("link", [1.0, 400.0])
def test_few_steps_are_enough_at_any_size(size, link):
    system = _system(*size, link)
    found = solve_field(system, 12)
    residual = system.pull - system.apply(found)
    assert float(residual.norm() / system.pull.norm()) < 0.02


def test_a_coarser_system_has_the_same_total():
    system = _system(31, 45, 2.0)
    coarse = system.coarser()
    assert coarse.weight.shape == (1, 1, 16, 23) and coarse.across.shape == (1, 1, 16, 22)
    torch.testing.assert_close(coarse.weight.sum(), system.weight.sum())
    torch.testing.assert_close(coarse.pull.sum(), system.pull.sum())


def test_other_weights_keep_the_links():
    system = _system(8, 8, 1.0)
    other = reweighted(system, torch.ones(1, 1, 8, 8), torch.full((1, 1, 8, 8), 3.0), torch.tensor(0.5))
    assert other.across is system.across and float(other.weight.mean()) == 1.5
    torch.testing.assert_close(solve_field(other, 30), torch.full((1, 1, 8, 8), 2.0), atol=1e-4, rtol=0)
