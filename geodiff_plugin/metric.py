"""Turn a relative map into metres: an affine map with positive scale and shift, times a global scale.

Hop: ``x (B, 1, H, W)`` unclipped relative map, ``s_hat, t_hat, g_s (B,)`` -> ``depth_m (B, 1, H, W)``.
Paper: S4.1, Eq. 10 and 13 (eq:metric), Eq. 16 (no label); ``square`` is Marigold-DC's (its Eq. 2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._checks import check_choice

__all__ = [
    "GROWS_WITH_DEPTH",
    "POSITIVE",
    "SPACES",
    "AffineState",
    "MetricMap",
    "SquareAffine",
    "inverse_softplus",
    "smooth_floor",
]

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
        g_s: global scale; metres, in every space.
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


@dataclass(frozen=True)
class SquareAffine(AffineState):
    """Scale and shift as squares that start at 1, as Marigold-DC has them.

    Attributes:
        unit_scale: ``(B,)`` what a raw scale of 1 stands for.
        unit_shift: ``(B,)`` the same for the shift.
    """

    unit_scale: Tensor
    unit_shift: Tensor

    @property
    def scale(self) -> Tensor:
        """``s_hat^2 unit_scale``, dimensionless."""
        return self.s_hat**2 * self.unit_scale

    @property
    def shift(self) -> Tensor:
        """``t_hat^2 unit_shift``, dimensionless."""
        return self.t_hat**2 * self.unit_shift


def _depth(x: Tensor, s: Tensor, t: Tensor, g: Tensor) -> Tensor:
    return g * (s * x + t)


def _disparity(x: Tensor, s: Tensor, t: Tensor, g: Tensor) -> Tensor:
    return g / (s * x + t)


def _sqrt_disparity(x: Tensor, s: Tensor, t: Tensor, g: Tensor) -> Tensor:
    return g / (s * x + t) ** 2


def _log(x: Tensor, s: Tensor, t: Tensor, g: Tensor) -> Tensor:
    return g * torch.exp(s * x + t)


def _log1p(x: Tensor, s: Tensor, t: Tensor, g: Tensor) -> Tensor:
    return g * torch.expm1(s * x + t)


#: Space in which a prior's output is affine -> its formula.
SPACES = {
    "depth": _depth,
    "disparity": _disparity,
    "log": _log,
    "log1p": _log1p,
    "sqrt_disparity": _sqrt_disparity,
}
#: What ``s x + t`` is at a depth in units of g_s: the inverses of the formulas.
_INVERSES: dict[str, Callable[[Tensor], Tensor]] = {
    "depth": lambda units: units,
    "disparity": torch.reciprocal,
    "log": torch.log,
    "log1p": torch.log1p,
    "sqrt_disparity": torch.rsqrt,
}
#: Those in which a greater value is farther away.
GROWS_WITH_DEPTH = frozenset({"depth", "log", "log1p"})


#: How raw scale and shift become positive, and what keeps the relative map in its range with it.
POSITIVE = ("softplus", "square")


@dataclass(frozen=True)
class MetricMap:
    """The metric parametrisation of one prior.

    Attributes:
        space: key of ``SPACES``: what the prior's output is affine in. With ``s = softplus(s_hat)``
            and ``t = softplus(t_hat)``: depth ``g_s (s x + t)``, disparity ``g_s / (s x + t)``,
            log ``g_s exp(s x + t)``, log1p ``g_s (exp(s x + t) - 1)``, sqrt_disparity
            ``g_s / (s x + t)^2``. All positive and monotone.
        positive: ``"softplus"`` with the smooth floor, or ``"square"`` with ``x`` clipped to [0, 1], whose
            gradient is zero where it clips.

    Raises:
        ValueError: unknown space or ``positive``.

    Source: Eq. 16 with Eq. 13 (eq:metric). Deviation: the smooth floor, and the spaces beside depth.
    """

    space: str = "depth"
    positive: str = "softplus"

    def __post_init__(self) -> None:
        check_choice(self.space, "space", SPACES)
        check_choice(self.positive, "positive", POSITIVE)

    def confine(self, x: Tensor) -> Tensor:
        """``x`` as it may be resampled: clipped with ``"square"``, as it is with ``"softplus"``."""
        return x.clamp(0.0, 1.0) if self.positive == "square" else x

    def __call__(self, x: Tensor, affine: AffineState) -> Tensor:
        """Metric depth of a relative map.

        Args:
            x: ``(B, 1, H, W)`` unclipped relative map.
            affine: per-sample scale, shift and global scale.

        Returns:
            ``(B, 1, H, W)`` metres, > 0, differentiable in ``x``, ``s_hat`` and ``t_hat``; linear in ``g_s``.
        """
        s, t, g = (v.view(-1, 1, 1, 1) for v in (affine.scale, affine.shift, affine.g_s))
        confined = self.confine(x) if self.positive == "square" else smooth_floor(x)
        return SPACES[self.space](confined, s, t, g)

    def relative(self, depth_m: Tensor, affine: AffineState) -> Tensor:
        """The relative map of a metric depth; inverse of the call.

        Args:
            depth_m: ``(B, 1, H, W)`` metres, > 0.
            affine: per-sample scale, shift and global scale.

        Returns:
            ``(B, 1, H, W)``; below 0 no further than where the smooth floor has lost half of its height.
        """
        s, t, g = (v.view(-1, 1, 1, 1) for v in (affine.scale, affine.shift, affine.g_s))
        floored = (_INVERSES[self.space](depth_m / g) - t) / s
        if self.positive == "square":
            return self.confine(floored)
        floored = floored.clamp_min(0.5 * FLOOR_EPS)
        return floored - FLOOR_EPS**2 / floored

    def from_range(self, at_zero_m: Tensor, at_one_m: Tensor) -> AffineState:
        """The affine state under which ``x = 0`` and ``x = 1`` have the given depths.

        Args:
            at_zero_m: ``(B,)`` metres, depth of ``x = 0``; nearer than ``at_one_m`` in depth and log
                spaces, farther in the disparity spaces.
            at_one_m: ``(B,)`` metres, depth of ``x = 1``.

        Returns:
            State with ``g_s`` the geometric mean of the two in disparity spaces, the far value in depth
            space, a little under the near one in log space, so that scale and shift are of order 1, and
            1 m in log1p space, where the 1 is a metre.
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
        elif self.space == "log1p":
            g = torch.ones_like(a)
            t = torch.log1p(a)
            s = torch.log1p(b) - t
        else:
            power = 1.0 if self.space == "disparity" else 0.5
            g = torch.sqrt(a * b)
            t = (g / a) ** power
            s = (g / b) ** power - t
        tiny = 1e-4  # a flat map is legal; softplus cannot reach 0
        s, t = s.clamp_min(tiny), t.clamp_min(tiny)
        if self.positive == "square":
            return SquareAffine(torch.ones_like(s), torch.ones_like(t), g, s, t)
        return AffineState(inverse_softplus(s), inverse_softplus(t), g)

    def range_of(self, affine: AffineState) -> tuple[Tensor, Tensor]:
        """Depths in metres, ``(B,)`` each, of ``x = 0`` and ``x = 1``; inverse of ``from_range``."""
        s, t, g = affine.scale, affine.shift, affine.g_s
        formula = SPACES[self.space]
        return formula(torch.zeros_like(s), s, t, g), formula(torch.ones_like(s), s, t, g)
