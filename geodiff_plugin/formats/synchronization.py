"""Pairs the frames of two videos by time, and estimates how long after the left one the right one started.

Both cameras of a rig see the same motion, so the brightness in the same part of both images changes at the
same time.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from geodiff_plugin.formats.recordings import VideoFacts, video_facts

#: Maximum length of the videos that is compared, seconds.
COMPARED_S = 60.0
#: Size of the reduced frames, (width, height). Cells are wide, because disparity would look like a pan at
#: another moment in narrow ones.
CELLS = (2, 8)
#: Standard deviation of the temporal smoothing in frames, for times between the frames.
SMOOTHING = 1.0
#: Change of brightness between frames, of 255, that noise and compression explain.
NOISE = 0.5
#: Minimum number of intervals that both videos must share at a tested offset, and as a fraction of the
#: shorter video: fewer correlate by chance.
MIN_SHARED = 12
MIN_SHARED_FRACTION = 0.5
#: Minimum correlation of the changes at the estimated offset. Two cameras of one rig have .8 or more.
MIN_CORRELATION = 0.5
#: Minimum difference to the correlation at any other offset, further away than ``NEAR_S``.
MIN_LEAD = 0.1
NEAR_S = 0.25


class Offset(NamedTuple):
    """Time between the starts of two videos."""

    seconds: float  # by which the right one started after the left one
    correlation: float  # of the changes at this offset, [-1, 1]
    without: float  # the same without an offset


class WatchedVideo(NamedTuple):
    """Facts of a video, and the mean brightness of its cells over time."""

    facts: VideoFacts
    cells: np.ndarray  # (N, C) grey levels of the first N frames


def watch(path: Path, name: str) -> WatchedVideo:
    """Decode a video and measure the brightness of ``CELLS`` in its first ``COMPARED_S`` seconds."""
    cells: list[np.ndarray] = []

    def see(seconds: float, image: np.ndarray) -> bool:
        small = cv2.resize(image, CELLS, interpolation=cv2.INTER_AREA)
        cells.append(small.mean(axis=2, dtype=np.float64).ravel())
        return seconds < COMPARED_S

    facts = video_facts(path, name, see)
    return WatchedVideo(facts, np.stack(cells))


def frame_interval(times: Sequence[float] | np.ndarray) -> float:
    """Return the median time between frames, seconds."""
    return float(np.median(np.diff(times))) if len(times) > 1 else 1.0


def _changes(video: WatchedVideo, step: float) -> np.ndarray:
    """Return the change of every cell per interval of ``step`` seconds, ``(M, C)``, with unit variance."""
    times = np.asarray(video.facts.times[: len(video.cells)])
    grid = np.arange(0.0, times[-1] + step / 2, step)
    levels = np.stack([np.interp(grid, times, cell) for cell in video.cells.T], 1)
    changes = np.diff(gaussian_filter1d(levels, SMOOTHING, axis=0), axis=0)
    return changes / np.sqrt((changes**2).mean(0) + NOISE**2)


def estimate_offset(left: WatchedVideo, right: WatchedVideo) -> Offset | None:
    """Estimate the time between the starts of two videos; ``None`` if their changes do not determine it."""
    from scipy.signal import fftconvolve  # slow to import, because it loads scipy.stats

    step = min(frame_interval(np.asarray(video.facts.times)) for video in (left, right))
    a, b = _changes(left, step), _changes(right, step)
    needed = max(MIN_SHARED, MIN_SHARED_FRACTION * min(len(a), len(b)))
    if min(len(a), len(b)) < needed:
        return None
    lags = np.arange(-(len(b) - 1), len(a))  # intervals by which the right video started later
    product = fftconvolve(a, b[::-1], axes=0).sum(1)
    energies = [
        fftconvolve((a**2).sum(1), np.ones(len(b))),
        fftconvolve(np.ones(len(a)), (b**2).sum(1)[::-1]),
    ]
    shared = np.rint(fftconvolve(np.ones(len(a)), np.ones(len(b))))
    scale = np.sqrt(np.maximum(energies[0] * energies[1], 1e-12))
    correlation = np.where(shared >= needed, product / scale, -1.0)
    best = int(correlation.argmax())
    others = correlation[np.abs(lags - lags[best]) * step > NEAR_S]
    if correlation[best] < MIN_CORRELATION or correlation[best] - others.max(initial=-1.0) < MIN_LEAD:
        return None
    seconds = (lags[best] + _vertex(correlation, best)) * step
    return Offset(float(seconds), float(correlation[best]), float(correlation[lags == 0][0]))


def _vertex(values: np.ndarray, at: int) -> float:
    """Return the offset of the vertex of a parabola through a maximum and both neighbours."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, peak, after = values[at - 1 : at + 2]
    return float(np.clip(0.5 * (before - after) / min(before - 2 * peak + after, -1e-12), -0.5, 0.5))


def pair_frames(left: VideoFacts, right: VideoFacts, offset_s: float) -> list[tuple[int, int]]:
    """Return the numbers of frames taken at the same time; the right video started ``offset_s`` later.

    A right frame is at most half the time between two frames away. Videos of equal length that start together
    are paired frame by frame, because the times of synchronized cameras may jitter.
    """
    times = np.asarray(left.times) - offset_s
    others = np.asarray(right.times)
    interval = max(frame_interval(times), frame_interval(others))
    if left.frames == right.frames and np.abs(times - others).max() < interval / 2:
        return [(n, n) for n in range(left.frames)]
    after = np.clip(np.searchsorted(others, times), 1, max(len(others) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(others) - 1)
    nearest = np.where(times - others[before] <= others[after] - times, before, after)
    near = np.abs(others[nearest] - times) <= interval / 2 * (1 + 1e-6)
    return [(n, int(nearest[n])) for n in np.flatnonzero(near).tolist()]
