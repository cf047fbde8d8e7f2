"""Kernels of flat walls against their reference in ``result.flattening``."""

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._kernels import without_kernels
from geodiff_plugin.algorithm import solver
from geodiff_plugin.result import flattening
from tests.kernels.drawn import drawn


@drawn(4)
@given(seed=st.integers(0, 999), size=st.tuples(st.integers(5, 27), st.integers(5, 27)))
@example(seed=0, size=(23, 26))
def test_values_are_drawn_to_the_same_smoothed_slopes(device, seed, size):
    """Both axes are smoothed as one batch, in the reference one after the other.

    Of fewer pixels the solves converge, and what is left is rounding that the smoothness magnifies.
    """
    generator, (height, width) = torch.Generator().manual_seed(seed), size

    def drawn(*shape: int) -> torch.Tensor:
        return torch.rand(1, 1, *shape, generator=generator).to(device)

    inverse, known = 0.5 + drawn(height, width), drawn(height, width) ** 3
    links = drawn(height, width - 1) + 1e-3, drawn(height - 1, width) + 1e-3
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solver, "COARSEST_STEPS", 6)
        patch.setattr(flattening, "STEPS", 2)
        found = flattening._towards_smoothed(inverse, known, links)
        with without_kernels():
            expected = flattening._towards_smoothed(inverse, known, links)
    assert found.shape == expected.shape
    assert (found - expected).abs().max() <= 1e-5 * expected.abs().max()
