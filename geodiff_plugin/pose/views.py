"""The matches of a left image with its right ones, on a grid of their own.

Data flow: images, K's, T's as given -> grey images of at most 832 px -> sparse tracks; dense ones by a
first depth.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from geodiff_plugin.geometry import plane_rays, project_rays
from geodiff_plugin.pose.dense import cell_centres, dense_matches
from geodiff_plugin.pose.sparse import match_features, sift_features
from geodiff_plugin.pose.tracks import Tracks
from geodiff_plugin.types import CameraView

__all__ = ["LONG_SIDE", "FirstDepth", "GreyViews", "dense_tracks", "grey_views", "sparse_tracks"]

#: Longer side of the left image that matches are sought on, pixels; residuals are in pixels of this grid.
LONG_SIDE = 832

FirstDepth = Callable[[Sequence[CameraView]], Tensor]
"""Right views with poses -> a rough depth ``(1, 1, h, w)`` of the left image, metres, without holes."""


@dataclass(frozen=True, eq=False)
class GreyViews:
    """Grey images on the grid of the matches.

    Attributes:
        left: ``(H, W)`` uint8.
        rights: ``(Hr, Wr)`` uint8 each, at about as many pixels per radian.
        K_left: ``(3, 3)`` float64.
        K_rights: ``(V, 3, 3)`` float64.
    """

    left: np.ndarray
    rights: tuple[np.ndarray, ...]
    K_left: np.ndarray
    K_rights: np.ndarray


def _grey(image_01: Tensor, K_image: Tensor, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """A grey image shrunk by a factor <= 1, and its K."""
    pixels = image_01.detach().cpu().float().permute(1, 2, 0).contiguous().numpy()
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) if pixels.shape[-1] == 3 else pixels[..., 0]
    K = K_image.detach().cpu().double().numpy().copy()
    height, width = grey.shape
    size = max(1, round(width * factor)), max(1, round(height * factor))
    if factor < 1.0:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        scale = np.array([size[0] / width, size[1] / height])
        K[:2, :2] *= scale[:, None]
        K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5
    return np.rint(grey * 255.0).clip(0, 255).astype(np.uint8), K


def grey_views(left_01: Tensor, rights: Sequence[CameraView], K_left: Tensor) -> GreyViews:
    """Images as matches are sought in them.

    Args:
        left_01: ``(3, H, W)`` in [0, 1].
        rights: as they were given.
        K_left: ``(3, 3)``.
    """
    left, K = _grey(left_01, K_left, min(1.0, LONG_SIDE / max(left_01.shape[-2:])))
    small = []
    for image, K_right, _ in rights:
        as_fine = float(K[0, 0] / K_right[0, 0])
        small.append(_grey(image, K_right, min(1.0, as_fine, 2 * LONG_SIDE / max(image.shape[-2:]))))
    return GreyViews(left, tuple(grey for grey, _ in small), K, np.stack([K_right for _, K_right in small]))


def sparse_tracks(views: GreyViews) -> Tracks:
    """SIFT points of the left image with their matches in the right ones."""
    left = sift_features(views.left)
    right_px = np.zeros((len(views.rights), len(left[0]), 2))
    seen = np.zeros(right_px.shape[:2], bool)
    for v, image in enumerate(views.rights):
        right = sift_features(image)
        of_left, of_right = match_features(left, right).T
        right_px[v, of_left], seen[v, of_left] = right[0][of_right], True
    return Tracks(left[0], right_px, seen, views.K_left, views.K_rights).seen_anywhere()


def dense_tracks(views: GreyViews, depth_m: Tensor, Ts: np.ndarray) -> Tracks:
    """The centres of the left image's cells with their places by optical flow in the right images.

    Args:
        views: the images.
        depth_m: ``(1, 1, H, W)`` rough depth on the left grid, without holes.
        Ts: ``(V, 4, 4)``, ``T_right_from_left``, that the depth goes with.
    """
    centres = cell_centres(views.left.shape).astype(np.float64)
    right_px = np.zeros((len(Ts), len(centres), 2))
    seen = np.zeros((len(Ts), len(centres)), bool)
    for v, (image, K, T) in enumerate(zip(views.rights, views.K_rights, Ts, strict=True)):
        K_left, K_right, T_right = (
            torch.as_tensor(m, dtype=torch.float32, device="cpu")[None] for m in (views.K_left, K, T)
        )
        height, width = views.left.shape
        projected = project_rays(depth_m, plane_rays(K_left, K_right, T_right, (height, width)))
        uv, z = (part[0].numpy() for part in projected)
        inside = (uv >= 0).all(-1) & (uv <= np.array(image.shape[::-1]) - 1).all(-1)
        right_px[v], seen[v] = dense_matches(views.left, image, uv, inside & (z > 0))
    return Tracks(centres, right_px, seen, views.K_left, views.K_rights).seen_anywhere()
