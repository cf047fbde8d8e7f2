"""Prepare one left image and its right view for guidance: common grid, cost volume, matches.

Hop: images, K's, T as the user gave them -> ``Evidence`` (once a call) -> ``Views`` of a chunk.
Paper: S7.3 (the plane-sweep view of the g_s search); the matches are beyond it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.geometry.cameras import resize_intrinsics
from geodiff_plugin.geometry.projection import plane_rays
from geodiff_plugin.matching import (
    CostVolume,
    Matches,
    build_cost_volume,
    find_matches,
    mirrored_pose_preferred,
)
from geodiff_plugin.objective import Views

SWAPPED = (
    "The inverse pose explains the views better than the given one: are left and right swapped, "
    "is the sign of the baseline wrong, or is E world-to-camera?"
)

__all__ = ["Evidence", "chunk_views", "prepare_evidence", "resize_long_edge"]


@dataclass(frozen=True)
class Evidence:
    """What two views say before any diffusion step, on the grid of the losses.

    Attributes:
        left_01: ``(3, H, W)`` in [0, 1].
        right_01: ``(3, Hr, Wr)`` in [0, 1].
        K_left: ``(3, 3)`` pixels of ``left_01``.
        K_right: ``(3, 3)`` pixels of ``right_01``.
        T_right_from_left: ``(4, 4)`` metres.
        volume: plane-sweep costs, or ``None`` where the configuration does not search it.
        matches: aggregated, left-right checked, or ``None`` where no term asks.
        sweep_matches: the same on the grid of the sweep, which is finer for wide images.
        warning: a sentence for the user, or empty.
    """

    left_01: Tensor
    right_01: Tensor
    K_left: Tensor
    K_right: Tensor
    T_right_from_left: Tensor
    volume: CostVolume | None
    matches: Matches | None
    sweep_matches: Matches | None
    warning: str = ""


def resize_long_edge(image_01: Tensor, K: Tensor, long_edge: int) -> tuple[Tensor, Tensor]:
    """Shrink an image, antialiased, so that its longer side is at most ``long_edge`` pixels.

    Args:
        image_01: ``(3, H, W)``.
        K: ``(3, 3)`` pixels of it.
        long_edge: pixels; a smaller image is returned as it is.

    Returns:
        image and the camera matrix that belongs to it.
    """
    height, width = image_01.shape[-2:]
    factor = long_edge / max(height, width)
    if factor >= 1.0:
        return image_01, K
    size = (max(1, round(height * factor)), max(1, round(width * factor)))
    small = F.interpolate(image_01[None], size, mode="bilinear", align_corners=False, antialias=True)[0]
    return small, resize_intrinsics(K[None], (height, width), size)[0]


def prepare_evidence(
    left_01: Tensor,
    right_01: Tensor,
    K_left: Tensor,
    K_right: Tensor,
    T_right_from_left: Tensor,
    *,
    loss_resolution: int,
    depth_range: tuple[float, float] | None,
    needs_volume: bool,
    needs_matches: bool,
) -> Evidence:
    """Bring both views to the loss grid and let them speak for themselves.

    Args:
        left_01: ``(3, H, W)`` float32 in [0, 1], native size.
        right_01: ``(3, Hr, Wr)``, native size, any other.
        K_left: ``(3, 3)`` pixels of the native left image.
        K_right: ``(3, 3)`` pixels of the native right image.
        T_right_from_left: ``(4, 4)`` metres.
        loss_resolution: pixels, bound of the longer side of the loss grid.
        depth_range: ``(near, far)`` metres that the sweep spans, or ``None`` for its default.
        needs_volume: build the cost volume.
        needs_matches: aggregate and check it.
    """
    left, K_loss = resize_long_edge(left_01, K_left, loss_resolution)
    # The right view is brought to the same pixels per radian, so that neither aliases in the other.
    ratio = float(K_loss[0, 0] / K_right[0, 0])
    long_edge = round(max(right_01.shape[-2:]) * min(1.0, ratio))
    right, K_right_loss = resize_long_edge(right_01, K_right, long_edge)
    volume, found, matches, warning = None, None, None, ""
    if needs_volume or needs_matches:
        # The sweep chooses its own grid, finer than that of the losses for wide images.
        rights = [(right_01, K_right, T_right_from_left)]
        volume = build_cost_volume(left_01, rights, K_left, depth_range=depth_range)
        if mirrored_pose_preferred(left_01, rights, K_left).preferred:
            warning = SWAPPED
    if needs_matches:
        found = find_matches(left_01, rights, K_left, volume=volume)
        matches = _on_grid(found, left, K_loss)
    return Evidence(left, right, K_loss, K_right_loss, T_right_from_left, volume, matches, found, warning)


def _on_grid(matches: Matches, left_01: Tensor, K_left: Tensor) -> Matches:
    """Matches of the sweep's grid on that of the losses."""
    size = (left_01.shape[-2], left_01.shape[-1])
    if matches.size == size:
        return matches
    # Nearest: a mean of two inverse depths across an edge is the depth of neither surface.
    maps = (
        F.interpolate(m[None], size, mode="nearest")[0] for m in (matches.inverse_depth, matches.confidence)
    )
    return Matches(*maps, matches.plane_step, K_left, size)


def chunk_views(evidence: Sequence[Evidence], owners: Sequence[int]) -> Views:
    """Stack the views of a chunk of samples.

    Args:
        evidence: one entry per image.
        owners: for every sample of the chunk the image that it belongs to.

    Returns:
        Views with ``B = len(owners)``. Right images of different sizes are brought to the largest one,
        their K with them.
    """
    own = [evidence[i] for i in owners]
    height = max(e.right_01.shape[-2] for e in own)
    width = max(e.right_01.shape[-1] for e in own)
    rights, K_rights = [], []
    for e in own:
        image, K, size = e.right_01[None], e.K_right[None], tuple(e.right_01.shape[-2:])
        if size != (height, width):
            image = F.interpolate(image, (height, width), mode="bilinear", align_corners=False)
            K = resize_intrinsics(K, size, (height, width))
        rights.append(image)
        K_rights.append(K)
    left = torch.stack([e.left_01 for e in own])
    K_left, K_right = torch.stack([e.K_left for e in own]), torch.cat(K_rights)
    T = torch.stack([e.T_right_from_left for e in own])
    rays = plane_rays(K_left, K_right, T, (left.shape[-2], left.shape[-1]))
    return Views(left, torch.cat(rights), K_left, K_right, T, rays)
