"""Frames checked against each other's depth, and averaged where they agree, as in the fusion of MVS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

__all__ = ["DepthFrame", "agreed"]

#: Two depths of one point agree within this share; a point that comes back further off is another surface.
SAME_SHARE, MOST_OFF_PX = 0.06, 2.0
#: A frame's own depth counts so many times that of another frame, whose pixels are resampled.
OWN_WEIGHT = 2.0
#: Confidence that one agreeing frame adds, as a share of what is missing to 1 and of its own confidence.
RISES = 0.4
Camera = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """Depth of one frame of a capture, as it goes from the runs to agreement and fusion.

    Attributes:
        name: of the frame.
        depth: ``(H, W)`` z of the frame's camera.
        confidence: ``(H, W)`` in [0, 1].
        K: ``(3, 3)`` pixels.
        E: ``(4, 4)`` camera-to-world.
        confirmed: ``(H, W)`` how many other frames have the same depth there.
        asked: ``(H, W)`` how many other frames see the point by this depth.
    """

    name: str
    depth: np.ndarray
    confidence: np.ndarray
    K: np.ndarray
    E: np.ndarray
    confirmed: np.ndarray | None = None
    asked: np.ndarray | None = None


def agreed(frame: DepthFrame, others: Sequence[DepthFrame]) -> DepthFrame:
    """A frame's depth averaged with that of other frames where they agree.

    Args:
        frame: as it came from its own run.
        others: frames that see the same, likewise.

    Returns:
        The frame with ``confirmed`` and ``asked``; depth is a mean over inverse depths weighted by
        confidence, and never leaves what the frames agree on.
    """
    inverse, confidence = 1.0 / frame.depth, frame.confidence
    weight = OWN_WEIGHT * (0.05 + confidence)
    total, above = weight.copy(), weight * inverse
    confirmed, asked = np.zeros(frame.depth.shape, np.uint8), np.zeros(frame.depth.shape, np.uint8)
    missing = 1.0 - confidence
    for other in others:
        depth, sure, seen, same = _seen_from(frame, other)
        asked += seen
        confirmed += same
        more = np.where(same, 0.05 + sure, 0.0)
        total += more
        above += more / np.where(same, depth, 1.0)
        missing = missing * np.where(same, 1.0 - RISES * sure, 1.0)
    return replace(
        frame,
        depth=(total / above).astype(np.float32),
        confidence=(1.0 - missing).astype(np.float32),
        confirmed=confirmed,
        asked=asked,
    )


def _seen_from(frame: DepthFrame, other: DepthFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Another frame's depth brought into a frame's view at every pixel.

    Returns:
        ``(H, W)`` each: the depth that the other frame gives, its confidence there, whether it sees the
        point, and whether both mean the same point.
    """
    height, width = frame.depth.shape
    v, u = np.mgrid[:height, :width].astype(np.float64)
    T = np.linalg.inv(other.E) @ frame.E
    x, y, z = _moved(u, v, frame.depth, frame.K, T)
    uo, vo = (
        (other.K[0, 0] * x + other.K[0, 1] * y) / z + other.K[0, 2],
        other.K[1, 1] * y / z + other.K[1, 2],
    )
    rows, columns = other.depth.shape
    seen = (z > 1e-6) & (uo > 0) & (vo > 0) & (uo < columns - 1) & (vo < rows - 1)
    ui, vi = (np.rint(np.where(seen, a, 0)).astype(int) for a in (uo, vo))
    there = other.depth[vi, ui].astype(np.float64)
    sure = other.confidence[vi, ui]
    # The other frame's point at the very place that ours falls on, back in our view.
    bx, by, bz = _moved(np.where(seen, uo, 0), np.where(seen, vo, 0), there, other.K, np.linalg.inv(T))
    bz = np.where(np.abs(bz) < 1e-6, 1e-6, bz)
    off = np.hypot(frame.K[0, 0] * bx / bz + frame.K[0, 2] - u, frame.K[1, 1] * by / bz + frame.K[1, 2] - v)
    same = seen & (np.abs(bz / frame.depth - 1) < SAME_SHARE) & (off < MOST_OFF_PX * width / 640)
    # A point behind what the other frame sees is hidden from it, which says nothing against ours.
    seen &= there > (1 - SAME_SHARE) * z
    return bz, sure, seen, same


def _moved(
    u: np.ndarray, v: np.ndarray, depth: np.ndarray, K: np.ndarray, T: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of pixels at their depth, in another camera's frame."""
    y = (v - K[1, 2]) / K[1, 1]
    x = (u - K[0, 2] - K[0, 1] * y) / K[0, 0]
    points = np.stack([x * depth, y * depth, depth], -1) @ T[:3, :3].T + T[:3, 3]
    return points[..., 0], points[..., 1], points[..., 2]
