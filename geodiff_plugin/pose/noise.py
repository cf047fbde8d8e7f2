"""What of the residuals is noise of single matches, and what neighbours have in common.

Data flow: matches + a pose that fits them -> share of the matches that count, in (0, 1]; common residual, px.
Paper: none.

Residuals of neighbours are alike where a pose cannot explain them (a rolling shutter, lens distortion, K),
and then a thousand matches hold a pose no better than a few. Blocks of the image show it: the mean of ``n``
independent residuals varies by ``1 / n`` of what one does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodiff_plugin.pose.tracks import Tracks, project_tracks, solve_inverse_depth

__all__ = ["ResidualParts", "across_lines", "blocks", "split_residuals"]

#: Blocks a row of the left image.
BLOCKS = 10
_FEWEST_IN_BLOCK, _FEWEST_BLOCKS = 5, 3


def blocks(tracks: Tracks) -> np.ndarray:
    """The block of the left image that every track lies in, ``(N,)``, numbered from 0 without gaps."""
    width = max(2.0 * tracks.K_left[0, 2], 1.0)  # that of an image whose principal point is near its middle
    column, row = (tracks.left_px // (width / BLOCKS)).astype(int).T
    return np.unique(row * 1000 + column, return_inverse=True)[1]


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


@dataclass(frozen=True)
class ResidualParts:
    """What the residuals of a right view consist of.

    Attributes:
        independent_share: how much of a match counts, in (0, 1]; 1 where residuals of neighbours have
            nothing in common.
        common_px: standard deviation, pixels, of what the residuals of neighbours have in common: that of
            the means of blocks beyond what noise of single matches leaves in them; of all residuals if the
            matches lie in too few blocks to tell.
    """

    independent_share: float
    common_px: float


def split_residuals(tracks: Tracks, T: np.ndarray) -> ResidualParts:
    """Tell noise of single matches from what neighbours have in common.

    Args:
        tracks: of one right view, at least one.
        T: ``(4, 4)``, ``T_right_from_left``, that fits them.
    """
    off, _ = across_lines(tracks, T)
    scale = max(1.4826 * float(np.median(np.abs(off))), 1e-3)
    kept = np.abs(off) < 3.0 * scale
    block = blocks(tracks.kept(kept))
    count = np.bincount(block)
    mean = np.bincount(block, off[kept]) / count
    enough = count >= _FEWEST_IN_BLOCK
    count, mean = count[enough], mean[enough]
    total = float((off[kept] ** 2).mean())
    inflated = (count * mean**2).mean() / total if len(count) else 1.0
    common = total
    if len(count) >= _FEWEST_BLOCKS:
        between = (mean**2).mean()
        common = between - max(total - between, 0.0) * (1.0 / count).mean()
    return ResidualParts(float(1.0 / max(inflated, 1.0)), float(max(common, 0.0) ** 0.5))
