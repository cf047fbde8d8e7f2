"""Triton kernels for window means over matches: data support, and filling of half-occlusions.

Their references are ``consistency.known_fraction`` and ``rows.with_occluded``. A program computes a few rows:
it sums along each row in the range of their windows, and adds the result to its rows whose window
includes it.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.matching import constants
from geodiff_plugin.matching.matches import HalfOcclusions, Matches

#: Rows and columns per program.
TILE = (8, 128)
# Triton kernels can read module constants only as constexpr.
_RADIUS = tl.constexpr(constants.KNOWN_RADIUS)
_ENOUGH_KNOWN = tl.constexpr(constants.ENOUGH_KNOWN)
_OCCLUDED_CONFIDENCE = tl.constexpr(constants.OCCLUDED_CONFIDENCE)
_MIN_KEPT_CONFIDENCE = tl.constexpr(constants.MIN_KEPT_CONFIDENCE)


@triton.jit
def _along(first, size, radius, COUNT: tl.constexpr):
    """Count the positions of a line within ``radius`` of each of ``COUNT`` positions from ``first``."""
    at = first + tl.arange(0, COUNT)
    return tl.minimum(at + radius, size - 1) - tl.maximum(at - radius, 0) + 1


@triton.jit
def in_window(height, width, radius, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Count the pixels inside the image in the windows of a program's tile; 1 for pixels outside."""
    down = _along(tl.program_id(0) * ROWS, height, radius, ROWS)
    across = _along(tl.program_id(1) * COLUMNS, width, radius, COLUMNS)
    return (tl.maximum(down, 1)[:, None] * tl.maximum(across, 1)[None, :]).to(tl.float32)


@triton.jit
def mean_precision(
    deviation, confidence, least, height, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):  # fmt: skip
    """Compute ``consistency._mean_precision`` of a program's tile ``(ROWS, COLUMNS)``."""
    first = tl.program_id(0) * ROWS
    row, column = first + tl.arange(0, ROWS), tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    total = tl.zeros([ROWS, COLUMNS], tl.float32)
    for y in range(tl.maximum(first - _RADIUS, 0), tl.minimum(first + ROWS + _RADIUS, height)):
        of_row = tl.zeros([COLUMNS], tl.float32)
        for right in range(-_RADIUS, _RADIUS + 1):
            x = column + right
            there = (x >= 0) & (x < width)
            sure = tl.load(confidence + y * width + x, there, 0.0)
            spread = tl.maximum(tl.load(deviation + y * width + x, there, 1.0), least)
            of_row += tl.where(sure > 0.0, tl.maximum(sure, 1.0) / (spread * spread), 0.0)
        total += tl.where((tl.abs(row - y) <= _RADIUS)[:, None], of_row[None, :], 0.0)
    return total / (in_window(height, width, _RADIUS, ROWS, COLUMNS) * _ENOUGH_KNOWN)


@triton.jit
def tile_places(height, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Return the pixels of a program's tile, and whether they are inside the image."""
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    column = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    return row[:, None] * width + column[None, :], (row < height)[:, None] & (column < width)[None, :]


# ``with_occluded`` allocates its maps contiguously, so maps of odd sizes are not aligned.
@triton.jit(do_not_specialize=["height", "width"], do_not_specialize_on_alignment=["deviation", "confidence"])
def known_kernel(
    deviation, confidence, fraction, height, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):  # fmt: skip
    """Compute ``consistency.known_fraction``. Grid: tiles down, tiles across, samples."""
    sample = tl.program_id(2) * height * width
    p, inside = tile_places(height, width, ROWS, COLUMNS)
    known = mean_precision(deviation + sample, confidence + sample, 1.0, height, width, ROWS, COLUMNS)
    tl.store(fraction + sample + p, tl.minimum(known, 1.0), inside)


@triton.jit(do_not_specialize=["height", "width"], do_not_specialize_on_alignment=["sure", "new_deviation"])
def occlusion_kernel(
    inverse_depth, confidence, deviation, occluded, background, inverse, sure, new_deviation, height, width,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Compute ``rows.with_occluded``. Grid: tiles down, tiles across."""
    p, inside = tile_places(height, width, ROWS, COLUMNS)
    known = mean_precision(deviation, confidence, 1.0, height, width, ROWS, COLUMNS)
    own = tl.load(confidence + p, inside, 0.0)
    put = (tl.load(occluded + p, inside, 0) != 0) & (own < _MIN_KEPT_CONFIDENCE)
    kept = tl.load(inverse_depth + p, inside, 0.0)
    tl.store(inverse + p, tl.where(put, tl.load(background + p, inside, 0.0), kept), inside)
    tl.store(sure + p, tl.where(put, tl.minimum(known, 1.0) * _OCCLUDED_CONFIDENCE, own), inside)
    tl.store(new_deviation + p, tl.where(put, 1.0, tl.load(deviation + p, inside, 1.0)), inside)


def tiles(size: tuple[int, int]) -> tuple[int, int]:
    """Return the number of tiles of a map, down and across."""
    return triton.cdiv(size[0], TILE[0]), triton.cdiv(size[1], TILE[1])


def known_fraction(matches: Matches) -> Tensor:
    """Run ``consistency.known_fraction`` with a kernel, for matches with a deviation."""
    assert matches.deviation is not None
    confidence = matches.confidence.contiguous()
    fraction, size = torch.empty_like(confidence), (confidence.shape[-2], confidence.shape[-1])
    samples = confidence.numel() // (size[0] * size[1])
    launched_on(fraction, known_kernel[(*tiles(size), samples)])(
        matches.deviation.contiguous(), confidence, fraction, *size, ROWS=TILE[0], COLUMNS=TILE[1]
    )
    return fraction


def with_occluded(matches: Matches, strips: HalfOcclusions) -> Matches:
    """Run ``rows.with_occluded`` with a kernel, for matches with a deviation."""
    deviation = matches.deviation
    assert deviation is not None
    maps = matches.inverse_depth, matches.confidence, deviation, strips.inside, strips.inverse_depth
    inverse, confidence, new_deviation = deviation.new_empty(3, *deviation.shape).unbind()
    launched_on(deviation, occlusion_kernel[tiles(matches.size)])(
        *(each.contiguous() for each in maps), inverse, confidence, new_deviation, *matches.size,
        ROWS=TILE[0], COLUMNS=TILE[1],
    )  # fmt: skip
    return replace(matches, inverse_depth=inverse, confidence=confidence, deviation=new_deviation)
