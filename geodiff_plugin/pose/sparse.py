"""Matches of distinct points: SIFT as RootSIFT, mutual nearest neighbours, ratio test.

Data flow: grey left image, grey right images -> pixels of points in both.
Paper: none; Arandjelovic and Zisserman 2012 for the root, Lowe 2004 for the ratio.
"""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["Features", "match_features", "sift_features"]

#: The nearest descriptor must be nearer than this share of the second nearest.
RATIO = 0.8
#: Most points of an image; their number decides the time of matching.
MOST_POINTS = 4000
#: Low, so that blank walls give some points as well; the ratio test sorts them out.
CONTRAST = 0.01

Features = tuple[np.ndarray, np.ndarray]
"""Pixels ``(N, 2)`` float64 and descriptors ``(N, 128)`` float32 of unit length."""


def sift_features(grey: np.ndarray) -> Features:
    """Points of an image, the centre of its first pixel at (0, 0).

    Args:
        grey: ``(H, W)`` uint8.
    """
    sift = cv2.SIFT.create(nfeatures=MOST_POINTS, contrastThreshold=CONTRAST)
    points, descriptors = sift.detectAndCompute(grey, None)
    if not points:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-7))
    return np.array([p.pt for p in points], np.float64), root.astype(np.float32)


def match_features(left: Features, right: Features) -> np.ndarray:
    """Indices ``(M, 2)`` of points that are each other's nearest, by the ratio test from the left.

    Args:
        left: of ``sift_features``.
        right: likewise.
    """
    if min(len(left[0]), len(right[0])) < 2:
        return np.zeros((0, 2), int)
    alike = left[1] @ right[1].T  # unit vectors: distance^2 = 2 - 2 alike
    rows = np.arange(len(alike))
    best = alike.argmax(1)
    nearest = alike[rows, best]
    mutual = alike.argmax(0)[best] == rows
    alike[rows, best] = -1.0
    second = alike.max(1)
    clear = (1.0 - nearest) < RATIO**2 * (1.0 - second)
    kept = mutual & clear
    return np.c_[rows[kept], best[kept]]
