"""Cleans an image and its right views, and checks and refines their poses, once per call.

Data flow: photographs as given -> photographs to match with; right views as given -> ``pose.refine`` with a
    first depth of a coarse sweep -> right views and report.
Paper: none; it takes exact poses for granted (S3.3).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.matching import clean
from geodiff_plugin.matching.build import pilot_volume
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.pose.refine import refine_views, untouched
from geodiff_plugin.types import CameraView, PoseReport

__all__ = ["cleaned", "cleaned_views", "coarse_depth", "pose_views"]

#: Windows that spread sure matches into holes, pixels of the coarse sweep; a wider one counts a hundredth.
_WINDOWS = (3, 7, 15, 31, 63)
_FARTHEST = 1e-3


def cleaned(image_01: Tensor, config: GuidanceConfig) -> Tensor:
    """A photograph ``(3, H, W)`` in [0, 1] of native size, as the knob ``clean_photographs`` says."""
    return clean(image_01, config.sweep_pixels) if config.clean_photographs else image_01


def cleaned_views(
    left_01: Tensor, rights: Sequence[CameraView], config: GuidanceConfig
) -> tuple[Tensor, list[CameraView]]:
    """The left image and the right views, ``cleaned``, to be compared.

    Args:
        left_01: ``(3, H, W)`` float32 in [0, 1], native size.
        rights: as the user gave them.
        config: whether they are cleaned, and the grid of the sweep.
    """
    return cleaned(left_01, config), [
        view._replace(image_01=cleaned(view.image_01, config)) for view in rights
    ]


def pose_views(
    left_01: Tensor,
    rights: Sequence[CameraView],
    K_left: Tensor,
    config: GuidanceConfig = DEFAULT,
    unit: str | None = "m",
    measured: bool = False,
) -> tuple[tuple[CameraView, ...], PoseReport]:
    """The right views with the poses of the knob ``pose``, and the report on them.

    Args:
        left_01: ``(3, H, W)`` float32 in [0, 1], native size.
        rights: as the user gave them.
        K_left: ``(3, 3)`` pixels of ``left_01``.
        config: whether they are refined.
        unit: of the poses' lengths, ``"m"`` or ``None``.
        measured: whether the lengths of the baselines are measured; see ``Rig``.
    """
    if config.pose == "given":
        return untouched(rights)
    return refine_views(
        left_01, rights, K_left, lambda posed: coarse_depth(left_01, posed, K_left), unit, measured
    )


def coarse_depth(left_01: Tensor, rights: Sequence[CameraView], K_left: Tensor) -> Tensor:
    """A rough, smooth depth without holes, ``(1, 1, h, w)`` metres: a coarse sweep, its sure matches spread.

    Args:
        left_01: ``(3, H, W)`` float32 in [0, 1].
        rights: with poses that fit roughly.
        K_left: ``(3, 3)`` pixels of ``left_01``.
    """
    matches = match_volume(pilot_volume(left_01, rights, K_left))
    weight = matches.confidence[None] ** 2 + 1e-9
    values = matches.inverse_depth[None] * weight
    above, below = values.clone(), weight.clone()
    for i, window in enumerate(_WINDOWS):
        share = 100.0 ** -(i + 1)
        above += share * F.avg_pool2d(values, window, 1, window // 2, count_include_pad=False)
        below += share * F.avg_pool2d(weight, window, 1, window // 2, count_include_pad=False)
    inverse = F.avg_pool2d(above / below, 5, 1, 2, count_include_pad=False)
    return 1.0 / inverse.clamp_min(_FARTHEST * float(inverse.max()))
