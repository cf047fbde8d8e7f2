"""Rotates right views parallel to the left one, so that each plane is a scale and shift of the image.

Collins 1996, "A space-sweep approach to true multi-image matching".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin.cameras import ALL_VALID, Camera, View, eroded
from geodiff_plugin.geometry import EDGE_PX, constant_like, image_size, sample_at, to_device_of
from geodiff_plugin.matching.census import MARGIN_PX, census, census_cost, grey_levels

# A view that the rotation would shift by less than this is used unchanged, pixels.
_MIN_ROTATION_PX = 0.02
# Minimum ratio of a plane's depth in the rotated right view to its depth in the left one.
_MIN_RATIO = 0.02
# If many planes are pure shifts along the rows, the census of the right image is computed once at this number
# of positions per pixel along the row.
_PHASES = 8
# Number of positions per pixel across the rows.
_ROW_PHASES = 4
# Maximum drift across the rows of pure shifts, pixels: calibrated baselines are slightly oblique.
_MAX_DRIFT_PX = 1.0


@dataclass(frozen=True)
class AlignedView:
    """A right image on a canvas with the left grid's orientation and pixels per radian.

    A left pixel ``(u, v)`` on plane k maps to ``scale[k] * (u, v) + shift[k]`` on the canvas, so warping by a
    plane in either direction looks up rows and columns. ``grey (h, w)``; ``valid (h, w)`` bool, inside the
    right image, ``None`` for the whole canvas; ``scale (D,)``, 0 behind the right camera, and ``shift (D,
    2)``, column and row, are float64. ``masked`` states whether the right image itself has
    invalid pixels.
    """

    grey: Tensor
    valid: Tensor | None
    scale: np.ndarray
    shift: np.ndarray
    masked: bool

    @property
    def guide(self) -> Tensor:
        """``grey`` for the paths of the aggregation, NaN where the right image is not valid."""
        if not self.masked or self.valid is None:
            return self.grey
        return torch.where(self.valid, self.grey, torch.nan)

    @property
    def size(self) -> tuple[int, int]:
        """``(h, w)`` of the canvas."""
        return self.grey.shape[0], self.grey.shape[1]

    def positions(self, count: int, axis: int, margin: int = 0) -> np.ndarray:
        """Map the left grid's ``count`` columns (``axis`` 0) or rows (1), ``(D, count + 2 * margin)``.

        Positions are canvas pixels, float32, not clipped; lines in the margin repeat the outermost line.
        """
        lines = np.arange(-margin, count + margin).clip(0, count - 1)
        return (self.scale[:, None] * lines + self.shift[:, axis, None]).astype(np.float32)

    def sources(self, count: int, axis: int) -> np.ndarray:
        """Invert ``positions``: the left line of each canvas line, ``(D, n)``, or ``count`` for none."""
        lines = np.arange(self.size[1 - axis])
        scale = self.scale[:, None]
        at = ((lines - self.shift[:, axis, None]) / np.maximum(scale, 1e-9)).round()
        seen = (scale > 0) & (at >= 0) & (at < count)
        return np.where(seen, at, count).astype(np.int64)

    def inside(self, positions: np.ndarray, axis: int) -> np.ndarray:
        """Return whether ``positions`` are on the canvas and before the right camera, ``(D, n)`` bool."""
        last = self.size[1 - axis] - 1
        return (positions >= -EDGE_PX) & (positions <= last + EDGE_PX) & (self.scale > 0)[:, None]

    def nearest(self, positions: np.ndarray, axis: int) -> np.ndarray:
        """Return the canvas lines nearest to ``positions``, ``(D, n)`` int64, clipped to the canvas."""
        return positions.round().clip(0, self.size[1 - axis] - 1).astype(np.int64)


def align_view(right: View, left: Camera, inverse_depth: Tensor) -> AlignedView:
    """Rotate a right view, with a grey image, parallel to the left one; a rectified one is its own canvas.

    ``left`` is the camera of the left grid, and ``inverse_depth (D,)`` 1/m are its planes. The canvas covers
    the visible part of the right image, at most three left grids wide and high.
    """
    assert left.size is not None
    image = right.image_01
    size = left.size[::-1]
    compared = None if right.valid is None else eroded(right.valid, MARGIN_PX)
    matrices = right.camera.K, right.T_right_from_left, left.K
    K_r, T, K = (each.astype(np.float64) for each in matrices)
    R = T[:3, :3]
    w = inverse_depth.cpu().numpy().astype(np.float64)
    centre = R.T @ T[:3, 3]
    ratio = 1.0 + w * centre[2]  # depth in the rotated view over depth in the left view
    scale = np.where(ratio > _MIN_RATIO, 1.0 / np.maximum(ratio, _MIN_RATIO), 0.0)
    displacement = w[:, None] * (K[:2, :2] @ centre[:2]) - K[:2, 2]
    shift = scale[:, None] * displacement + K[:2, 2]
    to_right = K_r @ R @ np.linalg.inv(K)  # maps a left pixel to its point at infinity in the right image
    offset = _translation(to_right, size)
    if offset is not None:
        return AlignedView(image[0], compared, scale, shift + offset, compared is not None)
    low, high = _extent(to_right, size, image_size(image), scale, shift)
    rotated, valid = _rotated(image, to_right, low, high, compared)
    return AlignedView(rotated, valid, scale, shift - low, compared is not None)


def _rotated(
    image: Tensor, to_right: np.ndarray, low: np.ndarray, high: np.ndarray, compared: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Warp a right image by a homography to the canvas ``low`` to ``high``; also returns valid pixels.

    ``compared (H, W)`` bool are the valid pixels of the image; ``None`` for all.
    """
    # Not every device supports float64, and on CUDA the CPU would synchronize.
    device = image.device if image.is_cuda else torch.device("cpu")
    columns, rows = (
        torch.arange(int(a), int(b) + 1, dtype=torch.float64, device=device)
        for a, b in zip(low, high, strict=True)
    )
    row, column = torch.meshgrid(rows, columns, indexing="ij")
    p = torch.stack([column, row, torch.ones_like(row)], dim=-1) @ to_device_of(row, to_right).T
    uv = p[..., :2] / p[..., 2:].clamp_min(1e-9)
    ahead = p[..., 2] > 1e-9
    last = constant_like(uv, image.shape[-1] - 1, image.shape[-2] - 1)
    valid = ahead & ((uv >= -EDGE_PX) & (uv <= last + EDGE_PX)).all(dim=-1)
    # Bicubic, because the result is interpolated again on every plane.
    rotated = sample_at(image[None], uv[None].to(image), mode="bicubic")[0, 0].clamp(0.0, 1.0)
    valid = valid.to(image.device)
    if compared is not None:
        valid &= sample_at(compared[None, None].to(image), uv[None].to(image))[0, 0] > ALL_VALID
    return rotated, valid


def _translation(to_right: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
    """Return the shift ``(2,)`` equal to a homography on the left grid; ``None`` if there is none."""
    height, width = size
    ends = [[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]]
    corners = np.array(ends, dtype=np.float64)
    p = corners @ to_right.T
    if not (p[:, 2] > 0).all():
        return None
    displacement = p[:, :2] / p[:, 2:] - corners[:, :2]
    mean = displacement.mean(0)
    return mean if np.abs(displacement - mean).max() < _MIN_ROTATION_PX else None


def _extent(
    to_right: np.ndarray,
    size: tuple[int, int],
    size_right: tuple[int, int],
    scale: np.ndarray,
    shift: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return first and last column and row ``(2,)`` of the canvas, in left grid pixels at infinity."""
    far = np.array([size[1] - 1.0, size[0] - 1.0])
    ends = np.concatenate([shift, shift + scale[:, None] * far])[np.tile(scale > 0, 2)]
    low, high = (ends.min(0), ends.max(0)) if len(ends) else (np.zeros_like(far), far)
    low = np.maximum(low, -far)
    high = np.minimum(high, 2 * far)
    steps = np.linspace(0, 1, 9)
    u, v = np.meshgrid(steps * (size_right[1] - 1), steps * (size_right[0] - 1))
    grid = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], 1)
    back = grid @ np.linalg.inv(to_right).T
    if (back[:, 2] > 0.1 * np.abs(back[:, 2]).max()).all():  # otherwise the image extends to the horizon
        seen = back[:, :2] / back[:, 2:]
        low, high = np.maximum(low, seen.min(0)), np.minimum(high, seen.max(0))
    low = np.floor(low)
    return low, np.maximum(np.ceil(high), low + 1)


def _resampled(grey: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Sample grey levels int16 ``(h, w)`` bilinearly at rows ``(h,)`` and columns ``(w,)``; edges repeat."""
    for axis, positions in enumerate((rows, columns)):
        last = grey.shape[axis] - 1
        positions = positions.clamp(0, last)
        first = positions.floor()
        at = first.int()
        weight = positions - first
        weight = weight[:, None] if axis == 0 else weight
        grey = torch.lerp(
            grey.index_select(axis, at), grey.index_select(axis, (at + 1).clamp_(max=last)), weight
        )
    return grey_levels(grey)


@dataclass(frozen=True)
class EvenShifts:
    """Planes that are pure shifts along the canvas rows, rounded to fractions of a pixel (phases)."""

    columns: list[int]  # of every plane, in units of 1 / ``_PHASES`` pixel
    rows: list[int]  # of every plane, in units of 1 / ``_ROW_PHASES`` pixel
    first: int  # leftmost column that a plane reads, before rounding up to its phase
    count: int  # number of columns from there that all planes read together

    def phase(self, plane: int) -> tuple[int, int]:
        """Return the part of a plane's shift that needs its own image: column phase and row shift."""
        return self.columns[plane] % _PHASES, self.rows[plane]

    def begin(self, plane: int) -> int:
        """Return the column at which a plane begins in the image of its phase."""
        return self.columns[plane] // _PHASES - self.first

    def positions(self, phase: tuple[int, int], height: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows and columns of the canvas, float32, at which the image of a phase is sampled.

        These are ``height`` rows of the left grid, shifted, and the columns that the planes read together,
        both with ``MARGIN_PX`` more at each end. Rows of the margin repeat the outermost row, as in
        ``AlignedView.positions``. Columns do not, because planes that begin elsewhere share the image.
        """
        column, row = phase
        rows = np.arange(-MARGIN_PX, height + MARGIN_PX, dtype=np.float32).clip(0, height - 1)
        columns = np.arange(-MARGIN_PX, self.count + MARGIN_PX, dtype=np.float32)
        return rows + np.float32(row / _ROW_PHASES), columns + np.float32(self.first + column / _PHASES)


def even_shifts(view: AlignedView, width: int) -> EvenShifts | None:
    """Return the shifts of a view's planes for a left grid of this width; ``None`` if any is not a shift."""
    scale, shift = view.scale, view.shift
    drift = np.ptp(shift[:, 1])
    uneven = drift > _MAX_DRIFT_PX or np.abs(scale - 1.0).max() * width > 1.0 / _PHASES
    if uneven or len(scale) < 4 * _PHASES:
        return None
    # A plane shifted beyond the canvas by more than the left width shows only the repeated edge.
    columns = (shift[:, 0].clip(-width, view.size[1]) * _PHASES).round().astype(int).tolist()
    first = min(columns) // _PHASES
    rows = (shift[:, 1] * _ROW_PHASES).round().astype(int).tolist()
    return EvenShifts(columns, rows, first, max(columns) // _PHASES - first + width)


def _nearest_lines(
    view: AlignedView, columns: np.ndarray, rows: np.ndarray, like: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the canvas rows and columns nearest to positions with a margin, ``(D, H)`` and ``(D, W)``."""
    inner = slice(MARGIN_PX, -MARGIN_PX)
    lines = view.nearest(rows[:, inner], 1), view.nearest(columns[:, inner], 0)
    return to_device_of(like, lines[0]), to_device_of(like, lines[1])


class ComparedView:
    """Costs between the left view and an aligned right view on every plane, and their visibility."""

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
        """Compute the right view's ``census`` for all shifts of a phase, int8; cached per row."""
        if phase not in self._phases:
            self._phases = {key: parts for key, parts in self._phases.items() if key[1] == phase[1]}
            positions = shifts.positions(phase, self._left.shape[1])
            rows, columns = (to_device_of(self._left, each) for each in positions)
            self._phases[phase] = census(_resampled(self._view.grey, rows, columns)).to(torch.int8)
        return self._phases[phase]

    def cost(self, plane: int) -> Tensor:
        """Compute the ``census_cost (H, W)`` uint8 of a plane, for visible and invisible pixels."""
        if self._shifts is None:
            levels = _resampled(self._view.grey, self._rows[plane], self._columns[plane])
            return census_cost(census(levels, self._work), self._left, self._work)
        described = self._phase(self._shifts.phase(plane), self._shifts)
        begin = self._shifts.begin(plane)
        return census_cost(described[:, :, begin : begin + self._left.shape[2]], self._left, self._work)

    def seen(self, plane: int) -> Tensor:
        """Return a bool mask ``(H, W)`` of the pixels of a plane that the right view sees."""
        seen = self._rows_inside[plane][:, None] & self._columns_inside[plane]
        if self._view.valid is None or self._nearest is None:
            return seen
        rows, columns = (each[plane] for each in self._nearest)
        valid = self._view.valid.index_select(0, rows)
        return seen & valid.gather(1, columns.expand(len(rows), -1))
