"""Systems of smooth fields, and their coarser grids, against SciPy."""

import numpy as np
import pytest

from tests.unit.algorithm.references import a_system, arrays, normal_matrix


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
        weight, rhs, across, down = arrays(system, b, 1)
        fine = u[np.ix_(rows, columns)].ravel()
        affinities = fine @ normal_matrix(0 * weight, across, down) @ fine
        of_coarse = arrays(coarse, b, 1)
        normal = normal_matrix(*(of_coarse[i] for i in (0, 2, 3)))
        energy = u.ravel() @ normal @ u.ravel() - 2 * of_coarse[1].ravel() @ u.ravel()
        expected = (weight.ravel() * fine * fine).sum() + affinities / 2 - 2 * rhs.ravel() @ fine
        assert energy == pytest.approx(expected, rel=1e-5)
