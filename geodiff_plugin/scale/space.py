"""Converts a relative map to metres by an affine map with positive scale and shift, times a global scale.

S4.1, Eq. 10 and 13 (eq:metric), Eq. 16 (no label). ``square`` is Marigold-DC's (its Eq. 2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from geodiff_plugin._internal.checks import check_choice
from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin.scale.affine import AffineState
from geodiff_plugin.scale.constants import FLOOR_EPS, KERNEL_FORMS, MIN_SHIFT_FRACTION, SQUARE


def _is_float32_without_gradient(*tensors: Tensor) -> bool:
    """Return whether a kernel, which supports only float32 without gradients, can be used."""
    with_gradient = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    return tensors[0].dtype == torch.float32 and not with_gradient


def _has_form(metric: MetricMap, maps: Tensor, affine: AffineState) -> bool:
    """Return whether a kernel can compute maps that each have a scale, shift and global scale."""
    numbers = affine.s_hat, affine.t_hat, affine.g_s
    is_one_each = all(number.shape == maps.shape[:1] for number in numbers)
    return metric.space in KERNEL_FORMS and is_one_each and _is_float32_without_gradient(maps, *numbers)


@has_kernel("scale.kernels.space.smooth_floor", when=_is_float32_without_gradient)
def smooth_floor(x: Tensor) -> Tensor:
    """Keep relative values ``x``, about [0, 1] but unbounded, above 0 with a non-zero gradient.

    ``(x + sqrt(x^2 + 4 eps^2)) / 2``, with ``FLOOR_EPS`` for eps. Below 0 the slope falls only as ``(eps /
    x)^2``, so that a clipped pixel can still recover (a softplus would underflow). Not in the paper; Eq. 13
    needs ``D(z) >= 0``.
    """
    root = torch.sqrt(x * x + 4.0 * FLOOR_EPS * FLOOR_EPS)
    # Below 0 the sum would cancel, and neighbouring values would become equal in float32.
    return torch.where(x > 0, 0.5 * (x + root), 2.0 * FLOOR_EPS * FLOOR_EPS / (root - x.clamp_max(0.0)))


def inverse_smooth_floor(y: Tensor) -> Tensor:
    """Return the value whose ``smooth_floor`` is ``y``; at least ``-1.5 FLOOR_EPS``, also for lower ``y``."""
    y = y.clamp_min(0.5 * FLOOR_EPS)
    return y - FLOOR_EPS**2 / y


def inverse_softplus(y: Tensor) -> Tensor:
    """Return the raw value whose softplus is ``y``; ``y > 0``, any shape."""
    return y + torch.log(-torch.expm1(-y))


def cat_samples(parts: Sequence[Tensor]) -> Tensor:
    """Concatenate tensors along the first axis; a single one is not copied."""
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


class DepthRange(NamedTuple):
    """Depths of the nearest and farthest end of maps, metres ``(B,)``.

    ``on_edge (B,)`` bool is true if an end is on the edge of the searched range; ``None`` without a search.
    """

    near_m: Tensor
    far_m: Tensor
    on_edge: Tensor | None = None

    def of(self, samples: slice) -> DepthRange:
        """Return the range of some samples."""
        on_edge = None if self.on_edge is None else self.on_edge[samples]
        return DepthRange(self.near_m[samples], self.far_m[samples], on_edge)


@dataclass(frozen=True)
class PriorMaps:
    """Known properties of the relative maps of some samples, from the prior that makes them."""

    space: str  # space in which the maps are affine, key of ``SPACES``
    valid: Tensor | None = None  # (B, 1, h, w) bool, where the maps are defined; ``None``: everywhere
    depth_range: DepthRange | None = None  # of a metric prior
    given: bool = False  # whether the maps are the user's, and the same at every step
    own_range: DepthRange | None = None  # of given maps if they are in metres; NaN if they cannot be


@dataclass(frozen=True)
class Space:
    """Space in which a prior's output is affine: ``v = s x + t`` is a function of depth in units of g_s.

    ``forward(v, g_s)`` gives metres; it is monotone, linear in ``g_s``, and > 0 for every ``v > 0``.
    ``inverse`` maps depth in units of g_s to ``v``. ``from_ends`` gives scale and shift, both of order 1, and
    g_s of the map with the given metres at ``x = 0`` and ``x = 1``.
    """

    forward: Callable[[Tensor, Tensor], Tensor]
    inverse: Callable[[Tensor], Tensor]
    grows_with_depth: bool
    from_ends: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]

    def ends(self, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """Return the depths at ``x = 0`` and ``1`` from ``(near, far)``, or vice versa; x may fall."""
        return (near, far) if self.grows_with_depth else (far, near)

    def range_of(self, scale: Tensor, shift: Tensor, g_s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nearest and farthest depth, metres, of a map with a scale and shift."""
        return self.ends(self.forward(shift, g_s), self.forward(scale + shift, g_s))

    def depth_at(self, x: Tensor, near: Tensor, far: Tensor) -> Tensor:
        """Compute metres at values ``x (..., P)`` for ranges ``(..., 1)``; monotone between near and far."""
        at_zero, at_one = (self.inverse(end) for end in self.ends(near, far))
        return self.forward(at_zero + (at_one - at_zero) * x, torch.ones_like(at_zero))


def _depth_ends(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return (b - a) / b, a / b, b


def _disparity_ends(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    g = torch.sqrt(a * b)
    return g / b - g / a, g / a, g


def _sqrt_disparity_ends(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    g = torch.sqrt(a * b)
    t = torch.sqrt(g / a)
    return torch.sqrt(g / b) - t, t, g


def _log_ends(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    g = a * 0.9  # the shift must stay positive: log(a / g) = 0.105
    return torch.log(b / a), torch.log(a / g), g


def _log1p_ends(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    t = torch.log1p(a)
    return torch.log1p(b) - t, t, torch.ones_like(a)  # the 1 is a metre


#: Formulas by the space in which a prior's output is affine. A new space is one entry.
SPACES: dict[str, Space] = {
    "depth": Space(lambda v, g: g * v, lambda units: units, True, _depth_ends),
    "disparity": Space(lambda v, g: g / v, torch.reciprocal, False, _disparity_ends),
    "log": Space(lambda v, g: g * torch.exp(v), torch.log, True, _log_ends),
    "log1p": Space(lambda v, g: g * torch.expm1(v), torch.log1p, True, _log1p_ends),
    "sqrt_disparity": Space(lambda v, g: g / v**2, torch.rsqrt, False, _sqrt_disparity_ends),
}


@dataclass(frozen=True)
class MetricMap:
    """The metric parametrisation of a prior whose map is affine in ``space``, a key of ``SPACES``.

    With ``s = softplus(s_hat)`` and ``t = softplus(t_hat)``: depth ``g_s (s x + t)``, disparity ``g_s / (s x
    + t)``, log ``g_s exp(s x + t)``, log1p ``g_s (exp(s x + t) - 1)``, sqrt_disparity ``g_s / (s x + t)^2``.
    All are positive and monotone. ``positive`` is ``"softplus"`` with the smooth floor, or ``"square"`` with
    ``x`` clipped to [0, 1], where the gradient is zero if it clips. ``InputError`` for an unknown space.

    Source: Eq. 16 with Eq. 13 (eq:metric). Deviation: the smooth floor, and the spaces other than depth.
    """

    space: str = "depth"
    positive: str = "softplus"

    def __post_init__(self) -> None:
        check_choice(self.space, "space", SPACES)

    def confine(self, x: Tensor) -> Tensor:
        """Prepare ``x`` for resampling: clipped with ``"square"``, unchanged with ``"softplus"``."""
        return x.clamp(0.0, 1.0) if self.positive == SQUARE else x

    @has_kernel("scale.kernels.space.metric_depth", when=_has_form)
    def __call__(self, x: Tensor, affine: AffineState) -> Tensor:
        """Convert an unclipped relative map ``x (B, 1, H, W)`` to metric depth ``(B, 1, H, W)``, metres, > 0.

        Differentiable in ``x``, ``s_hat`` and ``t_hat``; linear in ``g_s``.
        """
        s, t, g = (v.view(-1, 1, 1, 1) for v in (affine.scale, affine.shift, affine.g_s))
        confined = self.confine(x) if self.positive == SQUARE else smooth_floor(x)
        return SPACES[self.space].forward(s * confined + t, g)

    @has_kernel("scale.kernels.space.relative", when=_has_form)
    def relative(self, depth_m: Tensor, affine: AffineState) -> Tensor:
        """Convert metric depth ``(B, 1, H, W)`` to the relative map; inverse of the call."""
        s, t, g = (v.view(-1, 1, 1, 1) for v in (affine.scale, affine.shift, affine.g_s))
        floored = (SPACES[self.space].inverse(depth_m / g) - t) / s
        if self.positive == SQUARE:
            return self.confine(floored)
        return inverse_smooth_floor(floored)

    def from_range(self, near_m: Tensor, far_m: Tensor) -> AffineState:
        """Return the affine state for which the ends of a map have the given depths, ``(B,)`` metres."""
        s, t, g = SPACES[self.space].from_ends(*SPACES[self.space].ends(near_m.float(), far_m.float()))
        both = torch.stack([s, t]).clamp_min(MIN_SHIFT_FRACTION)
        if self.positive == SQUARE:
            s, t = both.unbind()
            return AffineState(torch.ones_like(s), torch.ones_like(t), g, (s, t))
        s_hat, t_hat = inverse_softplus(both).unbind()
        return AffineState(s_hat, t_hat, g)

    def range_of(self, affine: AffineState) -> tuple[Tensor, Tensor]:
        """Return nearest and farthest depth in metres, ``(B,)`` each; inverse of ``from_range``."""
        return SPACES[self.space].range_of(affine.scale, affine.shift, affine.g_s)
