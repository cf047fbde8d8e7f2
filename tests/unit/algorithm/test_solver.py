"""Smooth fields against SciPy: the system, its coarser grids, truncated solves and robust passes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geodiff_plugin.algorithm.solver import (
    FieldSystem,
    RobustSystem,
    scaled_links,
    solve_field,
    solve_robust,
)
from tests.unit.algorithm.references import field, normal_matrix, robust_field


def drawn(*shape: int, seed: int, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def a_system(height: int, width: int, samples: int = 2, channels: int = 2) -> FieldSystem:
    """Weights on a third of the pixels, and links that differ from pixel to pixel and sample to sample."""
    weight = drawn(samples, 1, height, width, seed=1)
    weight = torch.where(weight > 0.66, weight, 1e-3)
    data = drawn(samples, channels, height, width, seed=2, low=-1.0)
    across = drawn(samples, 1, height, width - 1, seed=3, high=6.0)
    down = drawn(samples, 1, height - 1, width, seed=4, high=3.0)
    return FieldSystem(weight, weight * data, across, down)


def arrays(system: FieldSystem, sample: int, channel: int) -> tuple[np.ndarray, ...]:
    """Weight, pull and links of one field of a system, float64."""
    parts = (
        system.weight[sample, 0],
        system.pull[sample, channel],
        system.across[sample, 0],
        system.down[sample, 0],
    )
    return tuple(part.double().numpy() for part in parts)


def test_the_preconditioner_is_the_diagonal_of_the_normal_equations():
    system = a_system(5, 8)
    for b in range(2):
        weight, _, across, down = arrays(system, b, 0)
        expected = normal_matrix(weight, across, down).diagonal().reshape(5, 8)
        np.testing.assert_allclose(system.diagonal()[b, 0], expected, rtol=1e-6)


@pytest.mark.parametrize("size", [(6, 8), (7, 9), (5, 8), (8, 5)])
def test_a_coarser_system_has_the_same_energy_but_for_its_halved_links(size):
    """The energy of a field that is constant over cells of 2x2 pixels, which are smaller at odd borders."""
    system = a_system(*size)
    coarse = system.coarser()
    rows, columns = (np.arange(side) // 2 for side in size)
    for b in range(2):
        u = np.random.default_rng(b).normal(size=coarse.weight.shape[-2:])
        weight, pull, across, down = arrays(system, b, 1)
        fine = u[np.ix_(rows, columns)].ravel()
        links = fine @ normal_matrix(0 * weight, across, down) @ fine
        of_coarse = arrays(coarse, b, 1)
        normal = normal_matrix(*(of_coarse[i] for i in (0, 2, 3)))
        energy = u.ravel() @ normal @ u.ravel() - 2 * of_coarse[1].ravel() @ u.ravel()
        expected = (weight.ravel() * fine * fine).sum() + links / 2 - 2 * pull.ravel() @ fine
        assert energy == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("size", [(9, 13), (25, 24), (27, 50), (50, 61)])
def test_truncated_solves_are_scipys_on_every_grid_of_the_pyramid(size):
    """50 x 61 has three grids, 27 x 50 and 25 x 24 one or two; batch and channels hold different fields."""
    system = a_system(*size)
    found = solve_field(system, 3)
    started = solve_field(system, 4, found + 0.3)
    for b, c in np.ndindex(2, 2):
        expected = field(*arrays(system, b, c), 3)
        np.testing.assert_allclose(found[b, c], expected, atol=2e-4)
        again = field(*arrays(system, b, c), 4, found[b, c].double().numpy() + 0.3)
        np.testing.assert_allclose(started[b, c], again, atol=2e-4)


def test_without_steps_the_field_is_the_one_it_starts_from():
    system = a_system(6, 7)
    start = drawn(2, 2, 6, 7, seed=9, low=-2.0)
    torch.testing.assert_close(solve_field(system, 0, start), start)


def test_a_field_that_is_solved_already_stays():
    """Residuals of zero: divisions by zero must not spoil the channel."""
    system = a_system(6, 7)
    flat = replace(system, pull=system.weight * torch.tensor([0.0, 0.7]).view(1, 2, 1, 1))
    found = solve_field(flat, 5, torch.tensor([0.0, 0.7]).view(1, 2, 1, 1).expand(2, 2, 6, 7).clone())
    torch.testing.assert_close(found, torch.tensor([0.0, 0.7]).view(1, 2, 1, 1).expand(2, 2, 6, 7))


def test_links_are_scaled_by_one_number_or_by_the_lower_end():
    links = drawn(2, 1, 4, 5, seed=5), drawn(2, 1, 3, 6, seed=6)  # of 4x6 pixels
    number = torch.tensor([2.0, 7.0]).view(2, 1, 1, 1)
    for scaled, link in zip(scaled_links(links, number), links, strict=True):
        np.testing.assert_allclose(scaled.numpy(), number.numpy() * link.numpy(), rtol=1e-6)
    smooth = drawn(2, 1, 4, 6, seed=7, low=1.0, high=9.0)
    across, down = (scaled.numpy() for scaled in scaled_links(links, smooth))
    a, (of_rows, of_columns) = smooth.numpy(), (link.numpy() for link in links)
    for b, y, x in np.ndindex(2, 4, 5):
        lower = min(a[b, 0, y, x], a[b, 0, y, x + 1])
        assert across[b, 0, y, x] == pytest.approx(lower * of_rows[b, 0, y, x])
    for b, y, x in np.ndindex(2, 3, 6):
        lower = min(a[b, 0, y, x], a[b, 0, y + 1, x])
        assert down[b, 0, y, x] == pytest.approx(lower * of_columns[b, 0, y, x])


@pytest.mark.parametrize(
    ("error", "with_support"), [("none", False), ("of a sample", True), ("of a pixel", True)]
)
def test_robust_passes_of_several_samples_and_sets_of_weights_are_those_of_numpy(error, with_support):
    """Two samples, two sets of weights, three passes; every twentieth observation contradicts the others."""
    size, rounds, steps, reach = (11, 14), 3, 5, 2.5
    data = 0.2 * drawn(2, 1, *size, seed=1, low=-1.0) + torch.tensor([0.1, -0.3]).view(2, 1, 1, 1)
    data = data + 3.0 * (drawn(2, 1, *size, seed=2) > 0.95)
    trusted = drawn(4, 1, *size, seed=3, low=-0.6).clamp_min(0.0)
    noise = drawn(2, 1, *size, seed=4, low=0.05, high=0.3)
    errors = {
        "none": None,
        "of a sample": torch.tensor([0.04, 0.4]).view(2, 1, 1, 1),
        "of a pixel": drawn(2, 1, *size, seed=5, high=0.5),
    }
    links = drawn(2, 1, 11, 13, seed=6), drawn(2, 1, 10, 14, seed=7)
    shape = (3, 2, 1, 1, 1) if error == "of a sample" else (3, 2, 1, *size)
    smoothness = torch.tensor([8.0, 3.0, 0.7]).view(3, 1, 1, 1, 1) * drawn(*shape, seed=8, low=0.5, high=2.0)
    inertia = torch.tensor([0.02, 0.01, 0.05]).view(3, 1, 1, 1, 1) * drawn(*shape, seed=9, low=0.5)
    system = RobustSystem(data, trusted, noise, errors[error], reach, links, smoothness, inertia)
    found = solve_robust(system, rounds, steps, with_support=with_support)
    assert (found.support is not None) == with_support and found.field.shape == (4, 1, *size)
    for k in range(4):  # the first set of both samples, then the second set
        b = k % 2
        of_prior = 0.0 if errors[error] is None else errors[error][b, 0].double().numpy()
        width = reach * np.hypot(noise[b, 0].double().numpy(), of_prior)
        passes = [
            (a[b, 0].double().numpy(), h[b, 0].double().numpy())
            for a, h in zip(smoothness, inertia, strict=True)
        ]
        of_links = tuple(link[b, 0].double().numpy() for link in links)
        expected = robust_field(
            data[b, 0].double().numpy(),
            trusted[k, 0].double().numpy(),
            width,
            of_links,
            passes,
            rounds,
            steps,
        )
        np.testing.assert_allclose(found.field[k, 0], expected[0], atol=2e-4)
        np.testing.assert_allclose(found.weights[k, 0], expected[1], atol=2e-3)
        if found.support is not None:
            np.testing.assert_allclose(found.support[k, 0], expected[2], atol=2e-4)


def test_the_support_is_asked_for_by_name():
    with pytest.raises(TypeError, match="positional"):
        solve_robust(None, 2, 3, True)
