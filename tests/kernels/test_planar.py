"""Kernels of flat walls against their reference in ``result.planar``."""

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin.algorithm import solver
from geodiff_plugin.matching import Matches
from geodiff_plugin.result import planar
from tests.kernels.drawn import drawn


def few_steps(patch: pytest.MonkeyPatch) -> None:
    from geodiff_plugin.algorithm.kernels import solver as kernels

    for module in (kernels, solver):
        patch.setattr(module, "COARSEST_STEPS", 6)
    patch.setattr(planar, "STEPS", 2)


@drawn(4)
@given(seed=st.integers(0, 999), size=st.tuples(st.integers(5, 27), st.integers(5, 27)))
@example(seed=0, size=(23, 26))
def test_values_are_drawn_to_the_same_smoothed_slopes(device, seed, size):
    """Of fewer pixels the solves converge, and what is left is rounding that the smoothness magnifies."""
    generator, (height, width) = torch.Generator().manual_seed(seed), size

    def drawn(*shape: int) -> torch.Tensor:
        return torch.rand(1, 1, *shape, generator=generator).to(device)

    inverse, known = 0.5 + drawn(height, width), drawn(height, width) ** 3
    affinities = drawn(height, width - 1) + 1e-3, drawn(height - 1, width) + 1e-3
    surface = planar._Surface(inverse, affinities)

    def pulled() -> torch.Tensor:
        return planar._values_rhs(inverse, planar._smoothed(surface, known), affinities)

    with pytest.MonkeyPatch.context() as patch:
        few_steps(patch)
        found = pulled()
        with without_kernels():
            expected = pulled()
    assert found.shape == expected.shape
    assert (found - expected).abs().max() <= 1e-5 * expected.abs().max()


@drawn(2)
@given(seed=st.integers(0, 999))
@example(seed=0)
def test_a_map_is_flattened_alike_on_both_grids(device, seed):
    """A map of about twice the size of its matches."""
    generator = torch.Generator().manual_seed(seed)

    def drawn(channels: int, *size: int) -> torch.Tensor:
        return torch.rand(1, channels, *size, generator=generator).to(device)

    depth_m, left_01 = 2.0 + 0.1 * drawn(1, 23, 27), drawn(3, 23, 27)
    denoised_m = depth_m + 0.1 * drawn(1, 23, 27)
    step = torch.tensor([0.01], device=device)
    matches = Matches(0.5 + drawn(1, 12, 14), drawn(1, 12, 14), step, 1.0 + 9.0 * drawn(1, 12, 14))
    error = torch.full((1, 1, 1, 1), 0.15, device=device)
    with pytest.MonkeyPatch.context() as patch:
        few_steps(patch)
        found = planar.flatten(depth_m, matches, left_01, error, denoised_m)
        with without_kernels():
            expected = planar.flatten(depth_m, matches, left_01, error, denoised_m)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0.0)
