"""The pyramid solver's kernel against its references, ``solve_field`` and ``solve_robust``."""

from dataclasses import replace

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin.algorithm import solver
from geodiff_plugin.algorithm.solver import solve_field, solve_robust
from geodiff_plugin.algorithm.systems import FieldSystem, RobustSystem
from tests.kernels.drawn import drawn

SIZES = st.tuples(st.integers(2, 29), st.integers(2, 29))


@pytest.fixture(scope="module", autouse=True)
def small_tiles(device):
    """Tiles of so few pixels that a small grid has many, fewer steps, and coarser grids from 8 pixels on."""
    from geodiff_plugin.algorithm.kernels import solver as kernels

    changes = {"TILE": 256, "ALONE": 512} if device.type == "cpu" else {}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in changes.items():
            patch.setattr(kernels, name, value)
        for module in (kernels, solver):
            patch.setattr(module, "COARSEST_SIDE", 8)
            patch.setattr(module, "COARSEST_STEPS", 5)
        yield


def random_system(
    seed: int, size: tuple[int, int], batch: int, channels: int, device: torch.device
) -> FieldSystem:
    """Few observations of different weights, and links that are nearly cut at edges."""
    generator, (height, width) = torch.Generator().manual_seed(seed), size

    def drawn(*shape: int) -> torch.Tensor:
        return torch.rand(batch, *shape, generator=generator)

    weight = drawn(1, height, width) ** 6 * (drawn(1, height, width) > 0.6) + 0.2
    rhs = weight * (drawn(channels, height, width) - 0.4)
    across, down = (10 * drawn(1, *shape) ** 4 + 0.01 for shape in ((height, width - 1), (height - 1, width)))
    return FieldSystem(*(part.to(device) for part in (weight, rhs, across, down)))


def assert_same_fields(system: FieldSystem, steps: int, start: torch.Tensor | None = None) -> None:
    """Kernel and reference within 1e-5 of the largest value."""
    found = solve_field(system, steps, start)
    with without_kernels():
        expected = solve_field(system, steps, start)
    assert found.shape == expected.shape
    assert (found - expected).abs().max() <= 1e-5 * expected.abs().max()


def random_robust_system(
    seed: int, shape: tuple[int, int, int], sets: int, passes: int, device: torch.device, local: bool
) -> RobustSystem:
    """Observations of ``B, H, W`` of which some contradict the rest, and several sets of weights for them."""
    generator, (batch, height, width) = torch.Generator().manual_seed(seed), shape

    def drawn(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator)

    data = drawn(batch, 1, height, width) - 0.4 + 3.0 * (drawn(batch, 1, height, width) > 0.9)
    trusted = drawn(sets * batch, 1, height, width) * (drawn(sets * batch, 1, height, width) > 0.4)
    affinities = tuple(
        drawn(batch, 1, *size) ** 4 + 0.01 for size in ((height, width - 1), (height - 1, width))
    )
    of_pass = (passes, batch, 1, height, width) if local else (passes, batch, 1, 1, 1)
    stiffness, tikhonov = 20 * drawn(*of_pass) + 0.1, 0.02 * drawn(*of_pass) + 0.01
    noise, error = 0.1 + drawn(batch, 1, height, width), 0.2 * drawn(*of_pass[1:]) if seed % 3 else None
    parts = (data, trusted, noise, *affinities, stiffness, tikhonov)
    data, trusted, noise, across, down, stiffness, tikhonov = (part.to(device) for part in parts)
    error = None if error is None else error.to(device)
    return RobustSystem(data, trusted, noise, error, 1.5, (across, down), stiffness, tikhonov)


def assert_same_robust_fields(system: RobustSystem, rounds: int, steps: int, with_support: bool) -> None:
    """Field, weights and support of kernel and reference within 1e-5 of the largest value."""
    found = solve_robust(system, rounds, steps, with_support=with_support)
    with without_kernels():
        expected = solve_robust(system, rounds, steps, with_support=with_support)
    assert (found.support is None) == (expected.support is None) == (not with_support)
    for ours, theirs in zip(found, expected, strict=True):
        if ours is not None:
            assert ours.shape == theirs.shape == system.trusted.shape
            assert (ours - theirs).abs().max() <= 1e-5 * theirs.abs().max()


@drawn(2)
@given(
    seed=st.integers(0, 999),
    size=SIZES,
    batch=st.integers(1, 2),
    passes=st.integers(1, 3),
    local=st.booleans(),
)
@example(seed=0, size=(29, 27), batch=2, passes=3, local=True)
def test_reweighted_fields_in_passes_with_a_smoothness_per_pixel(device, seed, size, batch, passes, local):
    system = random_robust_system(seed, (batch, *size), 1, passes, device, local)
    assert_same_robust_fields(system, rounds=2, steps=2, with_support=True)


@pytest.mark.parametrize("batch", [1, 2])
def test_several_sets_of_weights_for_the_same_observations(device, batch):
    system = random_robust_system(1, (batch, 19, 18), 2, 1, device, local=False)
    assert_same_robust_fields(system, rounds=2, steps=2, with_support=False)
    found = solve_robust(system, 2, 2)
    for k, trusted in enumerate(system.trusted.chunk(2)):
        alone = solve_robust(replace(system, trusted=trusted), 2, 2)
        for ours, theirs in zip(found[:2], alone[:2], strict=True):
            torch.testing.assert_close(ours[k * batch : (k + 1) * batch], theirs, rtol=0, atol=0)


@drawn(3)
@given(seed=st.integers(0, 999), size=SIZES, batch=st.integers(1, 2), channels=st.integers(1, 2))
@example(seed=0, size=(29, 27), batch=2, channels=2)
def test_fields_of_any_size_batch_and_channels(device, seed, size, batch, channels):
    assert_same_fields(random_system(seed, size, batch, channels, device), steps=3)


@drawn(3)
@given(seed=st.integers(0, 999), size=SIZES, steps=st.integers(0, 4))
@example(seed=0, size=(29, 27), steps=4)
def test_any_number_of_steps_from_a_field_that_is_given(device, seed, size, steps):
    system = random_system(seed, size, 1, 2, device)
    assert_same_fields(system, steps, torch.full_like(system.rhs, 0.3))


@pytest.mark.parametrize("left", [3e38, -3e38, float("nan")])
def test_what_was_in_memory_before_changes_nothing(device, left, monkeypatch):
    """It must not be computed with either: NumPy warns of overflows in the interpreter."""
    system = random_system(3, (9, 14), 1, 2, device)
    expected = solve_field(system, 3)
    empty = torch.Tensor.new_empty

    def filled(self, *size, **more):
        tensor = empty(self, *size, **more)
        return tensor.fill_(left) if tensor.is_floating_point() else tensor

    monkeypatch.setattr(torch.Tensor, "new_empty", filled)
    assert torch.equal(solve_field(system, 3), expected)


def test_links_of_one_sample_hold_for_a_batch(device):
    """As ``FieldSystem`` broadcasts them."""
    two, one = random_system(0, (9, 14), 2, 1, device), random_system(0, (9, 14), 1, 1, device)
    assert_same_fields(FieldSystem(two.weight, two.rhs, one.across, one.down), steps=3)


def test_a_field_that_is_known_everywhere_comes_back(device):
    """Without links the minimiser is the data, whatever the weights."""
    system = random_system(3, (17, 22), 1, 2, device)
    data = system.rhs / system.weight
    alone = FieldSystem(system.weight, system.rhs, 0.0 * system.across, 0.0 * system.down)
    torch.testing.assert_close(solve_field(alone, 3, torch.zeros_like(data)), data, rtol=1e-5, atol=1e-6)


def test_a_stiff_system_is_solved_as_well_as_by_the_reference(device):
    """Rounding errors grow with the stiffness, in the kernel no more than in the reference."""
    system = random_system(5, (23, 31), 1, 1, device)
    system = FieldSystem(0.01 * system.weight, 0.01 * system.rhs, 40 * system.across, 40 * system.down)
    found = solve_field(system, 4)
    with without_kernels():
        expected = solve_field(system, 4)
        exact = solve_field(FieldSystem(*(part.double() for part in vars(system).values())), 4)
    errors = [(field - exact).abs().max() for field in (found, expected)]
    assert errors[0] <= 3 * errors[1] + 1e-6 * exact.abs().max()


@pytest.mark.parametrize(("batch", "channels"), [(1, 1), (1, 2), (2, 1), (4, 2)])
def test_the_kernel_counts_its_places_in_32_bits(monkeypatch, batch: int, channels: int) -> None:
    from geodiff_plugin.algorithm.kernels import solver as kernels

    monkeypatch.setattr(kernels, "TILE", 1024)
    fields = batch * channels
    side = int((solver.MAX_VALUES / fields) ** 0.5)
    pixels = [rows * columns for rows, columns in kernels._sizes(side, side, True)]
    assert 2**30 < kernels._scratch_size(batch, fields, pixels) < 2**31


def test_larger_fields_than_the_kernel_can_address_are_those_of_the_reference(monkeypatch, device) -> None:
    from geodiff_plugin.algorithm.kernels import solver as kernels

    system = random_system(0, (8, 15), 1, 1, device)
    robust = random_robust_system(0, (1, 8, 15), 1, 1, device, local=False)
    launched = []
    monkeypatch.setattr(kernels, "_launch", lambda *args, **kwargs: launched.append(1))
    for most, count in ((120, 2), (119, 0)):
        monkeypatch.setattr(solver, "MAX_VALUES", most)
        launched.clear()
        solve_field(system, 2, system.rhs)
        solve_robust(robust, 1, 2)
        assert len(launched) == count
