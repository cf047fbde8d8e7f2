"""From a relative map to metres: an affine map with positive scale and shift, times a global scale.

S4.1, Eq. 10 and 13 (eq:metric), Eq. 16 (no label); ``square`` is Marigold-DC's (its Eq. 2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._checks import check_choice
from geodiff_plugin._kernels import use_kernel

#: Half-width of the smooth floor, in units of the relative map (whose range is about [0, 1]): so small that a
#: street from 6 to 330 m gains a third of a metre at its nearest point and nothing elsewhere.
FLOOR_EPS = 0.001
#: Least scale and shift of a range: a flat map is legal, and a softplus cannot reach 0.
LEAST_SHARE = 1e-4


def _by_kernel(*tensors: Tensor) -> bool:
    """Whether a formula of tensors runs by its kernel, which has no gradient and no other type."""
    with_gradient = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    return use_kernel(tensors[0]) and tensors[0].dtype == torch.float32 and not with_gradient


def smooth_floor(x: Tensor) -> Tensor:
    """Keep relative values ``x``, about [0, 1] but unbounded, above 0 with a gradient that is never zero.

    ``(x + sqrt(x^2 + 4 eps^2)) / 2``, with ``FLOOR_EPS`` for eps. Below 0 its slope falls only as ``(eps /
    x)^2``, so that a clipped pixel can still be pulled back (a softplus would underflow). Not in the paper;
    Eq. 13 needs ``D(z) >= 0``.
    """
    if _by_kernel(x):
        from geodiff_plugin.scale import kernels

        return kernels.floored(x)
    root = torch.sqrt(x * x + 4.0 * FLOOR_EPS * FLOOR_EPS)
    # Below 0 the sum would cancel, and neighbouring values become equal in float32.
    return torch.where(x > 0, 0.5 * (x + root), 2.0 * FLOOR_EPS * FLOOR_EPS / (root - x.clamp_max(0.0)))


def inverse_softplus(y: Tensor) -> Tensor:
    """Raw value whose softplus is ``y``; ``y > 0``, any shape."""
    return y + torch.log(-torch.expm1(-y))


def joined(parts: Sequence[Tensor]) -> Tensor:
    """Tensors along the first axis; a single one is not copied."""
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


@dataclass(frozen=True)
class AffineState:
    """The three numbers per sample that make a relative map metric, all ``(B,)`` float32.

    ``s_hat`` and ``t_hat`` are raw scale and shift, ``g_s`` is the global scale, metres. Scale and shift are
    their softplus, or, as in Marigold-DC, their squares times ``units``, what raw values of 1 stand for.
    """

    s_hat: Tensor
    t_hat: Tensor
    g_s: Tensor
    units: tuple[Tensor, Tensor] | None = None

    def of(self, samples: slice) -> Self:
        """The state of some samples."""
        units = None if self.units is None else (self.units[0][samples], self.units[1][samples])
        return type(self)(self.s_hat[samples], self.t_hat[samples], self.g_s[samples], units)

    @property
    def scale(self) -> Tensor:
        """``softplus(s_hat)``, or ``s_hat^2`` times its unit; dimensionless."""
        return F.softplus(self.s_hat) if self.units is None else self.s_hat**2 * self.units[0]

    @property
    def shift(self) -> Tensor:
        """``softplus(t_hat)``, or ``t_hat^2`` times its unit; dimensionless."""
        return F.softplus(self.t_hat) if self.units is None else self.t_hat**2 * self.units[1]


class DepthRange(NamedTuple):
    """Metres ``(B,)`` of the nearest and of the farthest end of maps.

    ``on_edge (B,)`` bool says whether they lie on the edge of what was searched; ``None``: not searched.
    """

    near_m: Tensor
    far_m: Tensor
    on_edge: Tensor | None = None

    def of(self, samples: slice) -> DepthRange:
        """The range of some samples."""
        on_edge = None if self.on_edge is None else self.on_edge[samples]
        return DepthRange(self.near_m[samples], self.far_m[samples], on_edge)


@dataclass(frozen=True)
class PriorMaps:
    """What is known beforehand of the relative maps of some samples, from the prior that makes them."""

    space: str  # what they are affine in, key of ``SPACES``
    valid: Tensor | None = None  # (B, 1, h, w) bool, where they say something; ``None`` for everywhere
    depth_range: DepthRange | None = None  # a metric prior's


class Affine(NamedTuple):
    """Scale, shift and global scale (metres) of an affine map, all > 0; ``(B,)`` each."""

    scale: Tensor
    shift: Tensor
    g_s: Tensor


@dataclass(frozen=True)
class Space:
    """What a prior's output is affine in: ``v = s x + t`` is a function of depth in units of g_s.

    ``forward`` gives metres of ``v, g_s``: monotone, linear in ``g_s``, > 0 for every ``v > 0``; ``inverse``
    is from depth in units of g_s to ``v``; ``from_ends`` gives the affine map, of scale and shift of order 1,
    that has given metres at ``x = 0`` and ``x = 1``.
    """

    forward: Callable[[Tensor, Tensor], Tensor]
    inverse: Callable[[Tensor], Tensor]
    grows_with_depth: bool
    from_ends: Callable[[Tensor, Tensor], Affine]

    def ends(self, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """The depths at ``x = 0`` and ``x = 1`` from ``(near, far)``, and the reverse: swapped if x falls."""
        return (near, far) if self.grows_with_depth else (far, near)

    def range_of(self, scale: Tensor, shift: Tensor, g_s: Tensor) -> tuple[Tensor, Tensor]:
        """Metres of the nearest and of the farthest end of a map under a scale and a shift."""
        return self.ends(self.forward(shift, g_s), self.forward(scale + shift, g_s))

    def depth_at(self, x: Tensor, near: Tensor, far: Tensor) -> Tensor:
        """Metres at relative values ``x (..., P)`` of ranges ``(..., 1)``; monotone between near and far."""
        at_zero, at_one = (self.inverse(end) for end in self.ends(near, far))
        return self.forward(at_zero + (at_one - at_zero) * x, torch.ones_like(at_zero))


def _depth_ends(a: Tensor, b: Tensor) -> Affine:
    return Affine((b - a) / b, a / b, b)


def _disparity_ends(a: Tensor, b: Tensor) -> Affine:
    g = torch.sqrt(a * b)
    return Affine(g / b - g / a, g / a, g)


def _sqrt_disparity_ends(a: Tensor, b: Tensor) -> Affine:
    g = torch.sqrt(a * b)
    t = torch.sqrt(g / a)
    return Affine(torch.sqrt(g / b) - t, t, g)


def _log_ends(a: Tensor, b: Tensor) -> Affine:
    g = a * 0.9  # the shift must stay positive: log(a / g) = 0.105
    return Affine(torch.log(b / a), torch.log(a / g), g)


def _log1p_ends(a: Tensor, b: Tensor) -> Affine:
    t = torch.log1p(a)
    return Affine(torch.log1p(b) - t, t, torch.ones_like(a))  # the 1 is a metre


#: Space in which a prior's output is affine -> its formulas. A new space is one entry.
SPACES: dict[str, Space] = {
    "depth": Space(lambda v, g: g * v, lambda units: units, True, _depth_ends),
    "disparity": Space(lambda v, g: g / v, torch.reciprocal, False, _disparity_ends),
    "log": Space(lambda v, g: g * torch.exp(v), torch.log, True, _log_ends),
    "log1p": Space(lambda v, g: g * torch.expm1(v), torch.log1p, True, _log1p_ends),
    "sqrt_disparity": Space(lambda v, g: g / v**2, torch.rsqrt, False, _sqrt_disparity_ends),
}

#: Spaces whose formula the kernels have, and its number there; in another one the reference runs.
KERNEL_FORMS = {"depth": 0, "disparity": 1, "log": 2, "log1p": 3, "sqrt_disparity": 4}

#: Field ``positive`` of the configuration that squares instead of taking the softplus.
SQUARE = "square"


@dataclass(frozen=True)
class MetricMap:
    """The metric parametrisation of one prior, whose map is affine in ``space``, a key of ``SPACES``.

    With ``s = softplus(s_hat)`` and ``t = softplus(t_hat)``: depth ``g_s (s x + t)``, disparity ``g_s / (s x
    + t)``, log ``g_s exp(s x + t)``, log1p ``g_s (exp(s x + t) - 1)``, sqrt_disparity ``g_s / (s x + t)^2``.
    All positive and monotone. ``positive`` is ``"softplus"`` with the smooth floor, or ``"square"`` with
    ``x`` clipped to [0, 1], whose gradient is zero where it clips. ``InputError`` for an unknown space.

    Source: Eq. 16 with Eq. 13 (eq:metric). Deviation: the smooth floor, and the spaces beside depth.
    """

    space: str = "depth"
    positive: str = "softplus"

    def __post_init__(self) -> None:
        check_choice(self.space, "space", SPACES)

    def _by_kernel(self, maps: Tensor, affine: AffineState) -> bool:
        """Whether maps, each with its scale, shift and global scale, are made by the kernel."""
        numbers = affine.s_hat, affine.t_hat, affine.g_s
        is_one_each = all(number.shape == maps.shape[:1] for number in numbers)
        return self.space in KERNEL_FORMS and is_one_each and _by_kernel(maps, *numbers)

    def confine(self, x: Tensor) -> Tensor:
        """``x`` ready to be resampled: clipped with ``"square"``, unchanged with ``"softplus"``."""
        return x.clamp(0.0, 1.0) if self.positive == SQUARE else x

    def __call__(self, x: Tensor, affine: AffineState) -> Tensor:
        """Metric depth ``(B, 1, H, W)`` of an unclipped relative map ``x (B, 1, H, W)``, metres, > 0.

        Differentiable in ``x``, ``s_hat`` and ``t_hat``; linear in ``g_s``.
        """
        if self._by_kernel(x, affine):
            from geodiff_plugin.scale import kernels

            return kernels.metric_depth(x, affine, self)
        s, t, g = (v.view(-1, 1, 1, 1) for v in (affine.scale, affine.shift, affine.g_s))
        confined = self.confine(x) if self.positive == SQUARE else smooth_floor(x)
        return SPACES[self.space].forward(s * confined + t, g)

    def relative(self, depth_m: Tensor, affine: AffineState) -> Tensor:
        """The relative map of a metric depth ``(B, 1, H, W)``; inverse of the call, bounded below 0."""
        if self._by_kernel(depth_m, affine):
            from geodiff_plugin.scale import kernels

            return kernels.relative(depth_m, affine, self)
        s, t, g = (v.view(-1, 1, 1, 1) for v in (affine.scale, affine.shift, affine.g_s))
        floored = (SPACES[self.space].inverse(depth_m / g) - t) / s
        if self.positive == SQUARE:
            return self.confine(floored)
        floored = floored.clamp_min(0.5 * FLOOR_EPS)
        return floored - FLOOR_EPS**2 / floored

    def from_range(self, near_m: Tensor, far_m: Tensor) -> AffineState:
        """The affine state under which the two ends of a map have the depths, ``(B,)`` metres."""
        s, t, g = SPACES[self.space].from_ends(*SPACES[self.space].ends(near_m.float(), far_m.float()))
        both = torch.stack([s, t]).clamp_min(LEAST_SHARE)
        if self.positive == SQUARE:
            s, t = both.unbind()
            return AffineState(torch.ones_like(s), torch.ones_like(t), g, (s, t))
        s_hat, t_hat = inverse_softplus(both).unbind()
        return AffineState(s_hat, t_hat, g)

    def range_of(self, affine: AffineState) -> tuple[Tensor, Tensor]:
        """Nearest and farthest depth in metres, ``(B,)`` each; inverse of ``from_range``."""
        return SPACES[self.space].range_of(affine.scale, affine.shift, affine.g_s)
