"""What of the residuals is noise of single matches, and what neighbours have in common.

Data flow: matches + a pose that fits them -> share of the matches that count, in (0, 1]; common residual, px.
Paper: none.

Residuals of neighbours are alike where a pose cannot explain them (a rolling shutter, lens distortion, K),
and then a thousand matches hold a pose no better than a few. Blocks of the image show it: the mean of ``n``
independent residuals varies by ``1 / n`` of what one does.
"""

from __future__ import annotations

import numpy as np

from geodiff_plugin.pose.tracks import Tracks, project_tracks, solve_inverse_depth

__all__ = ["across_lines", "common_residual_px", "independent_share"]

#: Blocks a row of the left image.
BLOCKS = 10
_FEWEST_IN_BLOCK, _FEWEST_BLOCKS = 5, 3


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


def _in_blocks(tracks: Tracks, T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals ``(N,)`` without outliers; their number and mean ``(M,)`` in the blocks that have enough."""
    off, _ = across_lines(tracks, T)
    scale = max(1.4826 * float(np.median(np.abs(off))), 1e-3)
    kept = np.abs(off) < 3.0 * scale
    width = max(2.0 * tracks.K_left[0, 2], 1.0)  # that of an image whose principal point is near its middle
    column, row = (tracks.left_px[kept] // (width / BLOCKS)).astype(int).T
    _, block, count = np.unique(row * 1000 + column, return_inverse=True, return_counts=True)
    mean = np.bincount(block, off[kept]) / count
    enough = count >= _FEWEST_IN_BLOCK
    return off[kept], count[enough], mean[enough]


def independent_share(tracks: Tracks, T: np.ndarray) -> float:
    """How much of a match counts, 1 where residuals of neighbours have nothing in common.

    Args:
        tracks: of one right view.
        T: ``(4, 4)``, ``T_right_from_left``, that fits them.
    """
    off, count, mean = _in_blocks(tracks, T)
    if not len(count):
        return 1.0
    return float(1.0 / max((count * mean**2).mean() / (off**2).mean(), 1.0))


def common_residual_px(tracks: Tracks, T: np.ndarray) -> float:
    """Standard deviation, in pixels, of what the residuals of neighbours have in common.

    Args:
        tracks: of one right view.
        T: ``(4, 4)``, ``T_right_from_left``, that fits them.

    Returns:
        That of the means of blocks beyond what noise of single matches leaves in them; of all residuals if
        the matches lie in too few blocks to tell.
    """
    off, count, mean = _in_blocks(tracks, T)
    total = float((off**2).mean())
    if len(count) < _FEWEST_BLOCKS:
        return total**0.5
    common = (mean**2).mean()
    noise = max(total - common, 0.0)
    return float(max(common - noise * (1.0 / count).mean(), 0.0) ** 0.5)
