"""Means over images with bootstrap intervals.

Data flow: one number per image -> mean and interval.
Paper: S5.1 reports means only; the intervals are ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["FEWEST_FOR_INTERVAL", "Mean", "mean_with_interval", "paired_difference"]

FEWEST_FOR_INTERVAL = 5
"""Below this number of images no interval is given: resampling four values says nothing."""


@dataclass(frozen=True)
class Mean:
    """A mean over images.

    Attributes:
        value: the mean; NaN for no image.
        low: 2.5 % quantile of the bootstrap, ``None`` for fewer than ``FEWEST_FOR_INTERVAL`` images.
        high: 97.5 % quantile.
        count: number of images.
    """

    value: float
    low: float | None
    high: float | None
    count: int


def mean_with_interval(values: Sequence[float], seed: int = 0, draws: int = 2000) -> Mean:
    """Mean over images and its 95 % percentile-bootstrap interval.

    Args:
        values: one number per image.
        seed: of the resampling; the same seed gives the same interval.
        draws: number of resamplings.

    Returns:
        ``Mean``.
    """
    data = np.asarray(values, np.float64)
    if data.size == 0:
        return Mean(float("nan"), None, None, 0)
    if data.size < FEWEST_FOR_INTERVAL:
        return Mean(float(data.mean()), None, None, data.size)
    picks = np.random.default_rng(seed).integers(0, data.size, (draws, data.size))
    low, high = np.quantile(data[picks].mean(axis=1), [0.025, 0.975])
    return Mean(float(data.mean()), float(low), float(high), data.size)


def paired_difference(first: dict[str, float], second: dict[str, float], seed: int = 0) -> Mean:
    """Mean of ``first - second`` over the images that both have, with its interval.

    Args:
        first: value by image.
        second: value by image.
        seed: of the resampling.

    Returns:
        ``Mean`` of the differences; an interval that excludes 0 tells the two methods apart.
    """
    shared = [name for name in first if name in second]
    return mean_with_interval([first[name] - second[name] for name in shared], seed)
