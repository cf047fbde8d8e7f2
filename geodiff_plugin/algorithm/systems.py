"""Least-squares problems for smooth fields on an image grid, and their solutions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class FieldSystem:
    """The minimizer ``u`` of ``sum weight (u - data)^2 + sum g |grad u|^2``, separately for each channel.

    ``weight (B, 1, H, W)`` is above 0 somewhere in each connected component, ``rhs (B, C, H, W)`` is weight
    times data. The affinities ``g`` >= 0 are ``across`` ``(B, 1, H, W - 1)`` and ``down`` ``(B, 1, H - 1,
    W)``.
    """

    weight: Tensor
    rhs: Tensor
    across: Tensor
    down: Tensor

    def diagonal(self) -> Tensor:
        """Return the diagonal ``(B, 1, H, W)``, used as the preconditioner."""
        horizontal = F.pad(self.across, (1, 0)) + F.pad(self.across, (0, 1))
        return self.weight + horizontal + F.pad(self.down, (0, 0, 1, 0)) + F.pad(self.down, (0, 0, 0, 1))

    def coarser(self) -> FieldSystem:
        """Return the same problem for fields that are constant over cells of 2x2 pixels.

        Affinities across a cell's border are halved, since cell centres are twice as far apart.
        """
        height, width = (-(-side // 2) for side in self.weight.shape[-2:])
        across = _cells(self.across[..., 1::2], (2, 1), (height, width - 1))
        down = _cells(self.down[..., 1::2, :], (1, 2), (height - 1, width))
        weight, rhs = (_cells(part, (2, 2), (height, width)) for part in (self.weight, self.rhs))
        return FieldSystem(weight, rhs, 0.5 * across, 0.5 * down)


def _cells(x: Tensor, cell: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Sum over cells of ``(rows, columns)`` pixels, on a grid of ``size``, padded with zeros."""
    rows, columns = cell
    x = F.pad(x, (0, size[1] * columns - x.shape[-1], 0, size[0] * rows - x.shape[-2]))
    return F.avg_pool2d(x, (rows, columns)) * (rows * columns)


@dataclass(frozen=True)
class RobustSystem:
    """Observations ``r`` of a field that is found in passes, each fitting the residual of the previous ones.

    A pass minimizes ``sum t w^2 log(1 + (u - r)^2 / w^2) + sum a g |grad u|^2 + sum b u^2``. The first term
    grows more slowly than a square, which reduces the influence of outliers.

    Attributes:
        data: ``r (B, 1, H, W)``.
        trusted: ``t (B, 1, H, W)``, weight of an observation without residual. With ``n B`` samples it holds
            ``n`` consecutive sets of weights for the same observations.
        noise: ``(B, 1, H, W)`` standard deviation of an observation.
        error: ``(B, 1, 1, 1)`` or ``(B, 1, H, W)``, standard deviation of the fitted map; ``None`` means 0.
        radius: ``w`` in combined standard deviations; an observation with this residual has half its weight.
        affinities: ``g``, across and down as in ``FieldSystem``.
        smoothness: ``a`` of every pass, ``(P, B, 1, 1, 1)`` or ``(P, B, 1, H, W)``; between two pixels the
            lower one applies.
        tikhonov: ``b`` of every pass, with the shape of the smoothness.
    """

    data: Tensor
    trusted: Tensor
    noise: Tensor
    error: Tensor | None
    radius: float
    affinities: tuple[Tensor, Tensor]
    smoothness: Tensor
    tikhonov: Tensor

    @property
    def width(self) -> Tensor:
        """Residual ``w (B, 1, H, W)`` with half the weight."""
        both = self.noise if self.error is None else (self.noise**2 + self.error**2).sqrt()
        return self.radius * both


class RobustField(NamedTuple):
    """Result of ``solve_robust``, ``(B, 1, H, W)`` each, one sample per set of weights."""

    field: Tensor  # sum of all passes
    weights: Tensor  # of the observations, at the last residuals
    support: Tensor | None  # last-pass field for observations of 1: how far they determine it
