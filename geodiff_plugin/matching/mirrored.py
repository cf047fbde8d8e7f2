"""Are left and right swapped, or is the pose the wrong way round? The views themselves tell.

Hop: images, K's, T's -> whether the inverse pose matches more of the image.
Paper: none; a check of the user's input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from geodiff_plugin.geometry import invert_rigid
from geodiff_plugin.matching.build import pilot_volume
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.matching.plane_sweep import RightView

__all__ = ["PoseCheck", "mirrored_pose_preferred"]

# Pixels of the sweeps.
_PIXELS = 15_000
# The inverse pose must match this many times as much of the image.
_CLEARLY = 1.25


@dataclass(frozen=True)
class PoseCheck:
    """How much of the image each pose matches.

    Attributes:
        preferred: whether the inverse pose does clearly better.
        given: mean confidence of a coarse sweep with the pose as given, [0, 1].
        inverse: the same with the inverse pose.
    """

    preferred: bool
    given: float
    inverse: float


@torch.no_grad()
def mirrored_pose_preferred(
    left_01: torch.Tensor, rights: Sequence[RightView], K_left: torch.Tensor
) -> PoseCheck:
    """Compare the pose as given with its inverse.

    The inverse is the pose that is true when the two images were swapped, and when a world-to-camera pose was
    given for a camera-to-world one. For a rectified pair it is the baseline with the other sign.

    Args:
        left_01: ``(3, H, W)`` float in [0, 1].
        rights: as for ``build_cost_volume``.
        K_left: ``(3, 3)`` pixels of ``left_01``.

    Returns:
        ``PoseCheck``; two coarse sweeps, a fraction of a second.
    """

    def confidence(views: Sequence[RightView]) -> float:
        return float(match_volume(pilot_volume(left_01, views, K_left, _PIXELS)).confidence.mean())

    given = confidence(rights)
    try:
        turned = confidence([(image, K_right, invert_rigid(T)) for image, K_right, T in rights])
    except ValueError:  # under the inverse pose the views do not overlap, so it is not the true one
        turned = 0.0
    return PoseCheck(turned > _CLEARLY * given, given, turned)
