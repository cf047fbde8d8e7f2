"""Detects swapped images and inverted poses from the matches.

Data flow: images, K's, T's -> whether the inverse pose matches more of the image.
Paper: none; a check of the user's input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from kornia.geometry.linalg import inverse_transformation

from geodiff_plugin.matching.build import pilot_volume
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.types import CameraView

__all__ = ["PoseCheck", "mirrored_pose_preferred"]

# Pixels of the sweeps.
_PIXELS = 15_000
# The inverse pose must match this many times as much of the image.
_CLEARLY = 1.25
# A pose that matches this much of the image is not a wrong one: the inverse need not be asked.
_PLAINLY = 0.4


@dataclass(frozen=True)
class PoseCheck:
    """How much of the image each pose matches.

    Attributes:
        preferred: whether the inverse pose does clearly better.
        given: mean confidence with the pose as given, [0, 1]: of a coarse sweep, or of the matches.
        inverse: that of a coarse sweep with the inverse pose; ``None`` where it was not asked.
    """

    preferred: bool
    given: float
    inverse: float | None


@torch.no_grad()
def mirrored_pose_preferred(
    left_01: torch.Tensor,
    rights: Sequence[CameraView],
    K_left: torch.Tensor,
    matches: Matches | None = None,
) -> PoseCheck:
    """Compare the pose as given with its inverse.

    The inverse is the pose that is true when the two images were swapped, and when a world-to-camera pose was
    given for a camera-to-world one. For a rectified pair it is the baseline with the other sign.

    Args:
        left_01: ``(3, H, W)`` float in [0, 1].
        rights: as for ``build_cost_volume``.
        K_left: ``(3, 3)`` pixels of ``left_01``.
        matches: what ``find_matches`` gave for the pose as given, if it was called already.

    Returns:
        ``PoseCheck``; two coarse sweeps, or none where the matches leave no doubt.
    """
    if matches is not None and (found := float(matches.confidence.mean())) > _PLAINLY:
        return PoseCheck(False, found, None)

    def confidence(views: Sequence[CameraView]) -> float:
        return float(match_volume(pilot_volume(left_01, views, K_left, _PIXELS)).confidence.mean())

    given = confidence(rights)
    try:
        turned = confidence(
            [CameraView(image, K_right, inverse_transformation(T)) for image, K_right, T in rights]
        )
    except ValueError:  # under the inverse pose the views do not overlap, so it is not the true one
        turned = 0.0
    return PoseCheck(turned > _CLEARLY * given, given, turned)
