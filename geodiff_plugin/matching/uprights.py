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

#: Shortest line, as a share of the picture's height.
SHORTEST = 0.06
#: An upright line moves along the rows by this per row at most.
MOST_LEANING = 0.2
#: Pixels beside a line in which its shift is looked for: that of its nearer side is the line's.
BESIDE = 2
#: Share of a line's pixels that must be matched.
LEAST_MATCHED = 0.5
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
#: So many standard errors of an estimate are not counted.
UNCERTAIN = 4.0
#: Steps of a robust fit.
STEPS = 8
#: Middle half of a normal distribution in standard deviations, and what a median's error is to a mean's.
MIDDLE_HALF, MEDIAN_OVER_MEAN = 1.349, 1.253


class _Fit(NamedTuple):
    """A straight course fitted to values: its slope, its value at the middle, residuals, and their scale."""

    slope: float
    middle: float
    off: np.ndarray
    scale: float


def _fit_line(at: np.ndarray, values: np.ndarray) -> _Fit:
    """``min sum_i rho(values_i - middle - slope (at_i - mean(at)))`` with Cauchy's ``rho``."""
    A = np.stack([at - at.mean(), np.ones(len(at))], axis=1)
    weight = np.ones(len(at))
    for _ in range(STEPS):
        H = (A * weight[:, None]).T @ A + 1e-9 * np.eye(2)
        slope, middle = np.linalg.solve(H, (A * weight[:, None]).T @ values)
        off = values - A @ (slope, middle)
        scale = max(1.4826 * float(np.median(np.abs(off))), 1e-6)
        weight = 1.0 / (1.0 + (off / (2.0 * scale)) ** 2)
    return _Fit(float(slope), float(middle), off, scale)


def _upright_lines(grey: np.ndarray) -> np.ndarray:
    """Ends ``(N, 4)`` x, v, x, v of upright lines of a grey picture ``(H, W)`` uint8."""
    found = cv2.createLineSegmentDetector().detect(grey)[0]
    lines = np.zeros((0, 4)) if found is None else found.reshape(-1, 4).astype(np.float64)
    along, down = np.abs(lines[:, 2] - lines[:, 0]), np.abs(lines[:, 3] - lines[:, 1])
    return lines[(down > SHORTEST * len(grey)) & (along < MOST_LEANING * down)]


def _course(line: np.ndarray, shift: np.ndarray, matched: np.ndarray) -> _Fit | None:
    """How the shift changes along a line; ``None`` where it is hardly matched or not straight."""
    height, width = shift.shape
    x0, v0, x1, v1 = line
    t = np.linspace(0.05, 0.95, max(8, int(abs(v1 - v0))))
    rows = np.clip(np.rint(v0 + (v1 - v0) * t).astype(int), 0, height - 1)
    columns = np.rint(x0 + (x1 - x0) * t).astype(int)
    columns = np.clip(columns + np.arange(-BESIDE, BESIDE + 1)[:, None], 0, width - 1)
    of_line = np.where(matched[rows, columns] > 0, shift[rows, columns], -np.inf).max(0)
    known = np.isfinite(of_line)
    if known.sum() < 8 or known.mean() < LEAST_MATCHED:
        return None
    fit = _fit_line(rows[known].astype(float), of_line[known].astype(float))
    return fit if fit.scale < MOST_SCATTER_PX else None


def certain_shear(grey: np.ndarray, shift: np.ndarray, matched: np.ndarray) -> float:
    """Pixels per row by which the right picture of a rectified pair is certainly sheared along its rows.

    It is the median of ``dd/dv - k d`` over upright lines, whose common ``k`` the left picture alone gives,
    moved towards 0 by ``UNCERTAIN`` standard errors. As matchers flatten surfaces, part of ``k d`` may be
    missing from ``dd/dv``: of the medians with and without it the one nearer to 0 counts.

    Args:
        grey: ``(H, W)`` uint8, the left picture.
        shift: ``(H, W)`` pixels from where a point would be at infinity, >= 0.
        matched: ``(H, W)``, above 0 where the shift is known.

    Returns:
        0 where nothing is certain, NaN where too few lines are matched.
    """
    lines = _upright_lines(grey)
    courses = [_course(line, shift, matched) for line in lines]
    kept = np.array([course is not None for course in courses], bool)
    if kept.sum() < FEWEST_LINES:
        return math.nan
    x = (lines[kept, 0] + lines[kept, 2]) / 2
    if x.std() < LEAST_SPREAD * grey.shape[1]:
        return math.nan
    slopes = (lines[kept, 2] - lines[kept, 0]) / (lines[kept, 3] - lines[kept, 1])
    meeting = _fit_line(x, slopes)
    parallel = np.abs(meeting.off) < MOST_OFF * max(meeting.scale, EXACT)
    if parallel.sum() < FEWEST_LINES:
        return math.nan
    flat = np.array([course.slope for course in courses if course is not None])[parallel]
    pitch = np.array([meeting.slope * course.middle for course in courses if course is not None])[parallel]
    certain = [_certain_median(flat), _certain_median(flat - pitch)]
    return min(certain, key=abs) if certain[0] * certain[1] > 0 else 0.0


def _certain_median(values: np.ndarray) -> float:
    """The median, moved towards 0 by ``UNCERTAIN`` standard errors."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    error = MEDIAN_OVER_MEAN * (high - low) / MIDDLE_HALF / math.sqrt(len(values))
    return float(np.sign(middle) * max(abs(middle) - UNCERTAIN * error, 0.0))
