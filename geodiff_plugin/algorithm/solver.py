"""Weighted least squares of a smooth field on an image grid, coarse to fine.

A screened Poisson equation, solved on a pyramid (cascadic multigrid, Bornemann and Deuflhard 1996).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import use_kernel

#: The shorter side, in pixels, of the coarsest grid.
COARSEST_SIDE = 24
#: Its conjugate-gradient steps: near enough to exact.
COARSEST_STEPS = 80
#: Values of all fields for which the kernel is used, at most. It works in 13 times as much memory, whose
#: places it counts in 32 bits.
MOST_VALUES = (1 << 31) // 13


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
    if use_kernel(system.pull) and system.pull.numel() <= MOST_VALUES:
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
    """Observations ``r`` of a field, which is found in passes, each of what the passes before have left.

    A pass minimises ``sum t w^2 log(1 + (u - r)^2 / w^2) + sum a g |grad u|^2 + sum b u^2``. Its first term
    grows more slowly than a square, so that what contradicts the rest counts for less.

    Attributes:
        data: ``r (B, 1, H, W)``.
        trusted: ``t (B, 1, H, W)``, the weight of an observation that is met. Of ``n B`` samples it is ``n``
            sets of weights, one after the other, for the same observations.
        noise: ``(B, 1, H, W)`` standard deviation of an observation.
        error: ``(B, 1, 1, 1)`` or ``(B, 1, H, W)``, that of what is fitted to them; ``None`` is 0.
        reach: ``w`` is so many times the two deviations together: there an observation counts half.
        links: ``g``, across and down as in ``FieldSystem``.
        smoothness: ``a`` of every pass, ``(P, B, 1, 1, 1)``, or ``(P, B, 1, H, W)``: between two pixels the
            lower one of both holds.
        inertia: ``b`` of every pass, of one shape with the smoothness.
    """

    data: Tensor
    trusted: Tensor
    noise: Tensor
    error: Tensor | None
    reach: float
    links: tuple[Tensor, Tensor]
    smoothness: Tensor
    inertia: Tensor

    @property
    def width(self) -> Tensor:
        """``w (B, 1, H, W)``."""
        both = self.noise if self.error is None else (self.noise**2 + self.error**2).sqrt()
        return self.reach * both


class RobustField(NamedTuple):
    """What ``solve_robust`` finds, ``(B, 1, H, W)`` each, of as many samples as there are weights."""

    field: Tensor  # the sum of all passes
    weights: Tensor  # of the observations, at the last residuals
    support: Tensor | None  # the field of the last pass for observations of 1: how far it is decided by them


def solve_robust(system: RobustSystem, rounds: int, steps: int, *, with_support: bool = False) -> RobustField:
    """The field of all passes, each by ``rounds >= 1`` of iteratively reweighted least squares.

    The first round of the first pass trusts every observation, that of a later one starts with the weights of
    the pass before. ``steps`` are those of ``solve_field``, whose field the next round starts from.
    """
    if use_kernel(system.data) and (1 + with_support) * system.trusted.numel() <= MOST_VALUES:
        from geodiff_plugin.algorithm import kernels

        return kernels.solve_robust(system, rounds, steps, with_support)
    sets = len(system.trusted) // len(system.data)
    observed, width = (part.repeat(sets, 1, 1, 1) for part in (system.data, system.width))
    total, weights, solved = torch.zeros_like(observed), system.trusted, observed
    passes = list(zip(system.smoothness, system.inertia, strict=True))
    for k, (smoothness, inertia) in enumerate(passes):
        data, start = observed - total, None
        if with_support and k == len(passes) - 1:
            data = torch.cat([data, torch.ones_like(data)], 1)
        across, down = (link.repeat(sets, 1, 1, 1) for link in scaled_links(system.links, smoothness))
        held = inertia.repeat(sets, 1, 1, 1)
        for _ in range(rounds):
            solved = solve_field(FieldSystem(weights + held, weights * data, across, down), steps, start)
            left_over, start = solved[:, :1] - data[:, :1], solved
            weights = system.trusted / (1.0 + (left_over / width) ** 2)
        total = total + solved[:, :1]
    return RobustField(total, weights, solved[:, 1:] if with_support else None)


def scaled_links(links: tuple[Tensor, Tensor], smoothness: Tensor) -> tuple[Tensor, Tensor]:
    """Links times a smoothness ``(B, 1, 1, 1)``, or ``(B, 1, H, W)``: the lower one of both ends."""
    if smoothness.shape[-2:] != (1, 1):
        across = torch.minimum(smoothness[..., 1:], smoothness[..., :-1])
        down = torch.minimum(smoothness[..., 1:, :], smoothness[..., :-1, :])
        return across * links[0], down * links[1]
    return smoothness * links[0], smoothness * links[1]
