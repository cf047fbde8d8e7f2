"""The parameters that make a relative map metric, and the protocol of its formula."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class AffineState:
    """The three parameters per sample that make a relative map metric, all ``(B,)`` float32.

    ``s_hat`` and ``t_hat`` are raw scale and shift; ``g_s`` is the global scale, metres. Scale and shift are
    their softplus or, as in Marigold-DC, their squares times ``units``, the values for raw values of 1.
    """

    s_hat: Tensor
    t_hat: Tensor
    g_s: Tensor
    units: tuple[Tensor, Tensor] | None = None

    def of(self, samples: slice) -> Self:
        """Return the state of some samples."""
        units = None if self.units is None else (self.units[0][samples], self.units[1][samples])
        return type(self)(self.s_hat[samples], self.t_hat[samples], self.g_s[samples], units)

    def where(self, use: Tensor, other: Self) -> Self:
        """Return this state for the samples to ``use (B,)`` bool, and the other's for the rest."""
        units = None
        if self.units is not None and other.units is not None:
            scale_units, shift_units = zip(self.units, other.units, strict=True)
            units = torch.where(use, *scale_units), torch.where(use, *shift_units)
        return type(self)(
            torch.where(use, self.s_hat, other.s_hat),
            torch.where(use, self.t_hat, other.t_hat),
            torch.where(use, self.g_s, other.g_s),
            units,
        )

    @property
    def scale(self) -> Tensor:
        """Scale ``softplus(s_hat)``, or ``s_hat^2`` times its unit; dimensionless."""
        return F.softplus(self.s_hat) if self.units is None else self.s_hat**2 * self.units[0]

    @property
    def shift(self) -> Tensor:
        """Shift ``softplus(t_hat)``, or ``t_hat^2`` times its unit; dimensionless."""
        return F.softplus(self.t_hat) if self.units is None else self.t_hat**2 * self.units[1]


class MetricForm(Protocol):
    """The attributes that define the formula of a ``MetricMap``."""

    @property
    def space(self) -> str:
        """Space in which the map is affine, key of ``SPACES``."""

    @property
    def positive(self) -> str:
        """Method that keeps scale and shift positive, ``"softplus"`` or ``"square"``."""
