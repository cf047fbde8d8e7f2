"""The solver of smooth fields, at the steps that ship, against a sparse direct solver (SciPy's SuperLU)."""

import numpy as np
import pytest
import scipy.sparse as sparse
import torch
import torch.nn.functional as F
from scipy.sparse.linalg import splu
from torch import Tensor

from geodiff_plugin.algorithm import correction, solver
from geodiff_plugin.algorithm.correction import fit_depth
from geodiff_plugin.algorithm.solver import FieldSystem
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.matching import Matches


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
    fields = [factors.solve(pull.double().numpy().ravel()) for pull in system.pull[0]]
    return torch.from_numpy(np.stack(fields)).view(system.pull.shape).to(system.pull)


@pytest.fixture(scope="module")
def problem() -> tuple[Tensor, Matches, Tensor]:
    """The bundled pair's truth, shrunk, wrong by 10 %, smoothly, and matches on two thirds of it."""
    pair, size = read_demo_pair(), (126, 168)
    left = torch.from_numpy(pair.left).permute(2, 0, 1)[None].float() / 255.0
    left = F.interpolate(left, size, mode="bilinear", antialias=True)
    truth = F.interpolate(torch.from_numpy(pair.depth_m)[None, None].float(), size, mode="nearest-exact")
    generator = torch.Generator().manual_seed(0)
    wrong = torch.randn(1, 1, 6, 8, generator=generator) * 0.1
    depth_m = truth * F.interpolate(wrong, size, mode="bicubic").exp()
    holes = F.interpolate(torch.rand(1, 1, 11, 14, generator=generator), size, mode="bicubic") < 0.35
    noise = 1.0 + 0.01 * torch.randn(1, 1, *size, generator=generator)
    confidence = torch.where(holes, 0.0, 0.9)
    return depth_m, Matches(noise / truth, confidence, torch.full((1,), 1e-3)), left


#: By the prior's error: bounds on the difference of log depth from the exact fit, mean and 99 % quantile.
#: Measured: 9e-4 and .015 for a good prior, 4e-4 and .007 for the others.
BOUNDS = {0.03: (1.5e-3, 0.025), 0.1: (7e-4, 0.012), 0.3: (7e-4, 0.012)}


@pytest.mark.parametrize("error", BOUNDS)
def test_the_fit_that_ships_is_near_the_exact_one_and_more_steps_are_nearer(problem, monkeypatch, error):
    depth_m, target, left = problem
    given = torch.full((1, 1, 1, 1), error)
    shipped_m, _, _ = fit_depth(depth_m, target, left, given)
    with monkeypatch.context() as patch:
        patch.setattr(correction, "SOLVER_STEPS", 100)
        converged_m, _, _ = fit_depth(depth_m, target, left, given)
    monkeypatch.setattr(solver, "solve_field", solved_directly)
    exact_m, _, _ = fit_depth(depth_m, target, left, given)
    off, left_over = ((found / exact_m).log().abs() for found in (shipped_m, converged_m))
    mean, most = BOUNDS[error]
    assert off.mean() < mean and off.flatten().quantile(0.99) < most
    assert left_over.mean() < 1e-5
    assert (depth_m / exact_m).log().abs().mean() > 0.05  # there was much to correct
