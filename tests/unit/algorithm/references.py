"""References in NumPy and SciPy, in float64, that the tests of this folder share."""

import cv2
import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import cg

from geodiff_plugin.algorithm.systems import FieldSystem


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


def _conjugate_gradients(weight, rhs, across, down, steps, start):
    matrix = normal_matrix(weight, across, down)
    jacobi = sparse.diags_array(1.0 / matrix.diagonal())
    found, _ = cg(matrix, rhs.ravel(), start.ravel(), rtol=0.0, atol=1e-13, maxiter=steps, M=jacobi)
    return found.reshape(weight.shape) if steps else start


def _sums(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Sums over cells of so many rows and columns; cells at the end may be smaller."""
    along = np.add.reduceat(values, np.arange(0, values.shape[0], rows), 0)
    return np.add.reduceat(along, np.arange(0, values.shape[1], columns), 1)


def field(weight, rhs, across, down, steps, start=None):
    """One field by preconditioned conjugate gradients on a pyramid of halved grids, as ``solve_field``."""
    height, width = weight.shape
    if start is not None:
        return _conjugate_gradients(weight, rhs, across, down, steps, start)
    if min(height, width) <= 24:
        return _conjugate_gradients(weight, rhs, across, down, 80, np.zeros_like(rhs))
    coarse = field(
        _sums(weight, 2, 2),
        _sums(rhs, 2, 2),
        _sums(across[:, 1::2], 2, 1) / 2,
        _sums(down[1::2], 1, 2) / 2,
        steps,
    )
    fine = cv2.resize(coarse, (2 * coarse.shape[1], 2 * coarse.shape[0]), interpolation=cv2.INTER_LINEAR)
    return _conjugate_gradients(weight, rhs, across, down, steps, fine[:height, :width])


def robust_field(data, trusted, width, affinities, passes, rounds, steps):
    """Field, weights and support of one sample after passes of ``(smoothness, tikhonov)`` maps or numbers."""
    total, weights = np.zeros_like(data), trusted
    for smoothness, tikhonov in passes:
        a = np.broadcast_to(smoothness, data.shape)
        across = affinities[0] * np.minimum(a[:, 1:], a[:, :-1])
        down = affinities[1] * np.minimum(a[1:], a[:-1])
        left, solved, support = data - total, None, None
        for _ in range(rounds):
            system = weights + tikhonov
            support = field(system, weights, across, down, steps, support)
            solved = field(system, weights * left, across, down, steps, solved)
            weights = trusted / (1.0 + ((solved - left) / width) ** 2)
        total = total + solved
    return total, weights, support


def weighted_quantile(values: np.ndarray, weight: np.ndarray, fraction: float) -> float:
    """The least value up to which the given share of the weight lies."""
    order = np.argsort(values, axis=None, kind="stable")
    below = np.cumsum(weight.ravel()[order])
    return values.ravel()[order][min(np.sum(below < fraction * below[-1]), values.size - 1)]


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
        system.rhs[sample, channel],
        system.across[sample, 0],
        system.down[sample, 0],
    )
    return tuple(part.double().numpy() for part in parts)
