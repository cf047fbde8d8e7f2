"""Turn a relative map into metres: an affine map with positive scale and shift, times a global scale.

Hop: ``x (B, 1, H, W)`` unclipped relative map, ``s_hat, t_hat, g_s (B,)`` -> ``depth_m (B, 1, H, W)``.
Paper: S4.1, Eq. 10 and 13 (eq:metric), Eq. 16 (no label).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._checks import bad_value

__all__ = ["SPACES", "AffineState", "MetricMap", "inverse_softplus", "smooth_floor"]

#: Half-width of the smooth floor, in units of the relative map (whose range is about [0, 1]).
FLOOR_EPS = 0.01


def smooth_floor(x: Tensor, eps: float = FLOOR_EPS) -> Tensor:
    """Keep ``x`` above 0 with a gradient that is never zero.

    Args:
        x: any shape, relative values, about [0, 1] but unbounded.
        eps: value at ``x = 0``; far above 0 the result exceeds ``x`` by ``eps**2 / x``.

    Returns:
        ``(x + sqrt(x^2 + 4 eps^2)) / 2``, same shape, > 0. Its slope falls only as ``(eps / x)^2``
        below 0, so that a clipped pixel can still be pulled back (a softplus would underflow).

    Source: not in the paper, which needs ``D(z) >= 0`` for Eq. 13 and never says why it would be.
    """
    return 0.5 * (x + torch.sqrt(x * x + 4.0 * eps * eps))


def inverse_softplus(y: Tensor) -> Tensor:
    """Raw value whose softplus is ``y``; ``y > 0``, any shape."""
    return y + torch.log(-torch.expm1(-y))


@dataclass(frozen=True)
class AffineState:
    """The three numbers per sample that make a relative map metric, all ``(B,)`` float32.

    Attributes:
        s_hat: raw scale, before softplus.
        t_hat: raw shift, before softplus.
        g_s: global scale; metres (depth, log, sqrt_disparity and disparity spaces alike).
    """

    s_hat: Tensor
    t_hat: Tensor
    g_s: Tensor

    @property
    def scale(self) -> Tensor:
        """``softplus(s_hat)``, dimensionless."""
        return F.softplus(self.s_hat)

    @property
    def shift(self) -> Tensor:
        """``softplus(t_hat)``, dimensionless."""
        return F.softplus(self.t_hat)


def _depth(x: Tensor, s: Tensor, t: Tensor, g: Tensor) -> Tensor:
    return g * (s * x + t)


def _disparity(x: Tensor, s: Tensor, t: Tensor, g: Tensor) -> Tensor:
    return g / (s * x + t)


def _sqrt_disparity(x: Tensor, s: Tensor, t: Tensor, g: Tensor) -> Tensor:
    return g / (s * x + t) ** 2


def _log(x: Tensor, s: Tensor, t: Tensor, g: Tensor) -> Tensor:
    return g * torch.exp(s * x + t)


#: Space in which a prior's output is affine -> its formula.
SPACES = {"depth": _depth, "disparity": _disparity, "log": _log, "sqrt_disparity": _sqrt_disparity}


@dataclass(frozen=True)
class MetricMap:
    """The metric parametrisation of one prior.

    Attributes:
        space: key of ``SPACES``: what the prior's output is affine in. With ``s = softplus(s_hat)``
            and ``t = softplus(t_hat)``: depth ``g_s (s x + t)``, disparity ``g_s / (s x + t)``,
            log ``g_s exp(s x + t)``, sqrt_disparity ``g_s / (s x + t)^2``. All positive and monotone.

    Raises:
        ValueError: unknown space.

    Source: Eq. 16 with Eq. 13 (eq:metric). Deviation: the smooth floor, and the spaces beside depth.
    """

    space: str = "depth"

    def __post_init__(self) -> None:
        if self.space not in SPACES:
            bad_value("space", f"one of {sorted(SPACES)}", repr(self.space))

    def __call__(self, x: Tensor, affine: AffineState) -> Tensor:
        """Metric depth of a relative map.

        Args:
            x: ``(B, 1, H, W)`` unclipped relative map.
            affine: per-sample scale, shift and global scale.

        Returns:
            ``(B, 1, H, W)`` metres, > 0, differentiable in ``x``, ``s_hat`` and ``t_hat``; linear in ``g_s``.
        """
        s, t, g = (v.view(-1, 1, 1, 1) for v in (affine.scale, affine.shift, affine.g_s))
        return SPACES[self.space](smooth_floor(x), s, t, g)

    def from_range(self, at_zero_m: Tensor, at_one_m: Tensor) -> AffineState:
        """The affine state under which ``x = 0`` and ``x = 1`` have the given depths.

        Args:
            at_zero_m: ``(B,)`` metres, depth of ``x = 0``; nearer than ``at_one_m`` in depth and log
                space, farther in the disparity spaces.
            at_one_m: ``(B,)`` metres, depth of ``x = 1``.

        Returns:
            State with ``g_s`` the geometric mean of the two in disparity spaces, the far value in depth
            space and a little under the near one in log space, so that scale and shift are of order 1.
        """
        a, b = at_zero_m.float(), at_one_m.float()
        if self.space == "depth":
            g = b.clone()
            t = a / g
            s = (b - a) / g
        elif self.space == "log":
            g = a * 0.9  # the shift must stay positive: log(a / g) = 0.105
            t = torch.log(a / g)
            s = torch.log(b / a)
        else:
            power = 1.0 if self.space == "disparity" else 0.5
            g = torch.sqrt(a * b)
            t = (g / a) ** power
            s = (g / b) ** power - t
        tiny = 1e-4  # a flat map is legal; softplus cannot reach 0
        return AffineState(inverse_softplus(s.clamp_min(tiny)), inverse_softplus(t.clamp_min(tiny)), g)

    def range_of(self, affine: AffineState) -> tuple[Tensor, Tensor]:
        """Depths in metres, ``(B,)`` each, of ``x = 0`` and ``x = 1``; inverse of ``from_range``."""
        s, t, g = affine.scale, affine.shift, affine.g_s
        formula = SPACES[self.space]
        return formula(torch.zeros_like(s), s, t, g), formula(torch.ones_like(s), s, t, g)
