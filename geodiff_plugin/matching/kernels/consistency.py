"""Triton kernels for ``consistency``: costs at a right view's pixels, and the evidence of right views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.geometry import to_device_of
from geodiff_plugin.matching import constants
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.kernels.arithmetic import lerp, rounded
from geodiff_plugin.matching.volume import Buffers, CostVolume, Winner

# Triton kernels can read module constants only as constexpr.
_UNSEEN_LEVEL = tl.constexpr(constants.UNSEEN_LEVEL)
_LOG_ODDS = tl.constexpr(constants.LOG_ODDS)
_AGREEMENT_PLANES = tl.constexpr(constants.AGREEMENT_PLANES)
_MIN_CONTRAST = tl.constexpr(constants.MIN_CONTRAST)
_MIN_SHARPNESS = tl.constexpr(constants.MIN_SHARPNESS)
_MAX_BLUR = tl.constexpr(constants.MAX_BLUR)
_DOUBT_OF_A_PLANE = tl.constexpr(constants.DOUBT_OF_A_PLANE)
#: Pixels per program for maps.
PIXELS = 256
#: Pixels and planes per program for cost volumes.
COST_BLOCK = 32, 16


@triton.jit
def look_up_kernel(
    levels,
    lines,
    found,
    planes,
    pixels,
    height,
    width,
    levels_height,
    levels_width,
    levels_plane,
    levels_row,
    levels_column,
    BLOCK: tl.constexpr,
    PLANES: tl.constexpr,
):
    """Look up costs of BLOCK pixels on PLANES planes, at positions from ``lines (height + width, D)``."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)[:, None]
    plane = tl.program_id(1) * PLANES + tl.arange(0, PLANES)[None, :]
    used = (pixel < pixels) & (plane < planes)
    row = tl.load(lines + (pixel // width) * planes + plane, mask=used, other=0)
    column = tl.load(lines + (height + pixel % width) * planes + plane, mask=used, other=0)
    shown = used & (row < levels_height) & (column < levels_width)
    at = row.to(tl.int64) * levels_row + column.to(tl.int64) * levels_column + plane * levels_plane
    cost = tl.load(levels + at, mask=shown, other=_UNSEEN_LEVEL)
    tl.store(found + pixel.to(tl.int64) * planes + plane, cost, mask=used)


def look_up(levels: Tensor, rows: np.ndarray, columns: np.ndarray, buffers: Buffers) -> Tensor:
    """Run ``consistency._look_up`` with a kernel; needs no buffers."""
    planes, *size = levels.shape
    height, width = rows.shape[1], columns.shape[1]
    found = torch.empty(height, width, planes, dtype=levels.dtype, device=levels.device)
    lines = to_device_of(levels, np.concatenate([rows, columns], axis=1).T.astype(np.int32))
    grid = triton.cdiv(height * width, COST_BLOCK[0]), triton.cdiv(planes, COST_BLOCK[1])
    launched_on(levels, look_up_kernel[grid])(
        levels,
        lines,
        found,
        planes,
        height * width,
        height,
        width,
        *size,
        *levels.stride(),
        BLOCK=COST_BLOCK[0],
        PLANES=COST_BLOCK[1],
        num_warps=4,
    )
    return found.permute(2, 0, 1)


@triton.jit
def assess_kernel(
    position_in, best_in, second_best_in, contrast_in, sharpness_in, other, warp, valid, out,
    planes, pixels, width, other_rows, other_row, canvas_height, canvas_width, valid_row,
    first_inverse_depth, plane_step, sum_unit,
    FIRST: tl.constexpr, HAS_VALID: tl.constexpr, EVERY_ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Compute a right view's evidence for the winners of BLOCK pixels, combined with the previous views.

    ``out`` holds confidence, deviation and inverse depth. ``warp (3, planes)`` holds the scale of every
    plane, and its shift along columns and rows.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    used = pixel < pixels
    row, column = (pixel // width).to(tl.float32), (pixel % width).to(tl.float32)
    position = tl.load(position_in + pixel, mask=used, other=0.0)
    below = tl.minimum(tl.maximum(tl.floor(position).to(tl.int32), 0), planes - 2)
    part = position - below.to(tl.float32)
    scale = lerp(tl.load(warp + below), tl.load(warp + below + 1), part)
    to_side = lerp(tl.load(warp + planes + below), tl.load(warp + planes + below + 1), part)
    down = lerp(tl.load(warp + 2 * planes + below), tl.load(warp + 2 * planes + below + 1), part)
    at_column, at_row = rounded(scale * column + to_side), rounded(scale * row + down)
    inside = used & (scale > 0) & (at_column >= 0) & (at_column <= canvas_width - 1)
    inside &= (at_row >= 0) & (at_row <= canvas_height - 1)
    there = tl.where(inside, at_column, 0.0).to(tl.int32)
    line = tl.where(inside, at_row, 0.0).to(tl.int32)
    if HAS_VALID:
        inside &= tl.load(valid + line * valid_row + there, mask=inside, other=0) != 0
    before, after = line // EVERY_ROW, tl.minimum((line + EVERY_ROW - 1) // EVERY_ROW, other_rows - 1)
    there_before = tl.load(other + before * other_row + there, mask=inside, other=0.0)
    there_after = tl.load(other + after * other_row + there, mask=inside, other=0.0)
    difference = tl.where(inside, tl.abs(0.5 * (there_before + there_after) - position), float("inf"))

    best = tl.load(best_in + pixel, mask=used, other=0.0)
    second_best = tl.load(second_best_in + pixel, mask=used, other=0.0)
    contrast = tl.load(contrast_in + pixel, mask=used, other=0.0)
    sharpness = tl.load(sharpness_in + pixel, mask=used, other=0.0)
    cost = tl.minimum(tl.maximum(best * sum_unit, 0.0), 0.8)
    margin = tl.minimum(tl.maximum((second_best - best) * sum_unit, 0.0), 0.5)
    odds = tl.log(margin + 0.03) * _LOG_ODDS[1] + _LOG_ODDS[0] + cost * _LOG_ODDS[2]
    odds += tl.minimum(difference, _AGREEMENT_PLANES) * _LOG_ODDS[3]
    probability = tl.sigmoid(odds) * tl.minimum(contrast / _MIN_CONTRAST, 1.0)
    confidence = tl.where(difference <= _AGREEMENT_PLANES, probability, 0.0)
    if not FIRST:
        confidence = tl.maximum(confidence, tl.load(out + pixel, mask=used, other=0.0))
    blur = 1.0 / tl.maximum(sharpness / _MIN_SHARPNESS, 1.0 / _MAX_BLUR)
    deviation = tl.sqrt((1.0 - confidence) / _DOUBT_OF_A_PLANE) * tl.maximum(blur, 1.0)
    tl.store(out + pixel, confidence, mask=used)
    tl.store(out + pixels + pixel, deviation, mask=used)
    tl.store(out + 2 * pixels + pixel, first_inverse_depth + position * plane_step, mask=used)


def assess(volume: CostVolume, found: Winner, means: Tensor, others: Sequence[Tensor]) -> Tensor:
    """Compute confidence, deviation and inverse depth of ``consistency.match_volume``, ``(3, H, W)``.

    ``found`` are the left view's winners, ``means (2, H, W)`` their contrast and sharpness, ``others`` the
    right views' winners.
    """
    out = torch.empty(3, *volume.size, dtype=torch.float32, device=means.device)
    pixels = volume.size[0] * volume.size[1]
    for number, (view, other) in enumerate(zip(volume.aligned, others, strict=True)):
        warp = np.concatenate([view.scale[None], view.shift.T]).astype(np.float32)
        valid = out if view.valid is None else view.valid
        launched_on(out, assess_kernel[(triton.cdiv(pixels, PIXELS),)])(
            found.position,
            found.best,
            found.second_best,
            means[0],
            means[1],
            other,
            to_device_of(out, warp),
            valid,
            out,
            len(view.scale),
            pixels,
            volume.size[1],
            len(other),
            other.stride(0),
            *view.size,
            valid.stride(0),
            float(volume.inverse_depth[0]),
            float(volume.plane_step),
            1.0 / (constants.PATHS * COST_LEVELS),
            FIRST=number == 0,
            HAS_VALID=view.valid is not None,
            EVERY_ROW=constants.EVERY_ROW,
            BLOCK=PIXELS,
            num_warps=4,
            enable_fp_fusion=False,
        )
    return out
