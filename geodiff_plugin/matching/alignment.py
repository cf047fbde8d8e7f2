"""Right views turned parallel to the left one: every plane is one scale and one shift, costs are look-ups.

Collins 1996, "A space-sweep approach to true multi-image matching".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin.geometry import EDGE_PX, constant_like, image_size, sample_at, to_device_of
from geodiff_plugin.matching.census import MARGIN_PX, census, census_cost, grey_levels
from geodiff_plugin.types import CameraView

# A view that turning would move by less than this stays as it is.
_AS_IT_IS_PX = 0.02
# Planes that come nearer to the right camera's plane than this share of their depth are not seen.
_LEAST_RATIO = 0.02
# Where many planes are plain shifts along the rows, the census of the right image is computed once at this
# many positions per pixel along the row.
_PHASES = 8
# The same across the rows.
_ROW_PHASES = 4
# Plain shifts may drift across the rows by this much: calibrated baselines lie a little out of the row.
_MOST_DRIFT_PX = 1.0


@dataclass(frozen=True)
class AlignedView:
    """A right image on a canvas with the left grid's orientation and pixels per radian.

    A left pixel ``(u, v)`` on plane k lies at ``scale[k] * (u, v) + shift[k]`` of the canvas, so warping by a
    plane, either way, looks up rows and columns. ``grey (h, w)``; ``valid (h, w)`` bool, inside the right
    image, ``None`` for all of the canvas; ``scale (D,)``, 0 behind the right camera, and ``shift (D, 2)``,
    column and row, are float64.
    """

    grey: Tensor
    valid: Tensor | None
    scale: np.ndarray
    shift: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        """``(h, w)`` of the canvas."""
        return self.grey.shape[0], self.grey.shape[1]

    def positions(self, count: int, axis: int, margin: int = 0) -> np.ndarray:
        """Where the left grid's ``count`` columns (``axis`` 0) or rows (1) lie, ``(D, count + 2 * margin)``.

        Canvas pixels, float32, not clipped; the lines beyond the grid repeat its outermost.
        """
        lines = np.arange(-margin, count + margin).clip(0, count - 1)
        return (self.scale[:, None] * lines + self.shift[:, axis, None]).astype(np.float32)

    def sources(self, count: int, axis: int) -> np.ndarray:
        """The inverse of ``positions``: the left line of each canvas line, ``(D, n)``; ``count`` for none."""
        lines, scale = np.arange(self.size[1 - axis]), self.scale[:, None]
        at = ((lines - self.shift[:, axis, None]) / np.maximum(scale, 1e-9)).round()
        seen = (scale > 0) & (at >= 0) & (at < count)
        return np.where(seen, at, count).astype(np.int64)

    def inside(self, positions: np.ndarray, axis: int) -> np.ndarray:
        """Which of the ``positions`` are on the canvas, and not behind the right camera; ``(D, n)`` bool."""
        last = self.size[1 - axis] - 1
        return (positions >= -EDGE_PX) & (positions <= last + EDGE_PX) & (self.scale > 0)[:, None]

    def nearest(self, positions: np.ndarray, axis: int) -> np.ndarray:
        """The canvas lines nearest to ``positions``, ``(D, n)`` int64; those outside are its outermost."""
        return positions.round().clip(0, self.size[1 - axis] - 1).astype(np.int64)


def align_view(
    right: CameraView, K_left: Tensor, size: tuple[int, int], inverse_depth: Tensor
) -> AlignedView:
    """Turn a right view, whose image is grey, parallel to the left one; a rectified one is its own canvas.

    ``size (H, W)`` is the left grid, ``inverse_depth (D,)`` 1/m are its planes. The canvas covers the part of
    the right image on them, at most three left grids wide and high.
    """
    image, matrices = right.image_01, (right.K, right.T_right_from_left, K_left)
    K_r, T, K = (each.numpy(force=True).astype(np.float64) for each in matrices)
    R, w = T[:3, :3], inverse_depth.cpu().numpy().astype(np.float64)
    centre = R.T @ T[:3, 3]
    ratio = 1.0 + w * centre[2]  # depth in the turned view over depth in the left view
    scale = np.where(ratio > _LEAST_RATIO, 1.0 / np.maximum(ratio, _LEAST_RATIO), 0.0)
    moved = w[:, None] * (K[:2, :2] @ centre[:2]) - K[:2, 2]
    shift = scale[:, None] * moved + K[:2, 2]
    to_right = K_r @ R @ np.linalg.inv(K)  # of a left pixel's point at infinity
    offset = _translation(to_right, size)
    if offset is not None:
        return AlignedView(image[0], None, scale, shift + offset)
    low, high = _extent(to_right, size, image_size(image), scale, shift)
    return AlignedView(*_turned(image, to_right, low, high), scale, shift - low)


def _turned(image: Tensor, to_right: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[Tensor, Tensor]:
    """A right image under a homography, from column and row ``low`` to ``high``, and its valid pixels."""
    # Not every device has float64; on CUDA the CPU would be waited for.
    device = image.device if image.is_cuda else torch.device("cpu")
    columns, rows = (
        torch.arange(int(a), int(b) + 1, dtype=torch.float64, device=device)
        for a, b in zip(low, high, strict=True)
    )
    row, column = torch.meshgrid(rows, columns, indexing="ij")
    p = torch.stack([column, row, torch.ones_like(row)], dim=-1) @ to_device_of(row, to_right).T
    uv, ahead = p[..., :2] / p[..., 2:].clamp_min(1e-9), p[..., 2] > 1e-9
    last = constant_like(uv, image.shape[-1] - 1, image.shape[-2] - 1)
    valid = ahead & ((uv >= -EDGE_PX) & (uv <= last + EDGE_PX)).all(dim=-1)
    # Bicubic, because the result is interpolated once more on every plane.
    turned = sample_at(image[None], uv[None].to(image), mode="bicubic")[0, 0].clamp(0.0, 1.0)
    return turned, valid.to(image.device)


def _translation(to_right: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
    """The shift ``(2,)`` that a homography equals on the left grid; ``None`` if it is no plain shift."""
    height, width = size
    ends = [[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]]
    corners = np.array(ends, dtype=np.float64)
    p = corners @ to_right.T
    if not (p[:, 2] > 0).all():
        return None
    moved = p[:, :2] / p[:, 2:] - corners[:, :2]
    mean = moved.mean(0)
    return mean if np.abs(moved - mean).max() < _AS_IT_IS_PX else None


def _extent(
    to_right: np.ndarray,
    size: tuple[int, int],
    size_right: tuple[int, int],
    scale: np.ndarray,
    shift: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """First and last column and row ``(2,)`` of the canvas, in pixels of the left grid at infinity."""
    far = np.array([size[1] - 1.0, size[0] - 1.0])
    ends = np.concatenate([shift, shift + scale[:, None] * far])[np.tile(scale > 0, 2)]
    low, high = (ends.min(0), ends.max(0)) if len(ends) else (np.zeros_like(far), far)
    low, high = np.maximum(low, -far), np.minimum(high, 2 * far)
    steps = np.linspace(0, 1, 9)
    u, v = np.meshgrid(steps * (size_right[1] - 1), steps * (size_right[0] - 1))
    grid = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], 1)
    back = grid @ np.linalg.inv(to_right).T
    if (back[:, 2] > 0.1 * np.abs(back[:, 2]).max()).all():  # else the image reaches to the horizon
        seen = back[:, :2] / back[:, 2:]
        low, high = np.maximum(low, seen.min(0)), np.minimum(high, seen.max(0))
    low = np.floor(low)
    return low, np.maximum(np.ceil(high), low + 1)


def _resampled(grey: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
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


@dataclass(frozen=True)
class EvenShifts:
    """Planes that are plain shifts along the rows of the canvas, rounded to phases of a pixel."""

    columns: list[int]  # of every plane, in ``_PHASES`` of a pixel
    rows: list[int]  # of every plane, in ``_ROW_PHASES`` of a pixel
    first: int  # the leftmost column that a plane reads, before rounding up to its phase
    count: int  # columns from there that all planes read together

    def phase(self, plane: int) -> tuple[int, int]:
        """The part of a plane's shift that needs an image of its own: part of a column, and rows."""
        return self.columns[plane] % _PHASES, self.rows[plane]

    def begin(self, plane: int) -> int:
        """The column at which the plane begins in the image of its phase."""
        return self.columns[plane] // _PHASES - self.first

    def lines(self, phase: tuple[int, int], height: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the canvas, with a margin, that make the image of a phase; float32."""
        column, row = phase
        rows = np.arange(-MARGIN_PX, height + MARGIN_PX, dtype=np.float32).clip(0, height - 1)
        columns = np.arange(-MARGIN_PX, self.count + MARGIN_PX, dtype=np.float32)
        return rows + np.float32(row / _ROW_PHASES), columns + np.float32(self.first + column / _PHASES)


def even_shifts(view: AlignedView, width: int) -> EvenShifts | None:
    """The shifts of a view's planes, for a left grid of this width; ``None`` if some plane is no shift."""
    scale, shift = view.scale, view.shift
    drift = np.ptp(shift[:, 1])
    uneven = drift > _MOST_DRIFT_PX or np.abs(scale - 1.0).max() * width > 1.0 / _PHASES
    if uneven or len(scale) < 4 * _PHASES:
        return None
    # A plane shifted further than the left width beyond the canvas shows only the repeated edge.
    columns = (shift[:, 0].clip(-width, view.size[1]) * _PHASES).round().astype(int).tolist()
    first = min(columns) // _PHASES
    rows = (shift[:, 1] * _ROW_PHASES).round().astype(int).tolist()
    return EvenShifts(columns, rows, first, max(columns) // _PHASES - first + width)


def _nearest_lines(
    view: AlignedView, columns: np.ndarray, rows: np.ndarray, like: Tensor
) -> tuple[Tensor, Tensor]:
    """The canvas rows and columns nearest to positions with a margin, ``(D, H)`` and ``(D, W)``."""
    inner = slice(MARGIN_PX, -MARGIN_PX)
    lines = view.nearest(rows[:, inner], 1), view.nearest(columns[:, inner], 0)
    return to_device_of(like, lines[0]), to_device_of(like, lines[1])


class ComparedView:
    """Costs of every plane between the left view and an aligned right view, and where it is seen."""

    def __init__(self, left: Tensor, view: AlignedView) -> None:
        """``left`` is the ``census`` of the left view, ``(16, H, W)`` int16."""
        self._view, (_, height, width) = view, left.shape
        columns, rows = view.positions(width, 0, MARGIN_PX), view.positions(height, 1, MARGIN_PX)
        inner = slice(MARGIN_PX, -MARGIN_PX)
        self._columns_inside = to_device_of(left, view.inside(columns[:, inner], 0))
        self._rows_inside = to_device_of(left, view.inside(rows[:, inner], 1))
        self._columns, self._rows = to_device_of(left, columns), to_device_of(left, rows)
        self._nearest = None if view.valid is None else _nearest_lines(view, columns, rows, left)
        self._shifts = even_shifts(view, width)
        self._left = left if self._shifts is None else left.to(torch.int8)
        self._work = torch.empty_like(self._left)
        self._phases: dict[tuple[int, int], Tensor] = {}

    def _phase(self, phase: tuple[int, int], shifts: EvenShifts) -> Tensor:
        """``census`` of the right view for all shifts of a phase, int8; kept until the row changes."""
        if phase not in self._phases:
            self._phases = {key: votes for key, votes in self._phases.items() if key[1] == phase[1]}
            lines = shifts.lines(phase, self._left.shape[1])
            rows, columns = (to_device_of(self._left, each) for each in lines)
            self._phases[phase] = census(_resampled(self._view.grey, rows, columns)).to(torch.int8)
        return self._phases[phase]

    def cost(self, plane: int) -> Tensor:
        """``(H, W)`` uint8, ``census_cost`` of a plane, whether seen or not."""
        if self._shifts is None:
            levels = _resampled(self._view.grey, self._rows[plane], self._columns[plane])
            return census_cost(census(levels, self._work), self._left, self._work)
        votes, begin = self._phase(self._shifts.phase(plane), self._shifts), self._shifts.begin(plane)
        return census_cost(votes[:, :, begin : begin + self._left.shape[2]], self._left, self._work)

    def seen(self, plane: int) -> Tensor:
        """``(H, W)`` bool: what the right view sees of a plane."""
        seen = self._rows_inside[plane][:, None] & self._columns_inside[plane]
        if self._view.valid is None or self._nearest is None:
            return seen
        rows, columns = (each[plane] for each in self._nearest)
        valid = self._view.valid.index_select(0, rows)
        return seen & valid.gather(1, columns.expand(len(rows), -1))
