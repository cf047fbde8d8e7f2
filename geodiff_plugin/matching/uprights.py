"""A right picture that is sheared along its rows, as by a rolling shutter, by upright lines.

The pictures of parallel cameras have the same vanishing points. Lines that meet in one have slopes ``dx/dv =
k (x - x_0)`` in the left picture and ``k (x - d - x_0)`` in the right one, where they lie further left by the
shift ``d``, which therefore changes along them by ``dd/dv = k d``. A right picture that is sheared along its
rows changes ``dd/dv`` of all lines by one number.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from geodiff_plugin._certain import SD_PER_MAD, certain_part

#: Shortest line, as a share of the picture's height.
SHORTEST = 0.06
#: An upright line moves along the rows by this per row at most.
MOST_LEANING = 0.2
#: Pixels beside a line in which its shift is looked for: that of its nearer side is the line's.
BESIDE = 2
#: Share of a line's pixels that must be matched.
LEAST_MATCHED = 0.5
#: Pixels of a line that must be matched.
FEWEST_MATCHED = 8
#: Shifts along a line scatter by less than this around a straight course, pixels.
MOST_SCATTER_PX = 1.0
#: Lines that say something together.
FEWEST_LINES = 6
#: They are spread over the picture by this, as standard deviation in shares of its width.
LEAST_SPREAD = 0.1
#: Lines that do not meet in the common vanishing point lie off it by more than so many standard deviations.
MOST_OFF = 3.0
#: Slopes of lines are exact to this, in pixels per row.
EXACT = 0.01
#: Lines whose slopes scatter by more around their common vanishing point have none: it was up to .048 in 24
#: of 26 pairs, rolled or not, and .153 where a tilted board, half of the picture, looked like a shear.
MOST_APART = 0.06
#: Steps of a robust fit.
STEPS = 8
#: Middle half of a normal distribution in standard deviations, and what a median's error is to a mean's.
MIDDLE_HALF, MEDIAN_OVER_MEAN = 1.349, 1.253


class _Fits(NamedTuple):
    """Straight courses fitted to rows of values ``(N, L)``."""

    slope: np.ndarray  # (N,)
    middle: np.ndarray  # (N,), the value at the mean place
    off: np.ndarray  # (N, L), residuals
    scale: np.ndarray  # (N,), their robust standard deviation


def _median(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The median ``(N,)`` of the known values of every row ``(N, L)``, one at least."""
    ordered, count = np.sort(np.where(known, values, np.inf), axis=1), known.sum(1)
    row = np.arange(len(values))
    return (ordered[row, (count - 1) // 2] + ordered[row, count // 2]) / 2.0


def _fit_lines(at: np.ndarray, values: np.ndarray, known: np.ndarray) -> _Fits:
    """``min sum_i rho(values_i - middle - slope (at_i - mean(at)))`` of every row, with Cauchy's ``rho``.

    ``at`` and ``values (N, L)`` count where they are ``known (N, L)``, which they are somewhere in every row.
    """
    values = np.where(known, values, 0.0)
    away = np.where(known, at - (at * known).sum(1, keepdims=True) / known.sum(1, keepdims=True), 0.0)
    weight = known.astype(float)
    for _ in range(STEPS):
        total, first, second = weight.sum(1), (weight * away).sum(1), (weight * away**2).sum(1)
        sums, moments = (weight * values).sum(1), (weight * away * values).sum(1)
        determinant = np.maximum(total * second - first**2, 1e-9)
        slope = (total * moments - first * sums) / determinant
        middle = (second * sums - first * moments) / determinant
        off = values - middle[:, None] - slope[:, None] * away
        scale = np.maximum(SD_PER_MAD * _median(np.abs(off), known), 1e-6)
        weight = known / (1.0 + (off / (2.0 * scale[:, None])) ** 2)
    return _Fits(slope, middle, off, scale)


def upright_lines(grey: np.ndarray) -> np.ndarray:
    """Ends ``(N, 4)`` x, v, x, v of upright lines of a grey picture ``(H, W)`` uint8."""
    found = cv2.createLineSegmentDetector().detect(grey)[0]
    lines = np.zeros((0, 4)) if found is None else found.reshape(-1, 4).astype(np.float64)
    along, down = np.abs(lines[:, 2] - lines[:, 0]), np.abs(lines[:, 3] - lines[:, 1])
    return lines[(down > SHORTEST * len(grey)) & (along < MOST_LEANING * down)]


class _Along(NamedTuple):
    """What is matched along lines, ``(N, L)`` each; a line has a sample a row, the longest has ``L``."""

    row: np.ndarray  # of the picture
    shift: np.ndarray
    known: np.ndarray  # bool, where a line has a sample and this is matched
    share: np.ndarray  # (N,) of the samples of a line that are known


def _along(lines: np.ndarray, shift: np.ndarray, matched: np.ndarray) -> _Along:
    """The samples along lines ``(N, 4)``, one at least."""
    height, width = shift.shape
    x0, v0, x1, v1 = lines.T[:, :, None]
    count = np.maximum(8, np.abs(v1 - v0).astype(int))  # (N, 1)
    k = np.arange(count.max())
    t = 0.05 + 0.9 * k / (count - 1)
    rows = np.clip(np.rint(v0 + (v1 - v0) * t).astype(int), 0, height - 1)
    columns = np.rint(x0 + (x1 - x0) * t).astype(int)
    columns = np.clip(columns + np.arange(-BESIDE, BESIDE + 1)[:, None, None], 0, width - 1)
    of_line = np.where(matched[rows, columns] > 0, shift[rows, columns], -np.inf).max(0)
    known = np.isfinite(of_line) & (k < count)
    return _Along(rows.astype(float), of_line.astype(float), known, known.sum(1) / count[:, 0])


def certain_shear(lines: np.ndarray, shift: np.ndarray, matched: np.ndarray) -> float:
    """Pixels per row by which the right picture of a rectified pair is certainly sheared along its rows.

    It is the median of ``dd/dv - k d`` over upright lines, whose common ``k`` the left picture alone gives,
    of which the ``certain_part`` counts. As matchers flatten surfaces, part of ``k d`` may be missing from
    ``dd/dv``: of the medians with and without it the one nearer to 0 counts.

    Args:
        lines: ``(N, 4)``, ``upright_lines`` of the left picture ``(H, W)``.
        shift: ``(H, W)`` pixels from where a point would be at infinity, >= 0.
        matched: ``(H, W)``, above 0 where the shift is known.

    Returns:
        0 where nothing is certain, NaN where too few lines are matched.
    """
    if len(lines) < FEWEST_LINES:
        return math.nan
    along = _along(lines, shift, matched)
    enough = (along.known.sum(1) >= FEWEST_MATCHED) & (along.share >= LEAST_MATCHED)
    if enough.sum() < FEWEST_LINES:
        return math.nan
    lines, courses = lines[enough], _fit_lines(along.row[enough], along.shift[enough], along.known[enough])
    straight = courses.scale < MOST_SCATTER_PX
    x = (lines[straight, 0] + lines[straight, 2]) / 2
    if straight.sum() < FEWEST_LINES or x.std() < LEAST_SPREAD * shift.shape[1]:
        return math.nan
    slopes = (lines[straight, 2] - lines[straight, 0]) / (lines[straight, 3] - lines[straight, 1])
    meeting = _fit_lines(x[None], slopes[None], np.ones((1, len(x)), bool))
    if meeting.scale[0] > MOST_APART:
        return math.nan
    parallel = np.abs(meeting.off[0]) < MOST_OFF * max(float(meeting.scale[0]), EXACT)
    if parallel.sum() < FEWEST_LINES:
        return math.nan
    flat = courses.slope[straight][parallel]
    middle = courses.middle[straight][parallel]
    exact = max(float(meeting.scale[0]), EXACT) / (math.sqrt(len(x)) * x.std())  # standard error of k
    pitched = _certain_median(flat - float(meeting.slope[0]) * middle, exact * float(np.median(middle)))
    certain = [_certain_median(flat), pitched]
    return min(certain, key=abs) if certain[0] * certain[1] > 0 else 0.0


def _certain_median(values: np.ndarray, common: float = 0.0) -> float:
    """The ``certain_part`` of the median of values that have an error of the size ``common`` in common."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    error = MEDIAN_OVER_MEAN * (high - low) / MIDDLE_HALF / math.sqrt(len(values))
    return certain_part(float(middle), math.hypot(error, common))
