"""Stages by their kernels, in Triton's interpreter, against the same stages without them."""

import torch

from geodiff_plugin.algorithm import match_fitting, solver
from geodiff_plugin.algorithm.edges import sharpen_edges
from geodiff_plugin.algorithm.solver import solve_field, solve_robust
from geodiff_plugin.algorithm.systems import FieldSystem, RobustSystem
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import Matches
from tests.unit.runtime.triton_interpreter import interpreted

SIZE = (5, 7)


def drawn(*shape: int, seed: int, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def test_stages_of_the_fit_are_the_same_by_kernels():
    depth_m, image = drawn(2, 1, *SIZE, seed=1, low=1.0, high=4.0), drawn(2, 3, *SIZE, seed=2)
    log_depth = depth_m.log()
    matches = Matches(drawn(2, 1, *SIZE, seed=3), drawn(2, 1, *SIZE, seed=4), torch.tensor([0.01, 0.03]))
    error = torch.tensor([0.04, 0.2]).view(2, 1, 1, 1)

    def stages():
        residuals = match_fitting._residuals(log_depth, matches, 0.03)
        return [
            *residuals,
            *match_fitting.edge_affinities(image, log_depth),
            match_fitting.off_edges(matches, depth_m, error).confidence,
            match_fitting._spread(*residuals, matches.confidence),
            *match_fitting._levels(error, DEFAULT),
        ]

    expected = stages()
    with interpreted("geodiff_plugin.algorithm.kernels.match_fitting") as kernels:
        kernels.CHUNK = 64  # there are 35 matches
        found = stages()
    for by_kernel, reference in zip(found, expected, strict=True):
        torch.testing.assert_close(by_kernel, reference, rtol=1e-4, atol=1e-6)


def test_edges_are_sharpened_the_same_by_the_kernel():
    depth_m = torch.full((1, 1, 6, 9), 2.0)
    depth_m[..., 4], depth_m[..., 5:] = 3.1, 5.0
    image = drawn(1, 3, 6, 9, seed=1)
    expected = sharpen_edges(depth_m, image, 1)
    with interpreted("geodiff_plugin.algorithm.kernels.edges"):
        torch.testing.assert_close(sharpen_edges(depth_m, image, 1), expected)
    assert not torch.equal(expected, depth_m)


def test_the_solver_uses_its_kernel_for_fields_that_it_can_index(asked_kernels, monkeypatch):
    """The kernel itself is compared elsewhere: the interpreter is slow."""
    fields = drawn(2, 2, *SIZE, seed=1)
    pixel = torch.ones(2, 1, *SIZE)
    system = FieldSystem(pixel, fields, pixel[..., 1:], pixel[..., 1:, :])
    affinities, number = (system.across, system.down), torch.ones(1, 2, 1, 1, 1)
    robust = RobustSystem(pixel, pixel, pixel, None, 2.0, affinities, number, 0.1 * number)
    field, of_passes = (f"algorithm.kernels.solver.{name}" for name in ("solve_field", "solve_robust"))
    assert solve_field(system, 3, fields) == field
    # It can index so many values: a field of two channels has 140, a fit 70, with its support 140.
    monkeypatch.setattr(solver, "MAX_VALUES", 139)
    assert solve_field(system, 3, fields) != field
    assert solve_robust(robust, 2, 3, with_support=True) != of_passes
    assert solve_robust(robust, 2, 3) == of_passes
    monkeypatch.setattr(solver, "MAX_VALUES", 140)
    assert solve_field(system, 3, fields) == field
    assert solve_robust(robust, 2, 3, with_support=True) == of_passes
