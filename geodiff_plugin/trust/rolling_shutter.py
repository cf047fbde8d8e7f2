"""Check near-vertical lines for a right image that a rolling shutter sheared along its rows.

The images of parallel cameras have the same vanishing points. Lines through one vanishing point have slopes
``dx/dv = k (x - x_0)`` in the left image and ``k (x - d - x_0)`` in the right image, where they are further
left by the disparity ``d``. The disparity therefore changes along a line by ``dd/dv = k d``. A shear of the
right image along its rows adds the same constant to ``dd/dv`` of all lines.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from geodiff_plugin._internal.statistics import SD_PER_MAD, certain_part
from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet, MatchError
from geodiff_plugin.trust.stages import RowsStage

ROLLING_SHUTTER = FindingKind(
    "views.rolling-shutter",
    REASON,
    "Vertical lines lean in the right image",
    cause="A rolling shutter read the rows sequentially while the camera or the scene moved.",
    hint="Use a global-shutter camera, or keep the camera and the scene still.",
)

#: Minimum length of a line, as a fraction of the image height.
MIN_LENGTH = 0.06
#: Maximum slope of a near-vertical line, pixels per row.
MAX_LEAN = 0.2
#: Half width in pixels of the neighbourhood of a line in which its disparity is searched. The maximum is
#: used, which belongs to the nearer side.
HALF_WIDTH_PX = 2
#: Minimum fraction of a line's pixels that must be matched.
MIN_MATCHED = 0.5
#: Minimum number of a line's pixels that must be matched.
MIN_MATCHED_PX = 8
#: Maximum scatter of the disparities along a line around a linear fit, pixels.
MAX_SCATTER_PX = 1.0
#: Minimum number of lines required for a conclusion.
MIN_LINES = 6
#: Minimum standard deviation of the lines' positions, as a fraction of the image width.
MIN_SPREAD = 0.1
#: Maximum deviation of a line from the common vanishing point, in standard deviations.
MAX_OFF = 3.0
#: Accuracy of the slope of a line, pixels per row.
EXACT = 0.01
#: Maximum scatter of the slopes around a common vanishing point. It was up to .048 in 24 of 26 pairs, with or
#: without rolling shutter, and .153 for a tilted board in half of the image that looked like a shear.
MAX_RESIDUAL = 0.06
#: Number of iterations of a robust fit.
STEPS = 8
#: Interquartile range of a normal distribution in standard deviations, and the ratio of the standard errors
#: of its median and its mean.
INTERQUARTILE_RANGE, MEDIAN_OVER_MEAN = 1.349, 1.253


@dataclass(frozen=True)
class Shear:
    """The shear of the right image along its rows."""

    shear: float  # significant part of the shift from first to last row, as a fraction of the width
    width_px: int  # width of the left image


class RollingShutter(Check[Shear]):
    """Detects a sheared right image of a rectified pair, caused by a rolling shutter and motion."""

    kinds = (ROLLING_SHUTTER,)
    #: The significant part of the shear was 0 for 38 correct pairs of parallel cameras, and .0048 to .021 for
    #: 9 of 14 pairs with a shear of .023.
    MAX_SHEAR = 0.005
    #: Correct pairs can show up to this much, which does not lower the confidence.
    USUAL_SHEAR = 0.001

    @classmethod
    def of_rows(cls, stage: RowsStage) -> Shear | None:
        px_per_row = certain_shear(stage.lines, stage.shift, stage.matched)
        height, width = stage.size  # pixels are square on the grid of the rows
        return None if math.isnan(px_per_row) else Shear(px_per_row * height / width, width)

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact and abs(fact.shear) > cls.MAX_SHEAR:
            yield Finding(
                ROLLING_SHUTTER,
                f"A rolling shutter sheared the right image by {100 * abs(fact.shear):.1f} % of its width; "
                "depth errors vary by row. Use a global shutter.",
            )

    @classmethod
    def match_error(cls, facts: FactSheet) -> MatchError:
        fact = facts[cls]
        if fact is None or abs(fact.shear) <= cls.USUAL_SHEAR:
            return MatchError()
        # The RMS of a shift that grows linearly from 0 at one edge of the image.
        return MatchError(px=abs(fact.shear) * fact.width_px / math.sqrt(3.0))


def vertical_lines(grey: np.ndarray) -> np.ndarray:
    """Detect near-vertical lines in an image ``(H, W)`` uint8; returns endpoints ``(N, 4)`` x, v, x, v."""
    found = cv2.createLineSegmentDetector().detect(grey)[0]
    lines = np.zeros((0, 4)) if found is None else found.reshape(-1, 4).astype(np.float64)
    along, down = np.abs(lines[:, 2] - lines[:, 0]), np.abs(lines[:, 3] - lines[:, 1])
    return lines[(down > MIN_LENGTH * len(grey)) & (along < MAX_LEAN * down)]


class _Fits(NamedTuple):
    """Linear fits to rows of values ``(N, L)``."""

    slope: np.ndarray  # (N,)
    middle: np.ndarray  # (N,), value at the mean position
    off: np.ndarray  # (N, L), residuals
    scale: np.ndarray  # (N,), robust standard deviation of the residuals


def _median(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the median ``(N,)`` of the known values of every row ``(N, L)``; each row needs one."""
    ordered = np.sort(np.where(known, values, np.inf), axis=1)
    count = known.sum(1)
    row = np.arange(len(values))
    return (ordered[row, (count - 1) // 2] + ordered[row, count // 2]) / 2.0


def _fit_lines(at: np.ndarray, values: np.ndarray, known: np.ndarray) -> _Fits:
    """Minimise ``sum_i rho(values_i - middle - slope (at_i - mean(at)))`` per row, with the Cauchy ``rho``.

    Only entries of ``at (N, L)`` and ``values (N, L)`` that are ``known (N, L)`` count. Each row needs one.
    """
    values = np.where(known, values, 0.0)
    away = np.where(known, at - (at * known).sum(1, keepdims=True) / known.sum(1, keepdims=True), 0.0)
    weight = known.astype(float)
    for _ in range(STEPS):
        total = weight.sum(1)
        first = (weight * away).sum(1)
        second = (weight * away**2).sum(1)
        sums = (weight * values).sum(1)
        moments = (weight * away * values).sum(1)
        determinant = np.maximum(total * second - first**2, 1e-9)
        slope = (total * moments - first * sums) / determinant
        middle = (second * sums - first * moments) / determinant
        off = values - middle[:, None] - slope[:, None] * away
        scale = np.maximum(SD_PER_MAD * _median(np.abs(off), known), 1e-6)
        weight = known / (1.0 + (off / (2.0 * scale[:, None])) ** 2)
    return _Fits(slope, middle, off, scale)


class _Along(NamedTuple):
    """Samples along lines, ``(N, L)`` each: one sample per row, ``L`` for the longest line."""

    row: np.ndarray  # image row
    shift: np.ndarray  # disparity
    known: np.ndarray  # bool, whether the sample exists and is matched
    fraction: np.ndarray  # (N,) fraction of known samples of a line


def _along(lines: np.ndarray, shift: np.ndarray, matched: np.ndarray) -> _Along:
    """Sample the disparity along at least one line ``(N, 4)``."""
    height, width = shift.shape
    x0, v0, x1, v1 = lines.T[:, :, None]
    count = np.maximum(8, np.abs(v1 - v0).astype(int))  # (N, 1)
    k = np.arange(count.max())
    t = 0.05 + 0.9 * k / (count - 1)
    rows = np.clip(np.rint(v0 + (v1 - v0) * t).astype(int), 0, height - 1)
    columns = np.rint(x0 + (x1 - x0) * t).astype(int)
    offsets = np.arange(-HALF_WIDTH_PX, HALF_WIDTH_PX + 1)[:, None, None]
    columns = np.clip(columns + offsets, 0, width - 1)
    of_line = np.where(matched[rows, columns] > 0, shift[rows, columns], -np.inf).max(0)
    known = np.isfinite(of_line) & (k < count)
    return _Along(rows.astype(float), of_line.astype(float), known, known.sum(1) / count[:, 0])


def certain_shear(lines: np.ndarray, shift: np.ndarray, matched: np.ndarray) -> float:
    """Estimate the significant shear of the right image of a rectified pair along its rows, pixels per row.

    The estimate is the ``certain_part`` of the median of ``dd/dv - k d`` over near-vertical lines. Their
    common ``k`` is measured in the left image alone. Because matchers flatten surfaces, part of ``k d`` may
    be missing from ``dd/dv``. The function therefore returns the smaller of the medians with and without it.

    Args:
        lines: ``(N, 4)``, ``vertical_lines`` of the left image ``(H, W)``.
        shift: ``(H, W)`` disparity in pixels relative to infinity, >= 0.
        matched: ``(H, W)``, above 0 where the disparity is known.

    Returns:
        0 if no shear is significant, NaN if too few lines are matched.
    """
    if len(lines) < MIN_LINES:
        return math.nan
    along = _along(lines, shift, matched)
    enough = (along.known.sum(1) >= MIN_MATCHED_PX) & (along.fraction >= MIN_MATCHED)
    if enough.sum() < MIN_LINES:
        return math.nan
    lines = lines[enough]
    courses = _fit_lines(along.row[enough], along.shift[enough], along.known[enough])
    straight = courses.scale < MAX_SCATTER_PX
    x = (lines[straight, 0] + lines[straight, 2]) / 2
    if straight.sum() < MIN_LINES or x.std() < MIN_SPREAD * shift.shape[1]:
        return math.nan
    slopes = (lines[straight, 2] - lines[straight, 0]) / (lines[straight, 3] - lines[straight, 1])
    meeting = _fit_lines(x[None], slopes[None], np.ones((1, len(x)), bool))
    if meeting.scale[0] > MAX_RESIDUAL:
        return math.nan
    parallel = np.abs(meeting.off[0]) < MAX_OFF * max(float(meeting.scale[0]), EXACT)
    if parallel.sum() < MIN_LINES:
        return math.nan
    flat = courses.slope[straight][parallel]
    middle = courses.middle[straight][parallel]
    exact = max(float(meeting.scale[0]), EXACT) / (math.sqrt(len(x)) * x.std())  # standard error of k
    pitched = _certain_median(flat - float(meeting.slope[0]) * middle, exact * float(np.median(middle)))
    certain = [_certain_median(flat), pitched]
    return min(certain, key=abs) if certain[0] * certain[1] > 0 else 0.0


def _certain_median(values: np.ndarray, common: float = 0.0) -> float:
    """Return the ``certain_part`` of the median of values with a ``common`` standard error."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    error = MEDIAN_OVER_MEAN * (high - low) / INTERQUARTILE_RANGE / math.sqrt(len(values))
    return certain_part(float(middle), math.hypot(error, common))
