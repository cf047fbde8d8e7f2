"""References in NumPy and SciPy, in float64, that the tests of this folder share."""

import cv2
import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import cg


def normal_matrix(weight: np.ndarray, across: np.ndarray, down: np.ndarray) -> sparse.csr_array:
    """The matrix of ``sum weight u^2 + sum link |grad u|^2`` on a grid ``(h, w)``."""
    height, width = weight.shape
    pixels = np.arange(height * width).reshape(height, width)
    ends = [(pixels[:, :-1], pixels[:, 1:], across), (pixels[:-1], pixels[1:], down)]
    total = sparse.diags_array(weight.ravel())
    for first, second, link in ends:
        edges = np.arange(link.size)
        signs = np.r_[np.ones(link.size), -np.ones(link.size)]
        gradient = sparse.coo_array(
            (signs, (np.r_[edges, edges], np.r_[second.ravel(), first.ravel()])),
            (link.size, height * width),
        )
        total = total + gradient.T @ sparse.diags_array(link.ravel()) @ gradient
    return sparse.csr_array(total)


def _conjugate_gradients(weight, pull, across, down, steps, start):
    matrix = normal_matrix(weight, across, down)
    jacobi = sparse.diags_array(1.0 / matrix.diagonal())
    found, _ = cg(matrix, pull.ravel(), start.ravel(), rtol=0.0, atol=1e-13, maxiter=steps, M=jacobi)
    return found.reshape(weight.shape) if steps else start


def _sums(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Sums over cells of so many rows and columns; cells at the end may be smaller."""
    along = np.add.reduceat(values, np.arange(0, values.shape[0], rows), 0)
    return np.add.reduceat(along, np.arange(0, values.shape[1], columns), 1)


def field(weight, pull, across, down, steps, start=None):
    """One field by preconditioned conjugate gradients on a pyramid of halved grids, as ``solve_field``."""
    height, width = weight.shape
    if start is not None:
        return _conjugate_gradients(weight, pull, across, down, steps, start)
    if min(height, width) <= 24:
        return _conjugate_gradients(weight, pull, across, down, 80, np.zeros_like(pull))
    coarse = field(
        _sums(weight, 2, 2),
        _sums(pull, 2, 2),
        _sums(across[:, 1::2], 2, 1) / 2,
        _sums(down[1::2], 1, 2) / 2,
        steps,
    )
    fine = cv2.resize(coarse, (2 * coarse.shape[1], 2 * coarse.shape[0]), interpolation=cv2.INTER_LINEAR)
    return _conjugate_gradients(weight, pull, across, down, steps, fine[:height, :width])


def robust_field(data, trusted, width, links, passes, rounds, steps):
    """Field, weights and support of one sample after passes of ``(smoothness, inertia)`` maps or numbers."""
    total, weights = np.zeros_like(data), trusted
    for smoothness, inertia in passes:
        a = np.broadcast_to(smoothness, data.shape)
        across = links[0] * np.minimum(a[:, 1:], a[:, :-1])
        down = links[1] * np.minimum(a[1:], a[:-1])
        left, solved, support = data - total, None, None
        for _ in range(rounds):
            system = weights + inertia
            support = field(system, weights, across, down, steps, support)
            solved = field(system, weights * left, across, down, steps, solved)
            weights = trusted / (1.0 + ((solved - left) / width) ** 2)
        total = total + solved
    return total, weights, support


def weighted_quantile(values: np.ndarray, weight: np.ndarray, share: float) -> float:
    """The least value up to which the given share of the weight lies."""
    order = np.argsort(values, axis=None, kind="stable")
    below = np.cumsum(weight.ravel()[order])
    return values.ravel()[order][min(np.sum(below < share * below[-1]), values.size - 1)]
