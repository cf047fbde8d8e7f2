"""Weighted least squares of a smooth field on an image grid, coarse to fine.

A screened Poisson equation, solved on a pyramid (cascadic multigrid, Bornemann and Deuflhard 1996).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import use_kernel

#: The shorter side, in pixels, of the coarsest grid.
COARSEST_SIDE = 24
#: Its conjugate-gradient steps: near enough to exact.
COARSEST_STEPS = 80


@dataclass(frozen=True)
class FieldSystem:
    """The minimiser ``u`` of ``sum weight (u - data)^2 + sum link |grad u|^2``, a channel at a time.

    ``weight (B, 1, H, W)`` is above 0 somewhere in each connected part, ``pull (B, C, H, W)`` is weight times
    data; links >= 0 lie ``across`` ``(B, 1, H, W - 1)`` and ``down`` ``(B, 1, H - 1, W)``.
    """

    weight: Tensor
    pull: Tensor
    across: Tensor
    down: Tensor

    def diagonal(self) -> Tensor:
        """``(B, 1, H, W)``, the preconditioner."""
        beside = F.pad(self.across, (1, 0)) + F.pad(self.across, (0, 1))
        return self.weight + beside + F.pad(self.down, (0, 0, 1, 0)) + F.pad(self.down, (0, 0, 0, 1))

    def coarser(self) -> FieldSystem:
        """The same problem for fields that are constant over cells of 2x2 pixels.

        Links across a cell's border are halved: their ends are twice as far apart.
        """
        height, width = (-(-side // 2) for side in self.weight.shape[-2:])
        across = _cells(self.across[..., 1::2], (2, 1), (height, width - 1))
        down = _cells(self.down[..., 1::2, :], (1, 2), (height - 1, width))
        weight, pull = (_cells(part, (2, 2), (height, width)) for part in (self.weight, self.pull))
        return FieldSystem(weight, pull, 0.5 * across, 0.5 * down)


def _cells(x: Tensor, cell: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Sums over cells of ``(rows, columns)`` pixels, on a grid of ``size``, padded with zeros."""
    rows, columns = cell
    x = F.pad(x, (0, size[1] * columns - x.shape[-1], 0, size[0] * rows - x.shape[-2]))
    return F.avg_pool2d(x, (rows, columns)) * (rows * columns)


def solve_field(system: FieldSystem, steps: int, start: Tensor | None = None) -> Tensor:
    """The field ``(B, C, H, W)`` of a system, by ``steps`` conjugate-gradient steps on each finer grid.

    Without ``start``, a field near the solution, coarser grids are solved first. The work is fixed.
    """
    if use_kernel(system.pull):
        from geodiff_plugin.algorithm import kernels

        return kernels.solve_field(system, steps, start)
    height, width = system.weight.shape[-2:]
    if start is not None:
        return _conjugate_gradients(system, start, steps)
    if min(height, width) <= COARSEST_SIDE:
        return _conjugate_gradients(system, torch.zeros_like(system.pull), COARSEST_STEPS)
    coarse = solve_field(system.coarser(), steps)
    fine = F.interpolate(coarse, scale_factor=2, mode="bilinear")[..., :height, :width]
    return _conjugate_gradients(system, fine, steps)


def _conjugate_gradients(system: FieldSystem, x: Tensor, steps: int) -> Tensor:
    """``x`` after ``steps`` steps, with the system scaled to a diagonal of 1; flat vectors are faster."""
    tiny = 1e-20  # a channel that has converged stays where it is
    root = system.diagonal().rsqrt()
    across = F.pad(system.across * root[..., 1:] * root[..., :-1], (0, 1))  # no link from row to row
    down = system.down * root[..., 1:, :] * root[..., :-1, :]
    links = (across.flatten(2)[..., :-1], 1), (down.flatten(2), system.weight.shape[-1])

    def apply(u: Tensor) -> Tensor:
        out = u.clone()
        for link, away in links:
            out[..., away:].addcmul_(link, u[..., :-away], value=-1.0)
            out[..., :-away].addcmul_(link, u[..., away:], value=-1.0)
        return out

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return torch.linalg.vecdot(a, b)[..., None]

    x = (x / root).flatten(2)
    residual = (system.pull * root).flatten(2) - apply(x)
    direction, along = residual.clone(), dot(residual, residual)
    for _ in range(steps):
        image = apply(direction)
        length = along / dot(direction, image).clamp_min(tiny)
        x.addcmul_(length, direction)
        residual.addcmul_(length, image, value=-1.0)
        before, along = along, dot(residual, residual)
        direction = torch.addcmul(residual, along / before.clamp_min(tiny), direction)
    return x.view(system.pull.shape) * root


@dataclass(frozen=True)
class RobustSystem:
    """The minimiser of ``sum rho(u - data) + sum link |grad u|^2 + inertia sum u^2``.

    ``rho`` grows more slowly than a square, so that what contradicts the rest counts for less. ``data (B, C,
    H, W)`` are the observations, ``links`` go across and down as in ``FieldSystem``, ``inertia (B, 1, 1, 1)``
    pulls towards 0. ``robust`` takes the residuals ``(B, 1, H, W)`` of the first channel to the weights
    ``rho'(r) / 2 r`` of the next round of least squares, which further channels share.
    """

    data: Tensor
    links: tuple[Tensor, Tensor]
    inertia: Tensor
    robust: Callable[[Tensor], Tensor]


def solve_robust(system: RobustSystem, weights: Tensor, rounds: int, steps: int) -> tuple[Tensor, Tensor]:
    """The field of iteratively reweighted least squares, and the weights for one more round.

    ``weights (B, 1, H, W)`` are those of the first of ``rounds >= 1``; ``steps`` as for ``solve_field``.
    """
    field: Tensor | None = None
    for _ in range(rounds):
        least_squares = FieldSystem(weights + system.inertia, weights * system.data, *system.links)
        field = solve_field(least_squares, steps, field)
        weights = system.robust(field[:, :1] - system.data[:, :1])
    assert field is not None
    return field, weights
