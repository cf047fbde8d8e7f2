"""Points of the left image with their places in the right ones, and how well poses explain them (Eq. 25)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

#: Fewer matches than this say nothing about a pose.
FEWEST = 40
#: Blocks a row of the left image, for what neighbouring residuals have in common.
_BLOCKS, _FEWEST_IN_BLOCK, _FEWEST_BLOCKS = 10, 5, 3
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Tracks:
    """Points seen in the left image and in V right images.

    ``left_px (N, 2)`` and ``right_px (V, N, 2)`` are float64 pixels; ``seen (V, N)`` says where ``right_px``
    holds; ``K_left (3, 3)``, ``K_rights (V, 3, 3)``.
    """

    left_px: np.ndarray
    right_px: np.ndarray
    seen: np.ndarray
    K_left: np.ndarray
    K_rights: np.ndarray

    def __len__(self) -> int:
        return len(self.left_px)

    @cached_property
    def rays(self) -> np.ndarray:
        """``(N, 3)`` left rays with z = 1."""
        return np.linalg.solve(self.K_left, np.c_[self.left_px, np.ones(len(self))].T).T

    def kept(self, mask: np.ndarray | slice) -> Tracks:
        """The tracks of a boolean mask or an index."""
        left_px, right_px, seen = self.left_px[mask], self.right_px[:, mask], self.seen[:, mask]
        return replace(self, left_px=left_px, right_px=right_px, seen=seen)

    def alone(self, v: int) -> Tracks:
        """All tracks, with right view ``v`` alone."""
        at = slice(v, v + 1)
        return replace(self, right_px=self.right_px[at], seen=self.seen[at], K_rights=self.K_rights[at])

    def view(self, v: int) -> Tracks:
        """The tracks that right view ``v`` sees, of that view alone."""
        return self.alone(v).kept(self.seen[v])

    def seen_anywhere(self) -> Tracks:
        """The tracks that one right view has at least."""
        return self.kept(np.any(self.seen, axis=0))


def merge_tracks(parts: Sequence[Tracks]) -> Tracks:
    """Tracks of the same views one after the other."""
    return replace(
        parts[0],
        left_px=np.concatenate([p.left_px for p in parts]),
        right_px=np.concatenate([p.right_px for p in parts], axis=1),
        seen=np.concatenate([p.seen for p in parts], axis=1),
    )


class Projected(NamedTuple):
    """Tracks in one right view, at given inverse depths.

    ``px (N, 2)``; ``scaled (N, 3)``, the points in the right frame times their inverse left depth; the
    derivatives of ``px`` by ``scaled``, ``by_point (N, 2, 3)``, and by inverse depth,
    ``by_inverse_depth (N, 2)``.
    """

    px: np.ndarray
    scaled: np.ndarray
    by_point: np.ndarray
    by_inverse_depth: np.ndarray


def project_tracks(rays: np.ndarray, inverse_depth: np.ndarray, K: np.ndarray, T: np.ndarray) -> Projected:
    """Where a right camera ``K (3, 3)``, ``T_right_from_left (4, 4)`` sees points on left rays.

    ``rays (N, 3)`` have z = 1, ``inverse_depth (N,)`` is in 1/m, 0 for infinity.
    """
    scaled = rays @ T[:3, :3].T + inverse_depth[:, None] * T[:3, 3]
    z = scaled[:, 2]
    z = np.where(np.abs(z) < 1e-6, 1e-6, z)
    flat = scaled[:, :2] / z[:, None]
    px = flat @ K[:2, :2].T + K[:2, 2]
    by_point = np.empty((len(rays), 2, 3))
    by_point[:, :, :2] = K[:2, :2] / z[:, None, None]
    by_point[:, :, 2] = -(flat @ K[:2, :2].T) / z[:, None]
    return Projected(px, scaled, by_point, by_point @ T[:3, 3])


def _linear_inverse_depth(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """The inverse depth with the least algebraic error, ``(N,)``."""
    above, below = np.zeros(len(tracks)), np.zeros(len(tracks))
    for right_px, seen, K, T in zip(tracks.right_px, tracks.seen, tracks.K_rights, Ts, strict=True):
        A, b = tracks.rays @ (K @ T[:3, :3]).T, K @ T[:3, 3]
        c = A[:, :2] - right_px * A[:, 2:]
        d = b[:2] - right_px * b[2]
        above -= np.where(seen, (c * d).sum(1), 0.0)
        below += np.where(seen, (d * d).sum(1), 0.0)
    return above / np.maximum(below, _TINY)


def solve_inverse_depth(tracks: Tracks, Ts: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """The inverse depth ``(N,)`` 1/m of every track that fits its right pixels best, by Gauss and Newton.

    ``Ts (V, 4, 4)`` are ``T_right_from_left``, ``weights (V, N)`` of the observations; negative where the
    rays diverge.
    """
    weights = tracks.seen.astype(float) if weights is None else weights * tracks.seen
    inverse_depth = _linear_inverse_depth(tracks, Ts)
    for _ in range(3):
        above, below = np.zeros(len(tracks)), np.full(len(tracks), _TINY)
        for v, T in enumerate(Ts):
            at = project_tracks(tracks.rays, inverse_depth, tracks.K_rights[v], T)
            off = tracks.right_px[v] - at.px
            above += weights[v] * (at.by_inverse_depth * off).sum(1)
            below += weights[v] * (at.by_inverse_depth**2).sum(1)
        inverse_depth = inverse_depth + above / below
    return inverse_depth


def residuals_px(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """How far observations lie from where the poses ``(V, 4, 4)`` can put them; NaN where not seen.

    ``(V, N)`` pixels of the right views; with one right view that is the distance from the epipolar line.
    """
    inverse_depth = solve_inverse_depth(tracks, Ts)
    off = [
        np.linalg.norm(project_tracks(tracks.rays, inverse_depth, K, T).px - px, axis=1)
        for px, K, T in zip(tracks.right_px, tracks.K_rights, Ts, strict=True)
    ]
    return np.where(tracks.seen, np.stack(off), np.nan)


def median_residuals(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Median distance from the epipolar lines, ``(V,)`` pixels, NaN for a view with too few matches."""
    views = [(tracks.view(v), T[None]) for v, T in enumerate(Ts)]
    return np.array([np.median(residuals_px(*v)) if len(v[0]) >= FEWEST else np.nan for v in views])


def blocks(tracks: Tracks) -> np.ndarray:
    """The block of the left image that every track lies in, ``(N,)``, numbered from 0 without gaps."""
    width = max(2.0 * tracks.K_left[0, 2], 1.0)  # that of an image whose principal point is near its middle
    column, row = (tracks.left_px // (width / _BLOCKS)).astype(int).T
    return np.unique(row * 1000 + column, return_inverse=True)[1]


def across_lines(tracks: Tracks, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed residuals ``(N,)`` across a right view's epipolar lines, and the lines' normals ``(N, 2)``."""
    at = project_tracks(tracks.rays, solve_inverse_depth(tracks, T[None]), tracks.K_rights[0], T)
    along = at.by_inverse_depth / np.maximum(np.linalg.norm(at.by_inverse_depth, axis=1, keepdims=True), 1e-9)
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return ((at.px - tracks.right_px[0]) * normals).sum(1), normals


def split_residuals(tracks: Tracks, T: np.ndarray) -> tuple[float, float]:
    """Tell noise of single matches from what the residuals of neighbours have in common.

    Residuals of neighbours are alike where no pose explains them (a rolling shutter, lens distortion, K), and
    then a thousand matches hold a pose no better than a few. Blocks of the image show it: the mean of ``n``
    independent residuals varies by ``1 / n`` of what a single residual does.

    ``tracks`` are of one right view, which ``T (4, 4)`` fits. Returns how much of a match counts, in (0, 1];
    and the standard deviation, pixels, of what neighbours have in common: that of the means of blocks beyond
    what noise leaves in them, or of all residuals if the matches lie in too few blocks.
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
    return float(1.0 / max(inflated, 1.0)), float(max(common, 0.0) ** 0.5)
