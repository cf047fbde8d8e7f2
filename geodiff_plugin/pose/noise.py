"""How many independent observations a set of matches is worth.

Data flow: matches + poses that fit them -> share of the matches that count, in (0, 1].
Paper: none.

Residuals of neighbours are alike where a pose cannot explain them (a rolling shutter, lens distortion, K),
and then a thousand matches hold a pose no better than a few. Blocks of the image show it: the mean of ``n``
independent residuals varies by ``1 / n`` of what one does.
"""

from __future__ import annotations

import numpy as np

from geodiff_plugin.pose.tracks import Tracks, project_tracks, solve_inverse_depth

__all__ = ["across_lines", "independent_share"]

#: Blocks a row of the left image.
BLOCKS = 10
_FEWEST_IN_BLOCK = 5


def across_lines(tracks: Tracks, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed residuals ``(N,)`` across the epipolar lines, and the lines' normals ``(N, 2)``.

    Args:
        tracks: of one right view.
        T: ``(4, 4)``, ``T_right_from_left``.
    """
    at = project_tracks(tracks.rays, solve_inverse_depth(tracks, T[None]), tracks.K_rights[0], T)
    along = at.by_inverse_depth / np.maximum(np.linalg.norm(at.by_inverse_depth, axis=1, keepdims=True), 1e-9)
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return ((at.px - tracks.right_px[0]) * normals).sum(1), normals


def independent_share(tracks: Tracks, T: np.ndarray) -> float:
    """How much of a match counts, 1 where residuals of neighbours have nothing in common.

    Args:
        tracks: of one right view.
        T: ``(4, 4)``, ``T_right_from_left``, that fits them.
    """
    off, _ = across_lines(tracks, T)
    scale = max(1.4826 * float(np.median(np.abs(off))), 1e-3)
    kept = np.abs(off) < 3.0 * scale
    width = max(2.0 * tracks.K_left[0, 2], 1.0)  # that of an image whose principal point is near its middle
    column, row = (tracks.left_px[kept] // (width / BLOCKS)).astype(int).T
    _, block, count = np.unique(row * 1000 + column, return_inverse=True, return_counts=True)
    mean = np.bincount(block, off[kept]) / count
    enough = count >= _FEWEST_IN_BLOCK
    if not enough.any():
        return 1.0
    inflated = (count[enough] * mean[enough] ** 2).mean() / (off[kept] ** 2).mean()
    return float(1.0 / max(inflated, 1.0))
