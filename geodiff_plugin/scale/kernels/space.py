"""Triton kernel for ``space.smooth_floor`` and both directions of ``space.MetricMap``."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.scale.affine import AffineState, MetricForm
from geodiff_plugin.scale.constants import FLOOR_EPS, KERNEL_FORMS, SQUARE

# Triton kernels can read module constants only as constexpr.
_EPS = tl.constexpr(FLOOR_EPS)
DEPTH, DISPARITY, LOG, LOG1P, SQRT_DISPARITY = (
    tl.constexpr(KERNEL_FORMS[name]) for name in ("depth", "disparity", "log", "log1p", "sqrt_disparity")
)
#: Pixels per program.
PIXELS = 1024
#: Kernel mode: ``smooth_floor``.
FLOORED = 0
#: Kernel mode: relative map to metres.
METRIC = 1
#: Kernel mode: metres to relative map.
RELATIVE = 2
_FLOORED, _METRIC = tl.constexpr(FLOORED), tl.constexpr(METRIC)


@triton.jit
def forward(v, FORM: tl.constexpr):
    """Compute ``Space.forward`` for a global scale of 1."""
    if FORM == DEPTH:
        depth = v
    elif FORM == DISPARITY:
        depth = 1.0 / v
    elif FORM == LOG:
        depth = tl.exp(v)
    elif FORM == LOG1P:
        depth = tl.exp(v) - 1.0
    else:
        depth = 1.0 / (v * v)
    return depth


@triton.jit
def inverse(depth, FORM: tl.constexpr):
    """Compute ``Space.inverse``."""
    if FORM == DEPTH:
        v = depth
    elif FORM == DISPARITY:
        v = 1.0 / depth
    elif FORM == LOG:
        v = tl.log(depth)
    elif FORM == LOG1P:
        v = tl.log(1.0 + depth)
    else:
        v = 1.0 / tl.sqrt(depth)
    return v


@triton.jit
def ends(near, far, FORM: tl.constexpr):
    """Return ``Space.ends``: swapped for spaces that fall with depth."""
    if (FORM == DISPARITY) or (FORM == SQRT_DISPARITY):  # noqa: SIM109 - Triton has no ``in``
        at_zero, at_one = far, near
    else:
        at_zero, at_one = near, far
    return at_zero, at_one


@triton.jit
def floored_of(x, CLIPPED: tl.constexpr):
    """Compute ``space.smooth_floor``, or clip to [0, 1]."""
    if CLIPPED:
        floored = tl.minimum(tl.maximum(x, 0.0), 1.0)
    else:
        root = tl.sqrt(x * x + 4.0 * _EPS * _EPS)
        floored = tl.where(x > 0.0, 0.5 * (x + root), 2.0 * _EPS * _EPS / (root - tl.minimum(x, 0.0)))
    return floored


@triton.jit
def _softplus(raw):
    """Compute ``F.softplus``; log(1 + e) for small e uses a ratio in which the rounding errors cancel."""
    e = tl.exp(tl.minimum(raw, 20.0))
    above = 1.0 + e
    return tl.where(raw > 20.0, raw, tl.where(above == 1.0, e, tl.log(above) * (e / (above - 1.0))))


@triton.jit
def map_kernel(
    x, scale, shift, unit, out, pixels,
    MODE: tl.constexpr, FORM: tl.constexpr, CLIPPED: tl.constexpr, RAW: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Run ``smooth_floor``, or ``__call__`` or ``relative`` of ``MetricMap``, as ``MODE`` selects.

    ``FORM`` is the prediction space, ``RAW`` states that scale and shift still need a softplus, and
    ``CLIPPED`` selects a hard clamp instead of a smooth floor. Grid: pixel blocks, maps.
    """
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists, of_map = pixel < pixels, tl.program_id(1)
    at = of_map.to(tl.int64) * pixels + pixel
    value = tl.load(x + at, exists, 1.0)
    if MODE == _FLOORED:
        value = floored_of(value, CLIPPED)
    else:
        s, t, g = tl.load(scale + of_map), tl.load(shift + of_map), tl.load(unit + of_map)
        if RAW:
            s, t = _softplus(s), _softplus(t)
        if MODE == _METRIC:
            value = g * forward(s * floored_of(value, CLIPPED) + t, FORM)
        else:
            value = (inverse(value / g, FORM) - t) / s
            if CLIPPED:
                value = tl.minimum(tl.maximum(value, 0.0), 1.0)
            else:
                value = tl.maximum(value, 0.5 * _EPS)
                value = value - _EPS * _EPS / value
    tl.store(out + at, value, exists)


def _convert(x: Tensor, affine: AffineState | None, mode: int, form: int, clipped: bool) -> Tensor:
    """Convert maps with their scale, shift and global scale, as far as the mode needs them."""
    x, batch, numbers, raw = x.contiguous(), 1, [x, x, x], False
    if affine is not None:
        raw, batch = affine.units is None, len(x)
        both = (affine.s_hat, affine.t_hat) if raw else (affine.scale, affine.shift)
        numbers = [each.contiguous() for each in (*both, affine.g_s)]  # expands a number shared by all maps
    out, pixels = torch.empty_like(x), x.numel() // batch
    launched_on(x, map_kernel[(triton.cdiv(pixels, PIXELS), batch)])(
        x,
        *numbers,
        out,
        pixels,
        MODE=mode,
        FORM=form,
        CLIPPED=clipped,
        RAW=raw,
        PIXELS=PIXELS,
    )
    return out


def smooth_floor(x: Tensor) -> Tensor:
    """Run ``space.smooth_floor`` with a kernel."""
    return _convert(x, None, FLOORED, 0, False)


def metric_depth(metric: MetricForm, x: Tensor, affine: AffineState) -> Tensor:
    """Run ``MetricMap.__call__`` with a kernel."""
    return _convert(x, affine, METRIC, KERNEL_FORMS[metric.space], metric.positive == SQUARE)


def relative(metric: MetricForm, depth_m: Tensor, affine: AffineState) -> Tensor:
    """Run ``MetricMap.relative`` with a kernel."""
    return _convert(depth_m, affine, RELATIVE, KERNEL_FORMS[metric.space], metric.positive == SQUARE)
