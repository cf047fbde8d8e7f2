"""Smooth fields against SciPy: truncated solves and robust passes."""

import inspect
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sparse
import torch
import torch.nn.functional as F
from scipy.sparse.linalg import splu
from torch import Tensor

from geodiff_plugin.algorithm import match_fitting, solver
from geodiff_plugin.algorithm.match_fitting import fit_depth
from geodiff_plugin.algorithm.solver import scaled_affinities, solve_field, solve_robust
from geodiff_plugin.algorithm.systems import FieldSystem, RobustSystem
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.matching import Matches
from tests.unit.algorithm.references import a_system, arrays, drawn, field, robust_field


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
    flat = replace(system, rhs=system.weight * torch.tensor([0.0, 0.7]).view(1, 2, 1, 1))
    found = solve_field(flat, 5, torch.tensor([0.0, 0.7]).view(1, 2, 1, 1).expand(2, 2, 6, 7).clone())
    torch.testing.assert_close(found, torch.tensor([0.0, 0.7]).view(1, 2, 1, 1).expand(2, 2, 6, 7))


def test_links_are_scaled_by_one_number_or_by_the_lower_end():
    affinities = drawn(2, 1, 4, 5, seed=5), drawn(2, 1, 3, 6, seed=6)  # of 4x6 pixels
    number = torch.tensor([2.0, 7.0]).view(2, 1, 1, 1)
    for scaled, link in zip(scaled_affinities(affinities, number), affinities, strict=True):
        np.testing.assert_allclose(scaled.numpy(), number.numpy() * link.numpy(), rtol=1e-6)
    smooth = drawn(2, 1, 4, 6, seed=7, low=1.0, high=9.0)
    across, down = (scaled.numpy() for scaled in scaled_affinities(affinities, smooth))
    a, (of_rows, of_columns) = smooth.numpy(), (link.numpy() for link in affinities)
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
    size, rounds, steps, radius = (11, 14), 3, 5, 2.5
    data = 0.2 * drawn(2, 1, *size, seed=1, low=-1.0) + torch.tensor([0.1, -0.3]).view(2, 1, 1, 1)
    data = data + 3.0 * (drawn(2, 1, *size, seed=2) > 0.95)
    trusted = drawn(4, 1, *size, seed=3, low=-0.6).clamp_min(0.0)
    noise = drawn(2, 1, *size, seed=4, low=0.05, high=0.3)
    errors = {
        "none": None,
        "of a sample": torch.tensor([0.04, 0.4]).view(2, 1, 1, 1),
        "of a pixel": drawn(2, 1, *size, seed=5, high=0.5),
    }
    affinities = drawn(2, 1, 11, 13, seed=6), drawn(2, 1, 10, 14, seed=7)
    shape = (3, 2, 1, 1, 1) if error == "of a sample" else (3, 2, 1, *size)
    smoothness = torch.tensor([8.0, 3.0, 0.7]).view(3, 1, 1, 1, 1) * drawn(*shape, seed=8, low=0.5, high=2.0)
    tikhonov = torch.tensor([0.02, 0.01, 0.05]).view(3, 1, 1, 1, 1) * drawn(*shape, seed=9, low=0.5)
    system = RobustSystem(data, trusted, noise, errors[error], radius, affinities, smoothness, tikhonov)
    found = solve_robust(system, rounds, steps, with_support=with_support)
    assert (found.support is not None) == with_support and found.field.shape == (4, 1, *size)
    for k in range(4):  # the first set of both samples, then the second set
        b = k % 2
        of_prior = 0.0 if errors[error] is None else errors[error][b, 0].double().numpy()
        width = radius * np.hypot(noise[b, 0].double().numpy(), of_prior)
        passes = [
            (a[b, 0].double().numpy(), h[b, 0].double().numpy())
            for a, h in zip(smoothness, tikhonov, strict=True)
        ]
        of_links = tuple(link[b, 0].double().numpy() for link in affinities)
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
        inspect.signature(solve_robust).bind(None, 2, 3, True)


def solved_directly(system: FieldSystem, *_: object) -> Tensor:
    """The exact minimiser: normal equations of every channel, assembled link by link in float64."""
    weight = system.weight[0, 0].double().numpy()
    pixels = np.arange(weight.size).reshape(weight.shape)
    first = np.concatenate([pixels[:, :-1].ravel(), pixels[:-1].ravel()])
    second = np.concatenate([pixels[:, 1:].ravel(), pixels[1:].ravel()])
    link = np.concatenate([part[0, 0].double().numpy().ravel() for part in (system.across, system.down)])
    values = np.concatenate([weight.ravel(), link, link, -link, -link])
    row = np.concatenate([pixels.ravel(), first, second, first, second])
    column = np.concatenate([pixels.ravel(), first, second, second, first])
    factors = splu(sparse.coo_matrix((values, (row, column))).tocsc())
    fields = [factors.solve(rhs.double().numpy().ravel()) for rhs in system.rhs[0]]
    return torch.from_numpy(np.stack(fields)).view(system.rhs.shape).to(system.rhs)


@pytest.fixture(scope="module")
def problem() -> tuple[Tensor, Matches, Tensor]:
    """The bundled pair's ground truth, shrunk, wrong by 10 %, smoothly, and matches on two thirds of it."""
    pair, size = read_demo_pair(), (126, 168)
    left = torch.from_numpy(pair.left).permute(2, 0, 1)[None].float() / 255.0
    left = F.interpolate(left, size, mode="bilinear", antialias=True)
    ground_truth = F.interpolate(
        torch.from_numpy(pair.depth_m)[None, None].float(), size, mode="nearest-exact"
    )
    generator = torch.Generator().manual_seed(0)
    wrong = torch.randn(1, 1, 6, 8, generator=generator) * 0.1
    depth_m = ground_truth * F.interpolate(wrong, size, mode="bicubic").exp()
    holes = F.interpolate(torch.rand(1, 1, 11, 14, generator=generator), size, mode="bicubic") < 0.35
    noise = 1.0 + 0.01 * torch.randn(1, 1, *size, generator=generator)
    confidence = torch.where(holes, 0.0, 0.9)
    return depth_m, Matches(noise / ground_truth, confidence, torch.full((1,), 1e-3)), left


#: By the prior's error: bounds on the difference of log depth from the exact fit, mean and 99 % quantile.
#: Measured: 9e-4 and .015 for a good prior, 4e-4 and .007 for the others.
BOUNDS = {0.03: (1.5e-3, 0.025), 0.1: (7e-4, 0.012), 0.3: (7e-4, 0.012)}


@pytest.mark.parametrize("error", BOUNDS)
def test_the_fit_that_ships_is_near_the_exact_one_and_more_steps_are_nearer(problem, monkeypatch, error):
    depth_m, target, left = problem
    given = torch.full((1, 1, 1, 1), error)
    shipped_m, _, _ = fit_depth(depth_m, target, left, given)
    with monkeypatch.context() as patch:
        patch.setattr(match_fitting, "SOLVER_STEPS", 100)
        converged_m, _, _ = fit_depth(depth_m, target, left, given)
    monkeypatch.setattr(solver, "solve_field", solved_directly)
    exact_m, _, _ = fit_depth(depth_m, target, left, given)
    off, left_over = ((found / exact_m).log().abs() for found in (shipped_m, converged_m))
    mean, most = BOUNDS[error]
    assert off.mean() < mean and off.flatten().quantile(0.99) < most
    assert left_over.mean() < 1e-5
    assert (depth_m / exact_m).log().abs().mean() > 0.05  # there was much to correct
