"""Solves weighted least squares for a smooth field on an image grid, coarse to fine.

The problem is a screened Poisson equation, solved on a pyramid (cascadic multigrid, Bornemann and Deuflhard
1996).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel, launch_bound
from geodiff_plugin.algorithm.constants import COARSEST_SIDE, COARSEST_STEPS
from geodiff_plugin.algorithm.systems import FieldSystem, RobustField, RobustSystem

#: Maximum number of values of all fields for which the kernel is used. It needs 13 times as much memory,
#: addressed by 32-bit integers.
MAX_VALUES = (1 << 31) // 13
#: Squared norm of the residual, relative to the initial one, of a converged field in float32.
CONVERGED = 1e-14


@has_kernel(
    "algorithm.kernels.solver.solve_field",
    when=lambda system, steps, start=None: system.rhs.numel() <= MAX_VALUES,
)
def solve_field(system: FieldSystem, steps: int, start: Tensor | None = None) -> Tensor:
    """Solve a system for its field ``(B, C, H, W)`` by ``steps`` conjugate-gradient steps per finer grid.

    Without ``start``, a field near the solution, coarser grids are solved first. On a GPU the number of
    operations is fixed.
    """
    height, width = system.weight.shape[-2:]
    if start is not None:
        return _conjugate_gradients(system, start, steps)
    if min(height, width) <= COARSEST_SIDE:
        return _conjugate_gradients(system, torch.zeros_like(system.rhs), COARSEST_STEPS)
    coarse = solve_field(system.coarser(), steps)
    fine = F.interpolate(coarse, scale_factor=2, mode="bilinear")[..., :height, :width]
    return _conjugate_gradients(system, fine, steps)


def _conjugate_gradients(system: FieldSystem, x: Tensor, steps: int) -> Tensor:
    """Run ``steps`` steps from ``x`` on the system scaled to a unit diagonal; flat vectors are faster.

    On a CPU, the steps end once they no longer change the field; on a GPU, this would need a synchronization.
    """
    tiny = 1e-20  # keeps a converged channel unchanged
    root = system.diagonal().rsqrt()
    across = F.pad(system.across * root[..., 1:] * root[..., :-1], (0, 1))  # 0 between consecutive rows
    down = system.down * root[..., 1:, :] * root[..., :-1, :]
    affinities = (across.flatten(2)[..., :-1], 1), (down.flatten(2), system.weight.shape[-1])

    def apply(u: Tensor) -> Tensor:
        out = u.clone()
        for link, away in affinities:
            out[..., away:].addcmul_(link, u[..., :-away], value=-1.0)
            out[..., :-away].addcmul_(link, u[..., away:], value=-1.0)
        return out

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return torch.linalg.vecdot(a, b)[..., None]

    x = (x / root).flatten(2)
    residual = (system.rhs * root).flatten(2) - apply(x)
    direction = residual.clone()
    along = dot(residual, residual)
    enough, may_end = CONVERGED * along, not launch_bound(x)
    for _ in range(steps):
        if may_end and bool((along <= enough).all()):
            break
        image = apply(direction)
        length = along / dot(direction, image).clamp_min(tiny)
        x.addcmul_(length, direction)
        residual.addcmul_(length, image, value=-1.0)
        before = along
        along = dot(residual, residual)
        direction = torch.addcmul(residual, along / before.clamp_min(tiny), direction)
    return x.view(system.rhs.shape) * root


def _fits_the_kernel(system: RobustSystem, rounds: int, steps: int, *, with_support: bool = False) -> bool:
    return (1 + with_support) * system.trusted.numel() <= MAX_VALUES


@has_kernel("algorithm.kernels.solver.solve_robust", when=_fits_the_kernel)
def solve_robust(system: RobustSystem, rounds: int, steps: int, *, with_support: bool = False) -> RobustField:
    """Solve all passes for the field, each by ``rounds >= 1`` of iteratively reweighted least squares.

    The first round of the first pass gives every observation its full weight; later passes start with the
    weights of the previous pass. ``steps`` is as in ``solve_field``, and each round starts from the last
    field.
    """
    sets = len(system.trusted) // len(system.data)
    observed, width = (part.repeat(sets, 1, 1, 1) for part in (system.data, system.width))
    total = torch.zeros_like(observed)
    weights = system.trusted
    solved = observed
    passes = list(zip(system.smoothness, system.tikhonov, strict=True))
    for k, (smoothness, tikhonov) in enumerate(passes):
        data = observed - total
        start = None
        if with_support and k == len(passes) - 1:
            data = torch.cat([data, torch.ones_like(data)], 1)
        across, down = (
            link.repeat(sets, 1, 1, 1) for link in scaled_affinities(system.affinities, smoothness)
        )
        damping = tikhonov.repeat(sets, 1, 1, 1)
        for _ in range(rounds):
            solved = solve_field(FieldSystem(weights + damping, weights * data, across, down), steps, start)
            left_over = solved[:, :1] - data[:, :1]
            start = solved
            weights = system.trusted / (1.0 + (left_over / width) ** 2)
        total = total + solved[:, :1]
    return RobustField(total, weights, solved[:, 1:] if with_support else None)


def scaled_affinities(affinities: tuple[Tensor, Tensor], smoothness: Tensor) -> tuple[Tensor, Tensor]:
    """Multiply affinities by a smoothness ``(B, 1, 1, 1)``, or the lower of both ends in ``(B, 1, H, W)``."""
    if smoothness.shape[-2:] != (1, 1):
        across = torch.minimum(smoothness[..., 1:], smoothness[..., :-1])
        down = torch.minimum(smoothness[..., 1:, :], smoothness[..., :-1, :])
        return across * affinities[0], down * affinities[1]
    return smoothness * affinities[0], smoothness * affinities[1]
