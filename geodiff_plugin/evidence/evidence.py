"""``Evidence``: cost volume, matches and points of a left image, made once a call; views of a chunk.

Matches, corrections and losses lie on one grid of at most ``sweep_pixels``; the result has the image's size.
Source: S7.3 (the plane-sweep view of the g_s search); the matches are beyond it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

import geodiff_plugin.matching as matching
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.geometry import PlaneRays, image_size, plane_rays, resize_image
from geodiff_plugin.matching import CostVolume, Matches
from geodiff_plugin.messages import Message, distinct
from geodiff_plugin.pose.mistakes import INVERSE
from geodiff_plugin.scale.points import RELIABLE, reliable_matches
from geodiff_plugin.types import CameraView, PoseReport


@dataclass(frozen=True)
class Evidence:
    """What the views and points tell about depth before any diffusion step, on the grid of the evidence."""

    left_01: Tensor  # (3, H, W) in [0, 1]
    native_left: Tensor  # the same at its native size
    K_left: Tensor  # (3, 3) pixels of ``left_01``
    views: tuple[CameraView, ...]  # at as many pixels per radian; none where only points are known
    volume: CostVolume | None  # where the configuration searches it
    matches: Matches | None  # aggregated, left-right checked, where a term asks
    points: Matches | None = None  # depths that the user knows, in the form of matches
    reliable: Matches | None = None  # ``matches`` as points for the search, where enough are reliable
    native_views: tuple[CameraView, ...] = ()  # cleaned, with the poses in use, at their native sizes
    pose: PoseReport | None = None  # how their poses fit
    warnings: tuple[Message, ...] = ()


def within(evidence: Evidence, valid: Tensor) -> Evidence:
    """Evidence with confidence 0 where the prior is not ``valid``, on any grid; points stay if none is."""
    matches, points = (m and m.within(valid) for m in (evidence.matches, evidence.points))
    if points is not None and not bool(points.confidence.any()):
        points = evidence.points
    reliable = None if matches is None else reliable_matches(matches)
    return replace(evidence, matches=matches, points=points, reliable=reliable)


def prepare_evidence(
    left_01: Tensor,
    views: Sequence[CameraView],
    K_left: Tensor,
    points: Tensor | None,
    config: GuidanceConfig,
    needs_matches: bool,
    pose: PoseReport | None = None,
) -> Evidence:
    """Cost volume, matches and points of one image; left image, views and ``K_left`` are native.

    ``needs_matches``: the volume is aggregated and checked against each view. ``pose`` reports how the poses
    fit and whether they were refined.
    """
    left, further, K = matching.to_grid(left_01, views, K_left, config.sweep_pixels)
    volume, matches, known_points = None, None, None
    warnings: list[Message] = [] if pose is None else list(pose.warnings)
    if views and (config.search == "volume" or needs_matches):
        pair = left_01, views, K_left
        volume = matching.build_cost_volume(*pair, depth_range=config.depth_range, config=config)
        if needs_matches:
            matches = matching.match_volume(volume)
        if matching.inverse_pose_preferred(*pair, matches):
            warnings.append(INVERSE)
    if points is not None:
        sizes = image_size(left_01), image_size(left)
        known_points, left_out = matching.points_to_matches(points, K_left, *sizes)
        if left_out:
            sentence = f"{left_out} points outside the left image are left out: is their frame right?"
            warnings.append(Message("points.outside", sentence))
    reliable = None if matches is None else reliable_matches(matches)
    # Read back from the device now, so that no step waits for it.
    if volume is not None:
        _ = volume.reach_m, volume.rectified
    for target in (matches, known_points, reliable):
        if target is not None:
            _ = target.above(0.0), target.above(RELIABLE)
    depths = volume, matches, known_points, reliable
    # Two checks may find the same mistake.
    return Evidence(left, left_01, K, further, *depths, tuple(views), pose, distinct(warnings))


@dataclass(frozen=True)
class Views:
    """Images and cameras of every sample of a chunk, on the grid of the evidence.

    ``left_01 (B, 3, H, W)``, ``K_left (B, 3, 3)``; ``further`` are the right views, with a batch
    axis on each tensor, as many for every sample; ``rays`` are those of each, made once a chunk.
    """

    left_01: Tensor
    K_left: Tensor
    further: tuple[CameraView, ...]
    rays: tuple[PlaneRays, ...]

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the grid."""
        return image_size(self.left_01)


def chunk_views(evidence: Sequence[Evidence]) -> Views:
    """Stack the views of a chunk of samples, one entry each, images and K of one size.

    An image with fewer views than another repeats its first one: the terms take the best view of each pixel,
    so repetition changes nothing.
    """
    left = torch.stack([image.left_01 for image in evidence])
    K_left = torch.stack([image.K_left for image in evidence])
    further = []
    for v in range(max(len(image.views) for image in evidence)):
        views = [image.views[v if v < len(image.views) else 0] for image in evidence]
        height, width = (max(view.image_01.shape[axis] for view in views) for axis in (-2, -1))
        sized = [CameraView(*resize_image(image, K, (height, width)), T) for image, K, T in views]
        further.append(CameraView(*map(torch.stack, zip(*sized, strict=True))))
    rays = tuple(plane_rays(K_left, K, T, image_size(left)) for _, K, T in further)
    return Views(left, K_left, tuple(further), rays)
