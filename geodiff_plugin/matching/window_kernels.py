"""Triton kernels of means over windows of matches: what they know, and what fills the strips they cannot see.

Their references are ``consistency.known_share`` and ``rows.with_hidden``. A program makes a few rows: it sums
every row that their windows reach along the row, and adds that to those of its rows that reach it. This
module is imported only where ``use_kernel`` says so, because it imports Triton.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.matching import consistency, rows
from geodiff_plugin.matching.matches import Matches

#: Rows and columns of a program.
TILE = (8, 128)
# A kernel reads constants of its module only as these.
_REACH = tl.constexpr(consistency.KNOWN_REACH)
_ENOUGH_KNOWN = tl.constexpr(consistency.ENOUGH_KNOWN)
_HIDDEN_CONFIDENCE = tl.constexpr(rows.HIDDEN_CONFIDENCE)
_LEAST_KEPT = tl.constexpr(rows.LEAST_KEPT)


@triton.jit
def _along(first, size, reach, COUNT: tl.constexpr):
    """How many places of a line lie within ``reach`` of each of some that begin at ``first``."""
    at = first + tl.arange(0, COUNT)
    return tl.minimum(at + reach, size - 1) - tl.maximum(at - reach, 0) + 1


@triton.jit
def in_window(height, width, reach, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """How many pixels the windows of a program's tile have inside the image; 1 for pixels that it has not."""
    down = _along(tl.program_id(0) * ROWS, height, reach, ROWS)
    across = _along(tl.program_id(1) * COLUMNS, width, reach, COLUMNS)
    return (tl.maximum(down, 1)[:, None] * tl.maximum(across, 1)[None, :]).to(tl.float32)


@triton.jit
def mean_precision(
    deviation, confidence, least, height, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):  # fmt: skip
    """``consistency._mean_precision`` of the tile ``(ROWS, COLUMNS)`` of a program."""
    first = tl.program_id(0) * ROWS
    row, column = first + tl.arange(0, ROWS), tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    total = tl.zeros([ROWS, COLUMNS], tl.float32)
    for y in range(tl.maximum(first - _REACH, 0), tl.minimum(first + ROWS + _REACH, height)):
        of_row = tl.zeros([COLUMNS], tl.float32)
        for right in range(-_REACH, _REACH + 1):
            x = column + right
            there = (x >= 0) & (x < width)
            sure = tl.load(confidence + y * width + x, there, 0.0)
            spread = tl.maximum(tl.load(deviation + y * width + x, there, 1.0), least)
            of_row += tl.where(sure > 0.0, tl.maximum(sure, 1.0) / (spread * spread), 0.0)
        total += tl.where((tl.abs(row - y) <= _REACH)[:, None], of_row[None, :], 0.0)
    return total / (in_window(height, width, _REACH, ROWS, COLUMNS) * _ENOUGH_KNOWN)


@triton.jit
def tile_places(height, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """The pixels of a program's tile, and whether they are there."""
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    column = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    return row[:, None] * width + column[None, :], (row < height)[:, None] & (column < width)[None, :]


# ``with_hidden`` makes its maps side by side, so that those of odd sizes begin anywhere.
@triton.jit(do_not_specialize=["height", "width"], do_not_specialize_on_alignment=["deviation", "confidence"])
def known_kernel(
    deviation, confidence, share, height, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):  # fmt: skip
    """``consistency.known_share``. Grid: tiles down, tiles across, samples."""
    sample = tl.program_id(2) * height * width
    p, inside = tile_places(height, width, ROWS, COLUMNS)
    known = mean_precision(deviation + sample, confidence + sample, 1.0, height, width, ROWS, COLUMNS)
    tl.store(share + sample + p, tl.minimum(known, 1.0), inside)


@triton.jit(do_not_specialize=["height", "width"], do_not_specialize_on_alignment=["sure", "new_deviation"])
def hidden_kernel(
    inverse_depth, confidence, deviation, hidden, behind, inverse, sure, new_deviation, height, width,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """``rows.with_hidden``. Grid: tiles down, tiles across."""
    p, inside = tile_places(height, width, ROWS, COLUMNS)
    known = mean_precision(deviation, confidence, 1.0, height, width, ROWS, COLUMNS)
    own = tl.load(confidence + p, inside, 0.0)
    put = (tl.load(hidden + p, inside, 0) != 0) & (own < _LEAST_KEPT)
    kept = tl.load(inverse_depth + p, inside, 0.0)
    tl.store(inverse + p, tl.where(put, tl.load(behind + p, inside, 0.0), kept), inside)
    tl.store(sure + p, tl.where(put, tl.minimum(known, 1.0) * _HIDDEN_CONFIDENCE, own), inside)
    tl.store(new_deviation + p, tl.where(put, 1.0, tl.load(deviation + p, inside, 1.0)), inside)


def tiles(size: tuple[int, int]) -> tuple[int, int]:
    """How many tiles a map has down and across."""
    return triton.cdiv(size[0], TILE[0]), triton.cdiv(size[1], TILE[1])


def known_share(deviation: Tensor, confidence: Tensor) -> Tensor:
    """``consistency.known_share`` of matches ``(..., H, W)`` whose deviation is known."""
    share, size = torch.empty_like(confidence), (confidence.shape[-2], confidence.shape[-1])
    samples = confidence.numel() // (size[0] * size[1])
    launched_on(share, known_kernel[(*tiles(size), samples)])(
        deviation.contiguous(), confidence.contiguous(), share, *size, ROWS=TILE[0], COLUMNS=TILE[1]
    )
    return share


def with_hidden(
    matches: Matches, deviation: Tensor, strips: rows.HiddenStrips
) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse depth, confidence and deviation of ``rows.with_hidden``, where the deviation is known."""
    maps = matches.inverse_depth, matches.confidence, deviation, strips.inside, strips.inverse_depth
    inverse, confidence, new_deviation = deviation.new_empty(3, *deviation.shape).unbind()
    launched_on(deviation, hidden_kernel[tiles(matches.size)])(
        *(each.contiguous() for each in maps), inverse, confidence, new_deviation, *matches.size,
        ROWS=TILE[0], COLUMNS=TILE[1],
    )  # fmt: skip
    return inverse, confidence, new_deviation
