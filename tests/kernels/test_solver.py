"""The pyramid solver's kernel against its reference, ``algorithm.solver.solve_field``."""

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._kernels import without_kernels
from geodiff_plugin.algorithm import solver
from geodiff_plugin.algorithm.solver import FieldSystem, solve_field
from tests.kernels.drawn import drawn

SIZES = st.tuples(st.integers(2, 41), st.integers(2, 41))


@pytest.fixture(scope="module", autouse=True)
def small_tiles(device):
    """Tiles of so few pixels that a small grid has many, fewer steps, and coarser grids from 6 pixels on."""
    from geodiff_plugin.algorithm import kernels

    changes = {"TILE": 128, "SINGLE_TILE": 128} if device.type == "cpu" else {}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in changes.items():
            patch.setattr(kernels, name, value)
        patch.setattr(solver, "COARSEST_SIDE", 6)
        patch.setattr(solver, "COARSEST_STEPS", 8)
        yield


def random_system(
    seed: int, size: tuple[int, int], batch: int, channels: int, device: torch.device
) -> FieldSystem:
    """Few observations of different weights, and links that are nearly cut at edges."""
    generator, (height, width) = torch.Generator().manual_seed(seed), size

    def drawn(*shape: int) -> torch.Tensor:
        return torch.rand(batch, *shape, generator=generator)

    weight = drawn(1, height, width) ** 6 * (drawn(1, height, width) > 0.6) + 0.2
    pull = weight * (drawn(channels, height, width) - 0.4)
    across, down = (10 * drawn(1, *shape) ** 4 + 0.01 for shape in ((height, width - 1), (height - 1, width)))
    return FieldSystem(*(part.to(device) for part in (weight, pull, across, down)))


def assert_same_fields(system: FieldSystem, steps: int, start: torch.Tensor | None = None) -> None:
    """Kernel and reference within 1e-5 of the largest value."""
    found = solve_field(system, steps, start)
    with without_kernels():
        expected = solve_field(system, steps, start)
    assert found.shape == expected.shape
    assert (found - expected).abs().max() <= 1e-5 * expected.abs().max()


@drawn(4)
@given(seed=st.integers(0, 999), size=SIZES, batch=st.integers(1, 2), channels=st.integers(1, 2))
@example(seed=0, size=(41, 39), batch=2, channels=2)
def test_fields_of_any_size_batch_and_channels(device, seed, size, batch, channels):
    assert_same_fields(random_system(seed, size, batch, channels, device), steps=3)


@drawn(4)
@given(seed=st.integers(0, 999), size=SIZES, steps=st.integers(0, 4))
@example(seed=0, size=(41, 39), steps=4)
def test_any_number_of_steps_from_a_field_that_is_given(device, seed, size, steps):
    system = random_system(seed, size, 1, 2, device)
    assert_same_fields(system, steps, torch.full_like(system.pull, 0.3))


def test_links_of_one_sample_hold_for_a_batch(device):
    """As ``FieldSystem`` broadcasts them."""
    two, one = random_system(0, (9, 14), 2, 1, device), random_system(0, (9, 14), 1, 1, device)
    assert_same_fields(FieldSystem(two.weight, two.pull, one.across, one.down), steps=3)


def test_a_field_that_is_known_everywhere_comes_back(device):
    """Without links the minimiser is the data, whatever the weights."""
    system = random_system(3, (17, 22), 1, 2, device)
    data = system.pull / system.weight
    alone = FieldSystem(system.weight, system.pull, 0.0 * system.across, 0.0 * system.down)
    torch.testing.assert_close(solve_field(alone, 3, torch.zeros_like(data)), data, rtol=1e-5, atol=1e-6)


def test_a_stiff_system_is_solved_as_well_as_by_the_reference(device):
    """Rounding errors grow with the stiffness, in the kernel no more than in the reference."""
    system = random_system(5, (23, 31), 1, 1, device)
    system = FieldSystem(0.01 * system.weight, 0.01 * system.pull, 40 * system.across, 40 * system.down)
    found = solve_field(system, 4)
    with without_kernels():
        expected = solve_field(system, 4)
        exact = solve_field(FieldSystem(*(part.double() for part in vars(system).values())), 4)
    errors = [(field - exact).abs().max() for field in (found, expected)]
    assert errors[0] <= 3 * errors[1] + 1e-6 * exact.abs().max()
