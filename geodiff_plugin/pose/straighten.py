"""What a pose cannot explain, taken out of the right image: a smooth displacement across the epipolar lines.

Data flow: refined pose, matches, right image -> the right image whose matches lie on their lines.
Paper: none. Rolling shutter, lens distortion and errors of K leave such residuals.

Only after the pose: a residual that depends on depth is a pose's, and bending the image for it ruins it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from geodiff_plugin.pose.noise import across_lines
from geodiff_plugin.pose.tracks import Tracks

__all__ = ["Displacement", "fit_displacement", "straightened"]

#: Residual from which on a match counts for less, pixels.
SCALE_PX = 0.5
#: Pull of the 20 coefficients towards 0, in matches.
RIDGE = 3.0
#: Matches of left-out blocks must come nearer to their lines by this share, or nothing is bent.
LEAST_GAIN = 0.05
#: Side of those blocks in shares of the image's width.
_BLOCK = 1.0 / 6.0
_FEWEST = 80


@dataclass(frozen=True, eq=False)
class Displacement:
    """A cubic displacement of a right image.

    Attributes:
        coefficients: ``(10, 2)`` pixels of the image of ``size``.
        size: ``(H, W)`` that it was fitted at.
        most_px: no pixel moves further.
        rms_px: of the displacement at the matches.
    """

    coefficients: np.ndarray
    size: tuple[int, int]
    most_px: float
    rms_px: float

    def at(self, px: np.ndarray) -> np.ndarray:
        """``(N, 2)`` pixels that are to be added to ``(N, 2)`` pixels."""
        moved = _cubic(px, self.size) @ self.coefficients
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        return moved * np.minimum(1.0, self.most_px / np.maximum(length, 1e-9))


def _cubic(px: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """``(N, 10)``: all products of x and y up to the third degree, over [-1, 1] of the longer side."""
    half = max(size) / 2.0
    x, y = (px[:, 0] - (size[1] - 1) / 2) / half, (px[:, 1] - (size[0] - 1) / 2) / half
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)


def _fit(basis: np.ndarray, normals: np.ndarray, off: np.ndarray) -> np.ndarray:
    rows = (basis[:, :, None] * normals[:, None]).reshape(len(basis), -1)
    solution = np.zeros(rows.shape[1])
    for _ in range(15):
        weights = 1.0 / (1.0 + ((rows @ solution - off) / SCALE_PX) ** 2)
        weighted = rows * weights[:, None]
        solution = np.linalg.solve(weighted.T @ rows + RIDGE * np.eye(rows.shape[1]), weighted.T @ off)
    return solution.reshape(10, 2)


def fit_displacement(tracks: Tracks, T: np.ndarray, size: tuple[int, int]) -> Displacement | None:
    """The displacement that brings matches to their epipolar lines, if left-out matches agree.

    Args:
        tracks: of one right view.
        T: ``(4, 4)``, ``T_right_from_left``, refined.
        size: ``(H, W)`` of the right image.

    Returns:
        ``None`` where there are few matches or nothing smooth is left.
    """
    if len(tracks) < _FEWEST:
        return None
    off, normals = across_lines(tracks, T)
    right_px = tracks.right_px[0]
    basis = _cubic(right_px, size)
    block = (tracks.left_px // (_BLOCK * max(size))).sum(1) % 2 == 0
    told = np.empty(len(off))
    for part in (block, ~block):
        if part.sum() < _FEWEST // 4:
            return None
        told[~part] = ((basis[~part] @ _fit(basis[part], normals[part], off[part])) * normals[~part]).sum(1)
    if np.median(np.abs(off - told)) > (1.0 - LEAST_GAIN) * np.median(np.abs(off)):
        return None
    coefficients = _fit(basis, normals, off)
    lengths = np.linalg.norm(basis @ coefficients, axis=1)
    return Displacement(
        coefficients, size, float(np.quantile(lengths, 0.98)), float(np.sqrt((lengths**2).mean()))
    )


def straightened(image_01: torch.Tensor, displacement: Displacement) -> torch.Tensor:
    """The right image with every pixel moved as the displacement says.

    Args:
        image_01: ``(C, H, W)`` float in [0, 1], of any size.
        displacement: fitted to the image at its own size.

    Returns:
        ``(C, H, W)``, its edge repeated where nothing is known; not differentiable.
    """
    height, width = image_01.shape[-2:]
    scale = np.array([displacement.size[1] / width, displacement.size[0] / height])
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2).astype(np.float64)
    moved = displacement.at((grid + 0.5) * scale - 0.5) / scale
    source = (grid - moved).reshape(height, width, 2).astype(np.float32)
    pixels = image_01.detach().cpu().float().permute(1, 2, 0).contiguous().numpy()
    bent = cv2.remap(pixels, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    bent = bent.reshape(height, width, -1).clip(0.0, 1.0)
    return torch.from_numpy(np.ascontiguousarray(bent.transpose(2, 0, 1))).to(image_01)
