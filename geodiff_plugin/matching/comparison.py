"""Cost of the left descriptors against those of a right view, plane by plane.

Data flow: census of the left view + ``AlignedView`` -> costs and what is seen of one plane.
Paper: none.
"""

from __future__ import annotations

from typing import Any

import torch

from geodiff_plugin.matching.alignment import AlignedView
from geodiff_plugin.matching.census import MARGIN_PX, census, census_cost, grey_levels

__all__ = ["ComparedView"]

# Where many planes are plain shifts along the rows, the right image is described once at this many positions
# a pixel. So it is while the rows drift by no more than this: calibrations put the baseline of a rectified
# pair a little out of the row.
_PHASES, _ROW_PHASES, _MOST_DRIFT_PX = 8, 4, 1.0


def _resampled(grey: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """Grey levels, int16 ``(h, w)``, bilinear at these rows ``(h,)`` and columns ``(w,)``; edges repeat."""
    for axis, positions in enumerate((rows, columns)):
        last = grey.shape[axis] - 1
        positions = positions.clamp(0, last)
        first = positions.floor()
        at, weight = first.int(), positions - first
        weight = weight[:, None] if axis == 0 else weight
        grey = torch.lerp(
            grey.index_select(axis, at), grey.index_select(axis, (at + 1).clamp_(max=last)), weight
        )
    return grey_levels(grey)


class ComparedView:
    """What an aligned right view costs the left view on every plane, and what it sees of it."""

    def __init__(self, left: torch.Tensor, view: AlignedView) -> None:
        """Take ``left``, the ``census`` of the left view, ``(16, H, W)`` int16."""
        self._view, (_, height, width) = view, left.shape
        self._columns = view.positions(width, 0, MARGIN_PX)
        self._rows = view.positions(height, 1, MARGIN_PX)
        inner = slice(MARGIN_PX, -MARGIN_PX)
        self._columns_inside = view.inside(self._columns[:, inner], 0)
        self._rows_inside = view.inside(self._rows[:, inner], 1)
        self._shifts = self._even_shifts(width)
        self._left = left if self._shifts is None else left.to(torch.int8)
        self._room = torch.empty_like(self._left)
        self._phases: dict[tuple[int, int], torch.Tensor] = {}

    def _even_shifts(self, width: int) -> list[tuple[int, int]] | None:
        """Column and row shift of every plane in phases, where they say everything; else ``None``."""
        scale, shift = self._view.scale, self._view.shift
        drift = float(shift[:, 1].amax() - shift[:, 1].amin())
        uneven = drift > _MOST_DRIFT_PX or float((scale - 1.0).abs().amax()) * width > 1.0 / _PHASES
        if uneven or len(scale) < 4 * _PHASES:
            return None
        # Further than its own width beyond the canvas, a plane shows the repeated edge and nothing else.
        columns = (shift[:, 0].clamp(-width, self._view.size[1]) * _PHASES).round().long()
        self._first = int(columns.amin()) // _PHASES
        self._count = int(columns.amax()) // _PHASES - self._first + width
        rows = (shift[:, 1] * _ROW_PHASES).round().long()
        return list(zip(columns.tolist(), rows.tolist(), strict=True))

    def _phase(self, column: int, row: int, height: int) -> torch.Tensor:
        """``census`` of the right view for all shifts of a phase, int8; kept until the row changes."""
        if (column, row) not in self._phases:
            self._phases = {key: votes for key, votes in self._phases.items() if key[1] == row}
            # Whole numbers would become positions of the user's default dtype.
            there: dict[str, Any] = {"dtype": torch.float32, "device": self._columns.device}
            lines = torch.arange(-MARGIN_PX, self._count + MARGIN_PX, **there)
            rows = torch.arange(-MARGIN_PX, height + MARGIN_PX, **there).clamp_(0, height - 1)
            at = rows + row / _ROW_PHASES, lines + (self._first + column / _PHASES)
            self._phases[column, row] = census(_resampled(self._view.grey, *at)).to(torch.int8)
        return self._phases[column, row]

    def cost(self, plane: int) -> torch.Tensor:
        """``(H, W)`` uint8, ``census_cost`` of a plane, whether seen or not."""
        if self._shifts is None:
            levels = _resampled(self._view.grey, self._rows[plane], self._columns[plane])
            return census_cost(census(levels, self._room), self._left, self._room)
        _, height, width = self._left.shape
        column, row = self._shifts[plane]
        votes = self._phase(column % _PHASES, row, height)
        begin = column // _PHASES - self._first
        return census_cost(votes[:, :, begin : begin + width], self._left, self._room)

    def seen(self, plane: int) -> torch.Tensor:
        """``(H, W)`` bool: what the right view sees of a plane."""
        seen = self._rows_inside[plane][:, None] & self._columns_inside[plane]
        if self._view.valid is None:
            return seen
        rows, columns = (
            positions[plane, MARGIN_PX:-MARGIN_PX].round().clamp_(0, last - 1).long()
            for positions, last in zip((self._rows, self._columns), self._view.size, strict=True)
        )
        valid = self._view.valid.index_select(0, rows)
        return seen & valid.gather(1, columns.expand(len(rows), -1))
