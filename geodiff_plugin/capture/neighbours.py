"""Which frames are right views of a frame: those that see its points under a good angle of the rays."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from geodiff_plugin.pose.capture import SolvedCapture

__all__ = ["BEST_ANGLE_DEG", "choose_neighbours"]

#: Angle of two rays that a match is worth most at, degrees, and how fast it is worth less below and above it.
BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG = 6.0, 2.5, 10.0
#: A point that a chosen neighbour sees already counts so much for the next one.
SEEN_AGAIN = 0.5
#: A neighbour must be worth this share of the best one.
LEAST_SHARE = 0.15
#: Shared points below which two frames are no neighbours.
FEWEST_SHARED = 12


def choose_neighbours(
    solved: SolvedCapture, frame: int, most: int, among: Collection[int] | None = None
) -> list[int]:
    """Neighbours of a frame, the best first.

    Every shared point counts by the angle of its two rays, as in COLMAP's and MVSNet's view selection, and
    less where earlier neighbours see it: so the neighbours together see all of the frame.

    Args:
        solved: poses and points.
        frame: number of the frame.
        most: neighbours wanted, >= 1.
        among: frames to choose from; ``None`` for all.

    Returns:
        At most ``most`` numbers; those nearest by position where the frame shares no points.

    Source: Yao et al. 2018 (MVSNet), S5.1: the piecewise Gaussian of the angle.
    """
    values = _values(solved, frame)
    chosen: list[int] = []
    first, left = 0.0, np.ones(values.shape[1])
    out = (values > 0).sum(1) < FEWEST_SHARED
    out |= [among is not None and i not in among for i in range(len(out))]
    while len(chosen) < most:
        gains = np.where(out, -1.0, values @ left)
        best = int(np.argmax(gains))
        if gains[best] <= LEAST_SHARE * first:
            break
        first = first or float(gains[best])
        chosen.append(best)
        out[best] = True
        left = left * np.where(values[best] > 0, SEEN_AGAIN, 1.0)
    return chosen if chosen or among is not None else _nearest(solved, frame, most)


def _values(solved: SolvedCapture, frame: int) -> np.ndarray:
    """``(N, P)`` worth of the frame's points to every other frame, 0 where it does not see them."""
    own, values = solved.seen[frame].point, np.zeros((len(solved.E), len(solved.seen[frame].point)))
    rays = solved.points[own] - solved.E[frame, :3, 3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for other, (E, seen) in enumerate(zip(solved.E, solved.seen, strict=True)):
        if other == frame or not np.isfinite(E).all():
            continue
        back = solved.points[own] - E[:3, 3]
        back /= np.linalg.norm(back, axis=1, keepdims=True)
        angle = np.degrees(np.arccos(np.clip((rays * back).sum(1), -1, 1)))
        width = np.where(angle < BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG)
        worth = np.exp(-0.5 * ((angle - BEST_ANGLE_DEG) / width) ** 2)
        values[other] = worth * np.isin(own, seen.point)
    return values


def _nearest(solved: SolvedCapture, frame: int, most: int) -> list[int]:
    """Frames near a frame that look the same way, for one that shares no points."""
    E = solved.E if solved.E_given is None else solved.E_given
    if not np.isfinite(E[frame]).all():
        return []
    apart = np.linalg.norm(E[:, :3, 3] - E[frame, :3, 3], axis=1)
    turned = np.degrees(np.arccos(np.clip(E[:, :3, 2] @ E[frame, :3, 2], -1, 1)))
    fits = np.isfinite(apart) & (apart > 0) & (turned < 30)
    order = [int(i) for i in np.argsort(np.abs(np.arange(len(E)) - frame)) if fits[i]]
    return order[:most]
